"""Observation equations of image points, each at its own instant with its camera's pose at that instant."""

from dataclasses import dataclass

import numpy as np

from mosca.camera.projection import cross_matrices, lens_directions, project_with_jacobians
from mosca.continuous.estimator.banded_normals import Rows
from mosca.continuous.estimator.state import StateLayout, TrajectoryState
from mosca.continuous.model.bspline import values
from mosca.continuous.model.observations import TimedObservations
from mosca.data.arrays import Array
from mosca.data.rig import Camera, Pose, Rig

MOMENT_S = 1e-5
"""Step of the derivative by time [s]; positions are smooth over it, and their change is far above rounding."""
HUBER = 3.0
"""Huber's limit: larger image errors, in standard deviations, are downweighted."""


@dataclass(frozen=True, eq=False)
class LinearisedImages:
    """Image points at a state: ``residual`` (n, 2) in standard deviations, NaN where the lens does not image the
    point; ``rows``: 2 n equations with columns of the whole problem (3 per point, then 6 per moving camera), not yet
    weighted.
    """

    residual: Array
    rows: Rows


@dataclass(frozen=True, eq=False)
class _Near:
    """Image points' positions in their cameras' frames, ``v`` (n, 3), with the poses and rotation vectors used."""

    v: Array
    rotation: Array
    carrier_rotation: Array
    turn: Array
    carrier_turn: Array


class ImagePoints:
    """Image points with data that are constant during the estimate: whitening, lenses, carriers."""

    def __init__(self, observations: TimedObservations, rig: Rig) -> None:
        self.observations = observations
        here = Pose(np.eye(3), np.zeros(3))
        self.lenses = [
            Camera(c.name, c.width, c.height, c.lens, here) for c in (rig.camera(n) for n in observations.cameras)
        ]
        self.lens_px = np.array([rig.camera(n).residual_px for n in observations.cameras])
        self.whitening = np.linalg.inv(np.linalg.cholesky(observations.covariance_px2))
        self.carrier = observations.carried_by[observations.point]
        self.mask = [observations.camera == c for c in range(len(self.lenses))]

    def times(self, state: TrajectoryState) -> Array:
        """Return the instant of exposure (n,) of each image point [s]."""
        o = self.observations
        offset, drift, row_time = state.clocks[o.camera].T
        return np.asarray(offset + (1 + drift) * o.time_s + row_time * o.xy_px[:, 1])

    def _project(self, v: Array) -> tuple[Array, Array]:
        xy, by_v = np.empty((len(v), 2)), np.empty((len(v), 2, 3))
        for camera, own in zip(self.lenses, self.mask, strict=True):
            projected = project_with_jacobians(camera, v[own])
            xy[own], by_v[own] = projected.xy_px, projected.by_point
        return xy, by_v

    def _poses(self, state: TrajectoryState, time_s: Array) -> tuple[Array, Array, Array, Array]:
        """Return all cameras' rotations (k, c, 3, 3), centres and estimated rotation vectors (k, c, 3) at k instants,
        and the index (n,) among these of each of ``time_s`` (n,).
        """
        if state.moving is None:
            still = state.still
            none = np.zeros((1, *still.centres.shape))
            return still.rotations[None], still.centres[None], none, np.zeros(len(time_s), np.int64)
        # all points of an exposure share its instant, at which every camera's pose is evaluated once
        instant, which = np.unique(time_s, return_inverse=True)
        return *state.moving.at(instant), values(state.knots, state.moving.coefficients, instant)[..., :3], which

    def _near(self, state: TrajectoryState, time_s: Array) -> _Near:
        o = self.observations
        first, weight = state.knots.weights(time_s)
        reached = first[:, None] + np.arange(weight.shape[1])
        world = np.einsum("na,nai->ni", weight, state.xyz[reached, o.point[:, None]])
        rotations, centres, turns, which = self._poses(state, time_s)
        own, other = (which, o.camera), (which, self.carrier)
        rotation = rotations[own]
        is_carried = self.carrier >= 0
        if is_carried.any():
            at = o.carried_at[o.point]
            carried = centres[other] + np.einsum("nij,nj->ni", rotations[other], at)
            world = np.where(is_carried[:, None], carried, world)
        v = np.einsum("nji,nj->ni", rotation, world - centres[own])
        return _Near(v, rotation, rotations[other], turns[own], turns[other])

    def rays(self, state: TrajectoryState, depth: Array) -> LinearisedImages:
        """Return equations linear in the points: distances from rays, as image errors at a ``depth`` (n,) [m]."""
        o = self.observations
        time_s = self.times(state)
        directions = np.full((len(o), 3), np.nan)
        for camera, own in zip(self.lenses, self.mask, strict=True):
            directions[own] = lens_directions(camera.lens, o.xy_px[own])
        by_v = self._project(directions)[1] / depth[:, None, None]
        rotations, centres, _turns, which = self._poses(state, time_s)
        by_point = self.whitening @ by_v @ np.swapaxes(rotations[which, o.camera], 1, 2)
        rest = np.einsum("nij,nj->ni", by_point, centres[which, o.camera])
        return LinearisedImages(rest, self._rows(state, time_s, by_point, rest, np.zeros((len(o), 2, 0))))

    def depths(self, state: TrajectoryState) -> Array:
        """Return the distances (n,) of the points from their cameras [m]."""
        result: Array = np.linalg.norm(self._near(state, self.times(state)).v, axis=1)
        return result

    def residuals(self, state: TrajectoryState) -> Array:
        """Return measured minus predicted (n, 2) in standard deviations."""
        xy, _ = self._project(self._near(state, self.times(state)).v)
        return np.asarray(np.einsum("nij,nj->ni", self.whitening, self.observations.xy_px - xy))

    def linearised(self, state: TrajectoryState, places: StateLayout) -> LinearisedImages:
        """Return residuals and their equations at ``state``."""
        o = self.observations
        time_s = self.times(state)
        near = self._near(state, time_s)
        xy, by_v = self._project(near.v)
        residual = np.einsum("nij,nj->ni", self.whitening, o.xy_px - xy)
        by_v = self.whitening @ by_v
        by_point = by_v @ np.swapaxes(near.rotation, 1, 2)
        shared = np.zeros((len(o), 2, places.shared))
        if (places.clock >= 0).any():
            later = self._near(state, time_s + MOMENT_S).v
            by_time = np.einsum("nij,nj->ni", by_v, (later - near.v) / MOMENT_S)
            for kind, lever in enumerate((np.ones(len(o)), o.time_s, o.xy_px[:, 1])):
                column = places.clock[o.camera, kind]
                rows = np.flatnonzero(column >= 0)
                shared[rows, :, column[rows]] = by_time[rows] * lever[rows, None]
        if not (places.moving or places.still_free):
            return LinearisedImages(residual, self._rows(state, time_s, by_point, residual, shared))
        poses = np.concatenate([by_v @ cross_matrices(near.v), -by_point], axis=2)
        carried = -by_point @ near.carrier_rotation @ cross_matrices(o.carried_at[o.point])
        others = np.concatenate([carried, by_point], axis=2)
        if places.still_free:
            for k in range(places.cameras):
                shared[o.camera == k, :, 6 * k : 6 * k + 6] += poses[o.camera == k]
                shared[self.carrier == k, :, 6 * k : 6 * k + 6] += others[self.carrier == k]
            return LinearisedImages(residual, self._rows(state, time_s, by_point, residual, shared))
        poses[:, :, :3] = poses[:, :, :3] @ _right_jacobians(near.turn)
        others[:, :, :3] = others[:, :, :3] @ _right_jacobians(near.carrier_turn)
        return LinearisedImages(residual, self._rows(state, time_s, by_point, residual, shared, poses, others))

    def _rows(
        self, state: TrajectoryState, time_s: Array, by_point: Array, rest: Array, shared: Array,
        poses: Array | None = None, others: Array | None = None
    ) -> Rows:  # fmt: skip
        o = self.observations
        first, weight = state.knots.weights(time_s)
        point = np.where((self.carrier < 0)[:, None], 3 * o.point[:, None] + np.arange(3), -1)
        columns, by = [point], [by_point]
        if poses is not None and others is not None:
            base = 3 * len(o.points)
            columns.append(base + 6 * o.camera[:, None] + np.arange(6))
            by.append(poses)
            if (self.carrier >= 0).any():
                of_carrier = base + 6 * self.carrier[:, None] + np.arange(6)
                columns.append(np.where((self.carrier >= 0)[:, None], of_carrier, -1))
                by.append(others)
        joined = np.concatenate(by, axis=2)
        return Rows(
            np.repeat(first, 2), np.repeat(weight, 2, axis=0),
            np.repeat(np.concatenate(columns, axis=1), 2, axis=0), joined.reshape(-1, joined.shape[2]),
            shared.reshape(2 * len(shared), -1) if shared.size else np.zeros((2 * len(shared), shared.shape[2])),
            rest.ravel()
        )  # fmt: skip


def robust_weights(residual: Array) -> Array:
    """Return the robust weight of each image point (n,): 1 up to ``HUBER`` deviations, then falling with the square.

    Deviations are scaled by the residuals' median where that is larger than stated, so that a poor initial value does
    not reject all points. NaN has weight 0.
    """
    size = np.linalg.norm(residual, axis=1)
    known = np.isfinite(size)
    if not known.any():
        return np.zeros(len(size))
    # the median length of two normal numbers is sqrt(2 ln 2)
    scale = max(1.0, float(np.median(size[known])) / np.sqrt(2 * np.log(2)))
    return np.asarray(np.where(known, np.minimum(1.0, HUBER * scale / np.maximum(size, 1e-12)) ** 2, 0.0))


def weighted(rows: Rows, weight: Array) -> Rows:
    """Return equations (2 n,) with image points' weights (n,); those of weight 0 are left out."""
    root = np.repeat(np.sqrt(weight), 2)
    keep = root > 0
    first, weights, columns, by, shared, rest = (column[keep] for column in rows)
    root = root[keep]
    return Rows(first, weights, columns, by * root[:, None], shared * root[:, None], rest * root)


def _right_jacobians(turns: Array) -> Array:
    """Return d(rotation about own axes)/d(rotation vector) (n, 3, 3) (Sola 2018, eq. 143)."""
    angle = np.maximum(np.linalg.norm(turns, axis=1), 1e-6)[:, None, None]
    cross = cross_matrices(turns)
    return np.asarray(
        np.eye(3) - (1 - np.cos(angle)) / angle**2 * cross + (angle - np.sin(angle)) / angle**3 * cross @ cross
    )
