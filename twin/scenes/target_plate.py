"""Targets as geoms: plates that carry a figure, discs and balls, each with its centre exactly as specified.

A plate is a sheet so thin (2 um) that its face, centre and back coincide; its carrier is ``FILM_M`` behind. White
parts have gain 1, black ones 0, or ``INK`` where they are printed.
"""

from collections.abc import Sequence

import mujoco
import numpy as np

from mosca.data.arrays import Array
from mosca.data.target_codes import SECTORS, code_bits
from mosca.data.targets import BallTarget, CodedTarget, PlacedTarget, RoundTarget
from twin.scenes.emission import Glow
from twin.scenes.figure import Figure, circle, figure, polygon, ring_sector
from twin.scenes.world import FLAT_HALF_THICKNESS_M, SEAT_M, add_ball_marker, add_flat_target, add_marker

SHEET_HALF_M = 1e-6
"""Half the thickness of a plate's sheet [m]."""
FILM_M = 0.0002
"""Distance of a plate or disc from the face that carries it [m]."""
INK = 0.04
"""Reflectance of printed black relative to white paper."""
RETRO, PAPER = Glow("retro"), Glow("paper")
_BLACK = (0.02, 0.02, 0.02, 1.0)


def black_of(glow: Glow) -> float:
    """Return the light of a target's black parts, as a share of the light of its white parts."""
    return INK if glow.kind == "paper" else 0.0


def coded_figure(target: CodedTarget, black: float = 0.0) -> Figure:
    """Return the figure of a coded target: dot and ring sectors, and the plate where ``black`` is not 0."""
    half = target.plate_m / 2
    contours = [] if black == 0 else [polygon(rectangle(half, half), black)]
    contours.append(circle(0.0, 0.0, target.dot_radius_m, 1 - black))
    turn = 2 * np.pi / SECTORS
    contours += [
        ring_sector(0.0, 0.0, target.ring_inner_m, target.ring_outer_m, turn * a, turn * b, 1 - black)
        for a, b in white_runs(code_bits(target.number))
    ]
    return figure(contours)


def white_runs(bits: Sequence[bool]) -> tuple[tuple[int, int], ...]:
    """Return the runs of ones on a ring of ``bits`` that has a zero: (start, end) in sectors, start < end.

    A run across the ring's start ends beyond the ring's length, so that white neighbours have no seam between them.
    """
    n = len(bits)
    starts = [k for k in range(n) if bits[k] and not bits[k - 1]]
    return tuple((k, k + next(m for m in range(1, n) if not bits[(k + m) % n])) for k in starts)


def rectangle(half_width: float, half_height: float, x: float = 0.0, y: float = 0.0) -> Array:
    """Return the corners (4, 2) of a rectangle about (x, y), counter-clockwise."""
    signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    result: Array = signs * np.array([half_width, half_height]) + np.array([x, y])
    return result


def add_plate(
    body: mujoco.MjsBody, name: str, half_width: float, half_height: float, center: Array, rotation: Array
) -> None:
    """Add a marker plate at ``center`` (3,) whose axes are the columns of ``rotation`` (3, 3), facing +z."""
    size = [half_width, half_height, SHEET_HALF_M]
    add_marker(body, name, mujoco.mjtGeom.mjGEOM_BOX, size, np.asarray(center), rotation, _BLACK)


def add_ball_at(body: mujoco.MjsBody, name: str, center: Array, diameter: float) -> None:
    """Add a ball marker with its centre at ``center`` (3,) of the body's axes."""
    up = np.array([0.0, 0.0, 1.0])  # undo the offset that seats a marker on a skin
    add_ball_marker(body, name, np.asarray(center) - (diameter / 2 + SEAT_M) * up, up, diameter)


def add_target(body: mujoco.MjsBody, placed: PlacedTarget) -> None:
    """Add a target to ``body``, in whose axes it is placed."""
    match placed.target:
        case CodedTarget(plate_m=edge):
            add_plate(body, placed.name, edge / 2, edge / 2, placed.position, placed.rotation)
        case RoundTarget(radius_m=radius):
            stuck_on = placed.position - FLAT_HALF_THICKNESS_M * placed.normal
            add_flat_target(body, placed.name, stuck_on, placed.normal, 2 * radius)
        case BallTarget(diameter_m=diameter):
            add_ball_at(body, placed.name, placed.position, diameter)


def figures_of(targets: Sequence[PlacedTarget], glow: Glow) -> dict[str, Figure]:
    """Return the figures, by target name, of those ``targets`` that have one."""
    return {
        placed.name: coded_figure(placed.target, black_of(glow))
        for placed in targets
        if isinstance(placed.target, CodedTarget)
    }
