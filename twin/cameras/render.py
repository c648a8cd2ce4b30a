"""Light on the sensor: every marker's image integrated, not drawn.

A marker that nothing hides is integrated along its outline (``outline``), also where the image's border cuts
it, one partly hidden by samples of its image (``samples``); what hides it is asked of ``occlusion``, and of
``mj_multiRay`` where meshes are about. The shape of what is visible is judged at mid-exposure.
"""

import math
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numba import njit

from mosca.data.arrays import Array
from twin.cameras.kernel import PixelKernel
from twin.cameras.lens import land
from twin.cameras.marker_view import BALL, FLAT, front_of, rim
from twin.cameras.occlusion import Occluders, axis_reach, hit, may_hide
from twin.cameras.outline import add_outline, outline_lands
from twin.cameras.samples import sample_rays, share_seen, spread_samples
from twin.scenes.scene import UNSEEN_GROUP

__all__ = ["BALL", "FLAT", "MarkersInCamera", "MeshRays", "Seen", "has_meshes", "render_markers"]

IN_VIEW, PARTLY, HIDDEN, OUTSIDE, MESH_NEAR = 0, 1, 2, 3, -1


@dataclass(frozen=True, eq=False)
class MarkersInCamera:
    """Markers as one exposure sees them, camera frame [m].

    ``path`` (m, 3, 3): centre at the exposure's start, middle and end; ``normal`` (m, 3) at the middle;
    ``radius`` (m,); ``shape`` (m,) BALL or FLAT; ``electrons`` (m,) that a pixel fully covered by the marker
    collects during the exposure.
    """

    path: Array
    normal: Array
    radius: Array
    shape: Array
    electrons: Array


@dataclass(frozen=True, eq=False)
class Seen:
    """What the camera saw of each marker: ``visible`` (m,) share of its disc, ``xy_px`` (m, 2) image of its
    centre at mid-exposure, ``diameter_px`` (m,) of the whole disc's image (both NaN where nothing is visible).
    """

    visible: Array
    xy_px: Array
    diameter_px: Array


def render_markers(
    light: Array,
    lens: Array,
    kernel: PixelKernel,
    markers: MarkersInCamera,
    occluders: Occluders,
    geom_xyz: Array,
    geom_rotation: Array,
    mesh_rays: "MeshRays | None" = None,
) -> Seen:
    """Add the markers' light to ``light`` (H, W) [electrons], in place, and return what was seen of them.

    ``lens``: parameter vector of ``twin.cameras.lens``. ``geom_xyz`` (k, 3), ``geom_rotation`` (k, 3, 3): the
    occluders' poses in the camera frame at mid-exposure. ``mesh_rays`` answers for meshes, if there are any.
    """
    seen, state = _render_all(
        light, lens, kernel.table, kernel.reach, markers.path, markers.normal, markers.radius, markers.shape,
        markers.electrons, occluders.kind, occluders.size, occluders.marker, geom_xyz, geom_rotation,
        np.zeros(0, dtype=np.int64) if mesh_rays is None else mesh_rays.candidates(markers),
    )  # fmt: skip
    if mesh_rays is not None:
        for m in np.flatnonzero(state == MESH_NEAR):
            samples, cell, grid = sample_rays(
                lens, markers.path[m, 1], markers.normal[m], markers.radius[m], markers.shape[m]
            )
            free = mesh_rays.visible(int(m), samples)
            seen[m, 0] = share_seen(light.shape[0], light.shape[1], cell, grid, free)
            spread_samples(
                light,
                lens,
                kernel.table,
                kernel.reach,
                markers.path[m],
                markers.electrons[m],
                cell,
                grid,
                free,
            )
    seen[seen[:, 0] == 0.0, 1:] = np.nan
    return Seen(seen[:, 0], seen[:, 1:3], seen[:, 3])


class MeshRays:
    """Asks MuJoCo's exact ray caster what stands before a marker where meshes are about."""

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

    def candidates(self, markers: MarkersInCamera) -> Array:
        """Return for each marker 1 where a mesh's bounding sphere can hide any of it (m,)."""
        chosen = np.zeros(len(markers.radius), dtype=np.int64)
        for geom, reach in zip(self.occluders.mesh_geom, self.occluders.mesh_radius, strict=True):
            centre = self.rotation.T @ (self.data.geom_xpos[geom] - self.position)
            for m, place in enumerate(markers.path[:, 1]):
                if may_hide(centre, np.zeros(3), 0.0, reach, place[0], place[1], place[2], markers.radius[m]):
                    chosen[m] = 1
        return chosen

    def visible(self, marker: int, directions: Array) -> Array:
        """Return which rays (n, 3), camera frame, meet the marker before anything else (n,)."""
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


@njit(nogil=True, cache=True)
def _render_all(  # type: ignore[no-untyped-def]
    light,
    lens,
    table,
    reach,
    path,
    normal,
    radius,
    shape,
    electrons,
    kind,
    size,
    geom_marker,
    geom_xyz,
    geom_turn,
    mesh,
):
    """Render all markers; returns (visible, x, y, diameter) a marker and its state (MESH_NEAR: left to mesh rays)."""
    count, geoms = path.shape[0], kind.shape[0]
    seen = np.zeros((count, 4))
    state = np.zeros(count, dtype=np.int64)
    near = np.empty(geoms, dtype=np.int64)
    halves, reaches = np.empty(geoms), np.empty(geoms)
    for g in range(geoms):
        halves[g], reaches[g] = axis_reach(kind[g], size[g])
    for m in range(count):
        x, y, z = path[m, 1, 0], path[m, 1, 1], path[m, 1, 2]
        r = radius[m]
        u, v, ux, uy, uz, vx, vy, vz, ok = land(lens, x, y, z)
        seen[m, 1], seen[m, 2], seen[m, 3] = np.nan, np.nan, np.nan
        state[m] = OUTSIDE
        if not ok or x * x + y * y + z * z < 4 * r * r:
            continue
        # size of the image from the stretch across the viewing direction
        stretch = math.sqrt(max(ux * ux + uy * uy + uz * uz, vx * vx + vy * vy + vz * vz))
        diameter = 2.0 * r * stretch
        seen[m, 1], seen[m, 2], seen[m, 3] = u, v, diameter
        margin = 0.75 * diameter + reach + 1.0
        height, width = light.shape
        if u < -margin or v < -margin or u > width + margin or v > height + margin:
            continue
        if shape[m] == FLAT and normal[m, 0] * x + normal[m, 1] * y + normal[m, 2] * z >= -0.02 * math.sqrt(
            x * x + y * y + z * z
        ):
            state[m] = HIDDEN
            continue
        # what hides is judged at mid-exposure; samples also tell how much of a marker the border leaves
        near_count = 0
        for g in range(geoms):
            if geom_marker[g] != m and may_hide(
                geom_xyz[g], geom_turn[g, :, 2], halves[g], reaches[g], x, y, z, r
            ):
                near[near_count] = g
                near_count += 1
        half = 0.6 * diameter + 1.0
        border = u < half or v < half or u > width - 1 - half or v > height - 1 - half
        if mesh.shape[0] > 0 and mesh[m] == 1:
            state[m] = MESH_NEAR
            continue
        if near_count == 0 and not border:
            state[m] = IN_VIEW
            add_outline(
                light, lens, table, reach, path[m], normal[m], r, shape[m], electrons[m], u, v, diameter
            )
            seen[m, 0] = 1.0
            continue
        if near_count > 0 and _hidden_by_one(
            near, near_count, kind, size, geom_xyz, geom_turn, x, y, z, r, shape[m], normal[m]
        ):
            state[m] = HIDDEN
            continue
        directions, cell, grid = sample_rays(lens, path[m, 1], normal[m], r, shape[m])
        free = np.ones(directions.shape[0], dtype=np.bool_)
        blocked = 0
        for i in range(directions.shape[0]):
            dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
            front = front_of(dx, dy, dz, x, y, z, r, shape[m], normal[m])
            for q in range(near_count):
                g = near[q]
                if hit(kind[g], size[g], geom_xyz[g], geom_turn[g], dx, dy, dz) < front * (1.0 - 1e-9):
                    free[i] = False
                    blocked += 1
                    break
        seen[m, 0] = share_seen(height, width, cell, grid, free) if blocked > 0 or border else 1.0
        if blocked == 0 and (not border or outline_lands(lens, path[m], normal[m], r, shape[m])):
            state[m] = IN_VIEW
            add_outline(
                light, lens, table, reach, path[m], normal[m], r, shape[m], electrons[m], u, v, diameter
            )
            continue
        state[m] = PARTLY
        spread_samples(light, lens, table, reach, path[m], electrons[m], cell, grid, free)
    return seen, state


@njit(nogil=True, cache=True)
def _hidden_by_one(near, count, kind, size, xyz, turn, x, y, z, r, shape, n):  # type: ignore[no-untyped-def]
    """Whether one convex geom hides the whole outline, drawn 5 % too large, and so all of the marker."""
    for q in range(count):
        g = near[q]
        all_hit = True
        for k in range(12):
            dx, dy, dz, _a, _b, _c = rim(shape, n, x, y, z, 1.05 * r, k * math.pi / 6)
            front = math.sqrt((x * x + y * y + z * z) / (dx * dx + dy * dy + dz * dz)) - r / math.sqrt(
                dx * dx + dy * dy + dz * dz
            )
            if not hit(kind[g], size[g], xyz[g], turn[g], dx, dy, dz) < front:
                all_hit = False
                break
        if all_hit:
            return True
    return False
