"""The search for groups of rays that meet: compiled kernels of ``mosca.correspondence.match``.

For every pair of rays in one epipolar plane: intersect, judge the images by their sizes, add the nearest rays of the
other cameras, leave out a bad one. Rays are whitened (``mosca.data.rays.RayTable``), so that errors
are counted in standard deviations. A group of so many rays that chance does not explain it explains its rays, and
no further group is looked for with them; so the work grows with the rays and not with their pairs. A second pass
looks, for the rays left over, as far as half-hidden targets may lie beside their epipolar lines.
"""

import numpy as np

from mosca.camera.ray_table import LONG
from mosca.correspondence.hypothesis import (
    GATE,
    HIGH,
    JUDGE,
    LOW,
    MINIMUM,
    MOST_ODD,
    NONE,
    ODD_SHIFT,
    ONCE,
    OUTLIER,
    TWICE,
    TYPICAL,
    VALUES,
    acceptable,
    image_size,
    judge_sizes,
    larger,
    largest_image,
    limit,
    solve,
    store,
    too_large,
    trust2_of,
)
from mosca.correspondence.spatial_index import (
    CELLS,
    CORNER,
    FIRST,
    SCALE,
    buckets,
    cell_of,
    cells,
    plane_angles,
    within,
)
from mosca.data.rays import ANGLE, DENSITY, FLAGS, RADIUS, SIGMA, SPREAD, WHITE
from mosca.numba_support.decorators import bare_step, inlined_step, kernel, step
from mosca.triangulation.triangulate import DEPTH, RANKS, SHARE, TRUST

CERTAIN = 1e-3
"""Expected number of chance groups as good as this one, below which a group explains its rays."""
PLAIN = 3.0
"""Standard deviations up to which a group that a track expects is taken without looking at others."""
FEW_CELLS = 2
"""More cells than these beside the first are searched only where a closer look at the errors demands it."""
EDGE_ON = 0.5
"""Uncertainty of an epipolar plane's angle [rad] beyond which the ray is near the base and meets every plane."""


@kernel
def search(rays, views, pairs, bases, start, rules, xyz, covariance):  # type: ignore[no-untyped-def]
    """Return all groups: values (n, VALUES), members (n, c) ray of each camera or -1, trusts (n, c).

    ``xyz`` (k, 3), ``covariance`` (k, 3, 3): where tracks expect their targets; what lies there is tried first.
    """
    cameras, total = views.shape[0], rays.shape[0]
    room, count = max(64, 2 * total // max(cameras, 1)), NONE
    values, members = np.empty((room, VALUES)), np.empty((room, cameras), dtype=np.int64)
    trusts = np.empty((room, cameras))
    index = cells(rays, views, start)
    slack, reach = _slack(rays, start, rules)
    explained = np.empty(total, dtype=np.bool_)
    for i in range(total):
        explained[i] = not np.isfinite(rays[i, ANGLE])
    # partner[i, c]: the ray of camera c that a group of three or more has already joined with ray i
    partner = np.full((total, cameras), -1, dtype=np.int32)
    mates, ranks, solved = np.empty(cameras, dtype=np.int64), np.ones((cameras, RANKS)), np.zeros(VALUES)
    angle, variance, half = np.empty(total), np.empty(total), np.empty(total)
    gate_2 = 1.0 / rules[GATE] ** 2
    active, found = np.empty(total, dtype=np.int64), np.empty(total, dtype=np.int64)
    joined = np.zeros(total, dtype=np.bool_)
    for target in range(xyz.shape[0] if rules[TYPICAL] > 0.0 else 0):
        size, error, diameter, chance = _expected(
            target, xyz, covariance, explained, reach, index, mates, ranks, solved, rays, views, rules
        )  # fmt: skip
        if size > 0:
            if count == values.shape[0]:
                values, members, trusts = _longer(values), _longer(members), _longer(trusts)
            store(mates, ranks, solved, error, diameter, rays, count, values, members, trusts)
            count += 1
            _note(mates, solved, chance, partner, explained, joined, rays, views, rules)
    for stage in range(2 if rules[JUDGE] > 0.0 else 1):
        if stage == 1:
            # half-hidden targets: for rays that no three cameras join as they are
            for i in range(total):
                explained[i] |= joined[i]
        for pair in range(pairs.shape[0]):
            a, b = pairs[pair, 0], pairs[pair, 1]
            n_a = _left(start[a], start[a + 1], explained, active)
            n_b = _left(start[b], start[b + 1], explained, active[n_a:]) if n_a > 0 else 0
            if n_b == 0 or bases[pair, 0, 0] == np.inf:
                continue
            plane_angles(rays, active[: n_a + n_b], bases[pair], angle, variance)
            for n in range(n_a + n_b):
                i = active[n]
                half[n] = rules[GATE] * np.sqrt(variance[n] * (slack[i] if stage == 1 else 1.0))
                if not (half[n] < EDGE_ON and half[n] + abs(angle[n]) < np.pi):
                    half[n] = np.inf
            low, step, first, at, items, wide = buckets(angle[n_a : n_a + n_b], half[n_a : n_a + n_b])
            width = max(step * (n_b + 1), 1e-300)
            for n in range(n_a):
                i = active[n]
                for f in range(within(low, step, first, at, items, wide, angle[n], half[n], found)):
                    if explained[i]:
                        break
                    m = n_a + found[f]
                    j = active[m]
                    if explained[j] or partner[i, b] == j:
                        continue
                    away2 = gate_2 * (angle[n] - angle[m]) ** 2
                    if not np.isfinite(half[n] + half[m]):
                        away2 = 0.0
                    both = variance[n] + variance[m]
                    near = away2 <= both
                    if near == (stage == 1) or (
                        stage == 1 and away2 > slack[i] * variance[n] + slack[j] * variance[m]
                    ):
                        continue
                    if not _meet(
                        i, j, a, b, away2, variance[n], variance[m], mates, ranks, solved, rays, views, rules
                    ):
                        continue
                    chance = n_a * n_b * min(1.0, 2.0 * rules[GATE] * np.sqrt(both) / width)
                    size, error, diameter, chance = _grown(
                        a, b, chance, reach, index, partner, mates, ranks, solved, rays, views, rules
                    )
                    if size == 0:
                        continue
                    if count == values.shape[0]:
                        values, members, trusts = _longer(values), _longer(members), _longer(trusts)
                    store(mates, ranks, solved, error, diameter, rays, count, values, members, trusts)
                    count += 1
                    if size > 2:
                        _note(mates, solved, chance, partner, explained, joined, rays, views, rules)
    return values[:count], members[:count], trusts[:count]


@inlined_step
def _expected(  # type: ignore[no-untyped-def]
    track, xyz, covariance, explained, reach, index, members, ranks, solved, rays, views, rules
):  # fmt: skip
    """Join the rays nearest to where a track expects its target. Returns as ``_grown``.

    The group is judged as any other is; the track only saves the search. None where anything is odd, which has to
    compete with other groups: rays that meet poorly, that chance explains, that are not the nearest to their point.
    """
    cameras = views.shape[0]
    for p in range(3):
        solved[p] = xyz[track, p]
        for q in range(3):
            solved[3 + 3 * p + q] = covariance[track, p, q]
    size, chance, doubtful = NONE, float(xyz.shape[0]), False
    for c in range(cameras):
        k, trust, share, admitted = _nearest(c, rules[TYPICAL], reach[c], index, solved, rays, views, rules)
        members[c], ranks[c, TRUST] = k, trust
        if k >= 0:
            if explained[k]:
                return 0, 0.0, 0.0, 1.0
            size += 1
            chance *= min(1.0, share)
            doubtful |= admitted > 1
    if size < 3 or size < rules[MINIMUM] or not chance < CERTAIN:
        return 0, 0.0, 0.0, 1.0
    error = solve(members, ranks, solved, TWICE, rays, views)
    if not 0.0 <= error <= limit(2 * size - 3, PLAIN):
        return 0, 0.0, 0.0, 1.0
    # trusted already by their sizes there, since the typical one is known
    diameter = largest_image(members, solved, rays, views)[0]
    if not acceptable(members, solved, size, error, diameter, rays, views, rules):
        return 0, 0.0, 0.0, 1.0
    for c in range(cameras if doubtful else 0):
        if members[c] != _nearest(c, rules[TYPICAL], reach[c], index, solved, rays, views, rules)[0]:
            return 0, 0.0, 0.0, 1.0
    return size, error, diameter, chance


@bare_step
def _note(members, solved, chance, partner, explained, joined, rays, views, rules):  # type: ignore[no-untyped-def]
    """Remember which rays a group joins, and that a certain one explains them."""
    cameras = members.shape[0]
    for c in range(cameras):
        k = members[c]
        if k < 0:
            continue
        # an image of two targets may serve another group
        if not too_large(k, c, solved, rays, views, rules):
            joined[k] = True
            explained[k] |= chance < CERTAIN
        for d in range(0 if explained[k] else cameras):
            if members[d] >= 0:
                partner[k, d] = members[d]


@step
def _slack(rays, start, rules):  # type: ignore[no-untyped-def]
    """Return for each ray (n,) the factor on its variance if its target were mostly hidden, and for each camera (c,)
    the largest variance of a ray's direction [rad^2] with it.
    """
    slack, reach = np.ones(rays.shape[0]), np.zeros(start.shape[0] - 1)
    for c in range(reach.shape[0]):
        for i in range(start[c], start[c + 1]):
            if not np.isfinite(rays[i, ANGLE]):
                continue
            if rules[JUDGE] > 0.0 or rays[i, FLAGS] % LONG > 0.0:
                slack[i] = 1.0 + 0.5 * (ODD_SHIFT * MOST_ODD * rays[i, RADIUS] / rays[i, SIGMA]) ** 2
            variance = 0.0
            for p in range(6):
                variance += rays[i, SPREAD + p] ** 2
            reach[c] = max(reach[c], variance * slack[i])
    return slack, reach


@bare_step
def _left(first, last, explained, active):  # type: ignore[no-untyped-def]
    """List the rays that nothing explains; returns how many."""
    n = 0
    for i in range(first, last):
        if not explained[i]:
            active[n] = i
            n += 1
    return n


@bare_step
def _meet(i, j, a, b, away2, variance_i, variance_j, members, ranks, solved, rays, views, rules):  # type: ignore[no-untyped-def]
    """Begin a group with the rays i and j of cameras a and b; False where they do not meet."""
    d0, d1, d2 = rays[i, 0], rays[i, 1], rays[i, 2]
    e0, e1, e2 = rays[j, 0], rays[j, 1], rays[j, 2]
    x = views[b, 0] - views[a, 0]
    y = views[b, 1] - views[a, 1]
    z = views[b, 2] - views[a, 2]
    cosine = d0 * e0 + d1 * e1 + d2 * e2
    along_d, along_e = d0 * x + d1 * y + d2 * z, e0 * x + e1 * y + e2 * z
    sine2 = 1.0 - cosine * cosine
    if not sine2 > 1e-12:
        return False
    s, t = (along_d - cosine * along_e) / sine2, (cosine * along_d - along_e) / sine2
    if not (s > 0.0 and t > 0.0):
        return False
    size_i, size_j = rays[i, ANGLE] * s, rays[j, ANGLE] * t
    whole = rules[TYPICAL] if rules[TYPICAL] > 0.0 else larger(i, size_i, j, size_j, rays)
    trust_i = trust2_of(i, size_i, whole, rays, rules[JUDGE])
    trust_j = trust2_of(j, size_j, whole, rays, rules[JUDGE])
    if away2 > variance_i / trust_i + variance_j / trust_j:
        return False
    for c in range(members.shape[0]):
        members[c], ranks[c, TRUST] = -1, 1.0
    members[a], members[b] = i, j
    ranks[a, TRUST], ranks[b, TRUST] = np.sqrt(trust_i), np.sqrt(trust_j)
    solved[0] = 0.5 * (views[a, 0] + s * d0 + views[b, 0] + t * e0)
    solved[1] = 0.5 * (views[a, 1] + s * d1 + views[b, 1] + t * e1)
    solved[2] = 0.5 * (views[a, 2] + s * d2 + views[b, 2] + t * e2)
    error = solve(members, ranks, solved, ONCE, rays, views)
    if not 0.0 <= error <= rules[GATE] ** 2:
        return False
    return (
        rules[LOW + 0] <= solved[0] <= rules[HIGH + 0]
        and rules[LOW + 1] <= solved[1] <= rules[HIGH + 1]
        and rules[LOW + 2] <= solved[2] <= rules[HIGH + 2]
    )


@bare_step
def _grown(  # type: ignore[no-untyped-def]
    a, b, chance, reach, index, partner, members, ranks, solved, rays, views, rules
):
    """Widen a pair to all cameras, drop bad rays, judge. Returns how many rays it has (0: none), its squared error,
    diameter and the expected number of chance groups like it.
    """
    cameras = views.shape[0]
    i, j = members[a], members[b]
    size_i, size_j = image_size(i, a, solved, rays, views), image_size(j, b, solved, rays, views)
    seen = larger(i, size_i, j, size_j, rays)
    whole = rules[TYPICAL] if rules[TYPICAL] > 0.0 else seen
    size = TWICE
    for c in range(cameras):
        if c in (a, b):
            continue
        nearest, trust, share, _ = _nearest(c, whole, reach[c], index, solved, rays, views, rules)
        if nearest >= 0:
            members[c], ranks[c, TRUST], ranks[c, SHARE] = nearest, trust, share
            size += 1
    diameter = judge_sizes(members, ranks, solved, rays, views, rules)
    error = solve(members, ranks, solved, TWICE, rays, views)
    while size > 2 and not 0.0 <= error <= limit(2 * size - 3, rules[OUTLIER]):
        # a bad ray pulls the point towards itself: judge each by what is left without it
        at = _worst_ray(members, ranks, solved, rays, views) if error >= 0.0 else -1
        if at < 0:
            return 0, 0.0, 0.0, 1.0
        members[at] = -1
        size -= 1
        # with one of three bad, this pair or another: each has to stand for itself
        if size == 2 and at in (a, b):
            return 0, 0.0, 0.0, 1.0
        error = solve(members, ranks, solved, TWICE, rays, views)
    if size > 2 and (members[a] < 0 or members[b] < 0) and _joined(members, partner):
        return 0, 0.0, 0.0, 1.0
    if size < rules[MINIMUM] or not acceptable(members, solved, size, error, diameter, rays, views, rules):
        return 0, 0.0, 0.0, 1.0
    added = 0
    for c in range(cameras):
        if members[c] >= 0 and c != a and c != b:
            # whichever of the other cameras these are: the number of choices
            chance *= min(1.0, ranks[c, SHARE]) * (cameras - 2 - added) / (added + 1)
            added += 1
    return size, error, diameter, chance


@bare_step
def _worst_ray(members, ranks, solved, rays, views):  # type: ignore[no-untyped-def]
    """Return the camera whose ray, left out, lowers the group's squared error most.

    By e' (I - H)^-1 e with the ray's whitened error e and its share H = A P A' of its own error in the solution:
    exact for fixed depths, in which the problem is linear (Cook and Weisberg 1982, section 2.2).
    """
    worst, at = -1.0, -1
    for c in range(members.shape[0]):
        k = members[c]
        if k < 0:
            continue
        scale = ranks[c, TRUST] / ranks[c, DEPTH]
        e0 = e1 = h00 = h01 = h11 = 0.0
        for p in range(3):
            m0, m1 = scale * rays[k, WHITE + p], scale * rays[k, WHITE + 3 + p]
            e0 += m0 * (solved[p] - views[c, p])
            e1 += m1 * (solved[p] - views[c, p])
            for q in range(3):
                shared = scale * solved[3 + 3 * p + q]
                h00 += m0 * rays[k, WHITE + q] * shared
                h01 += m0 * rays[k, WHITE + 3 + q] * shared
                h11 += m1 * rays[k, WHITE + 3 + q] * shared
        r00, r11 = 1.0 - h00, 1.0 - h11
        det = max(r00 * r11 - h01 * h01, 1e-12)
        lowered = (r11 * e0 * e0 + 2.0 * h01 * e0 * e1 + r00 * e1 * e1) / det
        if lowered > worst:
            worst, at = lowered, c
    return at


@bare_step
def _joined(members, partner):  # type: ignore[no-untyped-def]
    """Whether the first two rays of a group have been joined in a group of three or more."""
    first = -1
    for c in range(members.shape[0]):
        if members[c] >= 0:
            if first >= 0:
                return partner[first, c] == members[c]
            first = members[c]
    return False


@inlined_step
def _nearest(c, whole, reach, index, solved, rays, views, rules):  # type: ignore[no-untyped-def]
    """Return the ray of camera c nearest to the group's point among those that the covariances admit (-1: none), its
    trust, the expected number of chance rays as near, and how many were admitted.
    """
    frame, first_in_cell, in_cell, place = index
    gate2 = rules[GATE] ** 2
    x, y, z = solved[0] - views[c, 0], solved[1] - views[c, 1], solved[2] - views[c, 2]
    distance = np.sqrt(x * x + y * y + z * z)
    w = distance + views[c, 5] * x + views[c, 8] * y + views[c, 11] * z
    if not w > 1e-9 * distance:
        return -1, 1.0, 0.0, 0
    inverse = 1.0 / w
    u = (views[c, 3] * x + views[c, 6] * y + views[c, 9] * z) * inverse
    v = (views[c, 4] * x + views[c, 7] * y + views[c, 10] * z) * inverse
    v00, v01, v02, v11, v12, v22 = solved[3], solved[4], solved[5], solved[7], solved[8], solved[11]
    # an angle counts (1 + |place|^2) / 2 there, and a point's error in no direction more than in all together
    scale = 0.5 * (1.0 + u * u + v * v)
    side = 1.01 * rules[GATE] * scale * np.sqrt(reach + (v00 + v11 + v22) / (distance * distance))
    beside, above = side, side
    left, right = _cells_beside(c, NONE, u, side, frame)
    top, bottom = _cells_beside(c, ONCE, v, side, frame)
    if (right - left) * (bottom - top) > FEW_CELLS:
        own = scale * scale * reach
        beside = _side(c, NONE, u, x / distance, y / distance, z / distance, w, own, solved, views, rules)
        left, right = _cells_beside(c, NONE, u, beside, frame)
        above = _side(c, ONCE, v, x / distance, y / distance, z / distance, w, own, solved, views, rules)
        top, bottom = _cells_beside(c, ONCE, v, above, frame)
    nearest, at, trust2, det_there, admitted = np.inf, -1, 1.0, 0.0, 0
    for row in range(top, bottom + 1):
        first = int(frame[c, FIRST] + row * frame[c, CELLS])
        for n in range(first_in_cell[first + left], first_in_cell[first + right + 1]):
            if abs(place[n, 0] - u) > beside or abs(place[n, 1] - v) > above:
                continue
            k = in_cell[n]
            depth = rays[k, 0] * x + rays[k, 1] * y + rays[k, 2] * z
            # a thousandth of a radian squared: far beyond any gate
            if depth < 0.9995 * distance:
                continue
            inverse = 1.0 / depth
            m00, m01, m02 = (
                rays[k, WHITE + 0] * inverse,
                rays[k, WHITE + 1] * inverse,
                rays[k, WHITE + 2] * inverse,
            )
            m10, m11, m12 = (
                rays[k, WHITE + 3] * inverse,
                rays[k, WHITE + 4] * inverse,
                rays[k, WHITE + 5] * inverse,
            )
            e0, e1 = m00 * x + m01 * y + m02 * z, m10 * x + m11 * y + m12 * z
            t2 = trust2_of(k, rays[k, ANGLE] * distance, whole, rays, rules[JUDGE])
            # the point's covariance carried into the ray's whitened image
            g0, g1, g2 = (
                v00 * m00 + v01 * m01 + v02 * m02,
                v01 * m00 + v11 * m01 + v12 * m02,
                v02 * m00 + v12 * m01 + v22 * m02,
            )
            h0, h1, h2 = (
                v00 * m10 + v01 * m11 + v02 * m12,
                v01 * m10 + v11 * m11 + v12 * m12,
                v02 * m10 + v12 * m11 + v22 * m12,
            )
            s00 = 1.0 + t2 * (m00 * g0 + m01 * g1 + m02 * g2)
            s01 = t2 * (m10 * g0 + m11 * g1 + m12 * g2)
            s11 = 1.0 + t2 * (m10 * h0 + m11 * h1 + m12 * h2)
            det = s00 * s11 - s01 * s01
            away = (s11 * e0 * e0 - 2.0 * s01 * e0 * e1 + s00 * e1 * e1) / det
            if t2 * away < gate2:
                admitted += 1
                # among those admitted the nearest in the image decides, not the least trusted
                if away < nearest:
                    nearest, at, trust2, det_there = away, k, t2, det
    if at < 0:
        return -1, 1.0, 0.0, 0
    area = np.pi * max(trust2 * nearest, 0.05) * np.sqrt(det_there) * rays[at, SIGMA] ** 2 / trust2
    return at, np.sqrt(trust2), views[c, DENSITY] * area, admitted


@bare_step
def _cells_beside(c, axis, place, side, frame):  # type: ignore[no-untyped-def]
    """Return the first and last row or column of cells within ``place`` -+ ``side``."""
    corner, scale, count = frame[c, CORNER + axis], frame[c, SCALE + axis], frame[c, CELLS]
    return cell_of(place - side, corner, scale, count), cell_of(place + side, corner, scale, count)


@bare_step
def _side(c, axis, place, x, y, z, w, own, solved, views, rules):  # type: ignore[no-untyped-def]
    """Return how far along one axis a point's image may lie beside its place; (x, y, z) its direction."""
    # the place's derivative by the point, and so its variance
    j0 = (views[c, 3 + axis] - place * (x + views[c, 5])) / w
    j1 = (views[c, 6 + axis] - place * (y + views[c, 8])) / w
    j2 = (views[c, 9 + axis] - place * (z + views[c, 11])) / w
    variance = j0 * (j0 * solved[3] + 2.0 * (j1 * solved[4] + j2 * solved[5]))
    variance += j1 * (j1 * solved[7] + 2.0 * j2 * solved[8]) + j2 * j2 * solved[11]
    # a little wider than to first order
    return 1.01 * rules[GATE] * np.sqrt(variance + own)


@step
def _longer(rows):  # type: ignore[no-untyped-def]
    """Return a copy of rows (n, k) with room for twice as many."""
    longer = np.empty((2 * rows.shape[0], rows.shape[1]), dtype=rows.dtype)
    for i in range(rows.shape[0]):
        for k in range(rows.shape[1]):
            longer[i, k] = rows[i, k]
    return longer
