"""Forward velocity and yaw rate of a body on the ground, from its poses with their covariance.

There are two kinds. ``smoothed_velocities`` are values at each pose, by Rauch-Tung-Striebel smoothing of distance and
heading, with covariance; plots and comparisons show them. ``mean_velocities`` are means over each interval between
exposures, from the poses at its ends, without a model of the motion. Models are fitted to the means, since a smoother
removes the fast changes that determine the poles.

Forwards is the horizontal direction of the body's x axis; the body turns about the world's z.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from mosca.data.arrays import Array, set_read_only
from mosca.data.bodies import BodyPoses
from mosca.data.rotations import rotation_from_quaternion
from mosca.errors import InputError
from mosca.machines.identification.held_inputs import IntervalGrid
from mosca.smoothing.rts import axis_moves, smooth_states
from mosca.tracking.motion_models import motion

OUTPUTS = ("v_x", "yaw_rate")
UNITS = ("m/s", "rad/s")
FEWEST_POSES = 100
LEARNED_FROM = 2000
"""Number of instants from which the motion's strength and memory, and unknown noise, are learned; half of that
changes the rms of the smoothed velocities of the twin's robot by less than 2 %."""
SEARCHED = 7.0
"""Strengths and memory are searched within a factor e^7, 1000, of the first guess; a steady speed determines none."""
UNKNOWN = 1e12
"""Variance of a value without information."""
OFF_GRID = 0.1
"""Share of the period by which an exposure may be off the regular grid."""


@dataclass(frozen=True, eq=False)
class PlanarPath:
    """Poses of a body on the ground at n exposures.

    ``frame`` (n,), ``time_ns`` (n,); ``values`` (n, 3): x, y [m] and unwrapped yaw [rad]; ``covariance`` (n, 3, 3),
    NaN where the tracks have none.
    """

    frame: Array
    time_ns: Array
    values: Array
    covariance: Array

    def __post_init__(self) -> None:
        n = len(np.asarray(self.frame))
        set_read_only(self, np.int64, frame=(n,), time_ns=(n,))
        set_read_only(self, values=(n, 3), covariance=(n, 3, 3))

    @property
    def period_s(self) -> float:
        """Time from one frame to the next [s]."""
        return float((self.time_ns[-1] - self.time_ns[0]) * 1e-9 / (self.frame[-1] - self.frame[0]))

    @property
    def grid(self) -> IntervalGrid:
        """Intervals between frames from the first pose to the last; its clock is 0 at the first."""
        return IntervalGrid(0.0, self.period_s, int(self.frame[-1] - self.frame[0]))


@dataclass(frozen=True, eq=False)
class BodyVelocities:
    """Velocities of a body on the ground: ``values`` (n, 2) v_x [m/s], yaw rate [rad/s]; ``covariance`` (n, 2, 2)."""

    frame: Array
    time_ns: Array
    values: Array
    covariance: Array

    def __post_init__(self) -> None:
        n = len(np.asarray(self.frame))
        set_read_only(self, np.int64, frame=(n,), time_ns=(n,))
        set_read_only(self, values=(n, 2), covariance=(n, 2, 2))


def planar_path(poses: BodyPoses, where: str) -> PlanarPath:
    """Return the path on the ground of one body's measured poses; an InputError's text begins with ``where``.

    The covariance is that of the poses, without the calibration's. InputError for too few poses, times that are not
    those of regular frames, and an x axis that points up or down.
    """
    if len(poses) < FEWEST_POSES:
        raise InputError(f"{where}: the body has a pose in {len(poses)} frames; {FEWEST_POSES} at least are wanted")
    rotation = np.array([rotation_from_quaternion(q) for q in poses.quaternion])
    e = rotation[:, :, 0]
    level = e[:, 0] ** 2 + e[:, 1] ** 2
    if level.min() < 0.25:
        raise InputError(f"{where}: the body's x axis points up or down by more than 60 degrees; choose other --axes")
    # by the rotation vector r about the world's axes, e + r x e turns by r_z - e_z (e_x r_x + e_y r_y) / level
    change = np.zeros((len(poses), 3, 6))
    change[:, 0, 0] = change[:, 1, 1] = change[:, 2, 5] = 1.0
    change[:, 2, 3:5] = -e[:, 2:] * e[:, :2] / level[:, None]
    values = np.column_stack([poses.position[:, :2], np.unwrap(np.arctan2(e[:, 1], e[:, 0]))])
    covariance = change @ poses.covariance @ change.transpose(0, 2, 1)
    path = PlanarPath(poses.frame, poses.time_ns, values, covariance)
    regular = path.time_ns[0] + (path.frame - path.frame[0]) * (1e9 * path.period_s)
    off = np.abs(path.time_ns - regular)
    if off.max() > OFF_GRID * 1e9 * path.period_s:
        worst = int(np.argmax(off))
        raise InputError(
            f"{where}: frame {path.frame[worst]} is {off[worst] * 1e-6:.3g} ms off regular frames of "
            f"{1e3 * path.period_s:.4g} ms; exposures at a steady rate are wanted"
        )
    return path


def distance_along(path: PlanarPath) -> tuple[Array, Array]:
    """Return the distance (n,) [m] moved forwards since the first pose, and its variance (n,) [m^2].

    It is the sum of displacements from pose to pose along the mean of their headings; its relative error is
    (turn between them)^2 / 24.
    """
    heading = (path.values[1:, 2] + path.values[:-1, 2]) / 2
    move = np.diff(path.values[:, :2], axis=0)
    gone = np.concatenate([[0.0], np.cumsum(np.sum(move * _axis(heading), axis=1))])
    axis = _axis(path.values[:, 2])
    return gone, np.einsum("ni,nij,nj->n", axis, path.covariance[:, :2, :2], axis)


def mean_velocities(path: PlanarPath) -> Array:
    """Return the mean v_x and yaw rate (n, 2) over the intervals of ``path.grid``, NaN where an end is missing."""
    at = path.frame - path.frame[0]
    values = np.full((path.grid.n, 2), np.nan)
    next_to = np.flatnonzero(np.diff(at) == 1)
    gone = np.stack([distance_along(path)[0], path.values[:, 2]], axis=1)
    values[at[next_to]] = (gone[next_to + 1] - gone[next_to]) / path.period_s
    return values


def smoothed_velocities(path: PlanarPath, changes_s: Array) -> BodyVelocities:
    """Return velocities with covariance at each pose, smoothed over the whole path.

    Forward and yaw acceleration are each modelled with a memory and a steady noise (Singer), and with jumps when a
    command takes effect, at ``changes_s`` (m,) [s] after the first pose. Strengths and memory are maximum likelihood
    estimates from the path; so is the noise where the poses have no covariance.
    """
    gone, variance = distance_along(path)
    outputs = []
    for values, of_values in ((gone, variance), (path.values[:, 2], path.covariance[:, 2, 2])):
        axis = _Axis(values, of_values, path.time_ns, changes_s)
        outputs.append(axis.smoothed())
    values, covariance = (np.stack(parts, axis=1) for parts in zip(*outputs, strict=True))
    return BodyVelocities(path.frame, path.time_ns, values, covariance[:, :, None] * np.eye(2))


class _Axis:
    """One coordinate over time, ``values`` (n,) with ``variance`` (n,), and the instants of jumps in acceleration."""

    def __init__(self, values: Array, variance: Array, time_ns: Array, changes_s: Array) -> None:
        self.values, self.time_ns = values, time_ns
        self.variance = variance if np.isfinite(variance).all() else None
        seconds = (time_ns - time_ns[0]) * 1e-9
        self.steps = np.diff(seconds, prepend=seconds[0])
        # variance of the first velocity; it has no influence after a few frames
        self.speed2 = float(np.max((np.diff(values) / self.steps[1:]) ** 2)) + 1e-12
        row = np.searchsorted(seconds, changes_s)
        inside = (row > 0) & (row < len(seconds))
        self.row, self.rest = row[inside], seconds[row[inside]] - changes_s[inside]

    def smoothed(self) -> tuple[Array, Array]:
        """Return the velocity (n,) and its variance (n,)."""
        guess = self._first_guess()
        found = minimize(
            lambda logs: self._smooth(LEARNED_FROM, logs)[2],
            guess,
            method="Nelder-Mead",
            bounds=[(one - SEARCHED, one + SEARCHED) for one in guess],
            options={"xatol": 0.05, "fatol": 0.5, "maxiter": 150},
        )
        state, spread, _ = self._smooth(len(self.values), found.x)
        return state[:, 3], spread[:, 3, 3]

    def _first_guess(self) -> Array:
        """Return logarithms of steady and jumping acceleration, of the memory [s], and of noise if not stated."""
        rate = np.diff(self.values) / self.steps[1:]
        memory = 5.0 * float(np.median(self.steps[1:]))
        strength = max(float(rate.std()) / memory / 2, 1e-6)
        noise = max(float(np.median(np.abs(np.diff(self.values, n=2)))), 1e-9)
        return np.log([strength / 3, strength, memory] + ([noise] if self.variance is None else []))

    def _smooth(self, n: int, logs: Array) -> tuple[Array, Array, float]:
        """Return states (n, 9), covariances (n, 9, 9) and -2 log-likelihood of the first ``n`` instants.

        The kernel's state has three axes: the first is this one; the others carry no information.
        """
        even, jump, memory = np.exp(logs[:3])
        variance = np.full(len(self.values), np.exp(2 * logs[-1])) if self.variance is None else self.variance
        move, noise = axis_moves(self.steps[:n], float(memory))
        for k, rest in zip(self.row, self.rest, strict=True):
            if k < n:
                later = motion("acceleration", float(rest), float(memory))
                moved = np.array([later.pa, later.va, later.aa])
                noise[k] += (jump / even) ** 2 * np.outer(moved, moved)
        n = len(move)
        values = np.zeros((n, 3))
        values[:, 0] = self.values[:n]
        covariance = np.tile(np.diag([0.0, UNKNOWN, UNKNOWN]), (n, 1, 1))
        covariance[:, 0, 0] = variance[:n]
        state, spread, cost = smooth_states(
            values, covariance, np.ones(n, bool), move, noise, self.speed2, float(even) ** 2
        )
        return state, spread, float(cost)


def _axis(heading: Array) -> Array:
    return np.stack([np.cos(heading), np.sin(heading)], axis=1)
