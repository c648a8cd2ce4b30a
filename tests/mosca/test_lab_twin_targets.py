"""Blur, brightness and shake against images made by plain numpy and scipy, and motions of known spectra."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from mosca.accuracy.lab_twin.disc_model import DiscModel
from mosca.accuracy.lab_twin.estimates import NotTold
from mosca.accuracy.lab_twin.moving_targets import turned_images
from mosca.accuracy.lab_twin.pixel_statistics import PixelStatistics
from mosca.accuracy.lab_twin.shake import shake_estimates, spectrum
from mosca.accuracy.lab_twin.target_images import TargetDisplacements, corner_blur, fit_targets, sharper
from mosca.data.rig import Camera, OpenCVLens, Pose
from mosca.detection.detect import detect
from mosca.detection.settings import DetectionSettings

FINE = 8


def ellipse(size, x, y, axes, turn, blur):
    """Return an evenly lit ellipse, blurred and averaged over pixels, by brute force."""
    rim = 6
    at = (np.arange((size + 2 * rim) * FINE) + 0.5) / FINE - 0.5 - rim
    dx, dy = np.meshgrid(at - x, at - y)
    c, s = np.cos(turn), np.sin(turn)
    inside = np.hypot((dx * c + dy * s) / axes[0], (dy * c - dx * s) / axes[1]) < 1.0
    fine = gaussian_filter(inside.astype(float), blur * FINE, truncate=6)
    whole = size + 2 * rim
    return fine.reshape(whole, FINE, whole, FINE).mean(axis=(1, 3))[rim:-rim, rim:-rim]


@pytest.mark.parametrize("blur", [0.4, 0.6, 1.2])
def test_a_disc_is_as_by_brute_force(blur):
    image = 500.0 * ellipse(25, 12.2, 11.7, (4.1, 3.6), 0.5, blur) + 20.0
    fit = DiscModel(25).fit(image, np.ones_like(image), (12.0, 12.0, 4.0))
    assert (fit.x_px, fit.y_px) == pytest.approx((12.2, 11.7), abs=0.004)
    # brute force itself is right to some 0.3 % of a blur of 0.4 px
    assert (fit.level, fit.background, fit.blur_px) == pytest.approx((500.0, 20.0, blur), rel=5e-3)
    assert fit.radius_px == pytest.approx(np.sqrt(4.1 * 3.6), rel=1e-3)


def test_slopes_are_those_of_finite_differences():
    model = DiscModel(21)
    fit = model.fit(model.unit(10.3, 9.8, (3.0, 3.4, 0.2), 0.6), np.ones((21, 21)), (10.0, 10.0, 3.0))
    _, by_x, by_y = model.with_slopes(fit, 0.6)
    step = 1e-4
    for slope, away in ((by_x, (step, 0.0)), (by_y, (0.0, step))):
        ends = [
            model.unit(fit.x_px + sign * away[0], fit.y_px + sign * away[1], fit.axes, 0.6) for sign in (1, -1)
        ]  # fmt: skip
        assert np.allclose(slope, (ends[0] - ends[1]) / (2 * step), atol=1e-6)


def still_images(shake, n=60, blur=0.6, seed=3):
    """Yield images of six discs that all move by ``shake`` (n, 2)."""
    random = np.random.default_rng(seed)
    centres = [
        (x + random.uniform(-0.5, 0.5), y + random.uniform(-0.5, 0.5)) for x in (25, 65, 105) for y in (25, 65)
    ]
    for k in range(n):
        image = np.zeros((90, 130))
        for x, y in centres:
            row, column = int(y) - 14, int(x) - 14
            part = ellipse(29, x - column + shake[k, 0], y - row + shake[k, 1], (4.0, 3.8), 0.3, blur)
            image[row : row + 29, column : column + 29] += 2000.0 * part
        light = random.poisson(image * 2.0 + 200.0) / 2.0
        yield np.rint(light + random.normal(0.0, 3.0, image.shape) + 100.0).astype(np.uint16)


def test_targets_at_rest_tell_blur_brightness_and_shake():
    shake = np.random.default_rng(5).normal(0.0, 0.1, (24, 2))
    images = list(still_images(shake, 24))
    sums = PixelStatistics(90, 130, 12)
    for image in images:
        sums.add(image)
    rounded = np.rint(sums.mean).astype(np.uint16)
    targets = fit_targets(sums, detect(rounded, "a", DetectionSettings(), 12, None))
    assert len(targets) == 6
    spread = 0.0
    for _ in range(2):
        moved = TargetDisplacements(targets, spread)
        for k, image in enumerate(images):
            moved.add(image, k)
        common, noise = moved.common()
        spread = np.sqrt(common.var(axis=0).mean() - noise**2)
    assert np.sqrt(np.mean((common - shake + shake.mean(axis=0)) ** 2)) < 1.3 * noise + 0.004
    assert spread == pytest.approx(np.sqrt(shake.var(axis=0).mean()), rel=0.03)
    # the mean is wider by the shake; the single images are not
    wide = np.sqrt(0.6**2 + shake.var(axis=0).mean())
    assert np.mean([one.fit.blur_px for one in targets]) == pytest.approx(wide, abs=0.004)
    assert np.mean([sharper(one, spread) for one in targets]) == pytest.approx(0.6, abs=0.004)
    # evenly sharp: the corner as the middle; from targets near the middle alone no corner is told
    corner, sigma = corner_blur(targets, spread, (90, 130))
    assert abs(corner - 0.6) < 4.0 * sigma + 0.005
    # by construction: the square grows from 0.36 to 0.56 at the corner
    wider = []
    for one in targets:
        x, y = one.xy_px
        share = ((x - 65) ** 2 + (y - 45) ** 2) / (65**2 + 45**2)
        wider.append(replace(one, fit=replace(one.fit, blur_px=np.sqrt(0.36 + 0.2 * share))))
    assert corner_blur(wider, 0.0, (90, 130))[0] == pytest.approx(np.sqrt(0.56), rel=1e-6)
    assert corner_blur(targets[:5], spread, (90, 130)) is None
    assert np.mean([one.fit.level for one in targets]) == pytest.approx(2000.0, rel=0.004)


def test_the_noise_of_the_common_motion_is_not_taken_for_shake():
    images = list(still_images(np.zeros((24, 2)), 24))
    sums = PixelStatistics(90, 130, 12)
    for image in images:
        sums.add(image)
    targets = fit_targets(sums, detect(np.rint(sums.mean).astype(np.uint16), "a", DetectionSettings(), 12, None))
    moved = TargetDisplacements(targets)
    for k, image in enumerate(images):
        moved.add(image, k)
    common, noise = moved.common()
    assert np.sqrt((common**2).mean()) == pytest.approx(noise, rel=0.4)


def test_targets_off_the_axis_move_farther():
    """Images displaced by what a rotation of the camera makes of them; the motion of the middle comes back."""
    lens = OpenCVLens(100.0, 100.0, 64.5, 44.5)
    camera = Camera("a", 130, 90, lens, Pose(np.eye(3), np.zeros(3)))
    xy = np.array([[20.0, 20.0], [110.0, 25.0], [64.5, 44.5]])
    turned = turned_images(camera, xy)
    # closed form: x = f tan; turning by s / f about y moves an image by s (1 + x^2 / f^2), and y by s x y / f^2
    x, y = ((xy - (64.5, 44.5)) / 100.0).T
    assert np.allclose(turned[:, :, 0], np.stack([1.0 + x**2, x * y], axis=1), atol=1e-6)
    assert np.allclose(turned[:, :, 1], np.stack([x * y, 1.0 + y**2], axis=1), atol=1e-6)
    shake = np.random.default_rng(3).normal(0.0, 0.05, (40, 2))
    targets = [SimpleNamespace() for _ in xy]
    moved = TargetDisplacements([], 0.0, turned)
    moved._targets, moved._sigma = targets, np.array([[0.01, 0.02], [0.03, 0.01], [0.02, 0.02]])
    moved._rows = list(np.einsum("tij,nj->nti", turned, shake))
    common, noise = moved.common()
    assert np.allclose(common, shake - shake.mean(axis=0), atol=1e-9)
    assert noise < 1e-9


def motion(n, white, band=0.0, hz=(8.0, 20.0), drift=0.0, seed=1):
    """Return white noise and a sum of 60 tones of random phases in a band (n, 2), at 100 Hz."""
    random = np.random.default_rng(seed)
    time = np.arange(n) / 100.0
    tones = np.zeros((n, 2))
    for axis in range(2):
        for f in random.uniform(*hz, 60):
            tones[:, axis] += band * np.sqrt(2.0 / 60.0) * np.sin(2 * np.pi * (f * time + random.random()))
    return random.normal(0.0, white, (n, 2)) + tones + drift * time[:, None]


def test_white_shake_and_no_band():
    told = {one.key: one for one in shake_estimates("a", motion(400, 0.05), 0.01, 100.0)}
    one = told["errors.body_px"]
    assert abs(one.value - np.sqrt(0.05**2 - 0.01**2)) < 3.0 * one.sigma
    assert told["mount.vibration_px"].value == 0.0
    assert "mount.drift_px_per_s[0]" not in told


def test_a_band_of_vibration_and_a_drift():
    moved = motion(600, 0.03, band=0.12, drift=0.05)
    moved[100:103] = np.nan
    told = {one.key: one for one in shake_estimates("a", moved, 0.0, 100.0)}
    white, band = told["errors.body_px"], told["mount.vibration_px"]
    assert abs(white.value - 0.03) < 4.0 * white.sigma + 0.003
    assert abs(band.value - 0.12) < 4.0 * band.sigma
    ends = told["mount.vibration_hz[0]"].value, told["mount.vibration_hz[1]"].value
    assert ends == pytest.approx((8.0, 20.0), rel=0.25)
    assert told["mount.drift_px_per_s[0]"].value == pytest.approx(0.05, abs=0.01)


def test_power_adds_up():
    found = spectrum(motion(500, 0.04, band=0.1), 100.0)
    assert found.white + found.band == pytest.approx(0.04**2 + 0.1**2, rel=0.15)


def test_too_few_frames_and_no_times_are_named():
    assert all("frames of targets at rest" in one.reason for one in shake_estimates("a", motion(20, 0.1), 0.0, 100.0))
    told = {one.key: one for one in shake_estimates("a", motion(200, 0.1), 0.0, None)}
    assert isinstance(told["mount.vibration_px"], NotTold)
    assert "--fps" in told["mount.vibration_px"].reason
    assert told["errors.body_px"].value == pytest.approx(0.1, rel=0.1)
