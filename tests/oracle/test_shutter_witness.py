"""Moving targets behind global and rolling shutters and strobes, against integrals of instantaneous images.

Every instant's image is exact (``witness.image.contour_image``); each row of pixels integrates its own window
(``exposed``). Required: centroid 0.002 px rms, pixel values 1e-3 of the peak.
"""

from dataclasses import replace

import numpy as np
import pytest

from scenarios.fidelity.measure import centroids_apart, pixels_apart
from scenarios.fidelity.shutter import (
    INSTANTS,
    MIDDLE,
    PIXEL,
    RMS_PX,
    ROW_TIME_S,
    SIGMA,
    SIZE,
    WITNESS,
    Case,
    expected,
    path,
    rendered,
)
from scenarios.fidelity.twin_adapter import Target, seen_by_twin
from scenarios.fidelity.views import small_camera
from witness.image import Array, gathered
from witness.views import place


def own_middle(case: Case) -> Array:
    """Return the image (2,) of the centre in the middle of what its own row gathers: found by iteration."""
    xy, centre_at = np.array(MIDDLE), path(case)[0]
    for _ in range(100):
        start = xy[1] * case.row_time_s
        opens = max(start, case.light_s[0], case.lit_s[0])
        closes = min(start + case.length_s, case.light_s[1], case.lit_s[1])
        xy = WITNESS.project(centre_at((opens + closes) / 2)[None])[0]
    return np.asarray(xy)


CASES = {
    "global, still": Case(8.0, (0.0, 0.0)),
    "global, 3 px ball": Case(3.0, (6e3, -4e3)),
    "global, 8 px ball": Case(8.0, (6e3, -4e3)),
    "global, 14 px disc": Case(14.0, (6e3, -4e3), tilt=45.0),
    "global, 20 px streak": Case(6.0, (17e3, -10e3)),
    "global, speeding up": Case(6.0, (8e3, -5e3), (12e6, 16e6)),
    "global, turning back": Case(6.0, (1e3, -1e3), (60e6, -40e6)),
    "global, sharp lens": Case(8.0, (6e3, -4e3), sigma_px=0.15),
    "global, strobe": Case(8.0, (18e3, 4e3), light_s=(2e-4, 5e-4)),
    "global, lamp": Case(8.0, (18e3, 4e3), lit_s=(6e-4, 7.5e-4)),
    "rolling, 3 px ball": Case(3.0, (6e3, -4e3), row_time_s=ROW_TIME_S),
    "rolling, 8 px ball": Case(8.0, (6e3, -4e3), row_time_s=ROW_TIME_S),
    "rolling, 14 px disc": Case(14.0, (6e3, 4e3), tilt=50.0, row_time_s=ROW_TIME_S),
    "rolling, against the readout": Case(8.0, (2e3, -15e3), row_time_s=ROW_TIME_S),
    "rolling, along the readout": Case(8.0, (2e3, 15e3), row_time_s=ROW_TIME_S),
    "rolling, speeding up": Case(8.0, (2e3, -3e3), (8e6, 6e6), row_time_s=ROW_TIME_S, nodes=7),
    "rolling, short exposure": Case(8.0, (6e3, 4e3), length_s=5e-5, row_time_s=ROW_TIME_S),
    "rolling, strobe seen by all rows": Case(8.0, (6e3, 4e3), row_time_s=ROW_TIME_S, light_s=(6e-4, 7.5e-4)),
    "rolling, strobe that cuts rows": Case(8.0, (6e3, 4e3), row_time_s=ROW_TIME_S, light_s=(9e-4, 1.3e-3)),
    "rolling, lamp out half way": Case(8.0, (6e3, 4e3), row_time_s=ROW_TIME_S, lit_s=(0.0, 9e-4)),
    "rolling, readout of a slow phone": Case(8.0, (3e2, 2e2), row_time_s=2e-4),
}
MORE_INSTANTS = {"rolling, short exposure": 257, "rolling, readout of a slow phone": 193}
"""Where a target crosses more of the image than the witness's instants resolve otherwise."""


@pytest.mark.parametrize("name", CASES)
def test_image_is_the_integral_of_its_instants(name):
    # measured: centroid 8e-5 px at most (3 px balls 4e-4), pixels 2e-4 of the peak, but for a target that runs along
    # with the readout at 0.3 rows a row time
    case = CASES[name]
    image, seen = rendered(case)
    wanted = expected(case, MORE_INSTANTS.get(name, INSTANTS))
    off, pixel = centroids_apart(image, wanted), pixels_apart(image, wanted)
    assert off < RMS_PX
    assert pixel < PIXEL
    assert image.sum() == pytest.approx(wanted.sum(), rel=1e-3)
    np.testing.assert_allclose(seen.xy_px[0], own_middle(case), atol=RMS_PX)


def test_a_streak_in_closed_form():
    # a ball of 2 px that runs 24 px along a row: far from its ends every column holds the same light, that of
    # the ball's whole area over the way, by hand pi d^2 / 4 / 24 px, with all of the column's rows
    lens, witness = small_camera(SIZE)
    centre, radius, *_ = place(witness, (31.5, 27.0), 2.0, 2.0)
    step = np.array([24 * 2.0 / 300, 0.0, 0.0])
    image, _seen = seen_by_twin(lens, SIZE, [Target(lambda t: centre + step * (t - 0.5), radius)])
    area = np.pi * (300 * radius / centre[2]) ** 2
    columns = image.sum(axis=0)
    np.testing.assert_allclose(columns[26:38], area / 24, rtol=2e-3)
    # the upper half of an endless edge, checked on the witness: half a pixel of light at the edge itself
    assert gathered(np.array(0.0), SIGMA) == pytest.approx(0.5)


def test_rolling_shutter_skews_by_speed_times_row_time():
    # a still picture of a disc that moves sideways leans: rows 1 px apart are row_time apart
    case = Case(20.0, (10e3, 0.0), row_time_s=ROW_TIME_S, length_s=1e-4)
    image, _seen = rendered(case)
    rows = np.arange(20, 35)
    middles = image[rows] @ np.arange(SIZE[0]) / image[rows].sum(axis=1)
    lean = np.polyfit(rows, middles, 1)[0]
    assert lean == pytest.approx(10e3 * ROW_TIME_S, rel=0.02)


def test_an_unlit_target_gives_no_light():
    for change in (
        {"lit_s": (2e-3, 3e-3)},
        {"light_s": (2e-3, 3e-3)},
        {"lit_s": (0.0, 4e-4), "light_s": (5e-4, 1.0)},
    ):
        case = replace(CASES["global, 8 px ball"], **change)  # type: ignore[arg-type]
        image, _seen = rendered(case)
        assert image.max() == 0.0
