"""The second paper's neural trajectory (section 4.2): each point a network of time, all exposures at their own times.

Stated in the paper: one hidden layer of 256 units, time encoded to four numbers, three outputs, started from the
cubic spline's result, then eq. 8: squared reprojection errors of points and epipoles over all exposures; cameras as
functions of time in the same way. Left open there, and chosen here: activation tanh; encoding sin and cos of pi s and
2 pi s, s from 0 to 1; a network for each point, and for unknown cameras one for each of the six components of a pose;
hidden weights drawn so that a unit switches within ``response_s``; Levenberg-Marquardt over all weights. With more
weights than image points the errors can become zero in many ways. Which solution is reached depends on the start and
on the shortest steps from it, and so on the drawn hidden weights. Two settings were chosen on motions that are not in
the tables.
"""

from dataclasses import dataclass, replace

import numpy as np

from mosca.continuous.comparison_methods.interpolated import Interpolated
from mosca.continuous.comparison_methods.moving_projection import project_moving
from mosca.continuous.comparison_methods.neural_cameras import NetPoses, PoseModel, SteadyPoses
from mosca.continuous.comparison_methods.neural_net import Nets, Tangent, damped_solve, fitted
from mosca.continuous.comparison_methods.synchronous import Cameras, image_errors
from mosca.continuous.model.observations import TimedObservations
from mosca.data.arrays import Array
from mosca.data.rig import Rig


@dataclass(frozen=True)
class NeuralSettings:
    """``response_s``: time in which a hidden unit switches [s]; ``ridge``: least damping of a step, relative to the
    mean diagonal of the tangent kernel; ``steps``: most steps; ``seed`` of the hidden weights.
    """

    response_s: float = 0.07
    ridge: float = 1e-3
    steps: int = 6
    seed: int = 0


@dataclass(frozen=True, eq=False)
class Neural:
    """Trajectories as networks: ``points`` names, ``paths`` of the cameras, ``rms_px`` of the image errors per axis.

    ``from_s``, ``to_s`` (points,): between these the starting curves contain the point [s].
    """

    points: tuple[str, ...]
    nets: Nets
    middle: Array
    size_m: float
    from_s: Array
    to_s: Array
    paths: PoseModel
    rms_px: float

    def at(self, time_s: Array) -> Array:
        """Return the positions (t, points, 3) [m]; NaN where a point is not known."""
        t = np.asarray(time_s, dtype=float)
        xyz = self.anywhere(t)
        xyz[(t[:, None] < self.from_s - 1e-9) | (t[:, None] > self.to_s + 1e-9)] = np.nan
        return xyz

    def anywhere(self, time_s: Array) -> Array:
        """Return the output of the networks (t, points, 3) [m], known or not."""
        return np.array(np.moveaxis(self.middle[:, None] + self.size_m * self.nets.at(time_s), 0, 1))


def neural(
    observations: TimedObservations,
    rig: Rig,
    start: Interpolated,
    cameras: Cameras = "known",
    *,
    epipoles: bool = True,
    settings: NeuralSettings | None = None,
) -> Neural:
    """Return the neural trajectories that fit all exposures, begun at the spline's result ``start``.

    ``cameras`` and ``epipoles`` as in ``interpolated``; unknown cameras start at their poses in ``start``, and the
    first one stays there (datum). Computing time grows with the cube of the exposures: for recordings of seconds, not
    minutes.
    """
    settings = settings or NeuralSettings()
    rng = np.random.default_rng(settings.seed)
    first, last = float(start.instants_s[0]), float(start.instants_s[-1])
    xyz = np.moveaxis(start.scene.xyz, 1, 0)
    known = np.asarray(np.isfinite(xyz).all(axis=2))
    count = np.maximum(known.sum(axis=1), 1)[:, None]
    middle = np.where(known[..., None], xyz, 0.0).sum(axis=1) / count
    away = np.where(known[..., None], xyz - middle[:, None], 0.0)
    size = float(np.sqrt((away**2).sum(axis=1) / count)[known.any(axis=1)].mean()) or 1.0
    from_s = np.where(known, start.instants_s, np.inf).min(axis=1)
    to_s = np.where(known, start.instants_s, -np.inf).max(axis=1)
    fresh = Nets.fresh(len(xyz), 3, (first, last), settings.response_s, rng)
    nets = fitted(fresh, start.instants_s, (xyz - middle[:, None]) / size, steps=3)
    rotations, centres = start.scene.rotations, start.scene.centres
    poses: PoseModel = SteadyPoses(observations.cameras, rotations[0], centres[0])
    if cameras == "moving":
        own = Nets.fresh(6 * len(observations.cameras), 1, (first, last), settings.response_s, rng)
        poses = NetPoses.fit(observations.cameras, own, start.instants_s, rotations, centres)
    begun = Neural(start.points, nets, middle, size, from_s, to_s, poses, np.inf)
    # a point that the start never determines has no trajectory, and outside its known time there is no start for it
    early, late = np.full(len(observations.points), first), np.full(len(observations.points), last)
    early[observations.free], late[observations.free] = from_s, to_s
    point, t = observations.point, observations.time_s
    kept = observations.only((t >= early[point] - 1e-9) & (t <= late[point] + 1e-9))
    return _descended(_Task(kept, rig, cameras, epipoles), begun, settings)


def _descended(task: "_Task", state: Neural, settings: NeuralSettings) -> Neural:
    damping = 1e-2
    linear = task.linearised(state)
    for _ in range(settings.steps):
        trial = task.stepped(state, linear, max(damping, settings.ridge))
        after = task.linearised(trial)
        if after.cost >= linear.cost:
            damping *= 10
            if damping > 1e3:
                break
            continue
        gained = 1 - after.cost / linear.cost
        state, linear, damping = trial, after, damping / 10
        if gained < 0.01 and damping < settings.ridge:
            break
    return replace(state, rms_px=float(np.sqrt(linear.cost / max(linear.count, 1))))


@dataclass(frozen=True, eq=False)
class _Linear:
    """Errors and derivatives of all image points: of points (p, q, 2), with ``onto`` (p, q, 2, 3) by the networks'
    outputs and ``by_pose`` (p, q, 2, 6) by their camera's pose; of epipoles (k, 2), (k, 2, 6) by viewer and carrier.
    """

    error: Array
    onto: Array
    by_pose: Array
    epipole_error: Array
    by_viewer: Array
    by_carrier: Array
    cost: float
    count: int


class _Task:
    def __init__(self, see: TimedObservations, rig: Rig, cameras: Cameras, epipoles: bool) -> None:
        self.see, self.kind = see, cameras
        self.cameras = tuple(rig.camera(name) for name in see.cameras)
        self.instants, self.when = np.unique(see.time_s, return_inverse=True)
        members = [np.flatnonzero(see.point == m) for m in see.free]
        most = max(len(one) for one in members)
        self.index = np.array([np.pad(one, (0, most - len(one)), constant_values=-1) for one in members])
        self.real = self.index >= 0
        carried = see.carried_by[see.point] >= 0
        self.epipoles = np.flatnonzero(carried if epipoles and cameras != "known" else np.zeros(len(see), bool))

    def linearised(self, state: Neural) -> _Linear:
        see = self.see
        rotations, centres = state.paths.at(self.instants)
        places = np.moveaxis(state.anywhere(self.instants), 0, 1)  # (p, t, 3)
        p, q = self.index.shape
        error, onto, by_pose = np.zeros((p, q, 2)), np.zeros((p, q, 2, 3)), np.zeros((p, q, 2, 6))
        which, column = np.nonzero(self.real)
        row = self.index[which, column]
        e, by_point, pose = self._seen(row, rotations, centres, places[which, self.when[row]])
        error[which, column], onto[which, column] = e, by_point * state.size_m
        by_pose[which, column] = pose
        row = self.epipoles
        carrier = see.carried_by[see.point[row]]
        at = see.carried_at[see.point[row]]
        own = rotations[self.when[row], carrier]
        lamp = centres[self.when[row], carrier] + np.einsum("kij,kj->ki", own, at)
        e2, by_lamp, viewer = self._seen(row, rotations, centres, lamp)
        cross = np.cross(np.eye(3)[None], at[:, None, :])  # rows e_i x a: -[a]x
        turn = by_lamp @ own @ np.swapaxes(cross, 1, 2)
        carried = np.concatenate([turn, by_lamp], axis=2)
        cost = float((error**2).sum() + (e2**2).sum())
        return _Linear(error, onto, by_pose, e2, viewer, carried, cost, 2 * (len(which) + len(row)))

    def _seen(self, row: Array, rotations: Array, centres: Array, points: Array) -> tuple[Array, Array, Array]:
        """Return errors (k, 2) and derivatives by point (k, 2, 3) and pose (k, 2, 6) of image points ``row`` (k,)."""
        see = self.see
        error, by_point, pose = (np.zeros((len(row), 2)), np.zeros((len(row), 2, 3)), np.zeros((len(row), 2, 6)))
        for k, camera in enumerate(self.cameras):
            own = see.camera[row] == k
            if not own.any():
                continue
            at = self.when[row[own]]
            projected = project_moving(camera, rotations[at, k], centres[at, k], points[own])
            image, error[own] = image_errors(projected, see.xy_px[row[own]])
            by_point[own] = image.by_point
            pose[own] = np.concatenate([image.by_rotation, -image.by_point], axis=2)
        return error, by_point, pose

    def stepped(self, state: Neural, linear: _Linear, damping: float) -> Neural:
        p, q = self.index.shape
        times = np.where(self.real, self.see.time_s[self.index], state.nets.start_s)
        tangent = Tangent.of(state.nets, times, linear.onto)
        kernel = tangent.kernel()
        mu = damping * float(np.einsum("paa->", kernel)) / max(2 * int(self.real.sum()), 1)
        error = linear.error.reshape(p, -1)
        if self.kind == "known":
            dual = damped_solve(kernel, np.full(p, mu), error[..., None])[..., 0]
            return replace(state, nets=tangent.moved(dual))
        slopes = state.paths.slopes(self.instants)  # (t, c, 6, u)
        c, u = slopes.shape[1], slopes.shape[3]
        normal, right = np.eye(c * u) * (mu if self.kind == "moving" else 1e-9 * mu), np.zeros(c * u)
        solved = []
        for k in range(p):
            row = self.index[k][self.real[k]]
            camera = self.see.camera[row]
            block = np.zeros((2 * q, c, u))
            own = np.flatnonzero(self.real[k])
            part = linear.by_pose[k, own] @ slopes[self.when[row], camera]  # (k, 2, u)
            block[2 * own, camera], block[2 * own + 1, camera] = part[:, 0], part[:, 1]
            block = block.reshape(2 * q, -1)
            both = damped_solve(kernel[k : k + 1], np.array([mu]), np.column_stack([block, error[k]])[None])[0]
            solved.append(both)
            normal += mu * block.T @ both[:, :-1]
            right += mu * block.T @ both[:, -1]
        if len(self.epipoles):
            row = self.epipoles
            at, viewer, carrier = (self.when[row], self.see.camera[row], self.see.carried_by[self.see.point[row]])
            block = np.zeros((len(row), c, 2, u))
            each = np.arange(len(row))
            block[each, viewer] += linear.by_viewer @ slopes[at, viewer]
            block[each, carrier] += linear.by_carrier @ slopes[at, carrier]
            flat = np.swapaxes(block, 1, 2).reshape(2 * len(row), -1)
            normal += flat.T @ flat
            right += flat.T @ linear.epipole_error.ravel()
        z = np.zeros(c * u)
        z[u:] = np.linalg.solve(normal[u:, u:], right[u:])
        dual = np.array([both[:, -1] - both[:, :-1] @ z for both in solved])
        return replace(state, nets=tangent.moved(dual), paths=state.paths.moved(self.instants, z.reshape(c, u)))
