"""Occlusion of targets by meshes, by MuJoCo's exact ray caster at as many instants as the relative motion needs."""

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np

from mosca.data.arrays import Array
from twin.cameras.optics.lens import many_pixels
from twin.cameras.render.inputs import TargetPose, TargetsInCamera
from twin.cameras.render.occluder_culling import GROUP_PX, MOST_GROUPS
from twin.cameras.render.occluders import Occluders, may_hide
from twin.cameras.render.outline import lagrange_weights
from twin.cameras.render.ray_samples import SampleGrid, runs, sample_rays
from twin.scenes.scene import UNSEEN_GROUP

SceneAt = Callable[[float], tuple[Any, Array, Array]]
"""Seconds from the first row's opening -> MjData of that instant, and the camera's rotation and position in the
world. The results of a call are valid until the next call.
"""


class MeshRays:
    """Occlusion of the markers of a scene by meshes; ``middle_s``: the exposure's middle."""

    def __init__(
        self, model: Any, scene_at: SceneAt, middle_s: float, occluders: Occluders, marker_geoms: tuple[int, ...]
    ) -> None:
        self.model, self.scene_at, self.middle_s = model, scene_at, middle_s
        self.occluders, self.marker_geoms = occluders, marker_geoms
        self.groups = np.ones(6, dtype=np.uint8)
        self.groups[UNSEEN_GROUP] = 0

    def candidates(self, targets: TargetsInCamera) -> Array:
        """Return for each target 1 where a mesh's bounding sphere can hide any of it (m,)."""
        chosen = np.zeros(len(targets.radius), dtype=np.int64)
        data, rotation, position = self.scene_at(self.middle_s)
        middle = targets.path.shape[1] // 2
        swing = np.ptp(targets.path, axis=1).max(axis=1)
        for geom, reach in zip(self.occluders.mesh_geom, self.occluders.mesh_radius, strict=True):
            centre = rotation.T @ (data.geom_xpos[geom] - position)
            for m, where in enumerate(targets.path[: len(self.marker_geoms), middle]):
                far, size = reach + 2.0 * swing[m], targets.radius[m]
                if may_hide(centre, np.zeros(3), 0.0, far, where[0], where[1], where[2], size):
                    chosen[m] = 1
        return chosen

    def hidden(
        self, marker: int, lens: Array, targets: TargetsInCamera, nodes: Array, span: Array
    ) -> tuple[Array, Array, float, bool]:
        """Return the boundary (n, 3) of the hidden part of a target, group after group of instants, the first index
        of each group (g + 1,), the hidden share of its samples, and whether the boundary is that of the visible rest.

        ``span``: begin, middle and end of the exposure [s]. The rest is given for a target that is mostly hidden or
        passed fast: as a difference of large areas it would be blurred.
        """
        begin, middle, end = (float(t) for t in span)
        slip = self._slip(marker, lens, targets, nodes, begin, end)
        groups = 1 if slip < GROUP_PX else min(MOST_GROUPS, 1 + int(slip / GROUP_PX))
        instants = [middle] if groups == 1 else [begin + (end - begin) * (g + 0.5) / groups for g in range(groups)]
        found = [self._samples_at(marker, lens, targets, nodes, t, groups == 1) for t in instants]
        share = float(np.mean([1.0 - free.mean() if len(free) else 1.0 for _cell, _grid, free in found]))
        rest = groups > 1 or share > 0.5
        edges = [runs(cell, grid, free if rest else ~free, 1.0 if rest else -1.0) for cell, grid, free in found]
        first = np.concatenate([[0], np.cumsum([len(e) for e in edges])]).astype(np.int64)
        return np.concatenate(edges), first, share, rest

    def _slip(
        self, marker: int, lens: Array, targets: TargetsInCamera, nodes: Array, begin: float, end: float
    ) -> float:
        """Return the largest motion [px] of the meshes' points nearest the line of sight past a target's image."""
        geoms = self.occluders.mesh_geom
        sight = interpolate(targets.path[marker], nodes, 0.5 * (begin + end))
        data, rotation, position = self.scene_at(0.5 * (begin + end))
        share = np.clip(((data.geom_xpos[geoms] - position) @ rotation) @ sight / (sight @ sight), 0.05, 1.0)
        world = position + (share[:, None] * sight) @ rotation.T
        local = np.einsum("gji,gj->gi", _geom_rotations(data, geoms), world - data.geom_xpos[geoms])
        images = []
        for t in (begin, end):
            data, rotation, position = self.scene_at(t)
            moved = np.einsum("gij,gj->gi", _geom_rotations(data, geoms), local) + data.geom_xpos[geoms]
            both = np.vstack([(moved - position) @ rotation, interpolate(targets.path[marker], nodes, t)])
            images.append(many_pixels(lens, np.ascontiguousarray(both)))
        way = images[1] - images[0]
        slips = np.linalg.norm(way[:-1] - way[-1], axis=1)
        return float(np.max(slips[np.isfinite(slips)], initial=0.0))

    def _samples_at(
        self, marker: int, lens: Array, targets: TargetsInCamera, nodes: Array, time_s: float, still: bool
    ) -> tuple[Array, SampleGrid, Array]:
        """Return the cells of a target's samples at an instant, their grid, and which of them nothing hides."""
        x, y, z = (float(c) for c in interpolate(targets.path[marker], nodes, time_s))
        target_rotation = interpolate(targets.rotation[marker], nodes, time_s)
        target = TargetPose(int(targets.shape[marker]), target_rotation, x, y, z, float(targets.radius[marker]))
        for per_px in (3, 0):  # coarse samples suffice for most
            rays, cell, grid = sample_rays(lens, target, per_px)
            free = self.visible(marker, rays, time_s)
            if per_px and len(free) >= 30 and (not free.any() or (still and free.all())):
                break
        return cell, grid, free

    def visible(self, marker: int, directions: Array, time_s: float) -> Array:
        """Return which rays (n, 3), camera frame, meet the target before anything else at an instant (n,)."""
        data, rotation, position = self.scene_at(time_s)
        unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        world = np.ascontiguousarray(unit @ rotation.T)
        n = len(world)
        geoms, distances = np.full(n, -1, dtype=np.int32), np.zeros(n)
        if n:
            mujoco.mj_multiRay(
                self.model, data, np.ascontiguousarray(position), world.ravel(), self.groups, 1, -1,
                geoms, distances, None, n, 1e6,
            )  # fmt: skip
        result: Array = geoms == self.marker_geoms[marker]
        return result


def _geom_rotations(data: Any, geoms: Array) -> Array:
    rotations: Array = data.geom_xmat[geoms].reshape(-1, 3, 3)
    return rotations


def interpolate(values: Array, nodes: Array, time_s: float) -> Array:
    """Return values (K, ...), given at ``nodes`` (K,), interpolated at an instant."""
    weights = np.empty(len(nodes))
    lagrange_weights(nodes, time_s, weights)
    return np.asarray(np.tensordot(weights, values, axes=1))
