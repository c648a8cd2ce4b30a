"""Targets in motion with global and rolling shutters, strobes and lamps."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from mosca.data.arrays import Array
from reports.fidelity import Check, Row
from scenarios.fidelity.measure import about, centroids_apart, pixels_apart, rms
from scenarios.fidelity.twin_adapter import ALWAYS, EVEN, Target, seen_by_twin, turn_to, window_of
from scenarios.fidelity.views import small_camera
from twin.cameras.render.render import VisibleTargets
from witness.image import contour_image, exposed, row_windows
from witness.render import ball_outline, disc_outline
from witness.views import place, tilted_normal

SIZE, SIGMA, MIDDLE, F_PX, DISTANCE = (64, 56), 0.6, (30.0, 27.0), 300.0, 2.0
LENS, WITNESS = small_camera(SIZE, F_PX, (-0.2, 0.06, 5e-4, -4e-4))
RMS_PX, PIXEL = 0.002, 0.001
ROW_TIME_S = 20e-6
INSTANTS = 65
Span = tuple[float, float]


@dataclass(frozen=True)
class Case:
    """A target that crosses MIDDLE half way through the readout: image speed [px/s], acceleration [px/s^2]."""

    diameter: float
    speed: tuple[float, float]
    acceleration: tuple[float, float] = (0.0, 0.0)
    tilt: float | None = None
    length_s: float = 1e-3
    row_time_s: float = 0.0
    light_s: Span = ALWAYS
    lit_s: Span = ALWAYS
    nodes: int = 3
    sigma_px: float = SIGMA


CASES = {
    "global shutter": (
        Case(8.0, (6e3, -4e3)),
        Case(6.0, (17e3, -10e3)),
        Case(3.0, (6e3, -4e3)),
        Case(14.0, (6e3, -4e3), tilt=45.0),
        Case(6.0, (8e3, -5e3), (12e6, 16e6)),
    ),
    "strobe and lamp": (
        Case(8.0, (18e3, 4e3), light_s=(2e-4, 5e-4)),
        Case(8.0, (18e3, 4e3), lit_s=(6e-4, 7.5e-4)),
        Case(8.0, (6e3, 4e3), row_time_s=ROW_TIME_S, light_s=(6e-4, 7.5e-4)),
    ),
    "rolling shutter": (
        Case(8.0, (6e3, -4e3), row_time_s=ROW_TIME_S),
        Case(14.0, (6e3, 4e3), tilt=50.0, row_time_s=ROW_TIME_S),
        Case(8.0, (2e3, -15e3), row_time_s=ROW_TIME_S),
        Case(3.0, (6e3, -4e3), row_time_s=ROW_TIME_S),
        Case(8.0, (2e3, -3e3), (8e6, 6e6), row_time_s=ROW_TIME_S, nodes=7),
    ),
}


def motion(quick: bool) -> Check:
    """Check motion blur: balls and discs of 3-14 px that move up to 20 px in an exposure, accelerate and roll."""
    rows: list[Row] = []
    for name, cases in CASES.items():
        pairs = [_both(case) for case in (cases[:2] if quick else cases)]
        rows.append(Row(f"{name}: centroid, rms", rms(np.array([centroids_apart(*p) for p in pairs])), "px", RMS_PX))
        rows.append(Row(f"{name}: pixels, largest", max(pixels_apart(*p) for p in pairs), "of peak", PIXEL))
    fastest = CASES["rolling shutter"][0 if quick else 2]
    fine, coarse = expected(fastest, 2 * INSTANTS - 1), expected(fastest)
    return Check(
        "Motion blur and rolling shutter",
        "centre of light, and every pixel, of moving targets",
        "exact images of single instants (Green's theorem along the outline), splined and integrated row by row",
        f"{about(centroids_apart(fine, coarse), 'px')}, {about(pixels_apart(fine, coarse), 'of the peak')}",
        (*rows, *_faults()),
    )


def _both(case: Case) -> tuple[Array, Array]:
    return rendered(case)[0], expected(case)


def path(case: Case) -> tuple[Callable[[float], Array], float, Array]:
    """Return the target's position as a function of time, its radius [m] and, for a disc, its normal."""
    centre, radius, sight, one, other = place(WITNESS, MIDDLE, case.diameter, DISTANCE)
    metre = DISTANCE / F_PX  # of a pixel
    speed, acceleration = metre * np.array([*case.speed, 0.0]), metre * np.array([*case.acceleration, 0.0])
    middle = (case.length_s + case.row_time_s * (SIZE[1] - 1)) / 2

    def at(t: float) -> Array:
        return np.asarray(centre + speed * (t - middle) + acceleration * (t - middle) ** 2 / 2)

    return at, radius, tilted_normal(case.tilt or 0.0, sight, one, other)


def rendered(case: Case) -> tuple[Array, VisibleTargets]:
    """Return the twin's image (H, W) of a case, and its truth."""
    at, radius, normal = path(case)
    window = window_of(case.length_s, case.row_time_s, SIZE[1], case.light_s, case.nodes)
    rotation = turn_to(normal)
    target = Target(at, radius, lambda t: rotation, case.tilt is not None, lit_s=case.lit_s)
    return seen_by_twin(LENS, SIZE, [target], replace(EVEN, psf_sigma_px=case.sigma_px), window=window)


@lru_cache(maxsize=64)
def expected(case: Case, instants: int = INSTANTS) -> Array:
    """Return the witness's image (H, W): each row's mean over its own window, from ``instants`` instants."""
    at, radius, normal = path(case)

    def image_at(t: float) -> Array:
        outline = ball_outline(at(t), radius, 600) if case.tilt is None else disc_outline(at(t), normal, radius, 600)
        return contour_image(WITNESS.project(outline), case.sigma_px, *SIZE)

    opens, closes = row_windows(SIZE[1], case.length_s, case.row_time_s, case.light_s, case.lit_s)
    image: Array = exposed(image_at, opens, closes, instants) / case.length_s
    image.setflags(write=False)
    return image


def _faults() -> list[Row]:
    """Return the errors of the image of a twin whose input differs slightly from that of the witness."""
    across, rolled, flashed = (CASES["global shutter"][0], CASES["rolling shutter"][0], CASES["strobe and lamp"][0])
    late = 5e-5
    faults: dict[str, tuple[Case, dict[str, Any]]] = {
        "exposure centre 50 us late": (across, {"light_s": (2 * late, 1.0)}),
        "motion with the sign flipped": (rolled, {"speed": (-rolled.speed[0], -rolled.speed[1])}),
        "no row time": (rolled, {"row_time_s": 0.0}),
        "row time 5 % off": (rolled, {"row_time_s": 1.05 * ROW_TIME_S}),
        "strobe 20 us late": (flashed, {"light_s": (2.2e-4, 5.2e-4)}),
    }
    return [
        Row(
            f"fault: {name}",
            centroids_apart(rendered(replace(case, **changed))[0], expected(case)),
            "px",
            RMS_PX,
            control=True,
        )
        for name, (case, changed) in faults.items()
    ]
