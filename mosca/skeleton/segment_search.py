"""A segment's markers found among points by their distances from each other and from the joint above.

For a limb that a pose has lost: the places of its markers cannot be predicted, but their distances from each other
can, and the place of the joint above is known.
"""

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from mosca.data.arrays import Array
from mosca.data.distributions import chi2
from mosca.data.rotations import aligning_rotation

FITS = 0.999
"""Probability that a segment's own markers pass the gate."""
MARGIN = 2 * float(np.log(20.0))
"""Amount by which chi squared of other points must be worse: odds of 20 to 1."""
MOST_POINTS = 24
"""Number of points nearest to the joint that are tried, in threes."""


@dataclass(frozen=True, eq=False)
class MarkerSegment:
    """``markers`` (k,) indices; ``local`` (k, 3) their places from the joint above, in the segment's axes [m];
    ``skin2`` (k,) their variance on the segment, per coordinate [m^2].
    """

    markers: Array
    local: Array
    skin2: Array


def segment_points(
    segment: MarkerSegment, joint: Array, joint_m2: float, xyz: Array, variance: Array
) -> tuple[Array, Array] | None:
    """Return markers (3,) or (2,) of the segment and the indices of their points; None where none or several fit.

    ``joint`` (3,) place of the joint above, ``joint_m2`` its variance per coordinate; points ``xyz`` (n, 3) with
    ``variance`` (n,) per coordinate. Three markers are looked for before two.
    """
    from_joint = np.linalg.norm(xyz - joint, axis=1)
    rows = np.argsort(from_joint, kind="stable")[:MOST_POINTS]
    rows = rows[from_joint[rows] < 1.5 * np.linalg.norm(segment.local, axis=1).max()]
    points, spread, reach = xyz[rows], variance[rows], from_joint[rows]
    away = np.linalg.norm(points[:, None] - points, axis=2)
    np.fill_diagonal(away, np.inf)
    nominal = np.linalg.norm(segment.local[:, None] - segment.local, axis=2)
    by_joint = (reach - np.linalg.norm(segment.local, axis=1)[:, None]) ** 2 / (
        segment.skin2[:, None] + spread + joint_m2
    )
    for size in (3, 2):
        if min(len(rows), len(segment.markers)) < size:
            continue
        best: list[tuple[float, tuple[int, ...], Array]] = []
        for some in combinations(range(len(segment.markers)), size):
            cost = _costs(some, by_joint, away, nominal, segment.skin2, spread)
            flat = np.argpartition(cost, min(2, cost.size - 1), axis=None)[:2]
            best += [(float(cost.flat[k]), some, np.array(np.unravel_index(k, cost.shape))) for k in flat.tolist()]
        best = [one for one in best if one[0] < _gate(size) + MARGIN and _same_side(segment, one, joint, points)]
        best.sort(key=lambda one: one[0])
        if not best or best[0][0] > _gate(size):
            continue
        _, some, at = best[0]
        named = dict(zip(some, at.tolist(), strict=True))
        for other_cost, others, elsewhere in best[1:]:
            other = dict(zip(others, elsewhere.tolist(), strict=True))
            if other_cost < best[0][0] + MARGIN and _contradict(named, other):
                return None
        return segment.markers[list(some)], rows[at]
    return None


def _gate(size: int) -> float:
    return float(chi2.ppf(FITS, size * (size + 1) // 2))


def _costs(some: tuple[int, ...], by_joint: Array, away: Array, nominal: Array, skin2: Array, spread: Array) -> Array:
    """Return chi squared (n, n[, n]) of all pairs or triples of points taken as the markers ``some``."""
    size, n = len(some), len(spread)

    def along(*axes: int) -> tuple[int, ...]:
        return tuple(n if axis in axes else 1 for axis in range(size))

    total = np.zeros((n,) * size)
    for a, i in enumerate(some):
        total += by_joint[i].reshape(along(a))
        for b in range(a):
            j = some[b]
            pair = (away - nominal[i, j]) ** 2 / (skin2[i] + skin2[j] + spread[:, None] + spread)
            total += pair.reshape(along(b, a))
    return total


def _same_side(
    segment: MarkerSegment, one: tuple[float, tuple[int, ...], Array], joint: Array, points: Array
) -> bool:
    """Return whether the points are no mirror image of the markers, which has the same distances."""
    _, some, at = one
    local = np.concatenate([segment.local[list(some)], np.zeros((1, 3))])
    seen = np.concatenate([points[at], joint[None]])
    rotation = aligning_rotation(local, seen)
    off = (seen - seen.mean(axis=0)) - (local - local.mean(axis=0)) @ rotation.T
    return bool(np.sum(off[:-1] ** 2) < _gate(len(some)) * float(segment.skin2[list(some)].max() * len(some)))


def _contradict(named: dict[int, int], other: dict[int, int]) -> bool:
    """Return whether two assignments give a marker two points, or a point two markers."""
    points = {point: marker for marker, point in named.items()}
    return any(named.get(m, p) != p or points.get(p, m) != m for m, p in other.items())
