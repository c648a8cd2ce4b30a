"""Pose of a rigid body at any instant: between its exposures, and ahead of the newest one.

Position and rotation have a Kalman filter each, with Singer's motion model and the likeliest variance of the
acceleration (``mosca.smoothing.augmented_filter``); the angular acceleration is learned in the same way. The rotation
has a multiplicative filter (Markley 2003): its state is the rotation vector, about the world's axes, from the newest
rotation, and is set to zero after each measurement. A motion of constant velocity and constant angular velocity is
predicted exactly. An instant between two exposures is smoothed with the measurements around it
(``mosca.smoothing.rts``).

The covariances stated by the poses are multiplied by the likeliest of a few factors: errors larger than stated would
look like accelerations. Covariances between position and rotation are left out.
"""

from collections import deque
from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from pydantic.dataclasses import dataclass

from mosca.data.arrays import Array
from mosca.data.bodies import BodyPoses
from mosca.data.files.toml import SETTINGS, NotNegative, Positive
from mosca.data.rotations import rotation_from_quaternion, rotation_from_vector
from mosca.rigid_bodies.pose import vector_of
from mosca.smoothing.augmented_filter import TrackMeasurements, empty_filters, update
from mosca.smoothing.fixed_lag import PRIOR_COST, motion_prior
from mosca.smoothing.rts import LADDER, axis_moves, smooth_one

KEPT = 64
"""Number of newest poses that are kept; there is no pose for instants before them."""
AROUND = 6
"""Number of poses before, and after, an instant between two exposures that are used to smooth it."""

STARTING = 3
"""Poses since a body was found that determine position, velocity and acceleration; before that: ``starting``."""

SCALES = (1.0, 2.0, 4.0, 8.0)
"""Factors on the stated standard deviations that are tried: an error that all markers share (a camera that shakes) is
not in a pose's covariance."""

PoseStatus = Literal["interpolated", "extrapolated", "starting", "stale"]


@dataclass(frozen=True, config=SETTINGS)
class PredictionSettings:
    """How bodies move, and how far ahead their poses are predicted."""

    horizon_s: NotNegative = 0.1
    """Farthest that a pose is predicted beyond its newest exposure [s]: as long as an acceleration lasts."""
    memory_s: Positive = 0.1
    """Correlation time of acceleration and angular acceleration [s]."""
    speed_mps: Positive = 3.0
    """Standard deviation of a first velocity, an axis."""
    turn_rad_s: Positive = 10.0
    """Standard deviation of a first angular velocity, an axis."""
    acceleration_mps2: NotNegative | None = None
    """Standard deviation of the acceleration, an axis; None: learned."""
    turn_rad_s2: NotNegative | None = None
    """Standard deviation of the angular acceleration, an axis; None: learned."""
    learn_s: Positive = 2.0
    """Time constant with which their likelihoods are forgotten."""


class PredictedPose(NamedTuple):
    """A pose at an instant, and its basis."""

    rotation: Array
    """(3, 3) of world_from_body."""
    position: Array
    """(3,) [m]"""
    covariance: Array
    """(6, 6) of position [m], then rotation vector about the world's axes [rad]; as in ``BodyPoses``."""
    status: PoseStatus
    """``stale``: the newest exposure is older than the horizon; the pose is that at the end of the horizon.
    ``starting``: predicted from fewer than three poses, which do not determine how the body moves."""
    newest_ns: int
    """Middle of the newest exposure known so far."""


class _Measured(NamedTuple):
    time_ns: int
    rotation: Array
    position: Array
    covariance: Array


class _SingerFilter:
    """A filter of a vector (3,) with Singer's motion model; the variance of its acceleration is learned or given.

    ``scale``: factor on the stated standard deviations of the measurements.
    """

    def __init__(
        self, speed: float, acceleration: float | None, memory_s: float, learn_s: float, scale: float
    ) -> None:
        prior = motion_prior(speed, acceleration)
        self.scale = scale
        self._prior = prior._replace(start=prior.start + PRIOR_COST * np.log2(scale) ** 2)
        self._filters = empty_filters(1, 1, len(LADDER))
        self._memory_s, self._learn_s = memory_s, learn_s

    @property
    def variance(self) -> float:
        """Variance of the acceleration, an axis: the given one, or the likeliest."""
        return self._prior.fixed if self._prior.fixed >= 0 else float(LADDER[self._filters.cost[0].argmin()]) ** 2

    @property
    def cost(self) -> float:
        """-2 log-likelihood of the likeliest variance."""
        return float(self._filters.cost[0].min())

    def update(self, step_s: float, value: Array, covariance: Array, first: bool) -> None:
        """Take a measurement (3,) with its covariance (3, 3), ``step_s`` [s] after the previous one."""
        move, noise = axis_moves(np.array([step_s]), self._memory_s)
        remembered = np.array([np.exp(-step_s / self._learn_s)])
        self._filters.kept[0] = 0
        row = np.zeros(1, np.int64), np.array([first]), value[None].copy(), self.scale**2 * covariance[None]
        update(TrackMeasurements(*row, move, noise, remembered), self._prior, self._filters)

    def ahead(self, step_s: float) -> tuple[Array, Array]:
        """Return the value (3,) ``step_s`` [s] after the newest measurement, and its covariance (3, 3)."""
        (move,), (noise,) = axis_moves(np.array([step_s]), self._memory_s)
        row = np.kron(move[0], np.eye(3))
        spread = row @ self._filters.spread[0] @ row.T + self.variance * noise[0, 0] * np.eye(3)
        return row @ self._filters.mean[0], spread

    def subtract(self, value: Array) -> None:
        """Move the origin of the measured vector to ``value`` (3,)."""
        self._filters.mean[0, :3] -= value
        self._filters.axis_mean[0, :, :, 0] -= value


class _LearnedFilter:
    """Filters of one vector (3,) with different factors on the measurements' errors; the likeliest is used.

    Where the acceleration is given, there is a single filter, which takes the covariances as stated.
    """

    def __init__(self, speed: float, acceleration: float | None, memory_s: float, learn_s: float) -> None:
        scales = SCALES if acceleration is None else (1.0,)
        self._filters = [_SingerFilter(speed, acceleration, memory_s, learn_s, scale) for scale in scales]

    @property
    def best(self) -> _SingerFilter:
        """The likeliest filter."""
        return min(self._filters, key=lambda one: one.cost)

    def update(self, step_s: float, value: Array, covariance: Array, first: bool) -> None:
        """Update each filter, as ``_SingerFilter.update``."""
        for one in self._filters:
            one.update(step_s, value, covariance, first)

    def subtract(self, value: Array) -> None:
        """Move the origin in each filter, as ``_SingerFilter.subtract``."""
        for one in self._filters:
            one.subtract(value)


class BodyPredictor:
    """Predicts one body. Stateful: give it its poses in order of time."""

    def __init__(self, settings: PredictionSettings | None = None) -> None:
        s = PredictionSettings() if settings is None else settings
        self.settings = s
        self._moves = _LearnedFilter(s.speed_mps, s.acceleration_mps2, s.memory_s, s.learn_s)
        self._turns = _LearnedFilter(s.turn_rad_s, s.turn_rad_s2, s.memory_s, s.learn_s)
        self._kept: deque[_Measured] = deque(maxlen=KEPT)
        self._rotation = np.eye(3)

    @property
    def strengths(self) -> tuple[float, float]:
        """Standard deviations of acceleration [m/s^2] and angular acceleration [rad/s^2], an axis, as used now."""
        return self._moves.best.variance**0.5, self._turns.best.variance**0.5

    @property
    def scales(self) -> tuple[float, float]:
        """Factors on the stated standard deviations of position and rotation, as used now."""
        return self._moves.best.scale, self._turns.best.scale

    def update(self, poses: BodyPoses) -> None:
        """Take the body's poses; withheld poses, and poses not later than the newest one, are left out.

        After a gap of more than two horizons the motion before the gap is forgotten.
        """
        for row in np.flatnonzero(poses.status == "measured"):
            time_ns = int(poses.time_ns[row])
            newest = self._kept[-1].time_ns if self._kept else time_ns
            if self._kept and time_ns <= newest:
                continue
            step_s = (time_ns - newest) * 1e-9
            if step_s > 2 * self.settings.horizon_s:
                self._kept.clear()
            rotation = rotation_from_quaternion(poses.quaternion[row])
            self._take(_Measured(time_ns, rotation, poses.position[row], poses.covariance[row]), step_s)

    def at(self, time_ns: int) -> PredictedPose | None:
        """Return the pose at ``time_ns``; None before the first pose, and before the oldest pose that is kept."""
        if not self._kept or time_ns < self._kept[0].time_ns:
            return None
        newest_ns = self._kept[-1].time_ns
        if time_ns < newest_ns:
            return self._between(time_ns)
        step_s = (time_ns - newest_ns) * 1e-9
        used_s = min(step_s, self.settings.horizon_s)
        position, spread = self._moves.best.ahead(used_s)
        turn, turn_spread = self._turns.best.ahead(used_s)
        known: PoseStatus = "extrapolated" if len(self._kept) >= STARTING else "starting"
        status: PoseStatus = known if used_s == step_s else "stale"
        rotation = rotation_from_vector(turn) @ self._rotation
        return PredictedPose(rotation, position, _joined(spread, turn_spread), status, newest_ns)

    def newest(self) -> PredictedPose | None:
        """Return the newest pose as it was measured; None before the first."""
        if not self._kept:
            return None
        one = self._kept[-1]
        return PredictedPose(one.rotation, one.position, one.covariance, "extrapolated", one.time_ns)

    def _take(self, one: _Measured, step_s: float) -> None:
        first = not self._kept
        if first:
            self._rotation = one.rotation
        expected = np.zeros(3) if first else self._turns.best.ahead(step_s)[0]
        predicted = rotation_from_vector(expected) @ self._rotation
        self._turns.update(step_s, expected + vector_of(one.rotation @ predicted.T), one.covariance[3:, 3:], first)
        corrected, _ = self._turns.best.ahead(0.0)
        self._rotation = rotation_from_vector(corrected - expected) @ predicted
        self._turns.subtract(corrected)
        self._moves.update(step_s, one.position, one.covariance[:3, :3], first)
        self._kept.append(one)

    def _between(self, time_ns: int) -> PredictedPose:
        """Return the pose at an instant before the newest pose, smoothed with the poses around it."""
        kept = list(self._kept)
        before = int(np.searchsorted([one.time_ns for one in kept], time_ns, side="right"))
        used = kept[max(0, before - AROUND) : before + AROUND]
        reference = kept[before - 1].rotation
        turns = np.array([vector_of(one.rotation @ reference.T) for one in used])
        places = np.array([one.position for one in used])
        spreads = np.array([one.covariance for one in used])
        s, times = self.settings, [one.time_ns for one in used]
        position, spread = self._smoothed(times, places, spreads[:, :3, :3], time_ns, s.speed_mps, self._moves.best)
        turn, turn_spread = self._smoothed(times, turns, spreads[:, 3:, 3:], time_ns, s.turn_rad_s, self._turns.best)
        rotation = rotation_from_vector(turn) @ reference
        return PredictedPose(rotation, position, _joined(spread, turn_spread), "interpolated", kept[-1].time_ns)

    def _smoothed(
        self,
        times: Sequence[int],
        values: Array,
        covariance: Array,
        time_ns: int,
        speed: float,
        motion: _SingerFilter,
    ) -> tuple[Array, Array]:
        """Return the vector (3,) at ``time_ns`` and its covariance (3, 3), from (n, 3) and (n, 3, 3) at ``times``."""
        at = int(np.searchsorted(times, time_ns, side="right"))
        steps_s = np.diff(np.insert(np.array(times), at, time_ns), prepend=times[0]) * 1e-9
        move, noise = axis_moves(steps_s, self.settings.memory_s)
        measured = np.arange(len(times) + 1) != at
        full = np.insert(values, at, 0.0, axis=0), np.insert(motion.scale**2 * covariance, at, np.eye(3), axis=0)
        xyz, spread, _, _ = smooth_one(*full, measured, move, noise, speed**2, motion.variance)
        return xyz[at], spread[at]


def _joined(position: Array, rotation: Array) -> Array:
    joined = np.zeros((6, 6))
    joined[:3, :3], joined[3:, 3:] = position, rotation
    return joined
