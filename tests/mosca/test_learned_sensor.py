"""What is told of a sensor and of what was left out, against synthetic images of known gain, noise and faults."""

from dataclasses import replace

import numpy as np
import pytest
from disc_images import FINE, fine_image, pixels
from scipy import stats

from mosca.data.frames import CameraInfo, Frame, FrameSet
from mosca.detection.detect import NO_STATISTICS, DetectionSettings, detect_with_statistics
from mosca.detection.local_background import measure_background
from mosca.diagnostics.sensor import (
    FEWEST_BLOCKS,
    LEAST_NOISE_DN,
    MOST_BLOCKS,
    LearnedSensor,
    Sensors,
    background_figures,
    gain_estimate,
    left_out_line,
    noise_estimate,
    sensor_line,
)

H, W = 240, 320
LEVEL, GAIN, READ = 20.0, 0.05, 1.0


def image(rng, discs, gain=GAIN, read=READ, depth=8, single=()):
    """Discs (x, y, diameter, amplitude [DN]) on an even floor: Poisson electrons, gain, dark noise, rounding."""
    light = np.full((H, W), LEVEL)
    for x, y, diameter, amplitude in discs:
        shape = fine_image(diameter, 0.6)
        side = len(shape) // FINE
        own = np.zeros((H + 2 * side, W + 2 * side))
        left, top = x + side - side // 2, y + side - side // 2
        own[top : top + side, left : left + side] = amplitude * pixels(shape, *rng.integers(-8, 8, 2)).clip(0)
        light += own[side : side + H, side : side + W]
    values = rng.poisson(light / gain) * gain + rng.normal(0, read, light.shape)
    for x, y in single:
        values[y, x] = 200.0
    return np.clip(np.rint(values), 0, 2**depth - 1).astype(np.uint8 if depth == 8 else np.uint16)


def seen(pixels):
    return FrameSet(0, 0, {"cam": Frame("cam", 0, 0, 1_000_000, pixels)})


def told(images, depth=8, settings=None):
    """What is told after these images of one camera."""
    settings = settings or DetectionSettings()
    sensors, learned = Sensors([CameraInfo("cam", W, H, depth, 100.0)], settings), NO_STATISTICS
    for one in images:
        found, new = detect_with_statistics([one], ["cam"], settings, depth, statistics=learned)
        learned = learned.plus(new)
        sensors.attend(seen(one), {"cam": found[0]}, new)
    return sensors


GRID = [(20 + 40 * i, 20 + 40 * k, 6.3, 120.0) for i in range(7) for k in range(5)]


# ---------------------------------------------------------------- figures and intervals


def test_intervals_cover_gain_and_noise_of_a_known_sensor():
    noise = np.sqrt(READ**2 + GAIN * LEVEL)  # EMVA 1288: dark noise, photons of the background
    covered, off, width = [], [], []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        (one,) = told([image(rng, GRID) for _ in range(8)]).cameras()
        gain, dark = one.gain_dn_per_e, one.noise_dn
        covered.append((gain.low <= GAIN <= gain.high, dark.low <= noise <= dark.high))
        off.append(gain.value / GAIN - 1)
        width.append((gain.high - gain.low) / GAIN)
        assert (dark.high - dark.low) / noise < 0.3
        assert one.images == 8
        assert one.found == 8 * len(GRID)
    # of 40 a fair 95 % miss more than 6 once in 700
    assert np.sum(covered, axis=0).min() >= 34
    assert abs(np.mean(off)) < 0.04
    assert min(width) > 0.1
    assert np.median(width) < 1.1  # 0.6 where PRNU is known to be 0


def transfer_sums(w, s, q, r):
    """Sums of photon transfer over the last axis: w s s, s q, s u, q q, q u, u u, s r, q r, u r with u = s^2."""
    u = s * s
    pairs = ((s, s), (s, q), (s, u), (q, q), (q, u), (u, u), (s, r), (q, r), (u, r))
    return np.stack([(w * a * b).sum(axis=-1) for a, b in pairs], axis=-1)


def of_residuals(seed, uneven):
    """Gains of 300 experiments and their intervals over the true gain: variances of 1 + gain s + (uneven s)^2."""
    rng, found = np.random.default_rng(seed), []
    for _ in range(300):
        s, q = rng.uniform(1, 100, (12, 600)), rng.uniform(0, 3000, (12, 600))
        variance = 1.0 + GAIN * s + (uneven * s) ** 2
        r = variance * rng.chisquare(1, s.shape) - 1.0
        found.append(gain_estimate(transfer_sums(0.5 / variance**2, s, q, r)))
    value, low, high = np.array([(one.value, one.low, one.high) for one in found]).T / GAIN
    return value, low, high


@pytest.mark.parametrize("uneven", [0.0, 0.005, 0.01, 0.03])
@pytest.mark.parametrize("seed", [1, 2])
def test_residuals_alone_give_the_gain_and_how_certain_it_is(seed, uneven):
    value, low, high = of_residuals(seed, uneven)
    assert ((low <= 1) & (high >= 1)).mean() == pytest.approx(0.96, abs=0.035)
    assert abs(value.mean() - 1) < 0.04
    # half an interval is 2.23 (Student, 10 degrees) or 1.96 standard deviations, and wider where a PRNU of 1 % might
    # have been
    assert 0.8 / (2 * 2.15) < np.std((value - 1) / (high - low)) < 1.15 / (2 * 2.15)


def test_uneven_response_is_no_gain(monkeypatch):
    # control: as long as differences between pixels count as photon noise the interval misses the gain
    monkeypatch.setattr("mosca.diagnostics.sensor.UNEVEN", 1e-7)
    value, low, _ = of_residuals(1, 0.01)
    assert value.mean() > 1.05
    assert (low <= 1).mean() < 0.9


def test_what_a_frame_set_has_in_common_widens_the_interval():
    # the blocks' residuals are off together, by 30 %: many pixels are no independent witnesses
    rng, hits, naive = np.random.default_rng(3), 0, 0
    for _ in range(200):
        s = rng.uniform(20, 100, (20, 1600))
        r = GAIN * s * rng.normal(1.0, 0.3, (20, 1)) * rng.chisquare(1, s.shape)
        blocks = transfer_sums(0.5 / (GAIN * s) ** 2, s, np.abs(rng.normal(size=s.shape)), r)
        several, one = gain_estimate(blocks), gain_estimate(blocks[: FEWEST_BLOCKS - 1])
        hits += several.low <= GAIN <= several.high
        naive += one.low <= GAIN <= one.high
    assert hits / 200 > 0.9
    assert naive / 200 < 0.7


def test_a_gain_below_zero_is_none():
    # residuals that fall where the signal rises: the discs do not fit
    s, q = np.linspace(1, 100, 50), np.linspace(0, 30, 50)[::-1]
    assert gain_estimate(np.tile(transfer_sums(1.0, s, q, 50 * q - 0.1 * s), (20, 1))) is None
    assert gain_estimate(np.zeros((20, 9))) is None


def test_blocks_are_joined_and_lose_nothing():
    rng = np.random.default_rng(4)
    shown = image(rng, GRID[:3])
    found, new = detect_with_statistics([shown], ["cam"])
    n = 3 * MOST_BLOCKS + 5
    sensors = Sensors([CameraInfo("cam", W, H, 8, 100.0)])
    for _ in range(n):
        sensors.attend(seen(shown), {"cam": found[0]}, new)
    (many,) = sensors.cameras()
    (one,) = told([image(np.random.default_rng(4), GRID[:3])]).cameras()
    assert (many.images, many.found, many.residuals) == (n, 3 * n, n * one.residuals)
    assert many.blur_px.value == pytest.approx(one.blur_px.value)


def test_noise_that_rounding_hides_is_a_bound():
    for level in (20.0, 20.5):  # on a grey value, and between two: then rounding alone makes 1/4 DN^2
        rng = np.random.default_rng(5)
        images = [np.rint(level + rng.normal(0, 0.2, (H, W))).astype(np.uint8) for _ in range(2)]
        (one,) = told(images).cameras()
        assert (one.noise_dn.low, one.noise_dn.high) == (0.0, LEAST_NOISE_DN)
        assert "hidden by rounding" in sensor_line(one)


def test_noise_that_changes_with_time_widens_its_interval():
    steady = noise_estimate([(4.0, 0.1)] * 4)
    drifting = noise_estimate([(3.0, 0.1), (5.0, 0.1), (3.0, 0.1), (5.0, 0.1)])
    assert steady.high - steady.low == pytest.approx(2 * 1.96 * 0.05 / (2 * np.sqrt(4 - 1 / 12)), rel=0.01)
    assert drifting.high - drifting.low > 8 * (steady.high - steady.low)
    assert noise_estimate([]) is None


def test_the_noise_of_an_image_is_as_certain_as_it_scatters():
    rng, figures = np.random.default_rng(6), []
    for _ in range(60):
        dark = np.rint(30.0 + rng.normal(0, 2.0, (H, W))).astype(np.uint8)
        figures.append(background_figures(measure_background(dark, 40.0), H * W))
    _, variance, sigma = np.array(figures).T
    assert np.mean(variance) == pytest.approx(4.0 + 1 / 12, rel=0.03)
    # cells at the rim, in an image of 20 cells nearly all of them, scatter by more than others
    assert 0.8 < np.mean(sigma) / np.std(variance) < 2.2


def test_saturation_bits_and_steps():
    rng = np.random.default_rng(7)
    dark = [(20 + 40 * i, 60, 6.3, 60.0) for i in range(7)]
    bright = [(20 + 40 * i, 140, 6.3, 400.0) for i in range(7)]
    (one,) = told([image(rng, dark + bright) for _ in range(4)]).cameras()
    assert (one.saturation_dn, one.saturated, one.bits, one.step_dn) == (255, 0.5, 8, 1)
    (unsaturated,) = told([image(rng, dark)]).cameras()
    assert unsaturated.saturation_dn is None
    # 8-bit values in the upper bits of 12
    (shifted,) = told([image(rng, GRID).astype(np.uint16) * 16 for _ in range(3)], depth=12).cameras()
    assert shifted.step_dn == 16
    assert "in steps of 16 DN" in sensor_line(shifted)
    (true,) = told([image(rng, GRID, gain=1.0, read=16.0, depth=12) for _ in range(3)], depth=12).cameras()
    assert true.step_dn == 1


def test_a_camera_without_targets_tells_its_noise_alone():
    rng = np.random.default_rng(8)
    sensors = told([image(rng, []) for _ in range(3)])
    (one,) = sensors.cameras()
    assert one.gain_dn_per_e is None
    assert one.blur_px is None
    assert one.noise_dn.low < np.sqrt(2.0) < one.noise_dn.high
    assert "gain not learned" in sensors.lines()[0]
    assert sensors.findings() == ()
    assert Sensors([CameraInfo("cam", W, H, 8, 100.0)]).cameras() == ()


# ---------------------------------------------------------------- what was left out


def left_out(images, settings=None):
    return told(images, settings=settings).cameras()[0].left_out


NOTHING = {"faint": 0, "small": 0, "large": 0, "uneven": 0, "cut": 0}


def test_each_reason_is_counted():
    n = 4

    def make(discs, single=()):
        rng = np.random.default_rng(9)
        return [image(rng, GRID + discs, read=0.2, single=single) for _ in range(n)]

    assert left_out(make([])) == NOTHING
    # beside the border, half of it outside
    assert left_out(make([(0, 80, 6.3, 100.0), (160, H - 1, 6.3, 100.0)])) == NOTHING | {"cut": 2 * n}
    assert left_out(make([], single=[(300, 40), (300, 120), (300, 200)])) == NOTHING | {"small": 3 * n}
    # 22 px, and three of the GRID's lie in its place
    allowed = DetectionSettings(maximum_size_px=15.0)
    assert left_out(make([(300, 120, 22.0, 100.0)]), allowed) == NOTHING | {"large": n}


def test_faint_targets_are_counted_and_told_of():
    rng = np.random.default_rng(10)
    # noise of sqrt(1.04) DN with the floor's: 4 to 5.3 standard deviations are 4.1 to 5.4 DN
    faint = [(300, 20 + 40 * k, 4.3, 4.5) for k in range(5)]
    sensors = told([image(rng, GRID[:15] + faint, read=0.2) for _ in range(10)])
    (one,) = sensors.cameras()
    count = one.left_out["faint"]
    assert count >= 6
    assert one.left_out["large"] == one.left_out["cut"] == 0
    # 50 spots: some are not looked at at all, smooth ones may fall to pieces, single pixels of them be bright enough
    assert 10 <= sum(one.left_out.values()) + one.found - 150 <= 60
    (line,) = sensors.findings()
    assert line.startswith("camera 'cam': ")
    limit = stats.norm.isf(0.01 / (H * W))
    assert f"below {limit:.1f} standard deviations of the noise" in line


def sensor(found, images=100, **counts):
    nothing = LearnedSensor("cam", images, 0, 0, None, None, None, None, 8, 1, 0.0, 0, 0.0, found, NOTHING)
    return replace(nothing, left_out=NOTHING | counts)


@pytest.mark.parametrize(
    ("one", "tells"),
    [
        (sensor(10_400, faint=5_600), "104 of about 160 bright spots an image are targets; left out: 56 below 5.4"),
        (sensor(10_400, faint=500), None),  # 4.6 %
        (sensor(0, small=3), None),  # noise alone makes one image in a hundred show one
        (sensor(0, small=12), "0 of about 0.12 bright spots"),
        (sensor(10_000, cut=1_100), None),  # 10 % touch the border where targets are all over the image
        (sensor(10_000, large=900, uneven=200), "9 not shorter than detection.maximum_size_px (64), 2 no brighter"),
    ],
)
def test_what_is_notable_is_told_of(one, tells):
    line = left_out_line(one, DetectionSettings(), (491, 656))
    assert (tells in line) if tells else line == ""


def test_noise_alone_is_left_out_as_often_as_stated():
    # single pixels over the limit: false_alarms = 1 an image, by the normal law; 60 images of white noise
    settings = DetectionSettings(false_alarms=1.0)
    rng = np.random.default_rng(11)
    images = [np.rint(60.0 + rng.normal(0, 5.0, (H, W))).astype(np.uint8) for _ in range(60)]
    count = left_out(images, settings)["small"]
    low, high = stats.poisson.interval(0.998, 60.0)
    assert 0.7 * low < count < 1.4 * high  # the noise's own estimate, 2 % off, moves the rate by 20 %
