"""Moving targets behind global and rolling shutters and strobes, against integrals of instantaneous images.

Every instant's image is exact (``witness.image.contour_image``); each row of pixels integrates its own window
(``exposed``). Required: centroid 0.002 px rms, pixel values 1e-3 of the peak.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from scenarios.fidelity.twin_adapter import ALWAYS, Target, seen_by_twin, turn_to, window_of
from scenarios.fidelity.views import small_camera
from witness.image import Array, contour_image, exposed, gathered, row_windows
from witness.render import ball_outline, disc_outline, image_centroid
from witness.views import place

SIZE = (64, 56)
SIGMA = 0.6
LENS, WITNESS = small_camera(SIZE, 300.0, (-0.2, 0.06, 5e-4, -4e-4))
MIDDLE = (30.0, 27.0)
CENTROID_RMS, PIXEL = 0.002, 1e-3
EXPOSURE, ROW_TIME = 1e-3, 20e-6
Span = tuple[float, float]


@dataclass(frozen=True)
class Case:
    """A target that crosses MIDDLE half way through the readout: image speed [px/s] and acceleration [px/s^2]."""

    diameter: float
    speed: tuple[float, float]
    acceleration: tuple[float, float] = (0.0, 0.0)
    tilt: float | None = None
    length: float = EXPOSURE
    row_time: float = 0.0
    light_s: Span = ALWAYS
    lit_s: Span = ALWAYS
    nodes: int = 3
    instants: int = 81


def moving(case: Case) -> tuple[Target, Callable[[float], Array]]:
    """Return the target for the twin and its outline at any instant for the witness."""
    centre, radius, sight, one, other = place(WITNESS, MIDDLE, case.diameter, 2.0)
    metre = 2.0 / 300.0  # of a pixel
    speed = metre * np.array([*case.speed, 0.0])
    acceleration = metre * np.array([*case.acceleration, 0.0])
    middle = (case.length + case.row_time * (SIZE[1] - 1)) / 2

    def path(t: float) -> Array:
        return centre + speed * (t - middle) + acceleration * (t - middle) ** 2 / 2

    if case.tilt is None:
        return Target(path, radius, lit_s=case.lit_s), lambda t: ball_outline(path(t), radius, 600)
    tilt = np.deg2rad(case.tilt)
    normal = -np.cos(tilt) * sight + np.sin(tilt) * (0.6 * one + 0.8 * other)
    turn = turn_to(normal)
    target = Target(path, radius, lambda t: turn, True, lit_s=case.lit_s)
    return target, lambda t: disc_outline(path(t), normal, radius, 600)


def expected(case: Case, outline: Callable[[float], Array]) -> Array:
    """Return the image in the mean over each row's window."""
    opens, closes = row_windows(SIZE[1], case.length, case.row_time, case.light_s, case.lit_s)

    def at(t: float) -> Array:
        return contour_image(WITNESS.project(outline(t)), SIGMA, *SIZE)

    return exposed(at, opens, closes, case.instants) / case.length


def rendered(case: Case, target: Target) -> tuple[Array, Array]:
    """Return the twin's image and its true image point (2,) of the target's centre."""
    window = window_of(case.length, case.row_time, SIZE[1], case.light_s, case.nodes)
    image, seen = seen_by_twin(LENS, SIZE, [target], window=window)
    return image, seen.xy_px[0]


def own_middle(case: Case, target: Target) -> Array:
    """Return the image (2,) of the centre in the middle of what its own row gathers: found by iteration."""
    xy = np.array(MIDDLE)
    for _ in range(100):
        start = xy[1] * case.row_time
        opens = max(start, case.light_s[0], case.lit_s[0])
        closes = min(start + case.length, case.light_s[1], case.lit_s[1])
        xy = WITNESS.project(target.centre_at((opens + closes) / 2)[None])[0]
    return np.asarray(xy)


CASES = {
    "global, still": Case(8.0, (0.0, 0.0)),
    "global, 3 px ball": Case(3.0, (6e3, -4e3)),
    "global, 8 px ball": Case(8.0, (6e3, -4e3)),
    "global, 14 px disc": Case(14.0, (6e3, -4e3), tilt=45.0),
    "global, 20 px streak": Case(6.0, (17e3, -10e3)),
    "global, speeding up": Case(6.0, (8e3, -5e3), (12e6, 16e6)),
    "global, turning back": Case(6.0, (1e3, -1e3), (60e6, -40e6)),
    "global, strobe": Case(8.0, (18e3, 4e3), light_s=(2e-4, 5e-4)),
    "global, lamp": Case(8.0, (18e3, 4e3), lit_s=(6e-4, 7.5e-4)),
    "rolling, 3 px ball": Case(3.0, (6e3, -4e3), row_time=ROW_TIME),
    "rolling, 8 px ball": Case(8.0, (6e3, -4e3), row_time=ROW_TIME),
    "rolling, 14 px disc": Case(14.0, (6e3, 4e3), tilt=50.0, row_time=ROW_TIME),
    "rolling, against the readout": Case(8.0, (2e3, -15e3), row_time=ROW_TIME),
    "rolling, along the readout": Case(8.0, (2e3, 15e3), row_time=ROW_TIME),
    "rolling, speeding up": Case(8.0, (2e3, -3e3), (8e6, 6e6), row_time=ROW_TIME, nodes=7),
    "rolling, short exposure": Case(8.0, (6e3, 4e3), length=5e-5, row_time=ROW_TIME, instants=257),
    "rolling, strobe seen by all rows": Case(8.0, (6e3, 4e3), row_time=ROW_TIME, light_s=(6e-4, 7.5e-4)),
    "rolling, strobe that cuts rows": Case(8.0, (6e3, 4e3), row_time=ROW_TIME, light_s=(9e-4, 1.3e-3)),
    "rolling, lamp out half way": Case(8.0, (6e3, 4e3), row_time=ROW_TIME, lit_s=(0.0, 9e-4)),
    "rolling, readout of a slow phone": Case(8.0, (3e2, 2e2), row_time=2e-4, instants=193),
}


@pytest.mark.parametrize("name", CASES)
def test_image_is_the_integral_of_its_instants(name, record_property):
    # measured: centroid 8e-5 px at most (3 px balls 4e-4), pixels 2e-4 of the peak, but for a target that runs along
    # with the readout at 0.3 rows a row time
    case = CASES[name]
    target, outline = moving(case)
    image, centre = rendered(case, target)
    wanted = expected(case, outline)
    off = np.hypot(*(image_centroid(image) - image_centroid(wanted)))
    pixel = np.abs(image - wanted).max() / wanted.max()
    print(f"\n{name:34s} centroid {off:.1e} px  pixels {pixel:.1e} of the peak")
    record_property("centroid px, pixels of peak", f"{off:.2e}, {pixel:.2e}")
    assert off < CENTROID_RMS
    assert pixel < PIXEL
    assert image.sum() == pytest.approx(wanted.sum(), rel=1e-3)
    np.testing.assert_allclose(centre, own_middle(case, target), atol=CENTROID_RMS)


def test_a_streak_in_closed_form():
    # a ball of 2 px that runs 24 px along a row: far from its ends every column holds the same light, that of
    # the ball's whole area over the way, by hand pi d^2 / 4 / 24 px, with all of the column's rows
    size = (64, 56)
    lens, witness = small_camera(size)
    centre, radius, *_ = place(witness, (31.5, 27.0), 2.0, 2.0)
    path = lambda t: centre + np.array([24 * 2.0 / 300 * (t - 0.5), 0.0, 0.0])  # noqa: E731
    image, _seen = seen_by_twin(lens, size, [Target(path, radius)])
    area = np.pi * (300 * radius / centre[2]) ** 2
    columns = image.sum(axis=0)
    np.testing.assert_allclose(columns[26:38], area / 24, rtol=2e-3)
    # the upper half of an endless edge, checked on the witness: half a pixel of light at the edge itself
    assert gathered(np.array(0.0), SIGMA) == pytest.approx(0.5)


def test_rolling_shutter_skews_by_speed_times_row_time():
    # a still picture of a disc that moves sideways leans: rows 1 px apart are row_time apart
    case = Case(20.0, (10e3, 0.0), row_time=ROW_TIME, length=1e-4)
    target, _outline = moving(case)
    image, _centre = rendered(case, target)
    rows = np.arange(20, 35)
    middles = image[rows] @ np.arange(SIZE[0]) / image[rows].sum(axis=1)
    lean = np.polyfit(rows, middles, 1)[0]
    assert lean == pytest.approx(10e3 * ROW_TIME, rel=0.02)


def test_an_unlit_target_gives_no_light():
    for change in (
        {"lit_s": (2e-3, 3e-3)},
        {"light_s": (2e-3, 3e-3)},
        {"lit_s": (0.0, 4e-4), "light_s": (5e-4, 1.0)},
    ):
        case = replace(CASES["global, 8 px ball"], **change)  # type: ignore[arg-type]
        image, _centre = rendered(case, moving(case)[0])
        assert image.max() == 0.0


FAULTS: dict[str, tuple[str, dict, dict]] = {
    # the case, and the changed values of the twin's window and target
    "exposed half a window longer": ("global, 8 px ball", {"length": 1.5 * EXPOSURE}, {}),
    "target runs the other way": ("rolling, 8 px ball", {}, {"speed": (-6e3, 4e3)}),
    "row time 5 % off": ("rolling, 8 px ball", {"row_time": 1.05 * ROW_TIME}, {}),
    "no row time": ("rolling, 8 px ball", {"row_time": 0.0}, {}),
    "strobe 20 us late": ("rolling, strobe seen by all rows", {"light_s": (6.2e-4, 7.7e-4)}, {}),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_are_noticed(fault):
    # controls: the twin's inputs differ slightly from the witness's
    name, window, other = FAULTS[fault]
    case = CASES[name]
    _target, outline = moving(case)
    image, _centre = rendered(replace(case, **window), moving(replace(case, **other))[0])
    wanted = expected(case, outline)
    off = np.hypot(*(image_centroid(image) - image_centroid(wanted)))
    assert off > 3 * CENTROID_RMS
    assert np.abs(image - wanted).max() / wanted.max() > 3 * PIXEL
