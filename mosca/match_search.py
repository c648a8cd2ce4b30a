"""The search for groups of rays that meet: compiled kernels of ``mosca.match``.

For every pair of rays in one epipolar plane: intersect, judge the images by their sizes, add the nearest rays of the
other cameras, leave out a bad one. Rays are whitened (``mosca.triangulate.Bundle``), so that errors are counted in
standard deviations. A group of so many rays that chance does not explain it explains its rays, and no further
group is looked for with them; so the work grows with the rays and not with their pairs. A second pass looks, for the
rays left over, as far as half-hidden targets may lie beside their epipolar lines.
"""

import numpy as np
from numba import njit

from mosca.match_groups import (
    MOST_ODD,
    ODD_SHIFT,
    VALUES,
    acceptable,
    image_size,
    judge_sizes,
    limit,
    scratch,
    solve,
    store,
    too_large,
    trust_of,
)
from mosca.match_index import buckets, cell_of, cells, plane_angles, within

CERTAIN = 1e-3
"""Expected number of chance groups as good as this one, below which a group explains its rays."""
EDGE_ON = 0.5
"""Uncertainty of an epipolar plane's angle [rad] beyond which the ray is near the base and meets every plane."""


@njit(nogil=True, cache=True, error_model="numpy")
def search(rays, views, rules):  # type: ignore[no-untyped-def]
    """Return all groups: values (n, VALUES), members (n, c) ray of each camera or -1, trusts (n, c)."""
    cameras, total = views.origin.shape[0], rays.direction.shape[0]
    room, count = max(64, 2 * total // max(cameras, 1)), 0
    values, members = np.empty((room, VALUES)), np.empty((room, cameras), dtype=np.int64)
    trusts = np.empty((room, cameras))
    index = cells(rays.direction, views.rotation, views.start)
    slack, reach = _slack(rays, views, rules)
    explained = np.empty(total, dtype=np.bool_)
    for i in range(total):
        explained[i] = not np.isfinite(rays.angle[i])
    # partner[i, c]: the ray of camera c that a group of three or more has already joined with ray i
    partner = np.full((total, cameras), -1, dtype=np.int32)
    group = scratch(cameras)
    angle, variance, half = np.empty(total), np.empty(total), np.empty(total)
    active, found = np.empty(total, dtype=np.int64), np.empty(total, dtype=np.int64)
    for stage in range(2 if rules.judge else 1):
        for pair in range(views.pairs.shape[0]):
            a, b = views.pairs[pair, 0], views.pairs[pair, 1]
            if views.start[a] == views.start[a + 1] or views.start[b] == views.start[b + 1]:
                continue
            n_a = _left(views.start[a], views.start[a + 1], explained, active)
            n_b = _left(views.start[b], views.start[b + 1], explained, active[n_a:])
            if n_a == 0 or n_b == 0 or not _planes(a, b, n_a, n_b, active, rays, views, angle, variance):
                continue
            for n in range(n_a + n_b):
                i = active[n]
                half[n] = rules.gate * np.sqrt(variance[n] * (slack[i] if stage == 1 else 1.0))
                if not (half[n] < EDGE_ON and half[n] + abs(angle[n]) < np.pi):
                    half[n] = np.inf
            lines = buckets(angle[n_a : n_a + n_b], half[n_a : n_a + n_b])
            width = max(lines.step * (n_b + 1), 1e-300)
            for n in range(n_a):
                i = active[n]
                for f in range(within(lines, angle[n], half[n], found)):
                    if explained[i]:
                        break
                    m = n_a + found[f]
                    j = active[m]
                    if explained[j] or partner[i, b] == j:
                        continue
                    away2 = rules.gate**-2 * (angle[n] - angle[m]) ** 2
                    if not np.isfinite(half[n] + half[m]):
                        away2 = 0.0
                    both = variance[n] + variance[m]
                    near = away2 <= both
                    if near == (stage == 1) or (
                        stage == 1 and away2 > slack[i] * variance[n] + slack[j] * variance[m]
                    ):
                        continue
                    if not _meet(i, j, a, b, away2, variance[n], variance[m], group, rays, views, rules):
                        continue
                    chance = n_a * n_b * min(1.0, 2.0 * rules.gate * np.sqrt(both) / width)
                    size, error, diameter, chance = _grown(
                        a, b, chance, reach, index, group, rays, views, rules
                    )
                    if size == 0:
                        continue
                    if count == values.shape[0]:
                        values, trusts = _longer(values), _longer(trusts)
                        members = _longer_int(members)
                    store(group, error, diameter, rays, values[count], members[count], trusts[count])
                    count += 1
                    if size > 2:
                        certain = chance < CERTAIN
                        for c in range(cameras):
                            k = group.members[c]
                            if k < 0:
                                continue
                            for d in range(cameras):
                                if group.members[d] >= 0:
                                    partner[k, d] = group.members[d]
                            # an image of two targets may serve another group
                            if certain and not too_large(k, c, group.point, rays, views, rules):
                                explained[k] = True
    return values[:count], members[:count], trusts[:count]


@njit(nogil=True, cache=True, error_model="numpy")
def _slack(rays, views, rules):  # type: ignore[no-untyped-def]
    """Return for each ray (n,) the factor on its variance if its target were mostly hidden, and for each camera (c,)
    the largest variance of a ray's direction [rad^2] with it.
    """
    total = rays.direction.shape[0]
    slack, reach = np.ones(total), np.zeros(views.origin.shape[0])
    for c in range(views.origin.shape[0]):
        for i in range(views.start[c], views.start[c + 1]):
            if not np.isfinite(rays.angle[i]):
                continue
            if rules.judge or rays.flags[i]:
                slack[i] = 1.0 + 0.5 * (ODD_SHIFT * MOST_ODD * rays.radius[i] / rays.sigma[i]) ** 2
            s = 0.0
            for p in range(3):
                s += rays.spread[i, p, 0] ** 2 + rays.spread[i, p, 1] ** 2
            reach[c] = max(reach[c], s * slack[i])
    return slack, reach


@njit(nogil=True, cache=True, error_model="numpy")
def _left(first, last, explained, active):  # type: ignore[no-untyped-def]
    """List the rays that nothing explains; returns how many."""
    n = 0
    for i in range(first, last):
        if not explained[i]:
            active[n] = i
            n += 1
    return n


@njit(nogil=True, cache=True, error_model="numpy")
def _planes(a, b, n_a, n_b, active, rays, views, angle, variance):  # type: ignore[no-untyped-def]
    """Fill the angles of the epipolar planes of cameras a and b; False where both stand at one place."""
    base = views.origin[b] - views.origin[a]
    length = np.sqrt(np.sum(base**2))
    if length <= 0.0:
        return False
    base /= length
    # angles count from where both cameras look, so that none is near half a turn
    up = views.rotation[a, :, 2] + views.rotation[b, :, 2]
    up = up - base * np.sum(up * base)
    if np.sum(up**2) < 1e-6:
        up = views.rotation[a, :, 1] - base * np.sum(views.rotation[a, :, 1] * base)
    if np.sum(up**2) < 1e-6:
        up = views.rotation[a, :, 0] - base * np.sum(views.rotation[a, :, 0] * base)
    up = up / np.sqrt(np.sum(up**2))
    plane_angles(rays, active[: n_a + n_b], up, np.cross(base, up), angle, variance)
    return True


@njit(nogil=True, cache=True, error_model="numpy")
def _meet(i, j, a, b, away2, variance_i, variance_j, group, rays, views, rules):  # type: ignore[no-untyped-def]
    """Begin a group with the rays i and j of cameras a and b; False where they do not meet."""
    d, e = rays.direction[i], rays.direction[j]
    x = views.origin[b, 0] - views.origin[a, 0]
    y = views.origin[b, 1] - views.origin[a, 1]
    z = views.origin[b, 2] - views.origin[a, 2]
    cosine = d[0] * e[0] + d[1] * e[1] + d[2] * e[2]
    along_d, along_e = d[0] * x + d[1] * y + d[2] * z, e[0] * x + e[1] * y + e[2] * z
    sine2 = 1.0 - cosine * cosine
    if not sine2 > 1e-12:
        return False
    s, t = (along_d - cosine * along_e) / sine2, (cosine * along_d - along_e) / sine2
    if not (s > 0.0 and t > 0.0):
        return False
    size_i, size_j = rays.angle[i] * s, rays.angle[j] * t
    whole = rules.typical if rules.typical > 0.0 else max(size_i, size_j)
    trust_i = trust_of(i, size_i, whole, rays, rules.judge)
    trust_j = trust_of(j, size_j, whole, rays, rules.judge)
    if away2 > variance_i / trust_i**2 + variance_j / trust_j**2:
        return False
    group.members[:] = -1
    group.trust[:] = 1.0
    group.members[a], group.members[b] = i, j
    group.trust[a], group.trust[b] = trust_i, trust_j
    for k in range(3):
        group.point[k] = 0.5 * (views.origin[a, k] + s * d[k] + views.origin[b, k] + t * e[k])
    error = solve(group, 1, rays, views)
    if not 0.0 <= error <= rules.gate**2:
        return False
    return (
        rules.low[0] <= group.point[0] <= rules.high[0]
        and rules.low[1] <= group.point[1] <= rules.high[1]
        and rules.low[2] <= group.point[2] <= rules.high[2]
    )


@njit(nogil=True, cache=True, error_model="numpy")
def _grown(a, b, chance, reach, index, group, rays, views, rules):  # type: ignore[no-untyped-def]
    """Widen a pair to all cameras, drop bad rays, judge. Returns how many rays it has (0: none), its squared error,
    diameter and the expected number of chance groups like it.
    """
    cameras = views.origin.shape[0]
    i, j = group.members[a], group.members[b]
    seen = max(image_size(i, a, group.point, rays, views), image_size(j, b, group.point, rays, views))
    whole = rules.typical if rules.typical > 0.0 else seen
    size = 2
    for c in range(cameras):
        if c == a or c == b:
            continue
        nearest, trust, share = _nearest(c, whole, reach[c], index, group, rays, views, rules)
        if nearest >= 0:
            group.members[c], group.trust[c], group.share[c] = nearest, trust, share
            size += 1
    diameter = judge_sizes(group, rays, views, rules)
    error = solve(group, 2, rays, views)
    while size > 2 and not 0.0 <= error <= limit(2 * size - 3, rules.outlier):
        # a bad ray pulls the point towards itself: judge each by what is left without it
        least, at = np.inf, -1
        for c in range(cameras):
            k = group.members[c]
            if k >= 0:
                group.members[c] = -1
                rest = solve(group, 2, rays, views)
                group.members[c] = k
                if 0.0 <= rest < least:
                    least, at = rest, c
        # with one of the pair bad this was no pair; the good rays have pairs of their own
        if at < 0 or at == a or at == b:
            return 0, 0.0, 0.0, 1.0
        group.members[at] = -1
        size -= 1
        error = solve(group, 2, rays, views)
    if size < rules.minimum or not acceptable(group, size, error, diameter, rays, views, rules):
        return 0, 0.0, 0.0, 1.0
    added = 0
    for c in range(cameras):
        if group.members[c] >= 0 and c != a and c != b:
            # whichever of the other cameras these are: the number of choices
            chance *= group.share[c] * (cameras - 2 - added) / (added + 1)
            added += 1
    return size, error, diameter, chance


@njit(nogil=True, cache=True, error_model="numpy")
def _nearest(c, whole, reach, index, group, rays, views, rules):  # type: ignore[no-untyped-def]
    """Return the ray of camera c nearest to the group's point among those that the covariances admit (-1: none), its
    trust, and the expected number of chance rays as near.
    """
    r, o, gate2, cov = views.rotation[c], views.origin[c], rules.gate**2, group.cov
    x, y, z = group.point[0] - o[0], group.point[1] - o[1], group.point[2] - o[2]
    distance = np.sqrt(x * x + y * y + z * z)
    u = r[0, 0] * x + r[1, 0] * y + r[2, 0] * z
    v = r[0, 1] * x + r[1, 1] * y + r[2, 1] * z
    w = distance + r[0, 2] * x + r[1, 2] * y + r[2, 2] * z
    if not w > 1e-9 * distance:
        return -1, 1.0, 0.0
    u, v = u / w, v / w
    # the place's derivative by the point, row by row, and so its variance; an angle counts (1 + |place|^2) / 2
    stretch2 = (0.5 * (1.0 + u * u + v * v)) ** 2 * reach
    box = np.empty((2, 2), dtype=np.int64)
    for axis in range(2):
        place = v if axis else u
        j0 = (r[0, axis] - place * (x / distance + r[0, 2])) / w
        j1 = (r[1, axis] - place * (y / distance + r[1, 2])) / w
        j2 = (r[2, axis] - place * (z / distance + r[2, 2])) / w
        variance = j0 * (j0 * cov[0, 0] + 2.0 * (j1 * cov[0, 1] + j2 * cov[0, 2]))
        variance += j1 * (j1 * cov[1, 1] + 2.0 * j2 * cov[1, 2]) + j2 * j2 * cov[2, 2]
        # a little wider than to first order
        side = 1.01 * rules.gate * np.sqrt(variance + stretch2)
        corner, scale = index.corner[c, axis], index.scale[c, axis]
        box[axis, 0] = cell_of(place - side, corner, scale, index.side[c])
        box[axis, 1] = cell_of(place + side, corner, scale, index.side[c])
    best, at, trusted, share = np.inf, -1, 1.0, 0.0
    for row in range(box[1, 0], box[1, 1] + 1):
        first = index.offset[c] + row * index.side[c]
        for n in range(index.start[first + box[0, 0]], index.start[first + box[0, 1] + 1]):
            k = index.items[n]
            d, m = rays.direction[k], rays.white[k]
            depth = d[0] * x + d[1] * y + d[2] * z
            # a thousandth of a radian squared: far beyond any gate
            if depth < 0.9995 * distance:
                continue
            t2 = trust_of(k, rays.angle[k] * distance, whole, rays, rules.judge) ** 2
            e0 = (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z) / depth
            e1 = (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z) / depth
            if t2 * (e0 * e0 + e1 * e1) > gate2 * (1.0 + t2 * _most(m, cov, depth)):
                continue
            s00, s01, s11 = _carried(m, cov, depth)
            s00, s01, s11 = 1.0 + t2 * s00, t2 * s01, 1.0 + t2 * s11
            det = s00 * s11 - s01 * s01
            error = t2 * (s11 * e0 * e0 - 2.0 * s01 * e0 * e1 + s00 * e1 * e1) / det
            # among those admitted the nearest in the image decides, not the least trusted
            if error < gate2 and error / t2 < best:
                best, at, trusted = error / t2, k, np.sqrt(t2)
                share = views.density[c] * np.pi * max(error, 0.05) * np.sqrt(det) * rays.sigma[k] ** 2 / t2
    return at, trusted, share


@njit(nogil=True, cache=True, error_model="numpy")
def _carried(m, cov, depth):  # type: ignore[no-untyped-def]
    """Return a point's covariance carried into a ray's whitened image: xx, xy, yy."""
    s00 = s01 = s11 = 0.0
    for p in range(3):
        g = cov[p, 0] * m[0, 0] + cov[p, 1] * m[0, 1] + cov[p, 2] * m[0, 2]
        h = cov[p, 0] * m[1, 0] + cov[p, 1] * m[1, 1] + cov[p, 2] * m[1, 2]
        s00 += m[0, p] * g
        s01 += m[1, p] * g
        s11 += m[1, p] * h
    return s00 / depth**2, s01 / depth**2, s11 / depth**2


@njit(nogil=True, cache=True, error_model="numpy")
def _most(m, cov, depth):  # type: ignore[no-untyped-def]
    """Return a bound of ``_carried``'s larger eigenvalue: the product of the traces."""
    square = 0.0
    for p in range(3):
        square += m[0, p] ** 2 + m[1, p] ** 2
    return square * (cov[0, 0] + cov[1, 1] + cov[2, 2]) / depth**2


@njit(nogil=True, cache=True, error_model="numpy")
def _longer(rows):  # type: ignore[no-untyped-def]
    longer = np.empty((2 * rows.shape[0], rows.shape[1]))
    longer[: rows.shape[0]] = rows
    return longer


@njit(nogil=True, cache=True, error_model="numpy")
def _longer_int(rows):  # type: ignore[no-untyped-def]
    longer = np.empty((2 * rows.shape[0], rows.shape[1]), dtype=np.int64)
    longer[: rows.shape[0]] = rows
    return longer
