"""Search for a known constellation among points, compiled.

Each triple of markers is searched for among the points by its three distances. Each triple found gives a pose, which
is verified by all markers (hypothesise and verify; Fischler and Bolles 1981, exhaustive instead of random).
"""

import math
from typing import NamedTuple

import numpy as np

from mosca.data.arrays import Array
from mosca.numba_support.decorators import kernel, step
from mosca.rigid_bodies.pose_kernels import fit_pose

MOST_HYPOTHESES = 20000
"""Largest number of triples of points that are verified."""
WIDE_GATE2 = 9.0
"""Squared factor of the gates for the pose of a triple."""
FLAT = 1e-3
"""Sine of the angle below which a triangle is flat."""


class Candidates(NamedTuple):
    """The n points of one instant."""

    xyz: Array
    """(n, 3)"""
    covariance: Array
    """(n, 3, 3)"""
    free: Array
    """(n,) bool, whether a point may be used."""


class SearchRules(NamedTuple):
    """Rules for accepting a pose."""

    sigma2: float
    """Variance of a marker's position per axis [m^2]."""
    slack2: float
    """Variance that is added to ``sigma2`` in gates [m^2]."""
    sigmas: float
    """Size of the gates in standard deviations."""
    apart: float
    """Two poses are the same when no marker's positions in them lie farther apart than this [m]."""


class BodyTransform(NamedTuple):
    """x_world = rotation x_body + translation."""

    rotation: Array
    translation: Array


class _Best(NamedTuple):
    """The two best distinct poses of m markers."""

    rows: Array
    """(2, m) point of each marker, -1 for none."""
    score: Array
    """(2, 2) markers found, chi-square."""
    positions: Array
    """(2, m, 3)"""


@kernel
def claim(place, pose, points, gate2, rows):
    """Assign each marker the free point nearest to its predicted position; fills rows (m,), -1 for none.

    ``gate2`` (n,): squared gate of each point [m^2]. A point nearest to two markers goes to the nearer marker.
    Markers that already have a row keep it. Returns the number of markers with a row.
    """
    xyz, m, n = points.xyz, place.shape[0], points.xyz.shape[0]
    reach, p = np.empty(m), np.empty(3)
    owner = np.full(n, -1)
    for i in range(m):
        if rows[i] >= 0:
            owner[rows[i]] = i
            reach[i] = -1.0
    for i in range(m):
        if rows[i] >= 0:
            continue
        _moved(pose, place[i], p)
        best, at = np.inf, -1
        for a in range(n):
            if not points.free[a]:
                continue
            d2 = (xyz[a, 0] - p[0]) ** 2 + (xyz[a, 1] - p[1]) ** 2 + (xyz[a, 2] - p[2]) ** 2
            if d2 < gate2[a] and d2 < best:
                best, at = d2, a
        if at < 0:
            continue
        other = owner[at]
        if other >= 0 and reach[other] <= best:
            continue
        if other >= 0:
            rows[other] = -1
        owner[at], rows[i], reach[i] = i, at, best
    count = 0
    for i in range(m):
        count += rows[i] >= 0
    return count


@kernel
def find(place, triples, points, rules, rows, score):
    """Search for a constellation; fills rows (2, m) and score (2, 2) of the two best distinct poses.

    ``place`` (m, 3); ``triples`` (t, 3) of its markers. ``score``: markers found (0 for no pose), chi-square.
    """
    xyz, covariance = points.xyz, points.covariance
    m, n = place.shape[0], xyz.shape[0]
    index = np.flatnonzero(points.free)
    f = len(index)
    away = np.empty((f, f))
    gate2 = np.empty(n)
    for a in range(n):
        variance = covariance[a, 0, 0] + covariance[a, 1, 1] + covariance[a, 2, 2] + rules.sigma2 + rules.slack2
        gate2[a] = rules.sigmas**2 * variance
    span = 0.0
    for i in range(m):
        for j in range(i):
            span = max(span, _apart(place[i], place[j]))
    # no two markers are farther apart than the span: only points as near to each other are combined
    near, count = np.empty((f, f), dtype=np.int64), np.zeros(f, dtype=np.int64)
    for a in range(f):
        for b in range(f):
            away[a, b] = _apart(xyz[index[a]], xyz[index[b]])
            if a != b and away[a, b] < span + math.sqrt(gate2[index[a]] + gate2[index[b]]):
                near[a, count[a]] = b
                count[a] += 1
    rows[:], score[:] = -1, 0.0
    best = _Best(rows, score, np.empty((2, m, 3)))
    three, corner = np.empty((3, 3)), np.empty((3, 3))
    pose = BodyTransform(np.empty((3, 3)), np.empty(3))
    tried = 0
    for t in range(triples.shape[0]):
        i, j, k = triples[t, 0], triples[t, 1], triples[t, 2]
        dij, dik, djk = _apart(place[i], place[j]), _apart(place[i], place[k]), _apart(place[j], place[k])
        for q in range(3):
            corner[0, q], corner[1, q], corner[2, q] = place[i, q], place[j, q], place[k, q]
        for a in range(f):
            ga = gate2[index[a]]
            for nb in range(count[a]):
                b = near[a, nb]
                gb = gate2[index[b]]
                if (away[a, b] - dij) ** 2 > ga + gb:
                    continue
                for nc in range(count[a]):
                    c = near[a, nc]
                    gc = gate2[index[c]]
                    if c == b or (away[a, c] - dik) ** 2 > ga + gc or (away[b, c] - djk) ** 2 > gb + gc:
                        continue
                    if tried == MOST_HYPOTHESES:
                        return
                    tried += 1
                    for q in range(3):
                        three[0, q], three[1, q] = xyz[index[a], q], xyz[index[b], q]
                        three[2, q] = xyz[index[c], q]
                    if _triad(corner, three, pose):
                        _verify(place, points, gate2, rules, pose, best)
        if score[0, 0] == m and score[1, 0] < m:
            return  # no other pose can explain more points


@step
def _verify(place, points, gate2, rules, pose, best):
    """Claim points for all markers, fit them, and rank the pose among the two best."""
    m = place.shape[0]
    mine = np.full(m, -1)
    # the error of a triple's pose grows with the distance from the triple: a wide gate first, then a fit
    if claim(place, pose, points, WIDE_GATE2 * gate2, mine) < 3:
        return
    spread, chi2, total = np.empty((6, 6)), np.empty(m), -1.0
    xyz, covariance, sigma2 = points.xyz, points.covariance, rules.sigma2 + rules.slack2
    fitted = BodyTransform(pose.rotation.copy(), pose.translation.copy())
    at, where, spreads = np.empty((m, 3)), np.empty((m, 3)), np.empty((m, 3, 3))
    for again in range(2):
        k = 0
        for i in range(m):
            if mine[i] >= 0:
                for a in range(3):
                    at[k, a], where[k, a] = place[i, a], xyz[mine[i], a]
                    for b in range(3):
                        spreads[k, a, b] = covariance[mine[i], a, b]
                k += 1
        if k < 3:
            return
        total = fit_pose(at[:k], where[:k], spreads[:k], sigma2, fitted.rotation, fitted.translation, spread, chi2)
        if total < 0.0:
            return
        if again == 0:
            mine[:] = -1
            if claim(place, fitted, points, gate2, mine) < 3:
                return
    count = 0
    for i in range(m):
        count += mine[i] >= 0
    here = np.empty((m, 3))
    for i in range(m):
        _moved(fitted, place[i], here[i])
    _rank(here, mine, float(count), total, rules.apart, best)


@step
def _rank(here, mine, count, total, apart, best):
    """Keep the two best distinct poses, the better one first."""
    score = best.score
    for s in range(2):
        if score[s, 0] > 0 and _farthest(here, best.positions[s]) < apart:
            if not _better(count, total, score[s]):
                return
            if s == 1 and _better(count, total, score[0]):
                _second_from_first(best)
                s = 0
            _keep(s, here, mine, count, total, best)
            return
    if _better(count, total, score[0]):
        _second_from_first(best)
        _keep(0, here, mine, count, total, best)
    elif _better(count, total, score[1]):
        _keep(1, here, mine, count, total, best)


@step
def _second_from_first(best):
    _keep(1, best.positions[0], best.rows[0], best.score[0, 0], best.score[0, 1], best)


@step
def _keep(s, here, mine, count, total, best):
    best.score[s, 0], best.score[s, 1] = count, total
    for i in range(len(mine)):
        best.rows[s, i] = mine[i]
        for a in range(3):
            best.positions[s, i, a] = here[i, a]


@step
def _better(count, total, than):
    return count > than[0] or (count == than[0] and total < than[1])


@step
def _farthest(here, there):
    far = 0.0
    for i in range(here.shape[0]):
        far = max(far, _apart(here[i], there[i]))
    return far


@step
def _apart(p, q):
    return math.sqrt((p[0] - q[0]) ** 2 + (p[1] - q[1]) ** 2 + (p[2] - q[2]) ** 2)


@step
def _triad(corner, three, pose):
    """Write the pose that maps a triangle onto another by first edge and plane; False for degenerate triangles."""
    rotation, translation = pose.rotation, pose.translation
    one, two = np.empty((3, 3)), np.empty((3, 3))
    if not (_axes(corner, one) and _axes(three, two)):
        return False
    for a in range(3):
        for b in range(3):
            rotation[a, b] = two[a, 0] * one[b, 0] + two[a, 1] * one[b, 1] + two[a, 2] * one[b, 2]
    shift = np.zeros(3)
    for i in range(3):
        for a in range(3):
            rotated = rotation[a, 0] * corner[i, 0] + rotation[a, 1] * corner[i, 1] + rotation[a, 2] * corner[i, 2]
            shift[a] += (three[i, a] - rotated) / 3
    for a in range(3):
        translation[a] = shift[a]
    return True


@step
def _axes(points, axes):
    """Fill the columns of axes (3, 3): the first edge, the plane's other direction, its normal."""
    x0, x1, x2 = points[1, 0] - points[0, 0], points[1, 1] - points[0, 1], points[1, 2] - points[0, 2]
    y0, y1, y2 = points[2, 0] - points[0, 0], points[2, 1] - points[0, 1], points[2, 2] - points[0, 2]
    z0, z1, z2 = x1 * y2 - x2 * y1, x2 * y0 - x0 * y2, x0 * y1 - x1 * y0
    lx, ly = math.sqrt(x0**2 + x1**2 + x2**2), math.sqrt(y0**2 + y1**2 + y2**2)
    lz = math.sqrt(z0**2 + z1**2 + z2**2)
    if not lz > FLAT * lx * ly:
        return False
    axes[0, 0], axes[1, 0], axes[2, 0] = x0 / lx, x1 / lx, x2 / lx
    axes[0, 2], axes[1, 2], axes[2, 2] = z0 / lz, z1 / lz, z2 / lz
    axes[0, 1] = axes[1, 2] * axes[2, 0] - axes[2, 2] * axes[1, 0]
    axes[1, 1] = axes[2, 2] * axes[0, 0] - axes[0, 2] * axes[2, 0]
    axes[2, 1] = axes[0, 2] * axes[1, 0] - axes[1, 2] * axes[0, 0]
    return True


@step
def _moved(pose, place, out):
    rotation, translation = pose.rotation, pose.translation
    for a in range(3):
        out[a] = rotation[a, 0] * place[0] + rotation[a, 1] * place[1] + rotation[a, 2] * place[2] + translation[a]
