"""The twin's defocus, field curvature and coma against a densely integrated pupil (``witness.pupil``).

Required: centroid 0.001 px, pixel values 1 % of the peak.
"""

from dataclasses import replace

import numpy as np
import pytest

from scenarios.fidelity.twin_adapter import seen_by_twin
from scenarios.fidelity.views import marker, small_camera
from twin.cameras.optics.blur_parameters import Optics
from witness.image import Array, contour_image
from witness.pupil import blur_circle_px, disc_variance, displacements, pupil, pupil_mean
from witness.render import image_centroid

SIZE = (96, 72)
LENS, WITNESS = small_camera(SIZE, 300.0, (-0.2, 0.06, 5e-4, -4e-4))
FOCUSED = Optics(gap_px=0.0, f_mm=8.0, f_number=2.0, focus_m=2.0, pixel_pitch_mm=0.005)
SHARP = replace(FOCUSED, focus_m=None)
MIDDLE, FIELD = (52.0, 33.0), (80.0, 58.0)
CENTROID_PX, PIXEL = 0.001, 0.01


def expected(optics: Optics, xy: tuple[float, float], diameter: float, tilt: float | None, distance: float) -> Array:
    """Return the image by the pupil's mean, of a lens with ``optics``."""
    target, outline = marker(WITNESS, xy, diameter, tilt, distance)
    polygon = WITNESS.project(outline[::10])
    centre = target.centre_at(0.0)
    middle = np.array([(SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2])
    away = WITNESS.project(centre[None])[0] - middle
    field = np.hypot(*away) / (np.hypot(*SIZE) / 2)
    circle = optics.curvature_px * field**2
    if optics.focus_m is not None:  # the plane of focus is normal to the axis: use depth, not distance
        circle += blur_circle_px(centre[2], optics.focus_m, optics.f_mm, optics.f_number, optics.pixel_pitch_mm)
    points, weights = pupil(10, 28)
    places = displacements(points, circle, optics.coma_px * field, away / np.hypot(*away))
    return pupil_mean(
        lambda by: contour_image(polygon + by, optics.psf_sigma_px, *SIZE), places, weights
    ) * area_lost(len(polygon))


def area_lost(corners: int) -> float:
    """Return the factor that makes an inscribed polygon as large as its ellipse."""
    turn = 2 * np.pi / corners
    return float(turn / np.sin(turn))


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
    "all, near": (replace(FOCUSED, curvature_px=4.0, coma_px=3.0), FIELD, 8.0, None, 1.0),
    "all, far": (replace(FOCUSED, curvature_px=4.0, coma_px=3.0), FIELD, 8.0, None, 6.0),
    "all, negative": (replace(FOCUSED, curvature_px=-4.0, coma_px=-2.0), FIELD, 8.0, 40.0, 1.0),
}


@pytest.mark.parametrize("name", CASES)
def test_image_is_the_mean_over_the_pupil(name, record_property):
    # measured: centroid 8e-6 px at most; pixels 2e-4 of the peak for defocus on the axis, 7e-4 for coma
    optics, *where = CASES[name]
    image, _seen = seen_by_twin(LENS, SIZE, [marker(WITNESS, *where)[0]], optics)
    wanted = expected(optics, *where)
    pixel = np.abs(image - wanted).max() / wanted.max()
    off = np.hypot(*(image_centroid(image) - image_centroid(wanted)))
    print(f"\n{name:20s} centroid {off:.1e} px  pixels {pixel:.1e} of the peak")
    record_property("centroid px, pixels of peak", f"{off:.2e}, {pixel:.2e}")
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
    assert np.abs(image - sharp).max() / sharp.max() < PIXEL


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


FAULTS = {
    "defocus of the other sign": replace(CASES["all, near"][0], focus_m=2.0 / 3.0),
    "coma inwards": replace(CASES["all, near"][0], coma_px=-3.0),
    "curvature of the other sign": replace(CASES["all, near"][0], curvature_px=-4.0),
    "no coma": replace(CASES["all, near"][0], coma_px=0.0),
    "f-number a quarter off": replace(CASES["all, near"][0], f_number=2.5),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_are_noticed(fault):
    # controls. Defocus flips its sign when the focus is at 2/3 m: 1 m then lies as far behind it, in diopters
    _optics, *where = CASES["all, near"]
    image, _seen = seen_by_twin(LENS, SIZE, [marker(WITNESS, *where)[0]], FAULTS[fault])
    wanted = expected(CASES["all, near"][0], *where)
    assert np.abs(image - wanted).max() / wanted.max() > 1.5 * PIXEL
