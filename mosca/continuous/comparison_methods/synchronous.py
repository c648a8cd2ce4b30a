"""Adjustment of points and cameras at common instants, with the epipoles' terms (second paper, eq. 4 and 7).

It minimises the squared reprojection errors of the points and, where one camera sees another, of that camera's centre
(or of a lamp that it carries) as a point that moves with the camera. There are three kinds of cameras: "known", held
as given; "fixed", one unknown pose each for all instants; "moving", an unknown pose each at every instant. With
"moving" cameras every instant is an adjustment of its own, independent of the others.

``mosca.calibration.bundle`` is not used because there an image point depends on one camera's pose and on a point of
the world or of a placed object. An epipole depends on two cameras' poses, and an object's pose cannot be the same
unknown as a camera's. Lenses, blunders and precision, for which that solver is made, are not needed here. The
adjustment is small: points are eliminated in blocks of three (Brown 1958), and epipoles only enter the reduced
system.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from mosca.camera.projection import cross_matrices, lens_directions
from mosca.continuous.comparison_methods.moving_projection import ProjectedPoints, project_moving, rotated
from mosca.data.arrays import Array
from mosca.data.rig import Camera

Cameras = Literal["known", "fixed", "moving"]
STEPS, WORST_DAMPING, TINY = 60, 1e12, 1e-12
"""Levenberg-Marquardt: most steps, damping at which it stops, and the least diagonal element."""
SETTLED = 1e-9
"""Relative decrease of the cost below which the iteration has converged."""
LOST_PX = 1e4
"""Error of a point that is not imaged at a trial pose [px]."""


@dataclass(frozen=True, eq=False)
class Views:
    """Image points of m points in c cameras at t common instants: ``xy_px`` (t, c, m, 2), NaN where not seen.

    ``carried_by`` (m,): camera that carries the point, -1 for none; ``carried_at`` (m, 3) its position there [m].
    """

    cameras: tuple[Camera, ...]
    xy_px: Array
    carried_by: Array
    carried_at: Array

    @property
    def free(self) -> Array:
        """Indices of the points that no camera carries."""
        return np.flatnonzero(self.carried_by < 0)

    def rays(self) -> Array:
        """Return the unit rays (t, c, m, 3) of all image points in the cameras' frames."""
        shape = self.xy_px.shape
        return np.stack(
            [
                lens_directions(camera.lens, self.xy_px[:, k].reshape(-1, 2)).reshape(shape[0], shape[2], 3)
                for k, camera in enumerate(self.cameras)
            ],
            axis=1,
        )


@dataclass(frozen=True, eq=False)
class PosesAndPoints:
    """Poses world_from_camera at every instant, ``rotations`` (t, c, 3, 3) and ``centres`` (t, c, 3) [m], and the
    free points' positions ``xyz`` (t, n, 3) [m], NaN where fewer than two cameras see the point.
    """

    rotations: Array
    centres: Array
    xyz: Array


@dataclass(frozen=True, eq=False)
class Adjusted:
    """``scene``: the least-squares result; ``rms_px`` (g,): rms of its image errors per axis, of all instants
    together (g = 1) or of each (cameras "moving").
    """

    scene: PosesAndPoints
    rms_px: Array


def intersected(views: Views, rotations: Array, centres: Array) -> Array:
    """Return the points (t, n, 3) nearest to their rays; NaN for fewer than two rays or parallel ones."""
    rays = np.einsum("tcij,tcmj->tcmi", rotations, views.rays()[:, :, views.free])
    seen = np.isfinite(rays).all(axis=-1)
    across = np.where(seen[..., None, None], np.eye(3) - rays[..., :, None] * rays[..., None, :], 0.0)
    normal = across.sum(axis=1)
    right = np.einsum("tcmij,tcj->tmi", across, centres)
    good = (seen.sum(axis=1) >= 2) & (np.linalg.eigvalsh(normal)[..., 0] > 1e-7)
    xyz = np.full(right.shape, np.nan)
    xyz[good] = np.linalg.solve(normal[good], right[good][..., None])[..., 0]
    return xyz


def adjust(views: Views, start: PosesAndPoints, cameras: Cameras, *, epipoles: bool = True) -> Adjusted:
    """Return the least-squares scene near ``start`` (Levenberg-Marquardt, points eliminated).

    ``epipoles``: whether carried points are used (eq. 7) or not (eq. 4). With unknown cameras the first one keeps its
    pose, and the size of the scene stays near the start's; both are the datum, which images do not determine. With
    "fixed" cameras the start's poses at the first instant are used for all.
    """
    task = _Task(views, cameras, epipoles)
    if cameras == "fixed":
        t = len(start.xyz)
        start = PosesAndPoints(
            np.repeat(start.rotations[:1], t, axis=0), np.repeat(start.centres[:1], t, axis=0), start.xyz
        )
    state, system = start, task.linearised(start)
    groups = len(system.cost)
    damping, live = np.full(groups, 1e-4), np.ones(groups, dtype=bool)
    for _ in range(STEPS):
        trial = task.stepped(state, system, damping, live)
        after = task.cost(trial)
        better = live & (after < system.cost)
        gained = (system.cost - after)[better] / np.maximum(system.cost[better], TINY)
        if better.any():
            state = task.chosen(state, trial, better)
            # a group without further decrease has converged
            live[np.flatnonzero(better)[gained < SETTLED]] = False
            system = task.linearised(state)
        damping = np.where(better, np.maximum(damping / 10, 1e-10), damping * 10)
        live &= damping < WORST_DAMPING
        live &= system.cost > TINY * np.maximum(system.count, 1)
        if not live.any():
            break
    return Adjusted(state, np.sqrt(system.cost / np.maximum(system.count, 1)))


@dataclass(frozen=True, eq=False)
class _System:
    """Normal equations of each instant: blocks of the points, their coupling to the cameras, and the camera block."""

    point: Array  # (t, n, 3, 3)
    point_right: Array  # (t, n, 3)
    across: Array  # (t, n, 6c, 3)
    camera: Array  # (g, 6c, 6c)
    camera_right: Array  # (g, 6c)
    cost: Array  # (g,)
    count: Array  # (g,) image coordinates


class _Task:
    def __init__(self, views: Views, cameras: Cameras, epipoles: bool) -> None:
        self.views, self.kind, self.free = views, cameras, views.free
        seen = np.asarray(np.isfinite(views.xy_px).all(axis=-1))
        ordinary = seen[:, :, self.free]
        enough = ordinary.sum(axis=1) >= 2
        self.seen = ordinary & enough[:, None]
        self.epipoles = []
        if epipoles and cameras != "known":
            for m in np.flatnonzero(views.carried_by >= 0):
                for viewer in range(len(views.cameras)):
                    at = np.flatnonzero(seen[:, viewer, m])
                    if len(at) and viewer != views.carried_by[m]:
                        self.epipoles.append((viewer, int(views.carried_by[m]), int(m), at))

    def linearised(self, scene: PosesAndPoints) -> _System:
        t, n = scene.xyz.shape[:2]
        size = 6 * len(self.views.cameras)
        point, right = np.zeros((t, n, 3, 3)), np.zeros((t, n, 3))
        across = np.zeros((t, n, size, 3))
        camera, camera_right = np.zeros((t, size, size)), np.zeros((t, size))
        cost, count = np.zeros(t), np.zeros(t)
        for k in range(len(self.views.cameras)):
            at, which, image, error = self._ordinary(scene, k)
            pose = np.concatenate([image.by_rotation, -image.by_point], axis=2)
            pose_t, point_t = np.swapaxes(pose, 1, 2), np.swapaxes(image.by_point, 1, 2)
            own = slice(6 * k, 6 * k + 6)
            point[at, which] += point_t @ image.by_point
            right[at, which] += (point_t @ error[:, :, None])[..., 0]
            across[at, which, own] = pose_t @ image.by_point
            np.add.at(camera[:, own, own], at, pose_t @ pose)
            np.add.at(camera_right[:, own], at, (pose_t @ error[:, :, None])[..., 0])
            np.add.at(cost, at, (error**2).sum(axis=1))
            np.add.at(count, at, 2.0)
        for viewer, carrier, m, at in self.epipoles:
            image, error = self._epipole(scene, viewer, m, at)
            slope = np.zeros((len(at), 2, size))
            slope[:, :, 6 * viewer : 6 * viewer + 3] = image.by_rotation
            slope[:, :, 6 * viewer + 3 : 6 * viewer + 6] = -image.by_point
            # d (R exp([w]x) a) / dw = -R [a]x
            cross = cross_matrices(self.views.carried_at[[m]])[0]
            slope[:, :, 6 * carrier : 6 * carrier + 3] = -image.by_point @ scene.rotations[at, carrier] @ cross
            slope[:, :, 6 * carrier + 3 : 6 * carrier + 6] = image.by_point
            camera[at] += np.swapaxes(slope, 1, 2) @ slope
            camera_right[at] += np.einsum("kpi,kp->ki", slope, error)
            cost[at] += (error**2).sum(axis=1)
            count[at] += 2.0
        if self.kind != "moving":
            camera, camera_right, cost, count = (
                a.sum(axis=0, keepdims=True) for a in (camera, camera_right, cost, count)
            )
        return _System(point, right, across, camera, camera_right, cost, count)

    def stepped(self, scene: PosesAndPoints, system: _System, damping: Array, live: Array) -> PosesAndPoints:
        t = len(scene.xyz)
        each = damping if self.kind == "moving" else np.full(t, damping[0])
        diagonal = np.einsum("tnii->tni", system.point)
        held = diagonal.sum(axis=2) == 0
        inverse = np.linalg.inv(
            system.point
            + np.eye(3) * (each[:, None, None] * diagonal + np.where(held, 1.0, 0.0)[..., None])[..., None]
        )
        rotations, centres = scene.rotations, scene.centres
        by_point = system.point_right
        if self.kind != "known":
            moved = self._poses(system, inverse, damping)  # (g, 6c)
            moved = np.where(live[:, None], moved, 0.0)
            every = np.broadcast_to(moved, (t, moved.shape[1]))
            by_point = by_point - np.einsum("tnap,ta->tnp", system.across, every)
            pose = every.reshape(-1, 6)
            rotations = rotated(rotations.reshape(-1, 3, 3), pose[:, :3]).reshape(rotations.shape)
            centres = centres + pose[:, 3:].reshape(centres.shape)
        return PosesAndPoints(rotations, centres, scene.xyz + np.einsum("tnpq,tnq->tnp", inverse, by_point))

    def _poses(self, system: _System, inverse: Array, damping: Array) -> Array:
        weighted = np.einsum("tnap,tnpq->tnaq", system.across, inverse)
        shape = weighted.shape
        flat = np.swapaxes(weighted, 1, 2).reshape(shape[0], shape[2], -1)
        other = np.swapaxes(system.across, 1, 2).reshape(shape[0], shape[2], -1)
        taken = flat @ np.swapaxes(other, 1, 2)
        taken_right = np.einsum("tnaq,tnq->ta", weighted, system.point_right)
        if self.kind == "fixed":
            taken, taken_right = taken.sum(axis=0, keepdims=True), taken_right.sum(axis=0, keepdims=True)
        diagonal = np.einsum("gaa->ga", system.camera)
        reduced = system.camera - taken
        reduced = reduced + np.eye(shape[2]) * (damping[:, None] * diagonal + TINY * diagonal.max())[..., None]
        moved = np.zeros_like(diagonal)
        # the first camera is the datum
        solved = np.linalg.solve(reduced[:, 6:, 6:], (system.camera_right - taken_right)[:, 6:, None])
        moved[:, 6:] = solved[..., 0]
        return np.asarray(moved)

    def cost(self, scene: PosesAndPoints) -> Array:
        cost = np.zeros(len(scene.xyz))
        for k in range(len(self.views.cameras)):
            at, _, _, error = self._ordinary(scene, k)
            np.add.at(cost, at, (error**2).sum(axis=1))
        for viewer, _, m, at in self.epipoles:
            cost[at] += (self._epipole(scene, viewer, m, at)[1] ** 2).sum(axis=1)
        return cost if self.kind == "moving" else cost.sum(keepdims=True)

    def chosen(self, old: PosesAndPoints, new: PosesAndPoints, better: Array) -> PosesAndPoints:
        take = better if self.kind == "moving" else np.full(len(old.xyz), better[0])
        rotations = np.where(take[:, None, None, None], new.rotations, old.rotations)
        centres = np.where(take[:, None, None], new.centres, old.centres)
        return PosesAndPoints(rotations, centres, np.where(take[:, None, None], new.xyz, old.xyz))

    def _ordinary(self, scene: PosesAndPoints, k: int) -> tuple[Array, Array, ProjectedPoints, Array]:
        """Return instants, points, image and errors (observed minus projected) of camera k's ordinary points."""
        at, which = np.nonzero(self.seen[:, k] & np.isfinite(scene.xyz).all(axis=2))
        image = project_moving(
            self.views.cameras[k], scene.rotations[at, k], scene.centres[at, k], scene.xyz[at, which]
        )
        return at, which, *image_errors(image, self.views.xy_px[at, k, self.free[which]])

    def _epipole(self, scene: PosesAndPoints, viewer: int, m: int, at: Array) -> tuple[ProjectedPoints, Array]:
        carrier = int(self.views.carried_by[m])
        lamp = scene.centres[at, carrier] + scene.rotations[at, carrier] @ self.views.carried_at[m]
        image = project_moving(
            self.views.cameras[viewer], scene.rotations[at, viewer], scene.centres[at, viewer], lamp
        )
        return image_errors(image, self.views.xy_px[at, viewer, m])


def image_errors(image: ProjectedPoints, observed: Array) -> tuple[ProjectedPoints, Array]:
    """Return images and their errors; where a point is not imaged, derivatives are 0 and the error is LOST_PX."""
    error = observed - image.xy_px
    lost = ~np.isfinite(error).all(axis=1)
    if not lost.any():
        return image, error
    none = lost[:, None, None]
    cleared = ProjectedPoints(
        image.xy_px, np.where(none, 0.0, image.by_point), np.where(none, 0.0, image.by_rotation)
    )
    return cleared, np.where(lost[:, None], LOST_PX, error)
