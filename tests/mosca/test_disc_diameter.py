"""Diameters of blurred discs: unbiased, though the fit's edge is straight and a small disc's is not."""

import numpy as np
import pytest
from disc_images import frame
from scipy.optimize import least_squares
from scipy.stats import ncx2, norm

from mosca.detection.detect import NO_STATISTICS, detect_with_statistics
from mosca.detection.disc_fit.row import true_radius
from mosca.numba_support.decorators import kernel


@kernel
def true_radii(fitted, dark):
    return true_radius(fitted, dark)


def fitted_and_true(radius, even):
    """Radii over the fitted blur: that of a straight edge fitted to the exact image of a disc, and the true one.

    Under a blur of 1, the image is the chance that a normal deviate about a place lies within the radius.
    """
    r = np.linspace(0.005, radius + 4.0, 800)
    light = ncx2.cdf(radius**2, 2, r**2)
    weight = np.sqrt(r / (1.0 if even else 0.02 + light))

    def misfit(p):
        return weight * (p[0] * norm.cdf((p[1] - r) / p[2]) + p[3] - light)

    start = [light[0], max(radius, 1.2), 1.0, 0.0]
    found = least_squares(misfit, start, xtol=1e-14, ftol=1e-14, gtol=1e-14).x
    return found[1] / found[2], radius / found[2]


@pytest.mark.parametrize("even", [True, False])
@pytest.mark.parametrize("radius", [1.35, 1.5, 1.75, 2.1, 2.5, 3.0, 4.0, 6.0, 20.0])
def test_the_true_radius_is_that_of_an_exact_image(radius, even):
    fitted, true = fitted_and_true(radius, even)
    found, slope = true_radii(fitted, float(even))
    # linear between the places that are kept
    assert found == pytest.approx(true, rel=0.03 if radius < 1.4 else 0.01)
    more, _ = true_radii(fitted + 1e-6, float(even))
    assert slope == pytest.approx((more - found) / 1e-6, rel=1e-3)


def test_a_point_of_light_has_a_radius_too():
    found, _ = true_radii(0.3, 0.5)
    assert 1.0 < found < 1.3


@pytest.mark.parametrize(
    ("diameter", "blur", "within"),
    [(2.6, 0.9, 0.06), (3.4, 0.9, 0.02), (5.0, 0.9, 0.01), (3.4, 0.6, 0.01), (5.0, 0.45, 0.01), (12.0, 0.7, 0.005)],
)
def test_diameters_do_not_depend_on_the_blur(diameter, blur, within):
    """A disc of 3.4 px under a blur of 0.9 px was found 9 % too large, one of 2.6 px 25 %."""
    rng, learned = np.random.default_rng(2), NO_STATISTICS
    for _ in range(4):
        image, _, _ = frame(rng, diameter, blur, 150.0, 100.0)
        (found,), new = detect_with_statistics([image], ["a"], statistics=learned)
        learned = learned.plus(new)
    assert np.median(found.diameter_px) == pytest.approx(diameter, rel=within)
    # the stated error is that of the scatter
    assert np.std(found.diameter_px) == pytest.approx(np.sqrt(np.mean(found.diameter_sigma_px**2)), rel=0.4)
