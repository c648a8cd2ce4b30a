"""The search for groups of rays that meet: compiled kernels of ``mosca.match``.

For every pair of rays on each other's epipolar lines: intersect, judge the images by their sizes, add the nearest
rays of the other cameras, leave out a bad one. Rays are whitened (``mosca.triangulate.Bundle``), so that errors
are counted in standard deviations.
"""

import numpy as np
from numba import njit

from mosca.triangulate import solve_point

MOST_ODD = 0.7
"""Areas are compared up to this difference; beyond it an image says little more."""
ODD_SHIFT = 1.15
"""Shift of an image's centroid over (missing share of its area x radius). A disc with the share h hidden shifts by
0.85 h R to h R; small blurred images lose contrast with their area, so that only 3/4 of h is seen missing."""
SIZE_DEADBAND = 0.1
"""Differences of area below this are noise of the measured sizes."""
HALF_HIDDEN = 0.47
"""Missing share that more than half a disc leaves; two cameras do not make a point with such an image."""


@njit(nogil=True, cache=True)
def search(  # type: ignore[no-untyped-def]
    origin, start, direction, white, spread, sigma, radius, angle, gate, outlier, low, high, typical, judge
):
    """All pairs of cameras, all pairs of rays on each other's epipolar lines, widened to the other cameras."""
    if not judge:
        # a hidden part shifts a point's centroid by nothing: every ray counts in full
        radius = np.zeros_like(radius)
    cameras, total = origin.shape[0], direction.shape[0]
    # a ray's direction error, one standard deviation, if its target were mostly hidden
    reach, slack = np.empty(total), np.empty(total)
    for i in range(total):
        slack[i] = 1.0 + 0.5 * (ODD_SHIFT * MOST_ODD * radius[i] / sigma[i]) ** 2
        s = 0.0
        for a in range(3):
            s += spread[i, a, 0] ** 2 + spread[i, a, 1] ** 2
        reach[i] = s * slack[i]
    room = 64
    xyz, covariance = np.empty((room, 3)), np.empty((room, 3, 3))
    chi2, groups, diameters = np.empty(room), np.empty((room, cameras), dtype=np.int64), np.empty(room)
    trusts = np.empty((room, cameras))
    count = 0
    # partner[i, c]: the ray of camera c that a group of three or more has already joined with ray i
    partner = np.full((total, cameras), -1, dtype=np.int64)
    point, cov = np.empty(3), np.empty((3, 3))
    members, trust = np.empty(cameras, dtype=np.int64), np.ones(cameras)
    for a in range(cameras - 1):
        for b in range(a + 1, cameras):
            tx, ty, tz = origin[b, 0] - origin[a, 0], origin[b, 1] - origin[a, 1], origin[b, 2] - origin[a, 2]
            base2 = tx * tx + ty * ty + tz * tz
            for i in range(start[a], start[a + 1]):
                p, q, r = direction[i, 0], direction[i, 1], direction[i, 2]
                # normal of the epipolar plane
                nx, ny, nz = ty * r - tz * q, tz * p - tx * r, tx * q - ty * p
                for j in range(start[b], start[b + 1]):
                    e = nx * direction[j, 0] + ny * direction[j, 1] + nz * direction[j, 2]
                    if e * e > gate * gate * base2 * (reach[i] + reach[j]) or partner[i, b] == j:
                        continue
                    # the same product seen from the other side: e = d_i . (d_j x t)
                    dx, dy, dz = direction[j, 0], direction[j, 1], direction[j, 2]
                    mx, my, mz = dy * tz - dz * ty, dz * tx - dx * tz, dx * ty - dy * tx
                    variance = 0.0
                    for k in range(2):
                        variance += (
                            slack[j]
                            * (nx * spread[j, 0, k] + ny * spread[j, 1, k] + nz * spread[j, 2, k]) ** 2
                        )
                        variance += (
                            slack[i]
                            * (mx * spread[i, 0, k] + my * spread[i, 1, k] + mz * spread[i, 2, k]) ** 2
                        )
                    if e * e > gate * gate * variance:
                        continue
                    members[:] = -1
                    members[a], members[b] = i, j
                    trust[:] = 1.0
                    if solve_members(members, trust, origin, direction, white, point, cov) < 0.0:
                        continue
                    diameter = _judge(members, trust, point, origin, sigma, radius, angle, typical)
                    whole = typical if typical > 0.0 else diameter
                    error = solve_members(members, trust, origin, direction, white, point, cov)
                    if error < 0.0 or error > gate * gate or not _inside(point, low, high):
                        continue
                    size = _widen(
                        members,
                        trust,
                        a,
                        b,
                        origin,
                        start,
                        direction,
                        white,
                        sigma,
                        radius,
                        angle,
                        diameter,
                        point,
                        cov,
                        gate,
                    )
                    if size > 2:
                        error = solve_members(members, trust, origin, direction, white, point, cov)
                        diameter = _judge(members, trust, point, origin, sigma, radius, angle, typical)
                        error = solve_members(members, trust, origin, direction, white, point, cov)
                    while size > 2 and not 0.0 <= error <= _limit(2 * size - 3, outlier):
                        # a bad ray pulls the point towards itself: judge each by what is left without it
                        least, at = np.inf, -1
                        for c in range(cameras):
                            if members[c] >= 0:
                                held = members[c]
                                members[c] = -1
                                rest = solve_members(members, trust, origin, direction, white, point, cov)
                                members[c] = held
                                if 0.0 <= rest < least:
                                    least, at = rest, c
                        if at < 0:
                            break
                        members[at] = -1
                        size -= 1
                        error = solve_members(members, trust, origin, direction, white, point, cov)
                    # a pair that remains must still meet, with both images at least half there
                    if size == 2 and (
                        error > gate * gate or (judge and _half_hidden(members, point, origin, angle, whole))
                    ):
                        continue
                    if error < 0.0 or not _inside(point, low, high):
                        continue
                    if count == room:
                        room *= 2
                        xyz, covariance = _grow(xyz, room), _grow3(covariance, room)
                        chi2, groups = _grow1(chi2, room), _grow_int(groups, room)
                        diameters, trusts = _grow1(diameters, room), _grow(trusts, room)
                    xyz[count], covariance[count], chi2[count], groups[count] = point, cov, error, members
                    diameters[count], trusts[count] = diameter, trust
                    count += 1
                    if size > 2:
                        for c in range(cameras):
                            if members[c] >= 0:
                                for d in range(cameras):
                                    if members[d] >= 0:
                                        partner[members[c], d] = members[d]
    return xyz[:count], covariance[:count], chi2[:count], groups[:count], trusts[:count], diameters[:count]


@njit(nogil=True, cache=True)
def _judge(members, trust, point, origin, sigma, radius, angle, typical):  # type: ignore[no-untyped-def]
    """Set each member's trust from the size of its image; returns the target's diameter from its largest image."""
    largest = 0.0
    for c in range(members.shape[0]):
        if members[c] >= 0:
            largest = max(largest, angle[members[c]] * _distance(point, origin[c]))
    whole = typical if typical > 0.0 else largest
    for c in range(members.shape[0]):
        if members[c] >= 0:
            size = angle[members[c]] * _distance(point, origin[c])
            trust[c] = _trust(size, whole, sigma[members[c]], radius[members[c]])
    return largest


@njit(nogil=True, cache=True)
def _trust(size, whole, sigma, radius):  # type: ignore[no-untyped-def]
    """Factor on a ray's whitened error when its image has ``size`` where ``whole`` would be right.

    Too small: partly hidden. Too large: merged with a neighbour, whose share of the light moves the centroid.
    """
    share = (size / whole) ** 2
    odd = min(MOST_ODD, 1.0 - share if share < 1.0 else share - 1.0)
    if odd <= SIZE_DEADBAND:
        return 1.0
    # the centroid's shift for the whole disc's radius, spread over both axes
    shift = ODD_SHIFT * odd * radius * whole / size
    return 1.0 / np.sqrt(1.0 + 0.5 * (shift / sigma) ** 2)


@njit(nogil=True, cache=True)
def _half_hidden(members, point, origin, angle, whole):  # type: ignore[no-untyped-def]
    """Whether a member's image is so small that more than half of the target must be hidden."""
    for c in range(members.shape[0]):
        if members[c] >= 0:
            size = angle[members[c]] * _distance(point, origin[c])
            if 1.0 - (size / whole) ** 2 > HALF_HIDDEN:
                return True
    return False


@njit(nogil=True, cache=True)
def _distance(point, place):  # type: ignore[no-untyped-def]
    x, y, z = point[0] - place[0], point[1] - place[1], point[2] - place[2]
    return np.sqrt(x * x + y * y + z * z)


@njit(nogil=True, cache=True)
def _limit(freedom, sigma):  # type: ignore[no-untyped-def]
    """Chi-square bound of ``sigma`` standard deviations (Wilson and Hilferty's cube)."""
    q = 2.0 / (9.0 * freedom)
    return freedom * (1.0 - q + sigma * np.sqrt(q)) ** 3


@njit(nogil=True, cache=True)
def _inside(point, low, high):  # type: ignore[no-untyped-def]
    return low[0] <= point[0] <= high[0] and low[1] <= point[1] <= high[1] and low[2] <= point[2] <= high[2]


@njit(nogil=True, cache=True)
def solve_members(members, trust, origin, direction, white, point, cov):  # type: ignore[no-untyped-def]
    """Intersect the rays that ``members`` (c,) names for each camera (-1: none); see ``solve_point``."""
    cameras = members.shape[0]
    chosen, owner = np.empty(cameras, dtype=np.int64), np.empty(cameras, dtype=np.int64)
    trusted = np.empty(cameras)
    n = 0
    for c in range(cameras):
        if members[c] >= 0:
            chosen[n], owner[n], trusted[n] = members[c], c, trust[c]
            n += 1
    return solve_point(chosen[:n], owner[:n], trusted[:n], origin, direction, white, point, cov)


@njit(nogil=True, cache=True)
def _widen(  # type: ignore[no-untyped-def]
    members, trust, a, b, origin, start, direction, white, sigma, radius, angle, whole, point, cov, gate
):
    """Add the nearest ray of every other camera that the pair's point and its covariance admit."""
    size = 2
    for c in range(origin.shape[0]):
        if c in (a, b):
            continue
        x, y, z = point[0] - origin[c, 0], point[1] - origin[c, 1], point[2] - origin[c, 2]
        distance = np.sqrt(x * x + y * y + z * z)
        best, at, trusted = gate * gate, -1, 1.0
        for k in range(start[c], start[c + 1]):
            d = direction[k]
            depth = d[0] * x + d[1] * y + d[2] * z
            # a thousandth of a radian squared: far beyond any gate
            if depth < 0.9995 * distance:
                continue
            t = _trust(angle[k] * distance, whole, sigma[k], radius[k])
            w = white[k]
            u = t * (w[0, 0] * x + w[0, 1] * y + w[0, 2] * z) / depth
            v = t * (w[1, 0] * x + w[1, 1] * y + w[1, 2] * z) / depth
            s00, s01, s11 = 1.0, 0.0, 1.0
            for p in range(3):
                for q in range(3):
                    f = t * t * cov[p, q] / (depth * depth)
                    s00 += w[0, p] * w[0, q] * f
                    s01 += w[0, p] * w[1, q] * f
                    s11 += w[1, p] * w[1, q] * f
            error = (s11 * u * u - 2.0 * s01 * u * v + s00 * v * v) / (s00 * s11 - s01 * s01)
            # among those admitted the nearest in the image decides, not the least trusted
            if error < gate * gate and error / (t * t) < best / (trusted * trusted):
                best, at, trusted = error, k, t
        if at >= 0:
            members[c], trust[c] = at, trusted
            size += 1
    return size


@njit(nogil=True, cache=True)
def _grow(values, room):  # type: ignore[no-untyped-def]
    larger = np.empty((room, values.shape[1]))
    larger[: values.shape[0]] = values
    return larger


@njit(nogil=True, cache=True)
def _grow3(values, room):  # type: ignore[no-untyped-def]
    larger = np.empty((room, 3, 3))
    larger[: values.shape[0]] = values
    return larger


@njit(nogil=True, cache=True)
def _grow1(values, room):  # type: ignore[no-untyped-def]
    larger = np.empty(room)
    larger[: values.shape[0]] = values
    return larger


@njit(nogil=True, cache=True)
def _grow_int(values, room):  # type: ignore[no-untyped-def]
    larger = np.empty((room, values.shape[1]), dtype=np.int64)
    larger[: values.shape[0]] = values
    return larger
