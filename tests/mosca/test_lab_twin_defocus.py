"""Focus and aperture against thin-lens optics by hand, and images of defocused discs by brute force."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.signal import fftconvolve

from mosca.accuracy.lab_twin.defocus import LEAST_PSF_PX, defocus_of
from mosca.accuracy.lab_twin.disc_model import DiscModel

FINE = 8
F, PITCH = 6e-3, 1e-5
"""Focal length and pixel pitch [m]."""


def circle_px(depth, focus, number):
    """Return the blur circle's diameter by similar triangles, from where the lens images depth and focus [m]."""
    sharp, film = F * depth / (depth - F), F * focus / (focus - F)
    return F / number * np.abs(sharp - film) / sharp / PITCH


def blurs(focus, number, psf, noise=0.003, n=12):
    """Return depths and rms blurs, an axis, of n targets; an even disc has the rms diameter / 4."""
    random = np.random.default_rng(4)
    depth = random.uniform(1.9, 3.1, n)
    return depth, np.hypot(psf, circle_px(depth, focus, number) / 4.0) + noise * random.standard_normal(n)


@pytest.mark.parametrize(("focus", "number", "psf"), [(1.5, 0.4, 0.1), (4.0, 0.3, 0.1), (2.4, 0.15, 0.5)])
def test_focus_and_aperture_of_a_thin_lens(focus, number, psf):
    found = defocus_of(*blurs(focus, number, psf))
    assert found.is_told
    values, covariance = found.lens(F, PITCH)
    assert np.all(np.abs(values - (psf, focus, number)) < 3.0 * np.sqrt(np.diag(covariance)) + 1e-9)
    assert values == pytest.approx((psf, focus, number), rel=0.08)
    # the image of a farther target than those seen, on the other side of focus too
    assert found.circle_px(np.array([5.0])) == pytest.approx(circle_px(5.0, focus, number), rel=0.06)


def test_standard_deviations_are_those_of_the_scatter():
    random = np.random.default_rng(5)
    depth = np.linspace(1.9, 3.1, 12)
    exact = np.hypot(0.1, circle_px(depth, 4.0, 0.3) / 4.0)
    told = [defocus_of(depth, exact + 0.005 * random.standard_normal(12)) for _ in range(200)]
    sharp = [one for one in told if one.psf_px == LEAST_PSF_PX]  # no blur in focus is significant
    assert len(sharp) > 190
    values = np.array([one.lens(F, PITCH)[0][1:] for one in sharp])
    stated = np.mean([one.lens(F, PITCH)[1][1:, 1:] for one in sharp], axis=0)
    assert np.sqrt(np.diag(stated)) == pytest.approx(values.std(axis=0), rel=0.2)
    turned = stated[0, 1] / np.sqrt(stated[0, 0] * stated[1, 1])
    assert turned == pytest.approx(np.corrcoef(values.T)[0, 1], abs=0.05)


def test_what_does_not_change_with_depth_is_not_told():
    depth = np.linspace(2.0, 3.0, 10)
    flat = 0.6 + 0.01 * np.random.default_rng(6).standard_normal(10)
    assert not defocus_of(depth, flat).is_told
    assert defocus_of(depth[:5], flat[:5]) is None
    # of one depth alone
    near = np.full(10, 2.5) + 1e-3 * np.random.default_rng(7).standard_normal(10)
    assert not defocus_of(near, np.hypot(0.1, circle_px(near, 4.0, 0.3) / 4.0) + flat - 0.6).is_told


def test_a_target_that_is_something_else_is_left_out():
    depth, blur = blurs(4.0, 0.3, LEAST_PSF_PX, n=24)
    blur[np.argmin(np.abs(depth - depth.mean()))] += 0.4
    found = defocus_of(depth, blur)
    assert found.targets == 23
    assert found.lens(F, PITCH)[0] == pytest.approx((LEAST_PSF_PX, 4.0, 0.3), rel=0.08)


def defocused(size, x, y, radius, gauss, circle):
    """Return an even disc of light, blurred by a Gaussian and an even disc, averaged over pixels."""
    rim = 6
    whole = size + 2 * rim
    at = (np.arange(whole * FINE) + 0.5) / FINE - 0.5 - rim
    inside = np.hypot(*np.meshgrid(at - x, at - y)) < radius
    fine = gaussian_filter(inside.astype(float), gauss * FINE, truncate=6)
    # shares of the fine pixels in the pupil, by 11 x 11 points each
    points = np.hypot(*np.meshgrid(*2 * [(np.arange(-40 * 11, 41 * 11) - 5) / 11])) < 0.5 * circle * FINE
    pupil = points.reshape(81, 11, 81, 11).mean(axis=(1, 3))
    fine = fftconvolve(fine, pupil / pupil.sum(), mode="same")
    return fine.reshape(whole, FINE, whole, FINE).mean(axis=(1, 3))[rim:-rim, rim:-rim]


@pytest.mark.parametrize("circle", [1.5, 3.0])
def test_a_defocused_disc_is_as_by_brute_force(circle):
    gauss = 0.3
    blur = np.hypot(gauss, circle / 4.0)
    image = 500.0 * defocused(25, 12.2, 11.7, 3.8, gauss, circle) + 20.0
    share = (circle / 4.0 / blur) ** 2
    fit = DiscModel(25).fit(image, np.ones_like(image), (12.0, 12.0, 4.0), share)
    assert (fit.x_px, fit.y_px) == pytest.approx((12.2, 11.7), abs=0.005)
    assert (fit.level, fit.radius_px, fit.blur_px) == pytest.approx((500.0, 3.8, blur), rel=0.01)
    assert fit.misfit < 0.002


@pytest.mark.parametrize("share", [0.0, 0.6])
def test_derivatives_by_blur_are_those_of_finite_differences(share):
    model, step = DiscModel(15), 1e-5
    p = np.array([1.0, 0.1, 7.2, 6.9, 3.0, 3.2, 0.1, 0.7])
    _, slopes = model._columns(p, share)
    ends = [model._columns(p + sign * step * np.eye(8)[7], share)[0] for sign in (1, -1)]
    assert slopes[:, 7] == pytest.approx((ends[0] - ends[1]).ravel() / (2.0 * step), abs=1e-7)
