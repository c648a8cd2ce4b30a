"""Noise, background and gain that are learned, and targets decided on by them, against images of known noise."""

import numpy as np
import pytest
from disc_images import FINE, errors, fine_image, frame, pixels
from scipy import stats

from mosca.detection.detect import NO_STATISTICS, DetectionSettings, detect, detect_with_statistics, mean_background
from mosca.detection.local_background import measure_background
from mosca.detection.pixel_noise import gain_of
from mosca.errors import InputError

H, W = 491, 656
Y, X = np.mgrid[:H, :W].astype(float)


def sensed(rng, light_e, gain, read_dn, depth=8):
    """What a sensor makes of expected electrons (EMVA 1288): Poisson, gain, dark noise of a normal law, rounding."""
    values = rng.poisson(light_e) * gain + rng.normal(0, read_dn, light_e.shape)
    return np.clip(np.rint(values), 0, 2**depth - 1).astype(np.uint8 if depth == 8 else np.uint16)


def scene(rng, diameter, amplitude, floor, gain, read_dn, depth=8, blur=0.6):
    """Image and places of some 100 discs on a floor (H, W) [DN]."""
    disc = fine_image(diameter, blur)
    side = len(disc) // FINE
    step = side + 6
    light, truth = floor.copy(), []
    for y in range(6, H - side - 6, max(step, 40)):
        for x in range(6, W - side - 6, max(step, 40)):
            ix, iy = rng.integers(-FINE // 2, FINE // 2, 2)
            light[y : y + side, x : x + side] += amplitude * pixels(disc, ix, iy).clip(0)
            truth.append((x + side // 2 + ix / FINE, y + side // 2 + iy / FINE))
    return sensed(rng, light / gain, gain, read_dn, depth), np.array(truth)


# ---------------------------------------------------------------- background and noise


@pytest.mark.parametrize("slope", [0.0, 0.05])
@pytest.mark.parametrize(("read_dn", "gain"), [(0.7, 0.02), (3.0, 0.02), (1.0, 0.5)])
def test_background_and_noise_of_a_sloping_floor(slope, read_dn, gain):
    floor = 30.0 + slope * X + 0.6 * slope * Y
    image, truth = scene(np.random.default_rng(1), 6.3, 80.0, floor, gain, read_dn)
    assert len(truth) > 150
    found = measure_background(image, 40.0)
    rows, columns = found.level.shape
    y, x = ((np.arange(n) + 0.5) * size / n - 0.5 for n, size in ((rows, H), (columns, W)))
    true_level = 30.0 + slope * x + 0.6 * slope * y[:, None]
    true_variance = read_dn**2 + gain * true_level + 1 / 12
    # 130 samples a cell; the targets' skirts raise levels by a small share of the noise
    np.testing.assert_allclose(found.level, true_level, atol=0.5 * np.sqrt(true_variance.max()))
    np.testing.assert_allclose(found.variance / true_variance, 1.0, atol=0.45)
    assert np.median(found.variance / true_variance) == pytest.approx(1.0, abs=0.12)
    limits = found.limits(4.0, image.shape, image.dtype)
    true_limits = floor + 4.0 * np.sqrt(read_dn**2 + gain * floor + 1 / 12)
    assert np.abs(limits - true_limits).max() < 1.5 + 1.2 * np.sqrt(true_variance.max())


def test_texture_of_the_floor_is_told_apart_from_noise():
    # waves of 8 px and an amplitude of 5 DN: their variance is 12.5 DN^2, and no target is found in them
    floor = 40.0 + 5.0 * np.sin(2 * np.pi * X / 8) * np.ones_like(Y)
    image = sensed(np.random.default_rng(2), floor / 0.02, 0.02, 0.5)
    assert np.median(measure_background(image, 40.0).texture) == pytest.approx(12.5, rel=0.6)
    assert len(detect(image, "a")) == 0
    even = sensed(np.random.default_rng(2), np.full((H, W), 40.0 / 0.02), 0.02, 0.5)
    assert measure_background(even, 40.0).texture.max() == 0.0


def test_noise_below_a_subtracted_background_counts():
    rng = np.random.default_rng(3)
    floor = np.full((H, W), 20.0)
    dark = mean_background([sensed(rng, floor / 0.02, 0.02, 3.0) for _ in range(30)])
    image = sensed(rng, floor / 0.02, 0.02, 3.0)
    assert len(detect(image, "a", DetectionSettings(minimum_size_px=0), background=dark)) == 0
    # the control: measured in what is left of the noise after the subtraction
    left = np.maximum(image.astype(int) - dark, 0).astype(np.uint8)
    assert measure_background(left, 40.0).variance.max() < 0.5 * (9.0 + 0.4)


# ---------------------------------------------------------------- gain


@pytest.mark.parametrize(("contrast", "snr", "blur"), [(200, 30, 0.6), (200, 100, 0.8), (100, 30, 0.9)])
def test_gain_is_learned_by_photon_transfer(contrast, snr, blur):
    rng, learned = np.random.default_rng(5), NO_STATISTICS
    for diameter in (4.5, 8.3, 14.5, 8.3):
        image, _, gain = frame(rng, diameter, blur, contrast, snr)
        learned = learned.plus(detect_with_statistics([image], ["a"], statistics=learned)[1])
    dark = float(np.median(learned.backgrounds["a"].variance))
    found, sigma = gain_of(learned.sums, 0, dark)
    assert found == pytest.approx(gain, rel=0.15)
    assert sigma < 0.1 * gain


def limb(diameter, blur):
    """A Lambert ball lit from the camera, brightness sqrt(1 - rho^2): discs of all diameters on top of each other."""
    rho = (np.arange(24) + 0.5) / 24
    step = np.diff(np.sqrt(1 - (np.arange(25) / 24) ** 2))
    return sum(-s * fine_image(diameter * r, blur, across=int(diameter) + 14) for r, s in zip(rho, step, strict=True))


def smeared(diameter, blur, length):
    """A disc that moves evenly by ``length`` [px] while the shutter is open, at 30 degrees to the rows."""
    disc = fine_image(diameter, blur, across=int(diameter) + 14)
    along = np.linspace(-0.5, 0.5, 49) * length * FINE
    return sum(np.roll(disc, (round(0.5 * a), round(0.866 * a)), (0, 1)) for a in along) / len(along)


def taken(rng, profile, gain, hide=1.0):
    """An image of the profile at many places, and these [px]; ``hide``: how much of its right half is seen."""
    side, light, truth = len(profile) // FINE, np.full((H, W), 4.0), []
    for y in range(4, H - side - 4, side + 4):
        for x in range(4, W - side - 4, side + 4):
            ix, iy = rng.integers(-FINE // 2, FINE // 2, 2)
            shape = pixels(profile, ix, iy).clip(0)
            shape[:, side // 2 + 1 :] *= hide
            light[y : y + side, x : x + side] += 150.0 * shape
            truth.append((x + side // 2 + ix / FINE, y + side // 2 + iy / FINE))
    return sensed(rng, light / gain, gain, 0.7), np.array(truth)


SYMMETRIC = {
    "ball": lambda: limb(12.0, 0.5),
    "defocus": lambda: fine_image(8.3, 0.5, circle=5.0),
    "large": lambda: limb(30.0, 0.5),
    "motion": lambda: smeared(8.3, 0.5, 6.0),
}


@pytest.mark.parametrize("name", SYMMETRIC)
def test_what_a_symmetric_image_has_that_no_disc_has_is_no_noise(name):
    rng, learned, gain = np.random.default_rng(3), NO_STATISTICS, 0.05
    profile = SYMMETRIC[name]()
    for _ in range(4):
        image, truth = taken(rng, profile, gain)
        (seen,), new = detect_with_statistics([image], ["a"], statistics=learned)
        learned = learned.plus(new)
    found, sigma = gain_of(learned.sums, 0, float(np.median(learned.backgrounds["a"].variance)))
    # the residuals themselves give 8 to 25 times as much; edges that are smeared along one direction leave a fifth
    assert 0.8 < found / gain < (1.4 if name == "motion" else 1.2)
    assert sigma < 0.15 * gain
    error, variance = errors(seen, truth)
    # scaled by all of chi-square the motion's variances were 4 times as large; a disc fits large limbs so badly that
    # its place errs by more than the noise that goes with its slopes
    assert 0.6 < np.mean(error**2 / variance) < (2.3 if name == "large" else 1.3)


def test_what_is_not_symmetric_makes_a_place_uncertain():
    """The control: with half of the light of the right side, places are off by more than noise, and said to be."""
    rng, learned = np.random.default_rng(3), NO_STATISTICS
    for hide in (1.0, 1.0, 0.75):
        image, truth = taken(rng, fine_image(8.3, 0.5), 0.05, hide)
        (seen,), new = detect_with_statistics([image], ["a"], statistics=learned)
        learned = learned.plus(new)
    off = np.linalg.norm(seen.xy_px[:, None] - truth, axis=2).min(axis=1)
    stated = np.sqrt(np.trace(seen.covariance_px2, axis1=1, axis2=2))
    assert np.median(off) > 0.03
    assert np.median(stated) > 2.5 * 0.006


def test_stated_errors_hold_with_a_sensor_that_nobody_told():
    for contrast, snr in ((200, 30), (60, 20)):
        chi2 = []
        for seed in range(4):
            rng, learned = np.random.default_rng(seed), NO_STATISTICS
            for _ in range(3):
                image, truth, _ = frame(rng, 6.3, 0.7, contrast, snr)
                found, new = detect_with_statistics([image], ["a"], statistics=learned)
                learned = learned.plus(new)
            error, variance = errors(found[0], truth)
            chi2.append(np.mean(error**2 / variance))
        # one image's has a standard deviation of 0.08
        assert np.mean(chi2) == pytest.approx(1.0, abs=0.2)


# ---------------------------------------------------------------- decision


@pytest.mark.parametrize(("read_dn", "depth"), [(6.0, 8), (20.0, 12), (300.0, 16)])
def test_noise_alone_makes_targets_at_the_stated_rate(read_dn, depth):
    rng = np.random.default_rng(11)
    settings = DetectionSettings(false_alarms=1.0, minimum_size_px=0)
    level = np.full((H, W), 10.0 * read_dn)
    images = [
        np.clip(np.rint(rng.normal(level, read_dn)), 0, 2**depth - 1).astype(np.uint8 if depth == 8 else np.uint16)
        for _ in range(20)
    ]
    n = sum(len(detect(image, "a", settings, depth)) for image in images)
    # 20 expected; Poisson, and a noise that is known to 3 % (a factor of 1.9 at 4.6 sigma)
    assert stats.poisson.ppf(0.001, 20 / 2) <= n <= stats.poisson.ppf(0.999, 20 * 2)
    told = DetectionSettings(false_alarms=1.0, minimum_size_px=0, read_noise_dn=0.8 * read_dn / 2 ** (depth - 8))
    assert sum(len(detect(image, "a", told, depth)) for image in images[:4]) > 5 * 4


FLOORS = {
    "dark": 3.0 + 0 * X,
    "bright": 120.0 + 0 * X,
    "uneven": 20 + 60 * np.exp(-((X - 300) ** 2 + (Y - 200) ** 2) / 2e4),
}


@pytest.mark.parametrize("floor", FLOORS)
@pytest.mark.parametrize(
    ("diameter", "amplitude", "gain", "read_dn", "depth"),
    [
        (3.3, 12.0, 0.02, 0.7, 8),
        (6.3, 8.0, 0.02, 0.3, 8),
        (2.2, 100.0, 0.0128, 0.13, 8),
        (14.5, 130.0, 0.05, 0.7, 8),
        (38.3, 100.0, 0.02, 0.5, 8),
        (4.5, 1500.0, 0.3, 5.0, 12),
    ],
)
def test_one_set_of_defaults_finds_all_targets_and_nothing_else(floor, diameter, amplitude, gain, read_dn, depth):
    """Peaks from ten times the floor's noise on; a floor that bends may show one part of itself as a target."""
    level = FLOORS[floor] * 2 ** (depth - 8)
    amplitude = max(amplitude, 10 * np.sqrt(read_dn**2 + gain * level.max() + 1 / 12))
    image, truth = scene(np.random.default_rng(13), diameter, amplitude, level, gain, read_dn, depth)
    found = detect(image, "a", DetectionSettings(), depth)
    off = np.linalg.norm(found.xy_px[:, None] - truth[None], axis=2)
    assert off.min(axis=0).max() < 0.5
    assert len(truth) <= len(found) <= len(truth) + (floor == "uneven")


def test_a_faint_target_is_left_out_by_the_noise_alone():
    """The control: an amplitude of three times the noise is no target."""
    image, truth = scene(np.random.default_rng(17), 2.2, 4.0, FLOORS["dark"], 0.02, 2.0)
    assert len(truth) > 100
    assert len(detect(image, "a")) < 0.05 * len(truth)


def test_bright_targets_are_not_parted_by_their_noise_and_close_ones_are():
    rng = np.random.default_rng(19)
    image, truth = scene(rng, 25.3, 200.0, FLOORS["dark"], 0.8, 0.5)  # 250 electrons at the brightest
    assert len(detect(image, "a")) == len(truth)
    disc = fine_image(5.3, 0.6)
    side = len(disc) // FINE
    light = np.full((60, 80), 3.0)
    for x in (20, 28):
        light[20 : 20 + side, x : x + side] += 150 * pixels(disc, 0, 0).clip(0)
    assert len(detect(sensed(rng, light / 0.0128, 0.0128, 0.13), "a")) == 2


def test_a_threshold_of_the_paper_needs_its_rule():
    with pytest.raises(
        InputError, match="contrast_dn 10 given; it is a threshold of the paper's: add thresholds = 'paper'"
    ):
        DetectionSettings(contrast_dn=10.0)
    assert DetectionSettings(contrast_dn=10.0, thresholds="paper").contrast_dn == 10.0


def test_a_target_whose_image_is_no_disc_states_its_misfit():
    """Each second one is 15 % darker on its right side: too little to be rejected, five times the noise."""
    rng, learned = np.random.default_rng(23), NO_STATISTICS
    for _ in range(2):
        image, truth, _ = frame(rng, 8.3, 0.7, 150, 50)
        found, new = detect_with_statistics([image], ["a"], statistics=learned)
        learned = learned.plus(new)
    whole = np.median(found[0].covariance_px2[:, 0, 0])
    for x, y in truth[::2]:
        rows, columns = slice(int(y) - 8, int(y) + 9), slice(int(x) + 1, int(x) + 9)
        image[rows, columns] = np.rint(4.0 + 0.85 * (image[rows, columns] - 4.0).clip(0)).astype(np.uint8)
    (after,), _ = detect_with_statistics([image], ["a"], statistics=learned)
    nearest = np.linalg.norm(after.xy_px[:, None] - truth[None], axis=2).argmin(axis=1)
    shaded, variance = nearest % 2 == 0, after.covariance_px2[:, 0, 0]
    assert not after.flags.any()
    assert np.median(variance[shaded]) > 3 * whole
    assert np.median(variance[~shaded]) == pytest.approx(whole, rel=0.1)


@pytest.mark.parametrize("shape", [(1, 1), (1, 700), (700, 1), (3, 5)])
def test_an_image_of_one_row_has_a_background(shape):
    found = measure_background(np.full(shape, 7, np.uint8), 40.0)
    np.testing.assert_allclose(found.level, 7.0, rtol=1e-12)
    np.testing.assert_array_equal(found.limits(4.0, shape, np.dtype(np.uint8)), 8)
