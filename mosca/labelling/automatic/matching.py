"""Which tracklet is which marker of a template: a quadratic assignment, relaxed, then improved step by step.

The evidence is each pair's distance and how much it changes over a window of frames, and where each is with respect
to the trunk, whose direction is tried out. The relaxation is graduated assignment (Gold and Rangarajan 1996), its
costs are log likelihood ratios against a pair, or a place, of no marker.
"""

from copy import copy
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from mosca.data.arrays import Array
from mosca.labelling.automatic.body import FittedPose, TemplateBody, turned
from mosca.labelling.automatic.template import Expectation, MarkerTemplate

SOFT_M, SOFT_SHARE = 0.003, 0.01
"""How much a distance on one limb changes: skin and noise [m], and a share of it."""
LEAST = 5
"""Frames that must show a pair for its change to count."""
PAIR_BOUND, PLACE_BOUND = 5.0, 8.0
"""Largest log likelihood ratio against a pair and a place."""
ACROSS = 0.12
"""Weight of a pair on two limbs: there are many, and they depend on each other."""
ROOM_M3 = 1.0
"""Where points of no marker are: about a person."""
STEPS, EACH_FIT = 36, 4
"""Steps of the relaxation, and after how many of them the body is fitted again."""
HEADINGS = 8
"""Sides to which the person is taken to look at first."""
ANEW, MOST_OPEN = 8, 700
"""Steps in which a limb is assigned anew, and the most pairs of marker and free point whose distances count."""
LARGE = 60.0
"""Largest exponent: what differs by more is certain, and its exponential has no number."""
PAIRS_OF_NONE = 400
"""Pairs of markers, drawn, that say how far apart points are at all."""
TRIED, WORSE = 40, 12.0
"""Alternatives that are looked into, and how much worse they look at most."""


@dataclass(frozen=True, eq=False)
class MatchedMarkers:
    """An assignment of points (n) to markers (m)."""

    chosen: Array
    """(m,) index of the point, -1 for none."""
    score: float
    """Logarithm of its evidence, against points that are of no marker."""
    probability: Array
    """(m,) that it is right; 1 where there is none."""
    poses: list[FittedPose]
    """Of the frames."""


class Matching:
    """Costs of assigning points to markers."""

    def __init__(self, xyz: Array, at: list[int], body: TemplateBody, expected: Expectation) -> None:
        """``xyz`` (t, n, 3) of a window of frames; poses are those of the frames ``at``."""
        self.template, self.body = body.template, body
        self.points = xyz[at]
        self.seen = np.isfinite(self.points[:, :, 0])
        distance, change = pair_statistics(xyz)
        self.prior = np.log(body.template.share / (1 - body.template.share)) + np.log(ROOM_M3)
        self.m, self.n = len(body.template.names), xyz.shape[1]
        self.rigid, self.pairs = (one.reshape(self.m * self.n, -1) for one in _pair_gains(distance, change, expected))

    def frame(self, f: int) -> "Matching":
        """Return the problem of one of the frames alone."""
        one = copy(self)
        one.points, one.seen = self.points[f : f + 1], self.seen[f : f + 1]
        return one

    def places(self, poses: list[FittedPose]) -> Array:
        """Return the gain (m, n) of each point as each marker of the person in ``poses``, of the mean frame."""
        total = np.zeros((self.m, self.n))
        for points, seen, pose in zip(self.points, self.seen, poses, strict=True):
            about = pose.about
            root = np.linalg.cholesky(np.linalg.inv(about))
            off = np.nan_to_num(points)[None] - pose.place[:, None]
            squared = ((off @ root) ** 2).sum(axis=2)
            gain = -0.5 * squared - 0.5 * np.linalg.slogdet(2 * np.pi * about)[1][:, None]
            total += np.where(seen, np.maximum(gain, -PLACE_BOUND), 0.0)
        return np.asarray(total / np.maximum(self.seen.sum(axis=0), 1) + self.prior[:, None])

    def fit(self, poses: list[FittedPose], chosen: Array, steps: int = 2) -> list[FittedPose]:
        """Return the poses that fit an assignment (m,)."""
        at = np.maximum(chosen, 0)
        return [
            self.body.fit(pose, np.nan_to_num(points[at]), ((chosen >= 0) & seen[at]).astype(float), steps)
            for points, seen, pose in zip(self.points, self.seen, poses, strict=True)
        ]

    def evidence(self, chosen: Array, poses: list[FittedPose], steps: int = 2) -> tuple[float, list[FittedPose]]:
        """Return the logarithm of an assignment's evidence, that of the mean frame, and its poses."""
        poses = self.fit(poses, chosen, steps)
        total = 0.0
        for points, seen, pose in zip(self.points, self.seen, poses, strict=True):
            there = np.flatnonzero((chosen >= 0) & seen[np.maximum(chosen, 0)])
            off = points[chosen[there]] - pose.place[there]
            covariance = pose.covariance[there]
            squared = (off[:, None] @ np.linalg.inv(covariance) @ off[:, :, None])[:, 0, 0]
            each = -0.5 * squared - 0.5 * np.linalg.slogdet(2 * np.pi * covariance)[1] + self.prior[there]
            total += float(each.sum()) + pose.log_prior
        return total / len(poses) + self.both(self.rigid, chosen), poses

    def rows(self, chosen: Array) -> Array:
        """Return the rows of the pairs' gains that an assignment has."""
        there = np.flatnonzero(chosen >= 0)
        return np.asarray(there * self.n + chosen[there])

    def both(self, pairs: Array, chosen: Array) -> float:
        """Return what all pairs of an assignment gain."""
        rows = self.rows(chosen)
        return 0.5 * float(pairs[rows[:, None], rows].sum())

    def gains(self, chosen: Array, places: Array) -> Array:
        """Return the gain (m, n) of each marker at each point while the others are where ``chosen`` (m,) has them."""
        return np.asarray(places + self.pairs[self.rows(chosen)].sum(axis=0).reshape(self.m, self.n))


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
    """Return the gain (m, n, m, n) of points a, b as markers i, j: by the change of the distance, and by both."""
    m, n = len(expected.mean_m), len(distance)
    apart, off = ~np.eye(n, dtype=bool), ~np.eye(m, dtype=bool)
    # how much of what people can do this one does in the window
    moving = min(float(np.nan_to_num(np.nanmedian(change[apart]))) / float(np.median(expected.moved_m[off])), 2.0)
    soft = np.where(expected.same, SOFT_M + SOFT_SHARE * expected.mean_m, SOFT_M + moving * expected.moved_m)
    seen = np.isfinite(change) & apart
    known, away = np.where(seen, change, 0.0), np.nan_to_num(distance)
    sigma = expected.sigma_m + SOFT_M
    first, second = np.triu_indices(m, 1)
    some = np.random.default_rng(0).permutation(len(first))[:PAIRS_OF_NONE]
    i, j = first[some], second[some]
    rate = soft[i, j][:, None, None]
    change_none = _log_mean(-known / rate - np.log(rate))
    spread = sigma[i, j][:, None, None]
    away_none = _log_mean(-0.5 * ((away - expected.mean_m[i, j][:, None, None]) / spread) ** 2 - np.log(spread))
    weight = np.where(expected.same, 1.0, ACROSS) * off
    rigid, both = np.zeros((m, n, m, n), np.float32), np.zeros((m, n, m, n), np.float32)
    there = np.isfinite(distance) & apart
    for k in range(m):
        rate, spread = soft[k][:, None, None], sigma[k][:, None, None]
        by_change = np.where(seen, -known / rate - np.log(rate) - change_none, 0.0)
        by_away = -0.5 * ((away - expected.mean_m[k][:, None, None]) / spread) ** 2 - np.log(spread) - away_none
        by_away = np.where(there, by_away, 0.0)
        of = weight[k][:, None, None]
        rigid[k] = (of * np.clip(by_change, -PAIR_BOUND, PAIR_BOUND)).transpose(1, 0, 2)
        both[k] = (of * np.clip(by_change + by_away, -PAIR_BOUND, PAIR_BOUND)).transpose(1, 0, 2)
    return rigid, both


def _log_mean(values: Array) -> Array:
    return np.asarray(np.log(np.exp(values).mean(axis=0) + 1e-12))


@dataclass(frozen=True, eq=False)
class Assignment:
    """An assignment that a search came to."""

    evidence: float
    poses: list[FittedPose]
    chosen: Array


def headings(problem: Matching) -> list[FittedPose]:
    """Return the person standing in the first frame, looking to HEADINGS sides."""
    middle = np.nanmedian(problem.points[0], axis=0)
    angles = np.linspace(0, 2 * np.pi, HEADINGS, endpoint=False)
    return [problem.body.start(turned(np.array([0.0, 0.0, angle])), middle) for angle in angles]


def starts(problem: Matching) -> list[Assignment]:
    """Return assignments of the first frame, best first, from all directions the person may look to."""
    weight, poses = _relaxed(problem, headings(problem))
    first: dict[bytes, Assignment] = {}
    for q, pose in zip(weight, poses, strict=True):
        chosen = _with(np.full(problem.m, -1), np.arange(problem.m), np.arange(problem.n), q - 0.2)
        first.setdefault(chosen.tobytes(), Assignment(*problem.evidence(chosen, [pose], 4), chosen))
    return sorted(first.values(), key=lambda end: -end.evidence)


def unlike(found: list[Assignment]) -> list[Assignment]:
    """Return the best of ``found``, best first, and the best that has other points for most markers."""
    best = found[0]
    there = best.chosen >= 0
    others = (one for one in found if (one.chosen == best.chosen)[there].sum() < 0.5 * there.sum())
    return [best, *list(others)[:1]]


def _relaxed(problem: Matching, poses: list[FittedPose]) -> tuple[Array, list[FittedPose]]:
    """Return weights (s, m, n) of all starts, and their poses."""
    s, m, n = len(poses), problem.m, problem.n
    weight = np.zeros((s, m, n), dtype=np.float32)
    flat, points = problem.pairs, problem.points[0]
    places = np.stack([problem.places([pose]) for pose in poses])
    for step in range(STEPS):
        sharp = 0.15 + 0.85 * step / (STEPS - 1)
        gain = places + (weight.reshape(s, -1) @ flat).reshape(s, m, n)
        weight = _sinkhorn(sharp * gain).astype(np.float32)
        if step % EACH_FIT == EACH_FIT - 1:
            share = weight.sum(axis=2)
            mean = weight @ points / np.maximum(share, 1e-9)[:, :, None]
            poses = [problem.body.fit(*one) for one in zip(poses, mean, sharp * share, strict=True)]
            places = np.stack([problem.places([pose]) for pose in poses])
    return weight, poses


def _sinkhorn(gain: Array, rounds: int = 8) -> Array:
    """Return weights (s, m, n) whose rows and columns sum to one with a slack each, that gains nothing."""
    s, m, n = gain.shape
    weight = np.ones((s, m + 1, n + 1))
    weight[:, :m, :n] = np.exp(np.clip(gain, -LARGE, LARGE))
    for _ in range(rounds):
        weight[:, :m] /= weight[:, :m].sum(axis=2, keepdims=True)
        weight[:, :, :n] /= weight[:, :, :n].sum(axis=1, keepdims=True)
    return np.asarray(weight[:, :m, :n])


def searched(problem: Matching, found: Assignment) -> Assignment:
    """Return what comes of assigning limbs anew, by the others, until none gains."""
    parts = blocks(problem.template)
    last, k = 0, 0
    while k - last < len(parts):
        other, poses = _anew(problem, found, parts[k % len(parts)])
        k += 1
        if (other != found.chosen).any():
            value, poses = problem.evidence(other, poses)
            if value > found.evidence + 1e-3:
                found, last = Assignment(value, poses, other), k
    return found


def _anew(problem: Matching, found: Assignment, block: Array) -> tuple[Array, list[FittedPose]]:
    """Return an assignment (and its poses) in which the markers ``block`` (m,) are given points by the others."""
    kept = np.where(block, -1, found.chosen)
    free = np.setdiff1d(np.arange(problem.n), kept[kept >= 0])
    open_ = np.flatnonzero(kept < 0)
    if not len(free) or (kept >= 0).sum() < 4:
        return found.chosen, found.poses
    poses = problem.fit(found.poses, kept, 1)
    part, shape = np.ix_(open_, free), (problem.m, problem.n)
    fixed = (problem.places(poses) + problem.pairs[problem.rows(kept)].sum(axis=0).reshape(shape))[part]
    rows = (open_[:, None] * problem.n + free).ravel()
    weight = np.zeros(fixed.shape, dtype=np.float32)
    if len(rows) <= MOST_OPEN:
        among = problem.pairs[np.ix_(rows, rows)]
        for step in range(ANEW):
            gain = fixed + (among @ weight.ravel()).reshape(fixed.shape)
            weight = _sinkhorn((0.2 + 0.8 * step / (ANEW - 1)) * gain[None], 4)[0].astype(np.float32)
    else:
        weight = _sinkhorn(fixed[None])[0]
    new = _with(kept, open_, free, weight - 0.2)
    poses = problem.fit(poses, new, 1)
    return _with(kept, open_, free, problem.gains(new, problem.places(poses))[part]), poses


def _with(kept: Array, open_: Array, free: Array, gain: Array) -> Array:
    """Return ``kept`` (m,) with points ``free`` given to the markers ``open_`` so that the ``gain`` is largest."""
    rows, columns = linear_sum_assignment(np.maximum(gain, 0.0), maximize=True)
    good = gain[rows, columns] > 0
    new = kept.copy()
    new[open_[rows[good]]] = free[columns[good]]
    return new


def refine(problem: Matching, chosen: Array, poses: list[FittedPose], fixed: Array | None = None) -> MatchedMarkers:
    """Return the assignment near ``chosen`` of the most evidence, with its probability against those near it.

    ``fixed`` (m,): markers that keep their points.
    """
    best, poses = problem.evidence(chosen, poses, 2)
    tried: list[tuple[tuple[float, list[FittedPose]], Array]] = []
    for _ in range(12):
        others = _alternatives(problem, chosen, poses)
        if fixed is not None:
            others = [other for other in others if (other == chosen)[fixed].all()]
        tried = [(problem.evidence(other, poses, 1), other) for other in others]
        if not tried:
            break
        (value, new_poses), other = max(tried, key=lambda one: one[0][0])
        if value <= best + 1e-3:
            break
        best, poses, chosen = value, new_poses, other
    odds = np.zeros(problem.m)
    for (value, _), other in tried:
        odds[other != chosen] += np.exp(min(value - best, 0.0))
    return MatchedMarkers(chosen, best, np.where(chosen >= 0, 1.0 / (1.0 + odds), 1.0), poses)


def _alternatives(problem: Matching, chosen: Array, poses: list[FittedPose]) -> list[Array]:
    """Return assignments that may be better, or nearly as good."""
    gains = problem.gains(chosen, problem.places(poses))
    moves, swaps = _moves(problem, chosen, gains), _exchanges(problem, chosen, gains)
    out: list[Array] = []
    for flat in np.argsort(-moves, axis=None)[:TRIED]:
        i, k = divmod(int(flat), problem.n + 1)
        if moves[i, k] > -WORSE and (chosen[i] >= 0 or k < problem.n):
            other = chosen.copy()
            other[i] = k if k < problem.n else -1
            out.append(other)
    for flat in np.argsort(-swaps, axis=None)[: 2 * TRIED]:
        i, k = divmod(int(flat), problem.m)
        if swaps[i, k] > -WORSE and (chosen[k] < 0 or i < k):
            other = chosen.copy()
            other[[i, k]] = chosen[[k, i]]
            out.append(other)
    for markers in limbs(problem.template):
        other = chosen.copy()
        other[markers] = chosen[problem.template.other_side[markers]]
        out.append(other)
    return out


def _moves(problem: Matching, chosen: Array, gains: Array) -> Array:
    """Return what is gained (m, n + 1) when a marker moves to a free point, or to none (last column)."""
    now = _now(chosen, gains)
    out = np.concatenate([gains, np.zeros((problem.m, 1))], axis=1) - now[:, None]
    out[:, chosen[chosen >= 0]] = -np.inf
    return out


def _now(chosen: Array, gains: Array) -> Array:
    return np.where(chosen >= 0, gains[np.arange(len(chosen)), chosen], 0.0)


def _exchanges(problem: Matching, chosen: Array, gains: Array) -> Array:
    """Return what is gained (m, m) when two markers exchange their points, one of which may have none."""
    m = problem.m
    there = np.flatnonzero(chosen >= 0)
    at = chosen[there]
    out = np.full((m, m), -np.inf)
    now = _now(chosen, gains)
    # marker i at the point of j, without what j says of it from there
    as_other = np.full((m, m), -np.inf)
    as_other[:, there] = gains[:, at]
    i, j = np.meshgrid(np.arange(m), there, indexing="ij")
    out_of = problem.pairs.reshape(m, problem.n, m, problem.n)
    as_other[:, there] -= out_of[i, chosen[j], j, chosen[j]]  # zero: a pair of one point
    both = np.ix_(there, there)
    cross = out_of[there[:, None], at[None], there[None], at[:, None]]
    apart = out_of[there[:, None], at[:, None], there[None], at[None]]
    # each gain counts the other where it was; exchanged, the pair counts once, and once less in what there is now
    lost = out_of[there[:, None], at[None], there[None], at[None]]
    lost = lost + lost.T
    out[both] = as_other[both] + as_other[both].T - lost + cross - now[there][:, None] - now[there][None] + apart
    for k in np.flatnonzero(chosen < 0):
        # k takes the point of j, j has none
        out[k, there] = gains[k, at] - out_of[k, at, there, at] - now[there]
    np.fill_diagonal(out, -np.inf)
    return out


def blocks(template: MarkerTemplate) -> list[Array]:
    """Return sets of markers (m,): each segment, with what hangs on it, both sides of either, and all but these."""
    segments = np.eye(len(template.parent), dtype=bool)[template.segment].T
    below = _below(template.parent)[:, template.segment]
    out: dict[bytes, Array] = {}
    for one in (*segments, *below):
        both = one.copy()
        both[template.other_side[one]] = True
        for block in (one, both, ~both):
            if block.any() and not block.all():
                out.setdefault(block.tobytes(), block)
    return list(out.values())


def _below(parent: Array) -> Array:
    """Return whether (g, g) the second segment is the first, or hangs on it."""
    out = np.eye(len(parent), dtype=bool)
    for k, p in enumerate(parent.tolist()):
        if p >= 0:
            out[:, k] |= out[:, p]
    return out


def limbs(template: MarkerTemplate) -> list[Array]:
    """Return the markers of both sides of each segment, alone and with what hangs on it."""
    sided = template.other_side != np.arange(len(template.names))
    out: dict[bytes, Array] = {}
    for rows in (np.eye(len(template.parent), dtype=bool), _below(template.parent)):
        for row in rows:
            both = row[template.segment] & sided
            both[template.other_side[both]] = True
            if both.any():
                out.setdefault(both.tobytes(), np.flatnonzero(both))
    return list(out.values())
