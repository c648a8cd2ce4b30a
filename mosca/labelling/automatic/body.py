"""Pose and size of a template's person fitted to points: Gauss-Newton with priors on both.

Parameters (p): shift (3) and turn (3, rotation vector) of the whole body; turns of the segments (3 each: about z
first, then x, then y); the logarithm of the body's size; the logarithm of each segment's size relative to it.
"""

from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array
from mosca.labelling.automatic.template import MarkerTemplate

END_RAD = 0.17
"""Standard deviation of a joint's turn beyond the end of its range [rad]: 10 deg."""
SHIFT_M, YAW_RAD, TILT_RAD = 0.3, 0.6, 0.5
"""Standard deviations of a starting person's place [m], heading and tilt from upright [rad]."""
TAIL = 5.0
"""Degrees of freedom of a place's distribution (Student's t): the spread of a marker about its place is itself known
from few laboratories only, and some put a marker elsewhere altogether."""
STILL_RAD = 0.02
"""Standard deviation of a turn that has no range [rad]."""
LEAST_WEIGHT = 1e-3
"""Least weight of a place that is fitted."""


@dataclass(frozen=True, eq=False)
class FittedPose:
    """A person's pose and size, fitted to points."""

    parameters: Array
    """(p,)"""
    whole: Array
    """(3, 3) turn to which the rotation vector is relative."""
    place: Array
    """(m, 3) of the markers, world."""
    covariance: Array
    """(m, 3, 3) of the places, for the given pose."""
    jacobian: Array
    """(m, 3, p) of the places."""
    unknown: Array
    """(p, p) covariance of the parameters."""
    log_prior: float
    """Log of the prior density of pose and size times the volume that the points leave to them."""

    @property
    def about(self) -> Array:
        """Covariances (m, 3, 3) of the places, including the uncertainty of pose and size."""
        return np.asarray(self.covariance + self.jacobian @ self.unknown @ self.jacobian.transpose(0, 2, 1))


def trust(off: Array, information: Array) -> Array:
    """Return the weights (k,) of places ``off`` (k, 3) by Student's t: (tail + 3) / (tail + squared distance)."""
    squared = (off[:, None] @ information @ off[:, :, None])[:, 0, 0]
    return np.asarray((TAIL + 3) / (TAIL + squared))


class TemplateBody:
    """A template's person."""

    def __init__(self, template: MarkerTemplate) -> None:
        self.template, variation = template, template.variation
        g = len(template.parent)
        self.g, self.p = g, 7 + 4 * g
        self.parents: list[int] = template.parent.tolist()
        low, high = template.turn_rad[..., 0], template.turn_rad[..., 1]
        # a triangular distribution, times a factor between 0 and 1 (template.drawn_poses)
        mean = (low + high) / 3
        variance = (low**2 + high**2 - low * high) / 18
        spread = np.sqrt((variance + mean**2) / 3 - mean**2 / 4) + STILL_RAD
        self.mean = np.concatenate([np.zeros(6), (mean / 2).ravel(), np.zeros(1 + g)])
        self.sigma = np.concatenate(
            [
                np.full(3, SHIFT_M), [TILT_RAD, TILT_RAD, YAW_RAD], spread.ravel(), [variation.stature],
                np.full(g, variation.segment),
            ]
        )  # fmt: skip
        self.low, self.high = low - 1e-9, high + 1e-9
        self.above = _above(template.parent)
        self.child = _child(template.parent, template.segment)
        self.local = template.place_m - template.joint_m[template.segment]
        self.bone = template.joint_m - template.joint_m[template.parent]
        self.log_prior_volume = float(np.log(self.sigma).sum())

    def start(self, whole: Array, middle: Array) -> FittedPose:
        """Return the person standing, turned by ``whole``, its markers' median at ``middle`` (3,)."""
        parameters = self.mean.copy()
        place = self._places(parameters, whole)[0]
        parameters[:3] += middle - np.median(place, axis=0)
        place, turns, jacobian = self._places(parameters, whole)
        nothing = FittedPose(parameters, whole, place, self._covariance(turns), jacobian, np.empty(0), 0.0)
        return self.fit(nothing, place, np.zeros(len(place)), 0)

    def fit(self, pose: FittedPose, points: Array, weight: Array, steps: int = 3, tails: bool = False) -> FittedPose:
        """Return the pose after ``steps`` towards ``points`` (m, 3), each of ``weight`` (m,) 0..1, from ``pose``.

        ``tails``: distant points get less weight, by Student's t. Without it, they also attract a pose that is still
        far from them.
        """
        parameters, whole = pose.parameters.copy(), pose.whole
        place, jacobian, covariance = pose.place, pose.jacobian, pose.covariance
        use = weight > LEAST_WEIGHT
        for _ in range(steps):
            hessian, gradient = self.priors(parameters)
            rows, weighted = self._weighted(covariance, jacobian, weight, points - place, tails)
            gradient = gradient + weighted.T @ (points - place)[use].ravel()
            step = np.linalg.solve(hessian + weighted.T @ rows, gradient)
            # a turn of more than half a radian is not linear
            parameters = parameters + step * min(1.0, 0.5 / max(np.abs(step[3 : 6 + 3 * self.g]).max(), 1e-9))
            whole = turned(parameters[3:6]) @ whole
            parameters[3:6] = 0.0
            place, turns, jacobian = self._places(parameters, whole)
            covariance = self._covariance(turns)
        rows, weighted = self._weighted(covariance, jacobian, weight, points - place, tails)
        hessian = self.priors(parameters)[0] + weighted.T @ rows
        log_prior = self.log_prior(parameters, float(np.linalg.slogdet(hessian)[1]))
        return FittedPose(parameters, whole, place, covariance, jacobian, np.linalg.inv(hessian), log_prior)

    def log_prior(self, parameters: Array, information: float) -> float:
        """Return the log of the prior density of pose and size times the volume left by a log determinant."""
        off = (parameters - self.mean)[6:] / self.sigma[6:]
        over = self._over(parameters) / END_RAD
        known = -0.5 * information - self.log_prior_volume
        return -0.5 * float(off @ off + (over**2).sum()) + known

    def _weighted(
        self, covariance: Array, jacobian: Array, weight: Array, off: Array, tails: bool
    ) -> tuple[Array, Array]:
        """Return the derivatives (3 u, p) of places with a ``weight``, and these times the places' information."""
        use = weight > LEAST_WEIGHT
        information = np.linalg.inv(covariance[use])
        drawn = weight[use] * (trust(off[use], information) if tails else 1.0)
        rows = jacobian[use]
        return rows.reshape(-1, self.p), (information @ rows * drawn[:, None, None]).reshape(-1, self.p)

    def _over(self, parameters: Array) -> Array:
        turn = parameters[6 : 6 + 3 * self.g].reshape(-1, 3)
        return np.asarray(np.maximum(turn - self.high, 0.0) + np.minimum(turn - self.low, 0.0))

    def priors(self, parameters: Array) -> tuple[Array, Array]:
        """Return information (p, p) and gradient (p,) of the prior; the gradient is 0 for the whole body's pose."""
        diagonal = 1.0 / self.sigma**2
        gradient = (self.mean - parameters) * diagonal
        gradient[:6] = 0.0
        over = self._over(parameters).ravel()
        at = slice(6, 6 + 3 * self.g)
        diagonal = diagonal.copy()
        diagonal[at] += (over != 0) / END_RAD**2
        gradient[at] -= over / END_RAD**2
        return np.diag(diagonal), gradient

    def _covariance(self, turns: Array) -> Array:
        of = turns[self.template.segment]
        return np.asarray((of * self.template.spread_m[:, None] ** 2) @ of.transpose(0, 2, 1))

    def frames(self, pose: FittedPose) -> tuple[Array, Array]:
        """Return the segments' joints (g, 3) and turns (g, 3, 3) in a pose."""
        origin, world, _ = self._segments(pose.parameters, pose.whole)
        return origin, world

    def _segments(self, parameters: Array, whole: Array) -> tuple[Array, Array, Array]:
        """Return the segments' joints (g, 3), turns (g, 3, 3) and the axes (g, 3, 3) of their own three turns."""
        g, template = self.g, self.template
        turn = parameters[6 : 6 + 3 * g].reshape(g, 3)
        size = np.exp(parameters[6 + 3 * g] + parameters[7 + 3 * g :])
        root = turned(parameters[3:6]) @ whole
        own_y = _turns(1, turn[:, 1])
        own_yx = own_y @ _turns(0, turn[:, 0])
        own = own_yx @ _turns(2, turn[:, 2])
        world, origin, above = np.empty((g, 3, 3)), np.empty((g, 3)), np.empty((g, 3, 3))
        above[0], world[0], origin[0] = root, root @ own[0], root @ template.joint_m[0] + parameters[:3]
        bone = self.bone * size[template.parent][:, None]
        for k in range(1, g):
            parent = self.parents[k]
            above[k] = world[parent]
            world[k] = above[k] @ own[k]
            origin[k] = origin[parent] + above[k] @ bone[k]
        axes = np.stack([(above @ own_y)[:, :, 0], above[:, :, 1], (above @ own_yx)[:, :, 2]], axis=1)
        return origin, world, axes

    def _places(self, parameters: Array, whole: Array) -> tuple[Array, Array, Array]:
        """Return places (m, 3), turns of the segments (g, 3, 3), and the places' derivatives (m, 3, p)."""
        g, of = self.g, self.template.segment
        size = np.exp(parameters[6 + 3 * g] + parameters[7 + 3 * g :])
        origin, world, axes = self._segments(parameters, whole)
        arm = (world[of] @ self.local[:, :, None])[:, :, 0] * size[of, None]
        place = origin[of] + arm
        jacobian = np.zeros((len(of), 3, self.p))
        jacobian[:, [0, 1, 2], [0, 1, 2]] = 1.0
        jacobian[:, :, 3:6] = _crosses(np.eye(3), place - parameters[:3])
        below = self.above[of]
        away = np.where(below[:, :, None], place[:, None] - origin, 0.0)
        turning = _crosses(axes.reshape(-1, 3), np.repeat(away, 3, axis=1))
        jacobian[:, :, 6 : 6 + 3 * g] = turning
        bone = np.where(below[:, :, None], origin[self.child] - origin, 0.0)
        grown = np.where((of[:, None] == np.arange(g))[:, :, None], away, bone)
        jacobian[:, :, 7 + 3 * g :] = grown.transpose(0, 2, 1)
        jacobian[:, :, 6 + 3 * g] = place - origin[0]
        return place, world, jacobian


def _above(parent: Array) -> Array:
    """Return whether (g, g) the second segment is the first one or above it."""
    out = np.eye(len(parent), dtype=bool)
    for k, p in enumerate(parent.tolist()):
        if p >= 0:
            out[k] |= out[p]
    return out


def _child(parent: Array, segment: Array) -> Array:
    """Return, for each marker and segment (m, g), the child segment towards the marker's own; itself if none."""
    out = np.tile(np.arange(len(parent)), (len(segment), 1))
    for i, k in enumerate(segment.tolist()):
        while parent[k] >= 0:
            out[i, parent[k]] = k
            k = int(parent[k])
    return out


def _crosses(axes: Array, away: Array) -> Array:
    """Return ``axes`` (a, 3) x ``away`` (m, 3) or (m, a, 3), as (m, 3, a)."""
    x, y, z = (away[..., k] if away.ndim == 3 else away[:, None, k] for k in range(3))
    a, b, c = axes.T
    out = np.empty((len(away), 3, len(axes)))
    out[:, 0], out[:, 1], out[:, 2] = b * z - c * y, c * x - a * z, a * y - b * x
    return out


def turned(vector: Array) -> Array:
    """Return the rotation matrix (3, 3) of a rotation vector (Rodrigues)."""
    angle = float(np.sqrt(vector @ vector))
    x, y, z = (vector / angle).tolist() if angle > 1e-12 else (0.0, 0.0, 0.0)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross)


def _turns(axis: int, angle: Array) -> Array:
    """Return rotation matrices (g, 3, 3) about an axis."""
    c, s = np.cos(angle), np.sin(angle)
    out = np.zeros((len(angle), 3, 3))
    i, j = (axis + 1) % 3, (axis + 2) % 3
    out[:, axis, axis] = 1.0
    out[:, i, i] = out[:, j, j] = c
    out[:, i, j], out[:, j, i] = -s, s
    return out
