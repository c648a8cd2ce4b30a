"""Which images in different cameras are the same target: epipolar geometry over any number of cameras.

Mosca paper, section 3.2: the ray of a target in one camera appears as an epipolar line in another; targets
on that line are candidates, and further cameras decide where the lines meet. "On the line" is judged by the
covariances of both detections, never by a fixed number of pixels.

``hypotheses`` lists every consistent group (a group for each candidate pair, widened to all cameras
that agree); ``choose`` takes a set of them in which no detection serves twice, larger and better groups first,
and lets the tracks' predictions decide what two cameras alone leave open.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.spatial import cKDTree

from mosca.data.arrays import Array
from mosca.data.tracks import Points
from mosca.triangulate import Bundle, solve_point


MOST_HIDDEN = 0.7
HIDDEN_SHIFT = 0.9
"""Shift of a disc's centroid over (hidden share x radius): 0.85 at one half hidden, 1 at little (circle's chord)."""
SIZE_DEADBAND = 0.1
"""Hidden shares below this are noise of the measured sizes."""
SUPPORT_BONUS = 14.0
RAY_BONUS = 12.0
"""In units of half a chi-square: what a track's support and a further ray are worth when groups compete."""


@dataclass(frozen=True)
class MatchSettings:
    """``gate_sigma``: how many standard deviations a ray may pass beside the point. ``camera_sigma_px``: random
    error of image points besides detection noise (body, trigger, lens model), an axis. ``minimum_cameras``: smallest
    group. ``support_sigma``: how near a track's prediction supports a group. ``outlier_sigma``: a group of three
    and more loses its worst ray beyond this.
    """

    gate_sigma: float = 4.5
    camera_sigma_px: float = 0.06
    minimum_cameras: int = 2
    support_sigma: float = 4.0
    outlier_sigma: float = 4.0


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """Groups of rays that may be one target; they may share rays.

    ``xyz`` (n, 3), ``covariance`` (n, 3, 3), ``chi2`` (n,) sum of squared whitened errors, ``rays`` (n, c) row of
    the bundle that each camera contributes, or -1; ``diameter_m`` (n,) of the target from its largest image.
    """

    xyz: Array
    covariance: Array
    chi2: Array
    rays: Array
    diameter_m: Array

    def __len__(self) -> int:
        return len(self.xyz)


@dataclass(frozen=True, eq=False)
class Predicted:
    """Where the tracks expect their targets: ``xyz`` (k, 3), ``covariance`` (k, 3, 3)."""

    xyz: Array
    covariance: Array

    @classmethod
    def nothing(cls) -> "Predicted":
        """No expectation: every frame on its own."""
        return cls(np.empty((0, 3)), np.empty((0, 3, 3)))


def hypotheses(
    bundle: Bundle, settings: MatchSettings, volume: tuple[Array, Array], typical_diameter_m: float = 0.0
) -> Hypotheses:
    """Return every group of rays from at least two cameras that meet within ``volume`` (low (3,), high (3,)) [m].

    ``typical_diameter_m``: of the targets, as far as it is known (0: compare the images of a group alone). An
    image too small for it is a target partly hidden, one too large is merged with another; the centroid is
    shifted by up to ``0.9 x share of the area x radius``: the ray counts for less and is searched for farther away.
    """
    xyz, covariance, chi2, rays, diameter = _search(
        bundle.origin, bundle.start, bundle.direction, bundle.white, bundle.spread, bundle.sigma_px,
        bundle.radius_px, bundle.angle, settings.gate_sigma, settings.outlier_sigma,
        np.asarray(volume[0], dtype=float), np.asarray(volume[1], dtype=float), typical_diameter_m,
    )  # fmt: skip
    keep = (rays >= 0).sum(axis=1) >= settings.minimum_cameras
    return Hypotheses(xyz[keep], covariance[keep], chi2[keep], rays[keep], diameter[keep])


def choose(found: Hypotheses, bundle: Bundle, predicted: Predicted, settings: MatchSettings) -> Points:
    """Return groups that share no ray, best first.

    A group's worth: so much a ray, so much for a track that expects it there (each track speaks for one group),
    less its squared errors. A pair without support is taken only where no other such pair wants one of its
    rays: two cameras cannot tell, time will.
    """
    if len(found) == 0:
        c, none = len(bundle.origin), np.empty(0)
        return Points(np.empty((0, 3)), np.empty((0, 3, 3)), none, none, np.empty((0, c)), none)
    count = (found.rays >= 0).sum(axis=1)
    track, distance2 = _support(found, predicted, settings.support_sigma)
    worth = RAY_BONUS * count - 0.5 * found.chi2
    worth += np.where(track >= 0, SUPPORT_BONUS - 0.5 * distance2, 0.0)
    order = np.argsort(-worth, kind="stable")
    taken = _disjoint(
        found.rays[order], track[order], count[order], len(bundle.direction), len(predicted.xyz)
    )
    rows = order[taken]
    rays = np.where(found.rays[rows] >= 0, found.rays[rows] - bundle.start[:-1], -1)
    sigma = np.where(found.rays >= 0, bundle.sigma_px[found.rays], 0.0)[rows]
    scale = np.sqrt((sigma**2).sum(axis=1) / count[rows])
    residual = scale * np.sqrt(found.chi2[rows] / (2 * count[rows]))
    return Points(
        found.xyz[rows], found.covariance[rows], count[rows], residual, rays, found.diameter_m[rows]
    )


def _support(found: Hypotheses, predicted: Predicted, gate: float) -> tuple[Array, Array]:
    """Return for each hypothesis the prediction that supports it best (n,), or -1, and its squared distance (n,)."""
    track = np.full(len(found), -1)
    best = np.full(len(found), gate**2)
    if len(predicted.xyz) == 0:
        return track, best
    near = min(4, len(predicted.xyz))
    _, index = cKDTree(predicted.xyz).query(found.xyz, k=[*range(1, near + 1)])
    for neighbour in index.T:
        offset = found.xyz - predicted.xyz[neighbour]
        total = found.covariance + predicted.covariance[neighbour]
        distance2 = np.einsum("ni,ni->n", offset, np.linalg.solve(total, offset[:, :, None])[:, :, 0])
        nearer = distance2 < best
        track[nearer], best[nearer] = neighbour[nearer], distance2[nearer]
    return track, best


@njit(nogil=True, cache=True)
def _disjoint(rays, track, count, total, tracks):  # type: ignore[no-untyped-def]
    """Take rows in order as long as their rays, and the tracks that speak for them, are free."""
    used = np.zeros(total, dtype=np.bool_)
    spoken = np.zeros(tracks, dtype=np.bool_)
    taken = np.zeros(rays.shape[0], dtype=np.bool_)
    for n in range(rays.shape[0]):
        alone = track[n] < 0 or spoken[track[n]]
        if (alone and count[n] == 2) or not _free(rays[n], used):
            continue
        taken[n] = True
        if track[n] >= 0:
            spoken[track[n]] = True
        for c in range(rays.shape[1]):
            if rays[n, c] >= 0:
                used[rays[n, c]] = True
    wanted = np.zeros(total, dtype=np.int64)
    for n in range(rays.shape[0]):
        if count[n] == 2 and not taken[n] and _free(rays[n], used):
            for c in range(rays.shape[1]):
                if rays[n, c] >= 0:
                    wanted[rays[n, c]] += 1
    for n in range(rays.shape[0]):
        if count[n] == 2 and not taken[n] and _free(rays[n], used):
            alone = True
            for c in range(rays.shape[1]):
                if rays[n, c] >= 0 and wanted[rays[n, c]] > 1:
                    alone = False
            taken[n] = alone
    return taken


@njit(nogil=True, cache=True)
def _free(members, used):  # type: ignore[no-untyped-def]
    for c in range(members.shape[0]):
        if members[c] >= 0 and used[members[c]]:
            return False
    return True


@njit(nogil=True, cache=True)
def _search(origin, start, direction, white, spread, sigma, radius, angle, gate, outlier, low, high, typical):  # type: ignore[no-untyped-def]
    """All pairs of cameras, all pairs of rays on each other's epipolar lines, widened to the other cameras."""
    cameras, total = origin.shape[0], direction.shape[0]
    # a ray's direction error, one standard deviation, if its target were mostly hidden
    reach, slack = np.empty(total), np.empty(total)
    for i in range(total):
        slack[i] = 1.0 + 0.5 * (HIDDEN_SHIFT * MOST_HIDDEN * radius[i] / sigma[i]) ** 2
        s = 0.0
        for a in range(3):
            s += spread[i, a, 0] ** 2 + spread[i, a, 1] ** 2
        reach[i] = s * slack[i]
    room = 64
    xyz, covariance = np.empty((room, 3)), np.empty((room, 3, 3))
    chi2, groups, diameters = np.empty(room), np.empty((room, cameras), dtype=np.int64), np.empty(room)
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
                    if _solve(members, trust, origin, direction, white, point, cov) < 0.0:
                        continue
                    diameter = _judge(members, trust, point, origin, sigma, radius, angle, typical)
                    whole = typical if typical > 0.0 else diameter
                    error = _solve(members, trust, origin, direction, white, point, cov)
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
                        error = _solve(members, trust, origin, direction, white, point, cov)
                        diameter = _judge(members, trust, point, origin, sigma, radius, angle, typical)
                        error = _solve(members, trust, origin, direction, white, point, cov)
                    while size > 2 and not 0.0 <= error <= _limit(2 * size - 3, outlier):
                        # a bad ray pulls the point towards itself: judge each by what is left without it
                        least, at = np.inf, -1
                        for c in range(cameras):
                            if members[c] >= 0:
                                held = members[c]
                                members[c] = -1
                                rest = _solve(members, trust, origin, direction, white, point, cov)
                                members[c] = held
                                if 0.0 <= rest < least:
                                    least, at = rest, c
                        if at < 0:
                            break
                        members[at] = -1
                        size -= 1
                        error = _solve(members, trust, origin, direction, white, point, cov)
                    # a pair that remains must still meet
                    if size == 2 and error > gate * gate:
                        continue
                    if error < 0.0 or not _inside(point, low, high):
                        continue
                    if count == room:
                        room *= 2
                        xyz, covariance = _grow(xyz, room), _grow3(covariance, room)
                        chi2, groups = _grow1(chi2, room), _grow_int(groups, room)
                        diameters = _grow1(diameters, room)
                    xyz[count], covariance[count], chi2[count], groups[count] = point, cov, error, members
                    diameters[count] = diameter
                    count += 1
                    if size > 2:
                        for c in range(cameras):
                            if members[c] >= 0:
                                for d in range(cameras):
                                    if members[d] >= 0:
                                        partner[members[c], d] = members[d]
    return xyz[:count], covariance[:count], chi2[:count], groups[:count], diameters[:count]


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
    odd = min(MOST_HIDDEN, 1.0 - share if share < 1.0 else share - 1.0)
    if odd <= SIZE_DEADBAND:
        return 1.0
    # the centroid's shift for the whole disc's radius, spread over both axes
    shift = HIDDEN_SHIFT * odd * radius * whole / size
    return 1.0 / np.sqrt(1.0 + 0.5 * (shift / sigma) ** 2)


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
def _solve(members, trust, origin, direction, white, point, cov):  # type: ignore[no-untyped-def]
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
def _widen(
    members, trust, a, b, origin, start, direction, white, sigma, radius, angle, whole, point, cov, gate
):  # type: ignore[no-untyped-def]
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
