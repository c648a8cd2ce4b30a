"""Assignment of tracklets to the markers of a template: a quadratic assignment, relaxed, then improved stepwise.

The evidence is each pair's distance and its change over a window of frames, and each point's place relative to the
person in the pose that fits. Its terms are log likelihood ratios against pairs, or places, of no marker.
"""

from copy import copy

import numpy as np
from scipy.special import gammaln

from mosca.data.arrays import Array
from mosca.labelling.automatic.body import TAIL, FittedPose, TemplateBody, trust
from mosca.labelling.automatic.template import IN_A_SET, Expectation

SOFT_M, SOFT_SHARE = 0.003, 0.01
"""Change of a distance on one limb by skin and noise: a length [m], and in addition a share of the distance."""
LEAST = 5
"""Least frames that must show a pair for its change to count."""
PAIR_BOUND, PLACE_BOUND = 5.0, 8.0
"""Bounds of the log likelihood ratio against a pair, and against a place."""
ACROSS = 0.12
"""Weight of a pair on two limbs that move relative to each other: there are many, and they are not independent."""
ROOM_M3 = 1.0
"""Volume in which points of no marker are assumed, about a person [m^3]."""
CANNOT = 100.0
"""Loss where a point is given a marker that another point is at the same time: more than any evidence. With 50, 100,
200 the labels of six takes that run and dance are the same."""
PAIRS_OF_NONE = 400
"""Number of drawn pairs of markers from which the distances of any two points are estimated."""


class Matching:
    """Costs of assigning points to markers."""

    spare: Array
    """(n,) whether a point is given to a marker only in place of another point."""
    barred: Array
    """(m, n) 0, or the loss (below 0) where the point cannot be the marker."""
    tails = False
    """Whether points far from their places get less weight in the pose."""

    def __init__(self, xyz: Array, at: list[int], body: TemplateBody, expected: Expectation) -> None:
        """``xyz`` (t, n, 3) of a window of frames; poses are those of the frames ``at``."""
        self.template, self.body = body.template, body
        self.points = xyz[at]
        self.seen = np.isfinite(self.points[:, :, 0])
        distance, change = pair_statistics(xyz)
        self.together = np.isfinite(distance)
        self.m, self.n = len(body.template.names), xyz.shape[1]
        self.wear(body.template.share)
        self.spare, self.barred = np.zeros(self.n, dtype=bool), np.zeros((self.m, self.n))
        self.kept: dict[bytes, tuple[float, list[FittedPose]]] = {}
        self.rigid, self.pairs = (one.reshape(self.m * self.n, -1) for one in _pair_gains(distance, change, expected))

    def wear(self, share: Array) -> None:
        """Set the ``share`` (m,) of takes in which each marker is worn."""
        self.share, self.prior = share, np.log(share / (1 - share))
        self.none = self._log_presence(np.zeros(len(share), dtype=bool))

    def worn(self, share: Array) -> "Matching":
        """Return the same problem with each marker worn in a ``share`` (m,) of takes."""
        one = copy(self)
        one.wear(share)
        return one

    def with_tails(self) -> "Matching":
        """Return the same problem with less weight for points far from their places: for poses that nearly fit."""
        one = copy(self)
        one.tails = True
        return one

    def without_spare(self) -> "Matching":
        """Return the problem restricted to the points that are not spare."""
        one, kept = copy(self), np.flatnonzero(~self.spare)
        one.n, one.spare, one.kept, one.barred = len(kept), self.spare[kept], {}, self.barred[:, kept]
        one.points, one.seen, one.together = self.points[:, kept], self.seen[:, kept], self.together[kept][:, kept]
        rows = (np.arange(self.m)[:, None] * self.n + kept).ravel()
        one.rigid, one.pairs = self.rigid[np.ix_(rows, rows)], self.pairs[np.ix_(rows, rows)]
        return one

    def frame(self, f: int) -> "Matching":
        """Return the problem restricted to one frame."""
        one = copy(self)
        one.points, one.seen, one.kept = self.points[f : f + 1], self.seen[f : f + 1], {}
        return one

    def places(self, poses: list[FittedPose]) -> Array:
        """Return the gain (m, n) of each point as each marker of the person in ``poses``, averaged over frames."""
        total = np.zeros((self.m, self.n))
        for points, seen, pose in zip(self.points, self.seen, poses, strict=True):
            about = pose.about
            root = np.linalg.cholesky(np.linalg.inv(about))
            off = np.nan_to_num(points)[None] - pose.place[:, None]
            squared = ((off @ root) ** 2).sum(axis=2)
            gain = _log_place(squared, _log_volume(about)[:, None])
            total += np.where(seen, np.maximum(gain, -PLACE_BOUND), 0.0)
        return np.asarray(total / np.maximum(self.seen.sum(axis=0), 1) + self.prior[:, None] + self.barred)

    def fit(self, poses: list[FittedPose], chosen: Array, steps: int = 2) -> list[FittedPose]:
        """Return the poses that fit an assignment (m,)."""
        at = np.maximum(chosen, 0)
        return [
            self.body.fit(
                pose, np.nan_to_num(points[at]), ((chosen >= 0) & seen[at]).astype(float), steps, self.tails
            )
            for points, seen, pose in zip(self.points, self.seen, poses, strict=True)
        ]

    def evidence(self, chosen: Array, poses: list[FittedPose], steps: int = 2) -> tuple[float, list[FittedPose]]:
        """Return the logarithm of an assignment's evidence and its poses.

        A place counts once, however many frames show it: if a marker's place on a person is unusual, it is so in all
        frames. So the evidence of places is the mean over the frames.
        """
        poses = self.fit(poses, chosen, steps)
        each, count = np.zeros(self.m), np.zeros(self.m)
        for points, seen, pose in zip(self.points, self.seen, poses, strict=True):
            there = np.flatnonzero((chosen >= 0) & seen[np.maximum(chosen, 0)])
            off = points[chosen[there]] - pose.place[there]
            covariance = pose.covariance[there]
            squared = (off[:, None] @ np.linalg.inv(covariance) @ off[:, :, None])[:, 0, 0]
            each[there] += _log_place(squared, _log_volume(covariance))
            count[there] += 1
        total = float((each / np.maximum(count, 1)).sum()) + self.both(self.rigid, chosen)
        total += sum(pose.log_prior for pose in poses) / len(poses) + self.lost(chosen)
        return total + self.presence(chosen), poses

    def lost(self, chosen: Array) -> float:
        """Return the loss of an assignment by points that cannot be their markers."""
        there = np.flatnonzero(chosen >= 0)
        return float(self.barred[there, chosen[there]].sum())

    def presence(self, chosen: Array) -> float:
        """Return the log odds that exactly these markers are there, against none."""
        return self._log_presence(chosen >= 0) - self.none

    def _log_presence(self, there: Array) -> float:
        """Return the log probability that the markers ``there`` (m,), and no others, are there.

        A marker that is worn only beside another is improbable without it. Markers of both sides with the same share
        are worn together or not at all: each is seen with probability IN_A_SET if worn, else 1 - IN_A_SET.
        """
        beside, other = self.template.beside, self.template.other_side
        alone = (beside >= 0) & ~there[beside]
        share = np.where(alone, np.minimum(self.share, 1 - IN_A_SET), self.share)
        # a set names its markers: those are seen with their share alone
        left = (np.arange(self.m) < other) & (self.share == self.share[other])
        paired = left | left[other]
        each = np.where(there, share, 1 - share)
        seen = np.where(there, IN_A_SET, 1 - IN_A_SET)
        share = np.minimum(share, share[other])
        both = share * seen * seen[other] + (1 - share) * (1 - seen) * (1 - seen[other])
        return float(np.log(each[~paired]).sum() + np.log(both[left]).sum())

    def linear(self, poses: list[FittedPose]) -> "LinearEvidence":
        """Return a fast, linearised computation of evidence near ``poses``."""
        return LinearEvidence(self, poses)

    def near(self, chosen: Array, poses: list[FittedPose]) -> tuple[float, list[FittedPose]]:
        """Return ``evidence`` after a step from ``poses``; cached, since only ``presence`` differs between sets."""
        key = chosen.tobytes()
        if key not in self.kept:
            value, poses = self.evidence(chosen, poses, 1)
            self.kept[key] = value - self.presence(chosen), poses
        value, poses = self.kept[key]
        return value + self.presence(chosen), poses

    def rows(self, chosen: Array) -> Array:
        """Return the rows of an assignment in the matrix of the pairs' gains."""
        there = np.flatnonzero(chosen >= 0)
        return np.asarray(there * self.n + chosen[there])

    def both(self, pairs: Array, chosen: Array) -> float:
        """Return the sum of the gains of all pairs of an assignment."""
        rows = self.rows(chosen)
        return 0.5 * float(pairs[rows[:, None], rows].sum())

    def gains(self, chosen: Array, places: Array) -> Array:
        """Return the gain (m, n) of each marker at each point, with the other markers assigned by ``chosen`` (m,)."""
        return np.asarray(places + self.pairs[self.rows(chosen)].sum(axis=0).reshape(self.m, self.n))


class LinearEvidence:
    """Evidence of assignments whose poses are near given ones, with places linearised in pose and size."""

    def __init__(self, problem: Matching, poses: list[FittedPose]) -> None:
        self.problem, self.poses = problem, poses
        self.information = [np.linalg.inv(pose.covariance) for pose in poses]
        self.volume = [_log_volume(pose.covariance) for pose in poses]
        self.rows = [w @ pose.jacobian for w, pose in zip(self.information, poses, strict=True)]
        self.solved: dict[bytes, tuple[float, Array]] = {}

    def of(self, chosen: Array) -> float:
        """Return the log evidence of an assignment up to a constant, as ``Matching.evidence``."""
        problem, body = self.problem, self.problem.body
        each, count, prior = np.zeros(problem.m), np.zeros(problem.m), 0.0
        for f, pose in enumerate(self.poses):
            there = np.flatnonzero((chosen >= 0) & problem.seen[f][np.maximum(chosen, 0)])
            off = problem.points[f][chosen[there]] - pose.place[there]
            hessian, inverse = self._hessian(f, there)
            gradient = body.priors(pose.parameters)[1]
            drawn = off * trust(off, self.information[f][there])[:, None]
            gradient = gradient + self.rows[f][there].reshape(-1, body.p).T @ drawn.ravel()
            step = inverse @ gradient
            off = off - pose.jacobian[there] @ step
            squared = (off[:, None] @ self.information[f][there] @ off[:, :, None])[:, 0, 0]
            each[there] += _log_place(squared, self.volume[f][there])
            count[there] += 1
            prior += body.log_prior(pose.parameters + step, hessian)
        total = float((each / np.maximum(count, 1)).sum()) + prior / len(self.poses)
        return total + problem.both(problem.rigid, chosen) + problem.presence(chosen) + problem.lost(chosen)

    def _hessian(self, f: int, there: Array) -> tuple[float, Array]:
        """Return log determinant and inverse of the information on pose and size by the markers ``there``."""
        key = bytes([f]) + there.tobytes()
        if key not in self.solved:
            pose, body = self.poses[f], self.problem.body
            rows = self.rows[f][there].reshape(-1, body.p)
            hessian = body.priors(pose.parameters)[0] + rows.T @ pose.jacobian[there].reshape(-1, body.p)
            self.solved[key] = float(np.linalg.slogdet(hessian)[1]), np.linalg.inv(hessian)
        return self.solved[key]


def _log_volume(covariance: Array) -> Array:
    return np.asarray(0.5 * np.linalg.slogdet(covariance)[1])


def _log_place(squared: Array, volume: Array) -> Array:
    """Return the log likelihood ratio of a place with this squared Mahalanobis distance, against no marker."""
    half = 0.5 * (TAIL + 3)
    constant = gammaln(half) - gammaln(0.5 * TAIL) - 1.5 * np.log(TAIL * np.pi) + np.log(ROOM_M3)
    return np.asarray(constant - volume - half * np.log1p(squared / TAIL))


def pair_statistics(xyz: Array) -> tuple[Array, Array]:
    """Return mean and standard deviation (n, n) of the distances of points (t, n, 3); NaN where not seen together."""
    n = xyz.shape[1]
    mean, change = np.full((n, n), np.nan), np.full((n, n), np.nan)
    for k in range(n):
        away = np.linalg.norm(xyz - xyz[:, k : k + 1], axis=2)
        there = np.isfinite(away)
        count = there.sum(axis=0)
        total = np.where(there, away, 0.0).sum(axis=0)
        mean[k] = total / np.where(count > 0, count, np.nan)
        spread = np.where(there, (away - mean[k]) ** 2, 0.0).sum(axis=0)
        change[k] = np.sqrt(spread / np.where(count >= LEAST, count, np.nan))
    return mean, change


def _pair_gains(distance: Array, change: Array, expected: Expectation) -> tuple[Array, Array]:
    """Return gains (m, n, m, n) of points a, b as markers i, j: by the change of their distance, and by both.

    Two points that hardly move against each other get the weight of a pair on one limb, whatever markers they are
    assigned to (by the likelihood of the change on one limb against that on two). At a joint such points may be on
    two limbs, and would lose to names on one limb by the weight alone. Their distance depends on the pose, which is
    the same for all pairs.
    """
    m, n = len(expected.mean_m), len(distance)
    apart, off = ~np.eye(n, dtype=bool), ~np.eye(m, dtype=bool)
    # movement of this person in the window, relative to that of people in general
    moving = min(float(np.nan_to_num(np.nanmedian(change[apart]))) / float(np.median(expected.moved_m[off])), 2.0)
    soft = np.where(expected.same, SOFT_M + SOFT_SHARE * expected.mean_m, SOFT_M + moving * expected.moved_m)
    seen = np.isfinite(change) & apart
    known, away = np.where(seen, change, 0.0), np.nan_to_num(distance)
    sigma = expected.sigma_m + SOFT_M
    first, second = np.triu_indices(m, 1)
    some = np.random.default_rng(0).permutation(len(first))[:PAIRS_OF_NONE]
    i, j = first[some], second[some]
    rate = soft[i, j][:, None, None]
    by_pair = -known / rate - np.log(rate)
    change_none = _log_mean(by_pair)
    likely, limb = np.exp(by_pair), expected.same[i, j]
    on_one, on_two = (likely[those].mean(axis=0) if those.any() else 0.0 * away for those in (limb, ~limb))
    still = np.where(seen, on_one / np.maximum(on_one + on_two, 1e-300), 0.0)
    spread = sigma[i, j][:, None, None]
    away_none = _log_mean(-0.5 * ((away - expected.mean_m[i, j][:, None, None]) / spread) ** 2 - np.log(spread))
    rigid, both = np.zeros((m, n, m, n), np.float32), np.zeros((m, n, m, n), np.float32)
    there = np.isfinite(distance) & apart
    for k in range(m):
        rate, spread = soft[k][:, None, None], sigma[k][:, None, None]
        by_change = np.where(seen, -known / rate - np.log(rate) - change_none, 0.0)
        by_away = -0.5 * ((away - expected.mean_m[k][:, None, None]) / spread) ** 2 - np.log(spread) - away_none
        by_away = np.where(there, by_away, 0.0)
        of = np.where(expected.same[k], 1.0, ACROSS)[:, None, None] * off[k][:, None, None]
        by_change_bound = np.clip(by_change, -PAIR_BOUND, PAIR_BOUND)
        more = np.where(of == ACROSS, (1 - ACROSS) * still, 0.0) * by_change_bound
        rigid[k] = (of * by_change_bound + more).transpose(1, 0, 2)
        both[k] = (of * np.clip(by_change + by_away, -PAIR_BOUND, PAIR_BOUND) + more).transpose(1, 0, 2)
    return rigid, both


def _log_mean(values: Array) -> Array:
    return np.asarray(np.log(np.exp(values).mean(axis=0) + 1e-12))
