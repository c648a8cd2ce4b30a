"""Which groups are targets: compiled kernels of ``mosca.correspondence.match``, after
``mosca.correspondence.candidates``.

Groups are taken by their likelihood against chance, best first, so that no image serves twice; a group that loses
images to a better one is tried again with those it has left. What two cameras alone cannot tell is left open.
"""

import numpy as np

from mosca.camera.ray_table import EDGES, SIGMA
from mosca.correspondence.hypothesis import (
    CHI2,
    COVARIANCE,
    DIAMETER,
    GAIN,
    MINIMUM,
    NONE,
    TWICE,
    VALUES,
    XYZ,
    acceptable,
    solve,
    store,
    too_large,
    wholeness,
)
from mosca.correspondence.spatial_index import buckets, within
from mosca.numba_support.decorators import bare_step, kernel, step
from mosca.numba_support.linalg3 import Symmetric3, mahalanobis3
from mosca.triangulation.triangulate import RANKS, TRUST

CLEARLY_WORSE = 9.0
"""A pair whose squared error is larger by this (3 standard deviations) does not contest another."""
PRIOR_SEEN = 5.0
"""So many images seen and as many missed are taken for known beforehand."""
OPEN, TAKEN, GONE = 0, 1, 2


@kernel
def choose(values, members, trusts, rays, views, rules, xyz, covariance, support):  # type: ignore[no-untyped-def]
    """Return the state (n,) of each group: OPEN (a pair that others contest), TAKEN or GONE.

    Changes groups that lose rays in place. ``xyz`` (k, 3), ``covariance`` (k, 3, 3): where tracks expect their
    targets; ``support``: how many standard deviations away from it one speaks for a group.
    """
    n, cameras = members.shape
    used = np.zeros(rays.shape[0], dtype=np.int64)
    spoken = np.zeros(xyz.shape[0], dtype=np.bool_)
    state = np.zeros(n, dtype=np.int8)
    mates, ranks, solved = np.empty(cameras, dtype=np.int64), np.ones((cameras, RANKS)), np.empty(VALUES)
    low, step, first, at, items, wide = buckets(xyz[:, 0].copy(), support * np.sqrt(covariance[:, 0, 0]))
    found = np.empty(xyz.shape[0], dtype=np.int64)
    density = _log_density(values, xyz)
    lost, kept = _seen_shares(values, members, views)
    track, worth = np.full(n, -1, dtype=np.int64), np.zeros(n)
    for _round in range(max(cameras - 1, 1)):
        for g in range(n):
            if state[g] == OPEN:
                half = support * np.sqrt(values[g, COVARIANCE])
                near = within(low, step, first, at, items, wide, values[g, XYZ], half, found)
                track[g], gained = _speaker(g, values, xyz, covariance, spoken, support, density, found, near)
                seen, missing = _seen_and_missing(g, values, members, views)
                worth[g] = values[g, GAIN] + density + gained + missing * lost + kept * seen
        waiting = np.flatnonzero(state == OPEN)
        changed = False
        for g in waiting[np.argsort(-worth[waiting], kind="mergesort")]:
            # chance explains it as well, and no track expects it
            if worth[g] < 0.0 and track[g] < 0:
                state[g] = GONE
            elif _take(g, values, members, track, used, spoken, rays, views, rules):
                state[g] = TAKEN
                changed = True
        if not changed:
            break
        for left in waiting:
            if state[left] == OPEN and not _shrink(
                left, values, members, trusts, used, mates, ranks, solved, rays, views, rules
            ):
                state[left] = GONE
    _take_uncontested(values, members, state, used)
    return state


@step
def _log_density(values, xyz):  # type: ignore[no-untyped-def]
    """Return the logarithm of the density of groups [1/m^3] in the box that they and the tracks fill."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for k in range(3):
        for g in range(values.shape[0]):
            low[k], high[k] = min(low[k], values[g, XYZ + k]), max(high[k], values[g, XYZ + k])
        for t in range(xyz.shape[0]):
            low[k], high[k] = min(low[k], xyz[t, k]), max(high[k], xyz[t, k])
    side = high - low
    if values.shape[0] == 0:
        return 0.0
    longest = max(side[0], side[1], side[2])
    return np.log(values.shape[0] / max(side[0] * side[1] * side[2], 1e-9 * longest**3, 1e-18))


@bare_step
def _seen_shares(values, members, views):  # type: ignore[no-untyped-def]
    """Return the logarithms of the shares of cameras that miss, and that see, a target in their field of view.

    From the groups of three and more of this frame set, as far as there are enough.
    """
    seen, missed = PRIOR_SEEN, PRIOR_SEEN
    for g in range(members.shape[0]):
        count, missing = _seen_and_missing(g, values, members, views)
        if count > 2:
            seen += count
            missed += missing
    return np.log(missed / (seen + missed)), np.log(seen / (seen + missed))


@bare_step
def _seen_and_missing(g, values, members, views):  # type: ignore[no-untyped-def]
    """Return how many cameras have a ray in a group, and how many have its point in view and none."""
    seen = count = 0
    for c in range(members.shape[1]):
        if members[g, c] >= 0:
            seen += 1
            continue
        x, y, z = (
            values[g, XYZ] - views[c, 0],
            values[g, XYZ + 1] - views[c, 1],
            values[g, XYZ + 2] - views[c, 2],
        )
        w = np.sqrt(x * x + y * y + z * z) + views[c, 5] * x + views[c, 8] * y + views[c, 11] * z
        if not w > 0.0:
            continue
        u = (views[c, 3] * x + views[c, 6] * y + views[c, 9] * z) / w
        v = (views[c, 4] * x + views[c, 7] * y + views[c, 10] * z) / w
        count += views[c, EDGES] < u < views[c, EDGES + 2] and views[c, EDGES + 1] < v < views[c, EDGES + 3]
    return seen, count


@bare_step
def _speaker(g, values, xyz, covariance, spoken, gate, density, found, near):  # type: ignore[no-untyped-def]
    """Return which of the first ``near`` tracks ``found`` speaks for a group, or -1, and how much that is worth.

    The worth is the log-likelihood ratio of "this track's target" against "a group anywhere": a track that has not
    been seen for long expects its target everywhere and says little.
    """
    best, worth = -1, 0.0
    for k in range(near):
        t = found[k]
        if spoken[t]:
            continue
        x, y, z = (
            values[g, XYZ] - xyz[t, 0],
            values[g, XYZ + 1] - xyz[t, 1],
            values[g, XYZ + 2] - xyz[t, 2],
        )
        innovation = Symmetric3(
            covariance[t, 0, 0] + values[g, COVARIANCE],
            covariance[t, 0, 1] + values[g, COVARIANCE + 1],
            covariance[t, 0, 2] + values[g, COVARIANCE + 2],
            covariance[t, 1, 1] + values[g, COVARIANCE + 4],
            covariance[t, 1, 2] + values[g, COVARIANCE + 5],
            covariance[t, 2, 2] + values[g, COVARIANCE + 8],
        )
        gate2 = gate * gate
        if x * x > gate2 * innovation.xx or y * y > gate2 * innovation.yy or z * z > gate2 * innovation.zz:
            continue
        away2, det = mahalanobis3(innovation, x, y, z)
        if not away2 < gate2:
            continue
        said = -density - 0.5 * np.log(det * (2.0 * np.pi) ** 3) - 0.5 * away2
        if said > worth:
            best, worth = t, said
    return best, worth


@bare_step
def _take(g, values, members, track, used, spoken, rays, views, rules):  # type: ignore[no-untyped-def]
    """Take a group if its rays are free; a pair only if a track, still free, speaks for it.

    An image of two targets serves a second group if a track speaks for that.
    """
    alone = track[g] < 0 or spoken[track[g]]
    count = 0
    for c in range(members.shape[1]):
        k = members[g, c]
        if k >= 0:
            count += 1
            if used[k] > 1 or (used[k] == 1 and alone):
                return False
            if used[k] == 1 and not too_large(k, c, values[g, XYZ : XYZ + 3], rays, views, rules):
                return False
    if alone and count == 2:
        return False
    if track[g] >= 0:
        spoken[track[g]] = True
    for c in range(members.shape[1]):
        if members[g, c] >= 0:
            used[members[g, c]] += 1
    return True


@bare_step
def _shrink(g, values, members, trusts, used, mates, ranks, solved, rays, views, rules):  # type: ignore[no-untyped-def]
    """Take the rays that are used up from a group and solve it anew; False where no target is left."""
    count, lost = NONE, False
    for c in range(members.shape[1]):
        k = members[g, c]
        if k >= 0 and used[k] > 0:
            members[g, c], lost = -1, True
        count += members[g, c] >= 0
    if not lost:
        return True
    if count < rules[MINIMUM]:
        return False
    for c in range(members.shape[1]):
        mates[c], ranks[c, TRUST] = members[g, c], trusts[g, c]
    for k in range(VALUES):
        solved[k] = values[g, k]
    error = solve(mates, ranks, solved, TWICE, rays, views)
    if not acceptable(mates, solved, count, error, values[g, DIAMETER], rays, views, rules):
        return False
    store(mates, ranks, solved, error, values[g, DIAMETER], rays, g, values, members, trusts)
    return True


@step
def _take_uncontested(values, members, state, used):  # type: ignore[no-untyped-def]
    """Take the groups whose rays no other open one wants that meets about as well."""
    n, cameras = members.shape
    # for each ray the best group that wants it, and the best of those with another set of rays
    first = np.full(used.shape[0], -1, dtype=np.int64)
    second = np.full(used.shape[0], -1, dtype=np.int64)
    for g in range(n):
        if state[g] != OPEN:
            continue
        for c in range(cameras):
            k = members[g, c]
            if k < 0:
                continue
            if first[k] < 0:
                first[k] = g
            elif _same(g, first[k], members):
                continue
            elif values[g, CHI2] < values[first[k], CHI2]:
                first[k], second[k] = g, first[k]
            elif second[k] < 0 or values[g, CHI2] < values[second[k], CHI2]:
                second[k] = g
    for g in range(n):
        if state[g] != OPEN:
            continue
        for c in range(cameras):
            k = members[g, c]
            if k < 0:
                continue
            rival = second[k] if _same(g, first[k], members) else first[k]
            if used[k] > 0 or (rival >= 0 and values[rival, CHI2] < values[g, CHI2] + CLEARLY_WORSE):
                break
        else:
            state[g] = TAKEN
            for c in range(cameras):
                if members[g, c] >= 0:
                    used[members[g, c]] += 1


@bare_step
def _same(g, other, members):  # type: ignore[no-untyped-def]
    """Whether two groups have the same rays."""
    other_rays = 0
    for c in range(members.shape[1]):
        other_rays += members[g, c] != members[other, c]
    return other_rays == 0


@kernel
def columns(values, members, trusts, state, rays, start):  # type: ignore[no-untyped-def]
    """Return the columns of ``Points`` of the groups that were taken."""
    n, cameras = 0, members.shape[1]
    for g in range(values.shape[0]):
        n += state[g] == TAKEN
    xyz, covariance, count = np.empty((n, 3)), np.empty((n, 3, 3)), np.zeros(n, dtype=np.int64)
    residual, index = np.zeros(n), np.full((n, cameras), -1, dtype=np.int64)
    diameter, trusted = np.empty(n), np.zeros(n)
    n = 0
    for g in range(values.shape[0]):
        if state[g] != TAKEN:
            continue
        weight = 0.0
        for c in range(cameras):
            k = members[g, c]
            if k >= 0:
                count[n] += 1
                index[n, c] = k - start[c]
                weight += (trusts[g, c] / rays[k, SIGMA]) ** 2
                trusted[n] += wholeness(k, trusts[g, c], rays)
        for p in range(3):
            xyz[n, p] = values[g, XYZ + p]
            for q in range(3):
                covariance[n, p, q] = values[g, COVARIANCE + 3 * p + q]
        # the variance of its images' mean weight turns whitened errors into px: poor images add little
        residual[n] = np.sqrt(count[n] / weight * values[g, CHI2] / (2.0 * count[n]))
        diameter[n] = values[g, DIAMETER]
        n += 1
    return xyz, covariance, count, residual, index, diameter, trusted
