"""Sums over the residuals of a frame set, camera by camera, for ``mosca.diagnostics``: compiled.

Each point first moves to its best position. The sums are derived in ``mosca.diagnostics.noise_model`` and
``camera_health``.
"""

from typing import NamedTuple

import numpy as np

from mosca.data.arrays import Array
from mosca.data.rays import ANGLE, DIRECTION, ORIGIN, RADIUS, WHITE
from mosca.numba_support.decorators import bare_step, kernel
from mosca.numba_support.linalg3 import Symmetric3, cofactors3, determinant3, divided3, store3, times3

MOST_DOUBT = 0.01
"""Largest difference between the number of a point's cameras and that of those which count in full, for the cameras'
errors to be learned from it: of partly hidden images only the noise is known. For a walker (seeds 5 and 3), cameras
that err by 0.031 to 0.035 px came out at 0.029 to 0.053 with 0.5, nees 1.85 and 2.54; now at 0.029 to 0.037, nees
3.01 and 3.46."""
FARTHEST_SIGMAS = 5.0
"""Points with an image farther than this from its prediction do not count for the usual error."""
LEAST_LEFT = 0.05
"""Least share of its error that an image keeps after its point is fitted, for it to count."""
SINGULAR = 1e-9
"""Normal matrices whose smallest eigenvalue over the largest is below this (within a factor of 9) are singular."""
REST, FLOW, SLOPE, WEIGHT, OWN, TABLE = 0, 2, 4, 10, 13, 16
"""Columns of an image: residual and speed (2 each), its Jacobian by the point (2 x 3), weight and own covariance
(each xx, xy, yy)."""


class RayColumns(NamedTuple):
    """The columns of a ``mosca.data.rays.RayTable`` of c cameras."""

    rays: Array
    views: Array
    start: Array
    covariance: Array
    extra_px2: Array


class PointColumns(NamedTuple):
    """The n points made from these rays, and the points of the frame set before."""

    members: Array
    """(n, c) each camera's ray of the point, -1 for none."""
    xyz: Array
    """(n, 3)"""
    cameras: Array
    """(n,)"""
    trusted: Array
    """(n,)"""
    before: Array
    """(m, 3) points of the frame set before."""
    elapsed_s: float
    """Time since then."""


class ImageErrors(NamedTuple):
    """Error of image points besides detection noise, as known so far."""

    sigma_px2: Array
    """(c,)"""
    jitter_s: float


class Sampling(NamedTuple):
    """Which points are used, and how far to search."""

    first: int
    every: int
    """Every so many points from ``first`` on."""
    farthest_m: float
    """A point's speed is measured from the nearest point before, if it is nearer than this and both are nearest to
    each other."""
    adopt_px: float
    """How far beside a point an unused ray may lie to be its image, where clocks are estimated."""


class ResidualSums(NamedTuple):
    """Sums over the points of one frame set of c cameras."""

    whole: int
    """Points with images in enough cameras that count in full."""
    usual: int
    """Those of them without an outlier; the next four are sums over these."""
    normal: Array
    """(c + 1, c + 1) normal matrix for the variances of each camera and the triggers."""
    right: Array
    """(c + 1,)"""
    square: Array
    """(c,) squared residuals [px^2]."""
    images: Array
    """(c,)"""
    pull: Array
    """(c,) right side of the normal equations for each camera's delay, over all points."""
    clock: Array
    """(c, c) normal matrix of the delays."""
    timed: Array
    """(c,) number of images in these sums."""


class _Fit(NamedTuple):
    """Working memory: the images of one point after it was adjusted."""

    seen: Array
    """(c,) which cameras have an image."""
    table: Array
    """(c, TABLE)"""
    inverse: Array
    """(3, 3) covariance of the point."""
    toward: Array
    """(c, 3) scratch."""


@kernel
def residual_sums(rays, points, errors, sampling):
    """Return the ``ResidualSums`` of the sampled points that have a speed."""
    n, c = points.members.shape
    sums = ResidualSums(
        0, 0, np.zeros((c + 1, c + 1)), np.zeros(c + 1), np.zeros(c), np.zeros(c), np.zeros(c), np.zeros((c, c)),
        np.zeros(c),
    )  # fmt: skip
    fit = _Fit(np.zeros(c, np.bool_), np.empty((c, TABLE)), np.empty((3, 3)), np.empty((c, 3)))
    which, speed = np.empty(c, np.int64), np.empty(3)
    taken = np.zeros(rays.rays.shape[0], np.bool_)
    for i in range(n):
        for k in range(c):
            if points.members[i, k] >= 0:
                taken[rays.start[k] + points.members[i, k]] = True
    whole = usual = 0
    for i in range(sampling.first, n, sampling.every):
        if not (points.elapsed_s > 0.0 and points.cameras[i] >= 2 and _speed(i, points, sampling.farthest_m, speed)):
            continue
        for k in range(c):
            which[k] = rays.start[k] + points.members[i, k] if points.members[i, k] >= 0 else -1
        fitted = _adjusted(which, points.xyz[i], speed, rays, errors, fit)
        if points.cameras[i] >= min(3, c) and points.trusted[i] >= points.cameras[i] - MOST_DOUBT:
            whole += 1
            if fitted and _is_usual(fit):
                usual += 1
                _add_noise(fit, errors, sums)
        # images of a late camera are not among those of the points: search for them nearby
        if points.cameras[i] < c and _adopt(which, points.xyz[i], rays, taken, sampling.adopt_px):
            fitted = _adjusted(which, points.xyz[i], speed, rays, errors, fit)
        if fitted:
            _add_clocks(fit, sums)
    return ResidualSums(
        whole, usual, sums.normal, sums.right, sums.square, sums.images, sums.pull, sums.clock, sums.timed
    )


@bare_step
def _speed(i, points, farthest_m, speed):
    """Fill the speed (3,) of point i since the set before; False where none is known."""
    there = _nearest(points.xyz[i], points.before, farthest_m)
    if there < 0 or _nearest(points.before[there], points.xyz, np.inf) != i:
        return False
    for p in range(3):
        speed[p] = (points.xyz[i, p] - points.before[there, p]) / max(points.elapsed_s, 1e-9)
    return True


@bare_step
def _nearest(point, others, within):
    """Return which of the others (m, 3) lies nearest to a point, -1 where none lies nearer than ``within``."""
    nearest, at = within * within, -1
    x, y, z = point[0], point[1], point[2]
    for j in range(others.shape[0]):
        away = (others[j, 0] - x) ** 2 + (others[j, 1] - y) ** 2 + (others[j, 2] - z) ** 2
        if away < nearest:
            nearest, at = away, j
    return at


@bare_step
def _adjusted(which, point, speed, rays, errors, fit):
    """Fill ``fit`` with the images ``which`` (c,) of a point after it has moved to its best position.

    A ray gives the residual of its image to first order, as in triangulation: no point needs to be projected. Returns
    False where the images do not determine the point.
    """
    n00 = n01 = n02 = n11 = n12 = n22 = b0 = b1 = b2 = 0.0
    count = 0
    for c in range(which.shape[0]):
        fit.seen[c] = which[c] >= 0 and _image(fit.table[c], c, which[c], point, speed, rays, errors)
        if not fit.seen[c]:
            continue
        count += 1
        own = fit.table[c]
        u0, u1, u2 = _weighted(own, 0)
        v0, v1, v2 = _weighted(own, 1)
        n00 += u0 * own[SLOPE] + v0 * own[SLOPE + 3]
        n01 += u0 * own[SLOPE + 1] + v0 * own[SLOPE + 4]
        n02 += u0 * own[SLOPE + 2] + v0 * own[SLOPE + 5]
        n11 += u1 * own[SLOPE + 1] + v1 * own[SLOPE + 4]
        n12 += u1 * own[SLOPE + 2] + v1 * own[SLOPE + 5]
        n22 += u2 * own[SLOPE + 2] + v2 * own[SLOPE + 5]
        b0 += u0 * own[REST] + v0 * own[REST + 1]
        b1 += u1 * own[REST] + v1 * own[REST + 1]
        b2 += u2 * own[REST] + v2 * own[REST + 1]
    normal = Symmetric3(n00, n01, n02, n11, n12, n22)
    cofactors = cofactors3(normal)
    det = determinant3(normal, cofactors)
    if count < 2 or not det > SINGULAR * (n00 + n11 + n22) * (cofactors.xx + cofactors.yy + cofactors.zz):
        return False
    store3(divided3(cofactors, det), fit.inverse)
    x, y, z = times3(cofactors, b0, b1, b2)
    x, y, z = x / det, y / det, z / det
    for c in range(which.shape[0]):
        if fit.seen[c]:
            own = fit.table[c]
            own[REST] -= own[SLOPE] * x + own[SLOPE + 1] * y + own[SLOPE + 2] * z
            own[REST + 1] -= own[SLOPE + 3] * x + own[SLOPE + 4] * y + own[SLOPE + 5] * z
    return True


@bare_step
def _image(own, c, k, point, speed, rays, errors):
    """Fill a row of the table with ray ``k`` of camera ``c``; False where the point lies behind the camera."""
    views, covariance = rays.views, rays.covariance
    x, y, z = point[0] - views[c, ORIGIN], point[1] - views[c, ORIGIN + 1], point[2] - views[c, ORIGIN + 2]
    ray = rays.rays[k]
    depth = ray[DIRECTION] * x + ray[DIRECTION + 1] * y + ray[DIRECTION + 2] * z
    if not depth > 0.0:
        return False
    own[OWN], own[OWN + 1], own[OWN + 2] = covariance[k, 0, 0], covariance[k, 0, 1], covariance[k, 1, 1]
    # the rays are whitened by their whole assumed covariance
    l00 = np.sqrt(own[OWN] + rays.extra_px2[c])
    l10 = own[OWN + 1] / l00
    l11 = np.sqrt(own[OWN + 2] + rays.extra_px2[c] - l10 * l10)
    for p in range(3):
        own[SLOPE + p] = l00 * ray[WHITE + p] / depth
        own[SLOPE + 3 + p] = (l10 * ray[WHITE + p] + l11 * ray[WHITE + 3 + p]) / depth
    for row in range(2):
        a, b, d = own[SLOPE + 3 * row], own[SLOPE + 3 * row + 1], own[SLOPE + 3 * row + 2]
        own[REST + row] = -(a * x + b * y + d * z)
        own[FLOW + row] = a * speed[0] + b * speed[1] + d * speed[2]
    jitter2 = errors.jitter_s * errors.jitter_s
    t00 = own[OWN] + errors.sigma_px2[c] + jitter2 * own[FLOW] ** 2
    t01 = own[OWN + 1] + jitter2 * own[FLOW] * own[FLOW + 1]
    t11 = own[OWN + 2] + errors.sigma_px2[c] + jitter2 * own[FLOW + 1] ** 2
    det = t00 * t11 - t01 * t01
    own[WEIGHT], own[WEIGHT + 1], own[WEIGHT + 2] = t11 / det, -t01 / det, t00 / det
    return True


@bare_step
def _weighted(own, row):
    """Return a column (3) of J'W: the effect on the point of a residual along one axis of the image."""
    v, w = own[WEIGHT + row], own[WEIGHT + 1 + row]
    return (
        own[SLOPE] * v + own[SLOPE + 3] * w,
        own[SLOPE + 1] * v + own[SLOPE + 4] * w,
        own[SLOPE + 2] * v + own[SLOPE + 5] * w,
    )


@bare_step
def _is_usual(fit):
    table = fit.table
    for c in range(fit.seen.shape[0]):
        if fit.seen[c]:
            x, y = table[c, REST], table[c, REST + 1]
            away2 = table[c, WEIGHT] * x * x + 2.0 * table[c, WEIGHT + 1] * x * y + table[c, WEIGHT + 2] * y * y
            if not away2 < FARTHEST_SIGMAS**2:
                return False
    return True


@bare_step
def _add_noise(fit, errors, sums):
    """Add a point's images to the regression of squared residuals on the variances of cameras and triggers."""
    last, normal, right = fit.seen.shape[0], sums.normal, sums.right
    for c in range(last):
        if not fit.seen[c]:
            continue
        own = fit.table[c]
        whole = own[OWN] + own[OWN + 2] + 2.0 * errors.sigma_px2[c]
        flow2 = own[FLOW] ** 2 + own[FLOW + 1] ** 2
        whole += errors.jitter_s * errors.jitter_s * flow2
        taken_up = 0.0
        for row in (SLOPE, SLOPE + 3):
            for p in range(3):
                for q in range(3):
                    taken_up += own[row + p] * fit.inverse[p, q] * own[row + q]
        left = 1.0 - taken_up / whole
        squared = own[REST] ** 2 + own[REST + 1] ** 2
        sums.square[c] += squared
        sums.images[c] += 1.0
        if not left > LEAST_LEFT:
            continue
        scale = 1.0 / (left * whole)
        per_px, per_speed = 2.0 * left * scale, left * flow2 * scale
        known = (squared - left * (own[OWN] + own[OWN + 2])) * scale
        normal[c, c] += per_px * per_px
        normal[c, last] += per_px * per_speed
        normal[last, c] += per_px * per_speed
        normal[last, last] += per_speed * per_speed
        right[c] += per_px * known
        right[last] += per_speed * known


@bare_step
def _add_clocks(fit, sums):
    """Add a point's residuals along its motion to the normal equations of the cameras' delays."""
    seen, inverse, toward = fit.seen, fit.inverse, fit.toward
    cameras, clock = seen.shape[0], sums.clock
    for c in range(cameras):
        if not seen[c]:
            continue
        own = fit.table[c]
        v = own[WEIGHT] * own[FLOW] + own[WEIGHT + 1] * own[FLOW + 1]
        w = own[WEIGHT + 1] * own[FLOW] + own[WEIGHT + 2] * own[FLOW + 1]
        for p in range(3):
            toward[c, p] = own[SLOPE + p] * v + own[SLOPE + 3 + p] * w
        sums.pull[c] += v * own[REST] + w * own[REST + 1]
        clock[c, c] += v * own[FLOW] + w * own[FLOW + 1]
        sums.timed[c] += 1.0
    for c in range(cameras):
        if not seen[c]:
            continue
        x = y = z = 0.0
        for p in range(3):
            x += toward[c, p] * inverse[p, 0]
            y += toward[c, p] * inverse[p, 1]
            z += toward[c, p] * inverse[p, 2]
        for d in range(cameras):
            if seen[d]:
                clock[c, d] -= x * toward[d, 0] + y * toward[d, 1] + z * toward[d, 2]


@bare_step
def _adopt(which, point, rays, taken, reach_px):
    """Give a point the nearest free ray within reach in each camera without its image; True where there was any."""
    adopted = False
    for c in range(which.shape[0]):
        if which[c] >= 0:
            continue
        x, y, z = (
            point[0] - rays.views[c, ORIGIN],
            point[1] - rays.views[c, ORIGIN + 1],
            point[2] - rays.views[c, ORIGIN + 2],
        )
        distance = np.sqrt(x * x + y * y + z * z)
        nearest = reach_px
        for k in range(rays.start[c], rays.start[c + 1]):
            if taken[k]:
                continue
            beside = np.sqrt(
                (x / distance - rays.rays[k, DIRECTION]) ** 2
                + (y / distance - rays.rays[k, DIRECTION + 1]) ** 2
                + (z / distance - rays.rays[k, DIRECTION + 2]) ** 2
            )
            beside_px = beside * (2.0 * rays.rays[k, RADIUS] / rays.rays[k, ANGLE])
            if beside_px <= nearest:
                nearest, which[c], adopted = beside_px, k, True
    return adopted
