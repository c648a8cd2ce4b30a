"""Defocus, field curvature and coma against a densely integrated pupil."""

from dataclasses import replace

import numpy as np

from mosca.data.arrays import Array
from reports.fidelity import Check, Row
from scenarios.fidelity.measure import about, centroids_apart, pixels_apart, rms
from scenarios.fidelity.twin_adapter import seen_by_twin
from scenarios.fidelity.views import marker, small_camera
from twin.cameras.optics.blur_parameters import Optics
from witness.image import contour_image
from witness.pupil import blur_circle_px, displacements, pupil, pupil_mean

SIZE = (96, 72)
LENS, WITNESS = small_camera(SIZE, 300.0, (-0.2, 0.06, 5e-4, -4e-4))
FOCUSED = Optics(gap_px=0.0, f_mm=8.0, f_number=2.0, focus_m=2.0, pixel_pitch_mm=0.005)
SHARP = replace(FOCUSED, focus_m=None)
MIDDLE, FIELD = (52.0, 33.0), (80.0, 58.0)
CENTROID_PX, PIXEL = 0.001, 0.01
Case = tuple[Optics, tuple[float, float], float, float | None, float]
"""Lens, image position [px], diameter [px], tilt (None: a ball) and distance [m]."""
WORST = replace(FOCUSED, curvature_px=4.0, coma_px=3.0)
CASES: dict[str, tuple[Case, ...]] = {
    "defocus (focused at 2 m)": (
        (FOCUSED, MIDDLE, 8.0, None, 1.0),
        (FOCUSED, MIDDLE, 8.0, None, 4.0),
        (FOCUSED, MIDDLE, 2.0, None, 1.0),
        (FOCUSED, MIDDLE, 10.0, 50.0, 1.0),
        (FOCUSED, MIDDLE, 8.0, None, 0.6),
    ),
    "coma": (
        (replace(SHARP, coma_px=4.0), FIELD, 8.0, None, 1.0),
        (replace(SHARP, coma_px=-3.0), FIELD, 8.0, None, 1.0),
        (replace(SHARP, coma_px=3.0, psf_sigma_px=0.35), FIELD, 4.0, None, 1.0),
    ),
    "field curvature and all together": (
        (replace(SHARP, curvature_px=4.0), FIELD, 8.0, None, 1.0),
        (WORST, FIELD, 8.0, None, 1.0),
        (WORST, FIELD, 8.0, None, 6.0),
    ),
}


def pupil_blur(quick: bool) -> Check:
    """Check blur that changes with distance and field against the mean image over the pupil's points."""
    rows: list[Row] = []
    for name, cases in CASES.items():
        pairs = [(rendered(case), expected(case)) for case in (cases[:1] if quick else cases)]
        off = np.array([centroids_apart(*pair) for pair in pairs])
        rows.append(Row(f"{name}: centroid, rms", rms(off), "px", CENTROID_PX))
        rows.append(Row(f"{name}: pixels, largest", max(pixels_apart(*p) for p in pairs), "of peak", PIXEL))
    case = CASES["field curvature and all together"][1]
    fine, coarse = expected(case), expected(case, 6, 18)
    faults = {
        "defocus of the other sign": replace(WORST, focus_m=2.0 / 3.0),  # 1 m lies as far behind, in diopters
        "coma inwards": replace(WORST, coma_px=-3.0),
        "f-number a quarter off": replace(WORST, f_number=2.5),
    }
    for name, optics in faults.items():
        off_peak = pixels_apart(rendered((optics, *case[1:])), fine)
        rows.append(Row(f"fault: {name}: pixels", off_peak, "of peak", PIXEL, control=True))
    return Check(
        "Defocus and coma",
        "centre of light, and every pixel, of markers out of focus and off the axis",
        "mean of exact images over 234 points of the pupil: thin lens, Seidel's third-order coma",
        f"{about(centroids_apart(fine, coarse), 'px')}, {about(pixels_apart(fine, coarse), 'of the peak')}",
        tuple(rows),
    )


def rendered(case: Case) -> Array:
    """Return the twin's image (H, W)."""
    optics, xy, diameter, tilt, distance = case
    return seen_by_twin(LENS, SIZE, [marker(WITNESS, xy, diameter, tilt, distance)[0]], optics)[0]


def expected(case: Case, radial: int = 9, angles: int = 26) -> Array:
    """Return the image (H, W) as the mean over points of the pupil."""
    optics, xy, diameter, tilt, distance = case
    target, outline = marker(WITNESS, xy, diameter, tilt, distance)
    polygon = WITNESS.project(outline[::10])
    centre, middle = target.centre_at(0.0), (np.array(SIZE) - 1) / 2
    away = WITNESS.project(centre[None])[0] - middle
    field = np.hypot(*away) / (np.hypot(*SIZE) / 2)
    circle = optics.curvature_px * field**2
    if optics.focus_m is not None:  # the plane of focus is normal to the axis: use the depth
        circle += blur_circle_px(centre[2], optics.focus_m, optics.f_mm, optics.f_number, optics.pixel_pitch_mm)
    points, weights = pupil(radial, angles)
    places = displacements(points, circle, optics.coma_px * field, away / np.hypot(*away))
    turn = 2 * np.pi / len(polygon)  # an inscribed polygon is too small: the area of its ellipse follows from this
    image = pupil_mean(lambda by: contour_image(polygon + by, optics.psf_sigma_px, *SIZE), places, weights)
    return np.asarray(image * turn / np.sin(turn))
