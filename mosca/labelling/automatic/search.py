"""Search for an assignment of points to markers: a relaxation from several directions, then limb by limb.

The relaxation is graduated assignment (Gold and Rangarajan 1996).
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from mosca.data.arrays import Array
from mosca.labelling.automatic.body import FittedPose, turned
from mosca.labelling.automatic.matching import Matching
from mosca.labelling.automatic.template import MarkerTemplate

STEPS, EACH_FIT = 36, 4
"""Steps of the relaxation, and the number of steps after which the body is fitted again."""
HEADINGS = 8
"""Number of directions in which the person is assumed to look at the start."""
ANEW, MOST_OPEN = 8, 700
"""Steps of a limb's new assignment, and the most pairs of marker and free point for which distances count."""
FREED = 4
"""Steps in which a limb that is assigned anew leaves its turn: half a radian each, and a head turns by 1.5."""
LARGE = 60.0
"""Largest exponent: a larger difference is certain, and its exponential would overflow."""
LEAST_GAIN = 1e-3
"""Least gain of evidence for which an assignment is changed."""


@dataclass(frozen=True, eq=False)
class Assignment:
    """An assignment found by a search."""

    evidence: float
    poses: list[FittedPose]
    chosen: Array


def headings(problem: Matching) -> list[FittedPose]:
    """Return the person standing in the first frame, looking in HEADINGS directions."""
    middle = np.nanmedian(problem.points[0], axis=0)
    angles = np.linspace(0, 2 * np.pi, HEADINGS, endpoint=False)
    return [problem.body.start(turned(np.array([0.0, 0.0, angle])), middle) for angle in angles]


def starts(problem: Matching) -> list[Assignment]:
    """Return assignments of the first frame, best first, from all directions in which the person may look."""
    weight, poses = _relaxed(problem, headings(problem))
    first: dict[bytes, Assignment] = {}
    for q, pose in zip(weight, poses, strict=True):
        chosen = _with(np.full(problem.m, -1), np.arange(problem.m), np.arange(problem.n), q - 0.2)
        first.setdefault(chosen.tobytes(), Assignment(*problem.evidence(chosen, [pose], 4), chosen))
    return sorted(first.values(), key=lambda end: -end.evidence)


def unlike(found: list[Assignment]) -> list[Assignment]:
    """Return the best of ``found`` (best first), and the best one that has other points for most markers."""
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
    """Return weights (s, m, n) whose rows and columns, each with a slack of zero gain, sum to one."""
    s, m, n = gain.shape
    weight = np.ones((s, m + 1, n + 1))
    weight[:, :m, :n] = np.exp(np.clip(gain, -LARGE, LARGE))
    for _ in range(rounds):
        weight[:, :m] /= weight[:, :m].sum(axis=2, keepdims=True)
        weight[:, :, :n] /= weight[:, :, :n].sum(axis=1, keepdims=True)
    return np.asarray(weight[:, :m, :n])


def searched(problem: Matching, found: Assignment) -> Assignment:
    """Return the assignment after assigning limbs anew, from the other markers, until none gains."""
    parts = blocks(problem.template)
    last, k = 0, 0
    while k - last < len(parts):
        other, poses = _anew(problem, found, parts[k % len(parts)])
        k += 1
        if (other != found.chosen).any():
            value, poses = problem.evidence(other, poses)
            if value > found.evidence + LEAST_GAIN:
                found, last = Assignment(value, poses, other), k
    return found


def _anew(problem: Matching, found: Assignment, block: Array) -> tuple[Array, list[FittedPose]]:
    """Return an assignment and its poses with new points for the markers ``block`` (m,), from the other markers."""
    kept = np.where(block, -1, found.chosen)
    free = np.setdiff1d(np.arange(problem.n), kept[kept >= 0])
    open_ = np.flatnonzero(kept < 0)
    if not len(free) or (kept >= 0).sum() < 4:
        return found.chosen, found.poses
    poses = problem.fit(found.poses, kept, FREED)
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


def blocks(template: MarkerTemplate) -> list[Array]:
    """Return sets of markers (m,): each segment alone or with those below, both sides of it, and all but these."""
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
    """Return whether (g, g) the second segment is the first one or below it."""
    out = np.eye(len(parent), dtype=bool)
    for k, p in enumerate(parent.tolist()):
        if p >= 0:
            out[:, k] |= out[:, p]
    return out


def limbs(template: MarkerTemplate) -> list[Array]:
    """Return the markers of both sides of each segment, alone and with the segments below it."""
    sided = template.other_side != np.arange(len(template.names))
    out: dict[bytes, Array] = {}
    for rows in (np.eye(len(template.parent), dtype=bool), _below(template.parent)):
        for row in rows:
            both = row[template.segment] & sided
            both[template.other_side[both]] = True
            if both.any():
                out.setdefault(both.tobytes(), np.flatnonzero(both))
    return list(out.values())
