"""The checks' interface to the twin: targets before one camera, as plain numbers.

The expected images come from the package ``witness``, which is independent of the twin.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mosca.data.arrays import Array
from mosca.data.rig import Lens
from twin.cameras.exposure.lighting import NEVER_FADES
from twin.cameras.optics.blur_parameters import Optics
from twin.cameras.optics.lens import TwinLens
from twin.cameras.optics.psf import psf_of
from twin.cameras.render.occluders import Occluders
from twin.cameras.render.render import (
    BALL,
    FIGURE,
    FLAT,
    Figures,
    MeshRays,
    TargetsInCamera,
    VisibleTargets,
    Window,
    render_targets,
)
from twin.cameras.stray_light.stray import unhidden
from twin.scenes.figure import Figure

ELECTRONS = 12_000.0
ALWAYS = (-np.inf, np.inf)
NOTHING = unhidden(3)[0]
EVEN = Optics(gap_px=0.0)
"""A lens that has only its model, without a gap."""


def turn_to(normal: Array) -> Array:
    """Return a rotation (3, 3) whose third column is ``normal``, by Rodrigues' formula from the z axis."""
    n = np.asarray(normal, float) / np.linalg.norm(normal)
    v = np.cross([0.0, 0.0, 1.0], n)
    c = n[2]
    if c < -1 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])
    skew = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.asarray(np.eye(3) + skew + skew @ skew / (1 + c))


@dataclass(frozen=True, eq=False)
class Target:
    """One target: ``centre_at(t)`` -> (3,) [m], camera frame; ``turn_at(t)`` -> (3, 3); a ball unless ``flat`` or
    with a ``figure``.
    """

    centre_at: Callable[[float], Array]
    radius: float
    turn_at: Callable[[float], Array] = field(default=lambda t: np.eye(3))
    flat: bool = False
    figure: Figure | None = None
    electrons: float = ELECTRONS
    lit_s: tuple[float, float] = ALWAYS
    limb: float = 0.0
    shade: tuple[float, float, float] = (0.0, 0.0, 0.0)
    fade_rad: tuple[float, float] = NEVER_FADES


def ball(centre: Array, radius: float, **more: Any) -> Target:
    """Return a still ball."""
    return Target(lambda t: np.asarray(centre, float), radius, **more)


def disc(centre: Array, normal: Array, radius: float, **more: Any) -> Target:
    """Return a still, flat round target."""
    turn = turn_to(normal)
    return Target(lambda t: np.asarray(centre, float), radius, lambda t: turn, True, **more)


def window_of(
    length_s: float = 1.0,
    row_time_s: float = 0.0,
    rows: int = 1,
    light_s: tuple[float, float] = ALWAYS,
    nodes: int = 3,
) -> Window:
    """Return an exposure's window with its instants at Chebyshev-Gauss-Lobatto nodes."""
    end = length_s + row_time_s * (rows - 1)
    at = 0.5 * (1 - np.cos(np.pi * np.arange(nodes) / (nodes - 1)))
    return Window(at * end, length_s, row_time_s, light_s)


def seen_by_twin(
    lens: Lens,
    size: tuple[int, int],
    targets: list[Target],
    optics: Optics = EVEN,
    window: Window | None = None,
    occluders: Occluders = NOTHING,
    geoms_at: Callable[[float], tuple[Array, Array]] | None = None,
    mesh_rays: MeshRays | None = None,
) -> tuple[Array, VisibleTargets]:
    """Return the twin's noise-free image (H, W) over ELECTRONS, and its truth.

    ``size``: width and height; ``geoms_at``: time -> the occluders' centres (k, 3) and rotations (k, 3, 3) in the
    camera frame.
    """
    window = window_of() if window is None else window
    figures = [t.figure for t in targets if t.figure is not None]
    numbers = [figures.index(t.figure) if t.figure is not None else -1 for t in targets]
    shapes = [FIGURE if t.figure is not None else FLAT if t.flat else BALL for t in targets]
    asked = TargetsInCamera(
        np.array([[t.centre_at(s) for s in window.nodes_s] for t in targets], dtype=float),
        np.array([[t.turn_at(s) for s in window.nodes_s] for t in targets], dtype=float),
        np.array([t.radius for t in targets]),
        np.array(shapes, dtype=np.int64),
        np.array(numbers, dtype=np.int64),
        np.array([t.electrons for t in targets]),
        np.array([t.lit_s for t in targets], dtype=float),
        np.array([t.limb for t in targets]),
        np.array([t.shade for t in targets], dtype=float),
        np.array([t.fade_rad for t in targets], dtype=float),
    )
    k = len(occluders.geom)
    if geoms_at is None:
        xyz, turn = np.zeros((len(window.nodes_s), k, 3)), np.zeros((len(window.nodes_s), k, 3, 3))
    else:
        places = [geoms_at(s) for s in window.nodes_s]
        xyz, turn = np.array([p[0] for p in places], float), np.array([p[1] for p in places], float)
    light = np.zeros((size[1], size[0]), dtype=np.float32)
    seen = render_targets(
        light,
        TwinLens.of(lens, *size, optics).vector,
        psf_of(optics, *size),
        window,
        asked,
        occluders,
        np.ascontiguousarray(xyz),
        np.ascontiguousarray(turn),
        Figures.of(tuple(figures)),
        mesh_rays,
    )
    return light.astype(float) / ELECTRONS, seen
