"""Pose of one body at one instant: from points that are known to be its markers, or by a search among all points.

A pose is withheld rather than guessed. Fewer than three markers, or three in a line, do not determine it. The visible
markers may also fit other markers of the body (similar distances). Then the poses are compared by their likelihood: a
second pose within ``flip_chi2`` of the first makes the first ambiguous, and only the previous pose can decide.
"""

from collections.abc import Mapping
from dataclasses import dataclass as plain_dataclass
from itertools import combinations

import numpy as np
from pydantic import PositiveInt
from pydantic.dataclasses import dataclass

from mosca.data.arrays import Array, looked_at
from mosca.data.bodies import RigidBody
from mosca.data.files.toml import SETTINGS, NotNegative, Positive
from mosca.data.rotations import rotation_from_vector
from mosca.rigid_bodies.ambiguity import ALIKE_M, arrangements
from mosca.rigid_bodies.constellation_search import BodyTransform, Candidates, SearchRules, claim, find
from mosca.rigid_bodies.pose_kernels import fit_pose

HIDDEN_SHARE = 0.3
"""Share of its gate from which the worst point is also tested against the pose from the other points. With few
markers a fit absorbs up to two thirds of an outlier's error."""
UNKNOWN_M = 0.001
"""Standard deviation of a point per axis [m] where its covariance is unknown."""


@dataclass(frozen=True, config=SETTINGS)
class BodySettings:
    """When a body counts as found, and how it moves."""

    gate_sigma: Positive = 4.5
    """Gate of a marker, in standard deviations."""
    slack_m: NotNegative = 0.0005
    """Variation of a marker's position per axis besides the stated errors (bent holders); for gates only."""
    alike_m: Positive = ALIKE_M
    """Arrangements of markers that differ by less are ambiguous."""
    flip_chi2: NotNegative = 25.0
    """Chi-square by which another assignment of the same points must be worse."""
    least_found: PositiveInt = 4
    """Markers that must agree when a body is found anew, or all where it has fewer."""
    largest_turn_rad: Positive = 0.2
    """Standard deviation of the rotation about its worst axis beyond which a pose is withheld."""
    coast_s: NotNegative = 0.25
    """How long a body is predicted without being seen."""
    acceleration_mps2: NotNegative = 30.0
    """With ``turn_rad_s2``: how far a body can depart from its prediction."""
    turn_rad_s2: NotNegative = 100.0
    """Angular acceleration."""
    speed_mps: NotNegative = 3.0
    """Speed of a body just found."""


@plain_dataclass(frozen=True, eq=False)
class InstantPoints:
    """Points of one instant."""

    xyz: Array
    """(n, 3) [m]"""
    covariance: Array
    """(n, 3, 3) [m^2]"""
    variance: Array
    """(n,) trace of ``covariance`` [m^2]."""
    track: Array
    """(n,) track of each point, -1 for none."""
    row_of: Mapping[int, int]
    """Track -> row, empty where the points have no identity."""
    named: Mapping[str, int]
    """Label -> row of the points whose label no other point has."""

    def __len__(self) -> int:
        return len(self.xyz)


@plain_dataclass(frozen=True, eq=False)
class BodyPoseFit:
    """A body's pose."""

    rotation: Array
    """(3, 3)"""
    translation: Array
    """(3,)"""
    covariance: Array
    """(6, 6) as in ``BodyPoses``."""
    rows: Array
    """(m,) point of each marker, -1 for none."""
    chi2: Array
    """(m,) chi-square of each marker, 0 for none."""

    @property
    def count(self) -> int:
        """Number of markers used."""
        return int((self.rows >= 0).sum())

    def residual_m(self, body: RigidBody, seen: InstantPoints) -> float:
        """Return the rms distance of the points from the markers [m]."""
        used = self.rows >= 0
        there = body.positions[used] @ self.rotation.T + self.translation
        return float(np.sqrt(np.mean(np.sum((seen.xyz[self.rows[used]] - there) ** 2, axis=1))))


class Constellation:
    """A body prepared for fitting and search."""

    def __init__(self, body: RigidBody, settings: BodySettings) -> None:
        self.body, self.settings = body, settings
        self._place = np.array(body.positions)
        self._sigma2 = body.sigma_m**2
        self._triples = _triples(body.positions)
        self._others: dict[bytes, list[Array]] = {}
        self.span_m = float(body.distances().max())

    def fit(self, seen: InstantPoints, rows: Array) -> BodyPoseFit | None:
        """Return the pose of the markers at points ``rows`` (m,), -1 for none; None where it is undetermined."""
        used = np.flatnonzero(rows >= 0)
        if len(used) < 3:
            return None
        points = rows[used]
        out = np.empty((3, 3)), np.empty(3), np.empty((6, 6)), np.empty(len(used))
        if fit_pose(self._place[used], seen.xyz[points], seen.covariance[points], self._sigma2, *out) < 0:
            return None
        chi2 = np.zeros(len(rows))
        chi2[used] = out[3]
        return BodyPoseFit(*out[:3], rows.copy(), chi2)

    def sound_fit(self, seen: InstantPoints, rows: Array) -> BodyPoseFit | None:
        """Return the pose from the points that agree; others are left out one by one, the worst first.

        None where fewer than three points that agree remain.
        """
        fit = self.fit(seen, rows)
        while fit is not None and not self._agree(fit, seen):
            fewer = [self._without(fit, int(k), seen) for k in np.flatnonzero(fit.rows >= 0)]
            without = [one for one in fewer if one is not None]
            fit = min(without, key=lambda one: float(one.chi2.sum())) if without else None
        return fit

    def _without(self, fit: BodyPoseFit, k: int, seen: InstantPoints) -> BodyPoseFit | None:
        fewer = fit.rows.copy()
        fewer[k] = -1
        return self.fit(seen, fewer)

    def _agree(self, fit: BodyPoseFit, seen: InstantPoints) -> bool:
        """Return whether every point lies within its gate, the worst point also for the pose from the others."""
        used = np.flatnonzero(fit.rows >= 0)
        there = self._place[used] @ fit.rotation.T + fit.translation
        away = np.linalg.norm(seen.xyz[fit.rows[used]] - there, axis=1)
        share = away / self._gates(seen)[fit.rows[used]]
        worst = int(share.argmax())
        if len(used) == 3 or not HIDDEN_SHARE < share[worst] < 1.0:
            return bool(share[worst] < 1.0)
        k = int(used[worst])
        others = self._without(fit, k, seen)
        if others is None or not self.settled(others):
            return True
        row = fit.rows[k]
        gate = self._gates(seen)[row] + self.span_m * rotation_sigma(others)
        there = others.rotation @ self._place[k] + others.translation
        return bool(np.linalg.norm(seen.xyz[row] - there) < gate)

    def _gates(self, seen: InstantPoints) -> Array:
        """Return the gate of each point (n,) [m]."""
        variance = seen.variance + (self._sigma2 + self.settings.slack_m**2)
        return np.asarray(self.settings.gate_sigma * np.sqrt(variance))

    def claim(
        self, seen: InstantPoints, free: Array, rotation: Array, translation: Array, rows: Array, reach_m: float
    ) -> Array:
        """Return ``rows`` (m,) with free points for markers without one, within gates widened by ``reach_m``."""
        gates = (self._gates(seen) + reach_m) ** 2
        mine = rows.copy()
        points = Candidates(seen.xyz, seen.covariance, free)
        claim(self._place, BodyTransform(rotation, translation), points, gates, mine)
        return mine

    def find(self, seen: InstantPoints, free: Array) -> tuple[BodyPoseFit | None, int]:
        """Search for the body among the points ``free`` (n,); return its pose and the number of markers found.

        Where another pose explains the points as well, the pose is None and the count is returned all the same.
        """
        settings, m = self.settings, len(self._place)
        rows, score = np.full((2, m), -1), np.zeros((2, 2))
        rules = SearchRules(self._sigma2, settings.slack_m**2, settings.gate_sigma, settings.alike_m)
        find(self._place, self._triples, Candidates(seen.xyz, seen.covariance, free), rules, rows, score)
        count = int(score[0, 0])
        if count < min(settings.least_found, m):
            return None, 0
        if score[1, 0] == count and score[1, 1] - score[0, 1] < settings.flip_chi2:
            return None, count
        fit = self.sound_fit(seen, rows[0])
        if fit is None or fit.count < min(settings.least_found, m) or self.others(fit, seen):
            return None, count
        return fit, fit.count

    def others(self, fit: BodyPoseFit, seen: InstantPoints) -> list[BodyPoseFit]:
        """Return the poses of other assignments of the same points that are about as likely as ``fit``."""
        used = fit.rows >= 0
        key = used.tobytes()
        if key not in self._others:
            self._others[key] = [
                np.array(order)
                for order in arrangements(
                    self.body.positions[used], self.body.positions, self.settings.alike_m, False
                )
                if not np.array_equal(order, np.flatnonzero(used))
            ]
        found = []
        for order in self._others[key]:
            rows = np.full(len(fit.rows), -1)
            rows[order] = fit.rows[used]
            other = self.fit(seen, rows)
            if other is not None and other.chi2.sum() - fit.chi2.sum() < self.settings.flip_chi2:
                found.append(other)
        return found

    def settled(self, fit: BodyPoseFit) -> bool:
        """Return whether the rotation is known well enough to be reported."""
        return rotation_sigma(fit) < self.settings.largest_turn_rad


def rotation_sigma(fit: BodyPoseFit) -> float:
    """Return the standard deviation of the rotation about its worst axis [rad]."""
    return float(np.sqrt(np.linalg.eigvalsh(fit.covariance[3:, 3:])[-1]))


def instant_points(
    xyz: Array, covariance: Array, track: Array | None = None, marker: Array | None = None
) -> InstantPoints:
    """Return the points of one instant; an unknown covariance (NaN) is replaced by that of UNKNOWN_M."""
    xyz = np.ascontiguousarray(xyz, dtype=float).reshape(-1, 3)
    covariance = np.ascontiguousarray(covariance, dtype=float).reshape(-1, 3, 3)
    variance = covariance[:, 0, 0] + covariance[:, 1, 1] + covariance[:, 2, 2]
    if not np.isfinite(variance).all():
        known = np.isfinite(variance)
        covariance = np.where(known[:, None, None], covariance, UNKNOWN_M**2 * np.eye(3))
        variance = np.where(known, variance, 3 * UNKNOWN_M**2)
    row_of = {} if track is None else {int(one): row for row, one in enumerate(track)}
    names = [] if marker is None else marker.tolist()
    named = {name: row for row, name in enumerate(names) if name and names.count(name) == 1}
    identity = np.full(len(xyz), -1) if track is None else np.asarray(track)
    return InstantPoints(looked_at(xyz), looked_at(covariance), variance, identity, row_of, named)


def predicted(rotation: Array, translation: Array, rates: Array, step_s: float) -> tuple[Array, Array]:
    """Predict a pose by ``step_s`` [s] with ``rates`` (6,): velocity [m/s], angular velocity [rad/s], world axes."""
    return rotation_from_vector(step_s * rates[3:]) @ rotation, translation + step_s * rates[:3]


def vector_of(rotation: Array) -> Array:
    """Return the rotation vector (3,) [rad] of a rotation (3, 3) by an angle below pi."""
    across = np.array(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    sine, cosine = np.linalg.norm(across) / 2, (np.trace(rotation) - 1) / 2
    angle = np.arctan2(sine, cosine)
    return across / 2 * (angle / sine if sine > 1e-12 else 1.0)


def angle_between(one: Array, other: Array) -> float:
    """Return the angle [rad] between two rotations (3, 3)."""
    return float(np.arccos(np.clip((np.trace(one @ other.T) - 1) / 2, -1.0, 1.0)))


def _triples(positions: Array) -> Array:
    """Return all triples (t, 3) of markers, those of the largest triangles first."""
    every = np.array(list(combinations(range(len(positions)), 3)))
    a, b, c = (positions[every[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return np.ascontiguousarray(every[np.argsort(-area, kind="stable")])
