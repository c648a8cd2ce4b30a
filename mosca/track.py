"""Trajectories: predict, gate, assign, update; identities survive short occlusions.

Each target is a Kalman filter with constant velocity and white acceleration (Bar-Shalom, Li and Kirubarajan 2001,
section 6.3.2). Points and predictions are paired by the assignment of least total cost, cost the squared
Mahalanobis distance. A new target is tentative until its sightings weigh enough: a sighting by n cameras
weighs n - 1, since two cameras can agree by chance (images of odd size count for less than one); its samples
are handed out when it is confirmed, the earlier ones with them. What is handed out is the measured point, not
the filter's: no smoothing hides errors.
"""

from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import linear_sum_assignment

from mosca.data.arrays import Array
from mosca.data.tracks import Points, Samples
from mosca.match import Predicted


@dataclass(frozen=True)
class TrackSettings:
    """``acceleration_mps2``: standard deviation of the targets' acceleration. ``speed_mps``: of a new target's
    velocity, each axis. ``gate_sigma``: how far from its prediction a point may lie. ``gate_m``: never farther than
    this; a confirmed target takes a point of two cameras from half as far, with an image of odd size from a
    quarter (two cameras agree by chance, and the gate of a target long unseen admits many such chances).
    ``confirm_weight``: weight of sightings that confirms a target. ``coast_s``: how long a target is predicted
    without being seen.
    """

    acceleration_mps2: float = 20.0
    speed_mps: float = 1.5
    gate_sigma: float = 4.5
    gate_m: float = 0.08
    confirm_weight: float = 5.0
    coast_s: float = 0.25


@dataclass(eq=False)
class _Target:
    """A filter's state: mean (6,) of position and velocity, covariance (6, 6), and its history so far."""

    identity: int
    mean: Array
    covariance: Array
    weight: float
    seen_s: float
    confirmed: bool = False
    missed: int = 0
    waiting: list[tuple[object, ...]] = field(default_factory=list)


class Tracker:
    """Follows targets from frame set to frame set. The state is its own; hand it points in order of time."""

    def __init__(self, settings: TrackSettings) -> None:
        self.settings = settings
        self._targets: list[_Target] = []
        self._time_s: float | None = None
        self._next_identity = 0

    def predict(self, time_s: float) -> Predicted:
        """Carry all targets to ``time_s`` [s] and return where they are expected."""
        step = 0.0 if self._time_s is None else time_s - self._time_s
        if step < 0.0:
            raise ValueError(f"time {time_s} s lies before {self._time_s} s: points must come in order")
        self._time_s = time_s
        self._targets = [t for t in self._targets if time_s - t.seen_s <= self.settings.coast_s]
        if self._targets:
            move = np.eye(6)
            move[:3, 3:] = step * np.eye(3)
            noise = _process_noise(step, self.settings.acceleration_mps2)
            for target in self._targets:
                target.mean = move @ target.mean
                target.covariance = move @ target.covariance @ move.T + noise
        firm = [t for t in self._targets if t.confirmed]
        if not firm:
            return Predicted.nothing()
        return Predicted(np.array([t.mean[:3] for t in firm]), np.array([t.covariance[:3, :3] for t in firm]))

    def update(self, points: Points, frame: int, time_ns: int) -> Samples:
        """Give the points of the instant last predicted to the targets; return samples that are now certain."""
        pairs = self._assign(points)
        time_s = time_ns * 1e-9
        certain: list[tuple[object, ...]] = []
        for row, target in pairs.items():
            _correct(target, points.xyz[row], points.covariance[row])
            certain += self._sighted(target, points, row, frame, time_ns)
        # a tentative target that is twice not seen where it should be was none
        for target in self._targets:
            target.missed = 0 if target.seen_s == time_s else target.missed + 1
        self._targets = [t for t in self._targets if t.confirmed or t.missed < 2]
        for row in range(len(points)):
            if row not in pairs:
                certain += self._sighted(self._begin(points, row), points, row, frame, time_ns)
        return _columns(certain)

    def _assign(self, points: Points) -> dict[int, _Target]:
        """Return which point (row) goes to which target; confirmed targets choose first."""
        pairs: dict[int, _Target] = {}
        for chosen in (
            [t for t in self._targets if t.confirmed],
            [t for t in self._targets if not t.confirmed],
        ):
            free = np.array([row for row in range(len(points)) if row not in pairs], dtype=int)
            if not chosen or not len(free):
                continue
            cost, allowed = _distances(chosen, points, free, self.settings)
            beyond = 2.0 * self.settings.gate_sigma**2 + 1e3
            rows, columns = linear_sum_assignment(np.where(allowed, cost, beyond))
            pairs |= {int(free[c]): chosen[r] for r, c in zip(rows, columns, strict=True) if allowed[r, c]}
        return pairs

    def _begin(self, points: Points, row: int) -> _Target:
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = points.covariance[row]
        covariance[3:, 3:] = self.settings.speed_mps**2 * np.eye(3)
        mean = np.concatenate([points.xyz[row], np.zeros(3)])
        target = _Target(-1, mean, covariance, 0.0, 0.0)
        self._targets.append(target)
        return target

    def _sighted(
        self, target: _Target, points: Points, row: int, frame: int, time_ns: int
    ) -> list[tuple[object, ...]]:
        """Note a sighting; return the samples that it makes certain."""
        target.seen_s = time_ns * 1e-9
        cameras = int(points.n_cameras[row])
        target.weight += max(0.0, float(points.trusted[row]) - 1.0)
        if not target.confirmed and target.weight >= self.settings.confirm_weight - 1e-9:
            target.confirmed, target.identity = True, self._next_identity
            self._next_identity += 1
        covariance, residual = points.covariance[row], float(points.residual_px[row])
        target.waiting.append(
            (frame, time_ns, target.identity, points.xyz[row], covariance, cameras, residual)
        )
        if not target.confirmed:
            return []
        certain, target.waiting = target.waiting, []
        return [(*s[:2], target.identity, *s[3:]) for s in certain]


def _columns(samples: list[tuple[object, ...]]) -> Samples:
    if not samples:
        return Samples.none()
    frame, time_ns, track, xyz, covariance, n_cameras, residual = zip(*samples, strict=True)
    return Samples(
        np.array(frame), np.array(time_ns), np.array(track), np.array(xyz), np.array(covariance),
        np.array(n_cameras), np.array(residual), np.zeros(len(samples), np.int8),
    )  # fmt: skip


def _process_noise(step: float, acceleration: float) -> Array:
    """Discrete white acceleration over ``step`` [s]: covariance (6, 6)."""
    noise = np.zeros((6, 6))
    q = acceleration**2
    noise[:3, :3] = q * step**4 / 4 * np.eye(3)
    noise[:3, 3:] = noise[3:, :3] = q * step**3 / 2 * np.eye(3)
    noise[3:, 3:] = q * step**2 * np.eye(3)
    return noise


def _distances(
    targets: list[_Target], points: Points, rows: Array, settings: TrackSettings
) -> tuple[Array, Array]:
    """Return squared Mahalanobis distances (targets, rows) and which are within the gates."""
    mean = np.array([t.mean[:3] for t in targets])
    covariance = np.array([t.covariance[:3, :3] for t in targets])
    offset = points.xyz[rows][None] - mean[:, None]
    firm = np.array([t.confirmed for t in targets])[:, None]
    evidence = np.clip((points.trusted[rows] - 1.0) / 2.0, 0.25, 1.0)
    reach = settings.gate_m * np.where(firm, evidence, 1.0)
    near = np.einsum("trk,trk->tr", offset, offset) < reach**2
    cost = np.full(near.shape, np.inf)
    t, r = np.nonzero(near)
    total = covariance[t] + points.covariance[rows[r]]
    away = offset[t, r]
    cost[t, r] = np.einsum("ni,ni->n", away, np.linalg.solve(total, away[:, :, None])[:, :, 0])
    return np.where(near, cost, 0.0), near & (cost < settings.gate_sigma**2)


def _correct(target: _Target, xyz: Array, covariance: Array) -> None:
    """Kalman update with a measured position."""
    innovation = target.covariance[:3, :3] + covariance
    gain = np.linalg.solve(innovation, target.covariance[:3, :]).T
    target.mean = target.mean + gain @ (xyz - target.mean[:3])
    target.covariance = target.covariance - gain @ innovation @ gain.T
