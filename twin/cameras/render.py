"""Light on the sensor: every target's image integrated, not drawn.

The door to the kernels (``integrate``). Where meshes are about, ``mj_multiRay`` is asked ray by ray (``samples``).
"""

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from mosca.data.arrays import Array
from twin.cameras.integrate import MESH_NEAR, render_all, render_one
from twin.cameras.near import solids_of
from twin.cameras.occlusion import Occluders, may_hide
from twin.cameras.outline import BALL, FIGURE, FLAT
from twin.cameras.psf import Psf
from twin.cameras.samples import runs, sample_rays
from twin.scenes.figure import Figure
from twin.scenes.scene import UNSEEN_GROUP

__all__ = [
    "BALL", "FIGURE", "FLAT", "Figures", "MeshRays", "Seen", "TargetsInCamera", "Window", "has_meshes", "render_targets",
]  # fmt: skip

ALWAYS = (-np.inf, np.inf)


@dataclass(frozen=True, eq=False)
class Window:
    """How a frame's rows expose, in seconds from the opening of the first row.

    ``nodes_s`` (K,) instants at which paths are given, from the first row's opening to the last one's closing
    (K >= 3); ``length_s`` of a row's exposure; ``row_time_s`` from row to row (0: global shutter);
    ``light_s``: when the strobe is on.
    """

    nodes_s: Array
    length_s: float
    row_time_s: float = 0.0
    light_s: tuple[float, float] = ALWAYS


@dataclass(frozen=True, eq=False)
class Figures:
    """The figures of a scene: ``pieces`` (n, 7) of all, those of figure f from ``first[f]`` to ``first[f + 1]``."""

    pieces: Array
    first: Array

    @classmethod
    def of(cls, figures: "tuple[Figure, ...]") -> "Figures":
        """Return ``figures`` in the form that the kernels read."""
        counts = [len(f.pieces) for f in figures]
        pieces = np.concatenate([f.pieces for f in figures]) if figures else np.zeros((0, 7))
        return cls(np.ascontiguousarray(pieces), np.concatenate([[0], np.cumsum(counts)]).astype(np.int64))


NO_FIGURES = Figures(np.zeros((0, 7)), np.zeros(1, dtype=np.int64))


@dataclass(frozen=True, eq=False)
class TargetsInCamera:
    """Targets as one exposure sees them, camera frame [m].

    ``path`` (m, K, 3): centres at the window's nodes; ``turn`` (m, K, 3, 3): target's axes -> camera frame (its
    normal is the third column); ``radius`` (m,) (a figure's: of the disc that encloses it); ``shape`` (m,)
    BALL, FLAT or FIGURE; ``figure`` (m,) its number in Figures, or -1; ``electrons`` (m,) that a pixel fully
    covered by it collects in the window's length; ``lit_s`` (m, 2) when it shines; ``limb`` (m,) share of
    brightness that the rim lacks; ``shade`` (m, 3) change of brightness from the middle to the rim.
    """

    path: Array
    turn: Array
    radius: Array
    shape: Array
    figure: Array
    electrons: Array
    lit_s: Array
    limb: Array
    shade: Array

    @classmethod
    def plain(
        cls, path: Array, turn: Array, radius: Array, shape: Array, electrons: Array
    ) -> "TargetsInCamera":
        """Return balls and flat targets that are evenly bright and shine all the time."""
        m = len(path)
        return cls(
            np.ascontiguousarray(path, dtype=float),
            np.ascontiguousarray(turn, dtype=float),
            np.ascontiguousarray(radius, dtype=float),
            np.ascontiguousarray(shape, dtype=np.int64),
            np.full(m, -1, dtype=np.int64),
            np.ascontiguousarray(electrons, dtype=float),
            np.tile(np.array(ALWAYS), (m, 1)),
            np.zeros(m),
            np.zeros((m, 3)),
        )


@dataclass(frozen=True, eq=False)
class Seen:
    """What the camera saw of each target: ``visible`` (m,) share of its disc, ``xy_px`` (m, 2) image of its
    centre at its rows' mid-exposure, ``diameter_px`` (m,) of the whole disc's image (both NaN where nothing is
    visible).
    """

    visible: Array
    xy_px: Array
    diameter_px: Array


def render_targets(
    light: Array,
    lens: Array,
    psf: Psf,
    window: Window,
    targets: TargetsInCamera,
    occluders: Occluders,
    geom_xyz: Array,
    geom_turn: Array,
    figures: Figures = NO_FIGURES,
    mesh_rays: "MeshRays | None" = None,
) -> Seen:
    """Add the targets' light to ``light`` (H, W) [electrons], in place, and return what was seen of them.

    ``lens``: parameter vector of ``twin.cameras.lens``. ``geom_xyz`` (K, k, 3), ``geom_turn`` (K, k, 3, 3): the
    occluders' poses in the camera frame at the window's nodes. ``mesh_rays`` answers for meshes, if there are any;
    they are judged at mid-exposure.
    """
    count = len(targets.radius)
    nodes = np.ascontiguousarray(window.nodes_s, dtype=float)
    timing = (window.length_s, window.row_time_s, float(window.light_s[0]), float(window.light_s[1]))
    profile = np.column_stack([targets.limb, targets.shade])
    common = (
        light, lens, psf.kernel.table, psf.kernel.reach, psf.terms, nodes, timing, targets.path, targets.turn,
        targets.radius, targets.shape, targets.figure, targets.electrons, targets.lit_s, profile,
        figures.pieces, figures.first, occluders.kind, occluders.size, occluders.marker, geom_xyz, geom_turn,
        solids_of(occluders.kind, occluders.size, geom_xyz, geom_turn),
    )  # fmt: skip
    mesh = np.zeros(count, dtype=np.int64) if mesh_rays is None else mesh_rays.candidates(targets)
    seen, state = render_all(*common, mesh)
    if mesh_rays is not None:
        middle = len(nodes) // 2
        for m in np.flatnonzero(state == MESH_NEAR):
            edges, share = mesh_rays.hidden(int(m), lens, targets, middle)
            seen[m] = render_one(*common, int(m), MESH_NEAR, edges, share)[:4]
    seen[seen[:, 0] == 0.0, 1:] = np.nan
    return Seen(seen[:, 0], seen[:, 1:3], seen[:, 3])


class MeshRays:
    """Asks MuJoCo's exact ray caster what stands before a target where meshes are about."""

    def __init__(
        self,
        model: Any,
        data: Any,
        occluders: Occluders,
        marker_geoms: tuple[int, ...],
        world_from_camera: tuple[Array, Array],
    ) -> None:
        self.model, self.data, self.occluders, self.marker_geoms = model, data, occluders, marker_geoms
        self.rotation, self.position = world_from_camera
        self.groups = np.ones(6, dtype=np.uint8)
        self.groups[UNSEEN_GROUP] = 0

    def candidates(self, targets: TargetsInCamera) -> Array:
        """Return for each target 1 where a mesh's bounding sphere can hide any of it (m,)."""
        chosen = np.zeros(len(targets.radius), dtype=np.int64)
        middle = targets.path.shape[1] // 2
        for geom, reach in zip(self.occluders.mesh_geom, self.occluders.mesh_radius, strict=True):
            centre = self.rotation.T @ (self.data.geom_xpos[geom] - self.position)
            for m, where in enumerate(targets.path[: len(self.marker_geoms), middle]):
                if may_hide(centre, np.zeros(3), 0.0, reach, where[0], where[1], where[2], targets.radius[m]):
                    chosen[m] = 1
        return chosen

    def hidden(self, marker: int, lens: Array, targets: TargetsInCamera, node: int) -> tuple[Array, float]:
        """Return the boundary (n, 3) of what is hidden of a target and the hidden share of its samples."""
        for per_px in (3, 0):  # a coarse look answers for most
            rays, cell, grid = sample_rays(
                lens,
                targets.path[marker, node],
                targets.turn[marker, node],
                targets.radius[marker],
                targets.shape[marker],
                per_px,
            )
            free = self.visible(marker, rays)
            if per_px and len(free) >= 30 and (free.all() or not free.any()):
                break
        share = 1.0 - float(free.mean()) if len(free) else 1.0
        return runs(cell, grid, ~free, -1.0), share

    def visible(self, marker: int, directions: Array) -> Array:
        """Return which rays (n, 3), camera frame, meet the target before anything else (n,)."""
        unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        world = np.ascontiguousarray(unit @ self.rotation.T)
        n = len(world)
        geoms, distances = np.full(n, -1, dtype=np.int32), np.zeros(n)
        if n:
            mujoco.mj_multiRay(
                self.model, self.data, np.ascontiguousarray(self.position), world.ravel(), self.groups, 1, -1,
                geoms, distances, None, n, 1e6,
            )  # fmt: skip
        return geoms == self.marker_geoms[marker]


def has_meshes(occluders: Occluders) -> bool:
    """Whether the scene has geoms that only ``MeshRays`` can answer for."""
    return len(occluders.mesh_geom) > 0
