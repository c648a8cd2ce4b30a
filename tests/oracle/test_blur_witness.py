"""The twin's defocus, field curvature and coma against a densely integrated pupil (``witness.pupil``).

Required: centroid 0.001 px, pixel values 1 % of the peak.
"""

from dataclasses import replace

import numpy as np
import pytest

from scenarios.fidelity.blur import (
    CENTROID_PX,
    FIELD,
    FOCUSED,
    LENS,
    MIDDLE,
    PIXEL,
    SHARP,
    SIZE,
    WITNESS,
    WORST,
    expected,
    rendered,
)
from scenarios.fidelity.measure import centroids_apart, pixels_apart
from scenarios.fidelity.twin_adapter import seen_by_twin
from scenarios.fidelity.views import marker, small_camera
from witness.image import Array, contour_image
from witness.pupil import blur_circle_px, disc_variance, displacements, pupil
from witness.render import image_centroid

CASES = {
    "near": (FOCUSED, MIDDLE, 8.0, None, 1.0),
    "in focus": (FOCUSED, MIDDLE, 8.0, None, 2.0),
    "far": (FOCUSED, MIDDLE, 8.0, None, 4.0),
    "very near": (FOCUSED, MIDDLE, 8.0, None, 0.6),
    "small and near": (FOCUSED, MIDDLE, 2.0, None, 1.0),
    "large and near": (FOCUSED, MIDDLE, 20.0, None, 1.0),
    "tilted disc": (FOCUSED, MIDDLE, 10.0, 50.0, 1.0),
    "near, in the field": (FOCUSED, FIELD, 8.0, None, 1.0),
    "coma 1 px": (replace(SHARP, coma_px=1.0), FIELD, 8.0, None, 1.0),
    "coma 4 px": (replace(SHARP, coma_px=4.0), FIELD, 8.0, None, 1.0),
    "coma -3 px": (replace(SHARP, coma_px=-3.0), FIELD, 8.0, None, 1.0),
    "coma, sharper lens": (replace(SHARP, coma_px=3.0, psf_sigma_px=0.35), FIELD, 4.0, None, 1.0),
    "curvature": (replace(SHARP, curvature_px=4.0), FIELD, 8.0, None, 1.0),
    "all, near": (WORST, FIELD, 8.0, None, 1.0),
    "all, far": (WORST, FIELD, 8.0, None, 6.0),
    "all, negative": (replace(FOCUSED, curvature_px=-4.0, coma_px=-2.0), FIELD, 8.0, 40.0, 1.0),
}


@pytest.mark.parametrize("name", CASES)
def test_image_is_the_mean_over_the_pupil(name):
    # measured: centroid 8e-6 px at most; pixels 2e-4 of the peak for defocus on the axis, 7e-4 for coma
    image, wanted = rendered(CASES[name]), expected(CASES[name], 10, 28)
    off, pixel = centroids_apart(image, wanted), pixels_apart(image, wanted)
    assert off < CENTROID_PX
    assert pixel < PIXEL
    assert image.sum() == pytest.approx(wanted.sum(), rel=3e-4)


def test_the_plane_of_focus_is_a_plane():
    # 40 degrees off the axis: distance 2 m, depth 1.53 m; a camera focused at that depth images it sharply
    size = (700, 80)
    lens, witness = small_camera(size, 400.0)
    target, outline = marker(witness, (685.0, 40.0), 8.0, None, 2.0)
    depth = float(target.centre_at(0.0)[2])
    assert depth == pytest.approx(1.53, abs=0.02)
    image, _seen = seen_by_twin(lens, size, [target], replace(FOCUSED, focus_m=depth))
    sharp = contour_image(witness.project(outline), 0.6, *size)
    assert pixels_apart(image, sharp) < PIXEL


def test_blur_circle_in_closed_form():
    # by hand: f 8 mm, f/2, focus 2 m, object 1 m: 0.032 m * 0.001 m / 1.992 m = 16.06 um, 3.21 px of 5 um;
    # a uniform disc has a variance of diameter^2 / 16 along each axis, which adds to the image's own
    assert blur_circle_px(1.0, 2.0, 8.0, 2.0, 0.005) == pytest.approx(-3.2129, abs=1e-4)
    assert disc_variance(3.2129) == pytest.approx(3.2129**2 / 16, rel=1e-9)
    target, _outline = marker(WITNESS, MIDDLE, 6.0, None, 1.0)
    depth = float(target.centre_at(0.0)[2])
    circle = blur_circle_px(depth, 2.0, 8.0, 2.0, 0.005)
    grown = variance(seen_by_twin(LENS, SIZE, [target], FOCUSED)[0]) - variance(
        seen_by_twin(LENS, SIZE, [target], SHARP)[0]
    )
    np.testing.assert_allclose(grown, circle**2 / 16, rtol=3e-3)


def variance(image: Array) -> Array:
    """Return the variance of an image's light along x and y [px^2]."""
    x, y = image_centroid(image)
    columns, rows = np.arange(image.shape[1]) - x, np.arange(image.shape[0]) - y
    return np.array([image.sum(axis=0) @ columns**2, image.sum(axis=1) @ rows**2]) / image.sum()


def test_the_pupil_witness_agrees_with_closed_forms():
    # uniform disc: mean of rho^2 1/2, of rho^4 1/3; the displacements' mean is taken off; coma reaches from the
    # chief ray's position 0 to its length: the largest less the smallest along the field
    points, weights = pupil(12, 32)
    rho2 = (points**2).sum(axis=1)
    np.testing.assert_allclose([weights.sum(), weights @ rho2, weights @ rho2**2], [1.0, 0.5, 1 / 3], rtol=1e-12)
    outwards = np.array([0.6, 0.8])
    np.testing.assert_allclose(weights @ displacements(points, 3.0, 2.0, outwards), 0.0, atol=1e-12)
    rim = np.stack([np.cos(t := np.linspace(0, 2 * np.pi, 721)), np.sin(t)], axis=1)
    every = np.vstack([rim, [[0.0, 0.0]]])
    along = displacements(every, 0.0, 2.0, outwards) @ outwards
    assert along.max() - along[-1] == pytest.approx(2.0, rel=1e-4)  # from the chief ray to the farthest
    assert along.min() == pytest.approx(along[-1])
