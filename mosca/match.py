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
    the bundle that each camera contributes, or -1.
    """

    xyz: Array
    covariance: Array
    chi2: Array
    rays: Array

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


def hypotheses(bundle: Bundle, settings: MatchSettings, volume: tuple[Array, Array]) -> Hypotheses:
    """Return every group of rays from at least two cameras that meet within ``volume`` (low (3,), high (3,)) [m]."""
    xyz, covariance, chi2, rays = _search(
        bundle.origin, bundle.start, bundle.direction, bundle.white, bundle.spread,
        settings.gate_sigma, settings.outlier_sigma, np.asarray(volume[0], dtype=float),
        np.asarray(volume[1], dtype=float),
    )  # fmt: skip
    keep = (rays >= 0).sum(axis=1) >= settings.minimum_cameras
    return Hypotheses(xyz[keep], covariance[keep], chi2[keep], rays[keep])


def choose(found: Hypotheses, bundle: Bundle, predicted: Predicted, settings: MatchSettings) -> Points:
    """Return groups that share no ray, best first.

    Order: number of cameras, a track's support counting as half a camera, then the error. A pair without
    support is taken only where no other pair without support wants one of its rays: two cameras
    cannot tell, time will.
    """
    if len(found) == 0:
        c = len(bundle.origin)
        return Points(np.empty((0, 3)), np.empty((0, 3, 3)), np.empty(0), np.empty(0), np.empty((0, c)))
    count = (found.rays >= 0).sum(axis=1)
    supported = _supported(found, predicted, settings.support_sigma)
    freedom = 2 * count - 3
    order = np.lexsort((found.chi2 / freedom, -(count + 0.5 * supported)))
    lonely = (count == 2) & ~supported
    chosen = _disjoint(found.rays[order], lonely[order], len(bundle.direction))
    rows = order[chosen]
    rays = np.where(found.rays[rows] >= 0, found.rays[rows] - bundle.start[:-1], -1)
    sigma = np.where(found.rays >= 0, bundle.sigma_px[found.rays], 0.0)[rows]
    scale = np.sqrt((sigma**2).sum(axis=1) / count[rows])
    residual = scale * np.sqrt(found.chi2[rows] / (2 * count[rows]))
    return Points(found.xyz[rows], found.covariance[rows], count[rows], residual, rays)


def _supported(found: Hypotheses, predicted: Predicted, gate: float) -> Array:
    """Return which hypotheses lie within ``gate`` standard deviations of a prediction (n,)."""
    result = np.zeros(len(found), dtype=bool)
    if len(predicted.xyz) == 0:
        return result
    near = min(4, len(predicted.xyz))
    _, index = cKDTree(predicted.xyz).query(found.xyz, k=near)
    for neighbour in np.atleast_2d(index.T if near > 1 else index[None]):
        offset = found.xyz - predicted.xyz[neighbour]
        total = found.covariance + predicted.covariance[neighbour]
        distance2 = np.einsum("ni,ni->n", offset, np.linalg.solve(total, offset[:, :, None])[:, :, 0])
        result |= distance2 < gate**2
    return result


@njit(nogil=True, cache=True)
def _disjoint(rays, lonely, total):  # type: ignore[no-untyped-def]
    """Take rows in order as long as their rays are free; lonely pairs must be wanted by nobody else."""
    used = np.zeros(total, dtype=np.bool_)
    taken = np.zeros(rays.shape[0], dtype=np.bool_)
    for n in range(rays.shape[0]):
        if lonely[n]:
            continue
        free = True
        for c in range(rays.shape[1]):
            if rays[n, c] >= 0 and used[rays[n, c]]:
                free = False
        if free:
            taken[n] = True
            for c in range(rays.shape[1]):
                if rays[n, c] >= 0:
                    used[rays[n, c]] = True
    wanted = np.zeros(total, dtype=np.int64)
    for n in range(rays.shape[0]):
        if lonely[n]:
            free = True
            for c in range(rays.shape[1]):
                if rays[n, c] >= 0 and used[rays[n, c]]:
                    free = False
            if free:
                taken[n] = True
                for c in range(rays.shape[1]):
                    if rays[n, c] >= 0:
                        wanted[rays[n, c]] += 1
    for n in range(rays.shape[0]):
        if lonely[n] and taken[n]:
            for c in range(rays.shape[1]):
                if rays[n, c] >= 0 and wanted[rays[n, c]] > 1:
                    taken[n] = False
    return taken


@njit(nogil=True, cache=True)
def _search(origin, start, direction, white, spread, gate, outlier, low, high):  # type: ignore[no-untyped-def]
    """All pairs of cameras, all pairs of rays on each other's epipolar lines, widened to the other cameras."""
    cameras, total = origin.shape[0], direction.shape[0]
    reach = np.empty(total)
    for i in range(total):
        s = 0.0
        for a in range(3):
            s += spread[i, a, 0] ** 2 + spread[i, a, 1] ** 2
        reach[i] = s
    owner = np.empty(total, dtype=np.int64)
    for c in range(cameras):
        owner[start[c] : start[c + 1]] = c
    room = 64
    xyz, covariance = np.empty((room, 3)), np.empty((room, 3, 3))
    chi2, groups = np.empty(room), np.empty((room, cameras), dtype=np.int64)
    count = 0
    # partner[i, c]: the ray of camera c that a group of three or more has already joined with ray i
    partner = np.full((total, cameras), -1, dtype=np.int64)
    point, cov = np.empty(3), np.empty((3, 3))
    members = np.empty(cameras, dtype=np.int64)
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
                    if e * e > gate * gate * base2 * (reach[i] + reach[j]):
                        continue
                    if partner[i, b] == j:
                        continue
                    # the same product seen from the other side: e = d_i . (d_j x t)
                    dx, dy, dz = direction[j, 0], direction[j, 1], direction[j, 2]
                    mx, my, mz = dy * tz - dz * ty, dz * tx - dx * tz, dx * ty - dy * tx
                    variance = 0.0
                    for k in range(2):
                        variance += (nx * spread[j, 0, k] + ny * spread[j, 1, k] + nz * spread[j, 2, k]) ** 2
                        variance += (mx * spread[i, 0, k] + my * spread[i, 1, k] + mz * spread[i, 2, k]) ** 2
                    if e * e > gate * gate * variance:
                        continue
                    members[:] = -1
                    members[a], members[b] = i, j
                    error = _solve(members, origin, direction, white, point, cov)
                    if error < 0.0 or error > gate * gate or not _inside(point, low, high):
                        continue
                    size = _widen(members, a, b, origin, start, direction, white, point, cov, gate)
                    error = _solve(members, origin, direction, white, point, cov)
                    while size > 2 and not 0.0 <= error <= _limit(2 * size - 3, outlier):
                        # a bad ray pulls the point towards itself: judge each by what is left without it
                        least, at = np.inf, -1
                        for c in range(cameras):
                            if members[c] >= 0:
                                held = members[c]
                                members[c] = -1
                                rest = _solve(members, origin, direction, white, point, cov)
                                members[c] = held
                                if 0.0 <= rest < least:
                                    least, at = rest, c
                        if at < 0:
                            break
                        members[at] = -1
                        size -= 1
                        error = _solve(members, origin, direction, white, point, cov)
                    # a pair that remains must still meet
                    if size == 2 and error > gate * gate:
                        continue
                    if error < 0.0 or not _inside(point, low, high):
                        continue
                    if count == room:
                        room *= 2
                        xyz, covariance = _grow(xyz, room), _grow3(covariance, room)
                        chi2, groups = _grow1(chi2, room), _grow_int(groups, room)
                    xyz[count], covariance[count], chi2[count], groups[count] = point, cov, error, members
                    count += 1
                    if size > 2:
                        for c in range(cameras):
                            if members[c] >= 0:
                                for d in range(cameras):
                                    if members[d] >= 0:
                                        partner[members[c], d] = members[d]
    return xyz[:count], covariance[:count], chi2[:count], groups[:count]


@njit(nogil=True, cache=True)
def _limit(freedom, sigma):  # type: ignore[no-untyped-def]
    """Chi-square bound of ``sigma`` standard deviations (Wilson and Hilferty's cube)."""
    q = 2.0 / (9.0 * freedom)
    return freedom * (1.0 - q + sigma * np.sqrt(q)) ** 3


@njit(nogil=True, cache=True)
def _inside(point, low, high):  # type: ignore[no-untyped-def]
    return low[0] <= point[0] <= high[0] and low[1] <= point[1] <= high[1] and low[2] <= point[2] <= high[2]


@njit(nogil=True, cache=True)
def _solve(members, origin, direction, white, point, cov):  # type: ignore[no-untyped-def]
    cameras = members.shape[0]
    chosen, owner = np.empty(cameras, dtype=np.int64), np.empty(cameras, dtype=np.int64)
    n = 0
    for c in range(cameras):
        if members[c] >= 0:
            chosen[n], owner[n] = members[c], c
            n += 1
    return solve_point(chosen[:n], owner[:n], origin, direction, white, point, cov)


@njit(nogil=True, cache=True)
def _widen(members, a, b, origin, start, direction, white, point, cov, gate):  # type: ignore[no-untyped-def]
    """Add the nearest ray of every other camera that the pair's point and its covariance admit."""
    size = 2
    for c in range(origin.shape[0]):
        if c in (a, b):
            continue
        x, y, z = point[0] - origin[c, 0], point[1] - origin[c, 1], point[2] - origin[c, 2]
        distance = np.sqrt(x * x + y * y + z * z)
        best, at = gate * gate, -1
        for k in range(start[c], start[c + 1]):
            d = direction[k]
            depth = d[0] * x + d[1] * y + d[2] * z
            # a thousandth of a radian squared: far beyond any gate
            if depth < 0.9995 * distance:
                continue
            w = white[k]
            u = (w[0, 0] * x + w[0, 1] * y + w[0, 2] * z) / depth
            v = (w[1, 0] * x + w[1, 1] * y + w[1, 2] * z) / depth
            s00, s01, s11 = 1.0, 0.0, 1.0
            for p in range(3):
                for q in range(3):
                    f = cov[p, q] / (depth * depth)
                    s00 += w[0, p] * w[0, q] * f
                    s01 += w[0, p] * w[1, q] * f
                    s11 += w[1, p] * w[1, q] * f
            error = (s11 * u * u - 2.0 * s01 * u * v + s00 * v * v) / (s00 * s11 - s01 * s01)
            if error < best:
                best, at = error, k
        if at >= 0:
            members[c] = at
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
