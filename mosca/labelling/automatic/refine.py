"""The best assignment of points to markers near a given one, and its probability against its neighbours."""

from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array
from mosca.labelling.automatic.body import FittedPose
from mosca.labelling.automatic.matching import Matching
from mosca.labelling.automatic.search import LEAST_GAIN, limbs

TRIED, WORSE = 40, 12.0
"""Number of alternatives that are tried, and how much worse their gain may be at most."""
FAR = 8.0
"""An alternative whose linearised evidence is this much worse is not evaluated further."""


@dataclass(frozen=True, eq=False)
class MatchedMarkers:
    """An assignment of points (n) to markers (m)."""

    chosen: Array
    """(m,) index of the point, -1 for none."""
    score: float
    """Log evidence, against points of no marker."""
    probability: Array
    """(m,) that the point is right; 1 for a marker without a point."""
    poses: list[FittedPose]
    """One for each frame."""


def refine(problem: Matching, chosen: Array, poses: list[FittedPose]) -> MatchedMarkers:
    """Return the assignment of most evidence near ``chosen``, with its probability against its neighbours."""
    problem = problem.with_tails()
    best, poses = problem.evidence(chosen, poses, 2)
    values: list[tuple[float, Array]] = []
    better = True
    while better:
        better, values, linear = False, [], problem.linear(poses)
        base = linear.of(chosen)
        for other in alternatives(problem, chosen, poses):
            about = best + linear.of(other) - base
            if about < best - FAR:
                values.append((about, other))
                continue
            value, other_poses = problem.near(other, poses)
            if value > best + LEAST_GAIN:
                best, poses, chosen, better = value, other_poses, other, True
                break
            values.append((value, other))
    odds = np.zeros(problem.m)
    for value, other in values:
        odds[other != chosen] += np.exp(min(value - best, 0.0))
    return MatchedMarkers(chosen, best, np.where(chosen >= 0, 1.0 / (1.0 + odds), 1.0), poses)


def alternatives(problem: Matching, chosen: Array, poses: list[FittedPose]) -> list[Array]:
    """Return assignments that may be better, or nearly as good."""
    gains = problem.gains(chosen, problem.places(poses))
    moves, swaps = _moves(problem, chosen, gains), _exchanges(problem, chosen, gains)
    out: list[Array] = []
    absent = np.where(chosen < 0)[0]
    for flat in np.argsort(-moves, axis=None)[:TRIED]:
        i, k = divmod(int(flat), problem.n + 1)
        if moves[i, k] > -WORSE and (chosen[i] >= 0 or k < problem.n):
            other = chosen.copy()
            other[i] = k if k < problem.n else -1
            out.append(other)
            if chosen[i] >= 0 and k < problem.n and len(absent):
                # the point that the marker leaves may be a marker without a point
                pushed = other.copy()
                pushed[absent[gains[absent, chosen[i]].argmax()]] = chosen[i]
                out.append(pushed)
    for flat in np.argsort(-swaps, axis=None)[: 2 * TRIED]:
        i, k = divmod(int(flat), problem.m)
        if swaps[i, k] > -WORSE and i < k:
            other = chosen.copy()
            other[[i, k]] = chosen[[k, i]]
            out.append(other)
    gained = taken(problem, chosen, gains)
    for flat in np.argsort(-gained, axis=None)[: 2 * TRIED]:
        i, k = divmod(int(flat), problem.m)
        if gained[i, k] > -WORSE:
            other = chosen.copy()
            other[i], other[k] = chosen[k], -1
            out.append(other)
    for markers in limbs(problem.template):
        other = chosen.copy()
        other[markers] = chosen[problem.template.other_side[markers]]
        out.append(other)
    return out


def _moves(problem: Matching, chosen: Array, gains: Array) -> Array:
    """Return the gain (m, n + 1) of moving a marker to a free point, or to none (last column)."""
    now = _now(chosen, gains)
    out = np.concatenate([gains, np.zeros((problem.m, 1))], axis=1) - now[:, None]
    out[:, chosen[chosen >= 0]] = -np.inf
    there = chosen >= 0
    # a point never seen together with a marker's point may be the same marker, so it does not replace that point
    out[:, :-1][there] = np.where(problem.together[chosen[there]], out[:, :-1][there], -np.inf)
    out[:, :-1][np.ix_(~there, problem.spare)] = -np.inf
    return out


def _now(chosen: Array, gains: Array) -> Array:
    return np.where(chosen >= 0, gains[np.arange(len(chosen)), chosen], 0.0)


def _exchanges(problem: Matching, chosen: Array, gains: Array) -> Array:
    """Return the gain (m, m) of exchanging the points of two markers."""
    m = problem.m
    there = np.flatnonzero(chosen >= 0)
    at = chosen[there]
    out = np.full((m, m), -np.inf)
    now = _now(chosen, gains)
    # marker i at the point of j, without the gain of its pair with j at that point
    as_other = np.full((m, m), -np.inf)
    as_other[:, there] = gains[:, at]
    i, j = np.meshgrid(np.arange(m), there, indexing="ij")
    out_of = problem.pairs.reshape(m, problem.n, m, problem.n)
    as_other[:, there] -= out_of[i, chosen[j], j, chosen[j]]  # zero: a pair of one point
    both = np.ix_(there, there)
    cross = out_of[there[:, None], at[None], there[None], at[:, None]]
    apart = out_of[there[:, None], at[:, None], there[None], at[None]]
    # each gain includes the pair with the other at its old point; after the exchange the pair counts once, as it does
    # before
    lost = out_of[there[:, None], at[None], there[None], at[None]]
    lost = lost + lost.T
    out[both] = as_other[both] + as_other[both].T - lost + cross - now[there][:, None] - now[there][None] + apart
    np.fill_diagonal(out, -np.inf)
    return out


def taken(problem: Matching, chosen: Array, gains: Array) -> Array:
    """Return the gain (m, m) of a marker taking another's point: the other then has none, its own point is free."""
    there = np.flatnonzero(chosen >= 0)
    now, pairs = _now(chosen, gains), problem.pairs.reshape(problem.m, problem.n, problem.m, problem.n)
    out = np.full((problem.m, problem.m), -np.inf)
    for j in there:
        # the pair's gain is contained in ``now`` of both markers
        twice = np.where(chosen >= 0, pairs[np.arange(problem.m), chosen, j, chosen[j]], 0.0)
        out[:, j] = gains[:, chosen[j]] - pairs[:, chosen[j], j, chosen[j]] - now[j] - now + twice
    np.fill_diagonal(out, -np.inf)
    return out
