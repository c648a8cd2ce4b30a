"""What the residuals of a frame set say, summed up camera by camera: compiled, for
``mosca.diagnostics.camera_health``.

The points looked at move to their best places first; the derivation of what is summed stands in
``mosca.diagnostics.camera_health``.
"""

import numpy as np

from mosca.data.rays import ANGLE, DIRECTION, ORIGIN, RADIUS, WHITE
from mosca.numba_support.decorators import bare_step, kernel

FARTHEST_SIGMAS = 5.0
"""Images farther from their point say nothing of the usual error."""
LEAST_LEFT = 0.05
"""Share of its error that an image must keep beside its point to tell of it."""


@kernel
def look(  # type: ignore[no-untyped-def]
    rays, views, start, covariance, extra_px2, members, xyz, cameras, trusted, before, elapsed_s, first, every,
    farthest_m, adopt_px, sigma_px2, jitter_s
):  # fmt: skip
    """Sum up the residuals of every ``every``-th point from ``first`` on that has a speed.

    ``rays``, ``views``, ``start``, ``covariance``, ``extra_px2``: a ``mosca.data.rays.RayTable``;
    ``members`` (n, c), ``xyz`` (n, 3), ``cameras`` (n,), ``trusted`` (n,): its points; ``before`` (m, 3): those of
    the set before, ``elapsed_s`` ago. A point's speed is that since the point nearest to it there, if that is
    nearer than ``farthest_m`` and has none nearer here. ``adopt_px``: how far a ray that no point has may lie
    beside one, to be its image where clocks are asked for. ``sigma_px2`` (c,), ``jitter_s``: what is known of the
    errors.

    Returns how many points were whole and how many of them fitted as usual; of the latter the normal matrix
    (c + 1, c + 1) and right side (c + 1,) for the variances, sums of squared residuals (c,) [px^2] and images (c,);
    of all points the pull (c,) on each camera's clock, the matrix (c, c) that it pulls against, and images (c,).
    """
    n, c = members.shape
    normal, right, square, images = np.zeros((c + 1, c + 1)), np.zeros(c + 1), np.zeros(c), np.zeros(c)
    pull, clock, timed = np.zeros(c), np.zeros((c, c)), np.zeros(c)
    # rest and flow (2), slope (2 x 3), weight and own covariance (3) of each camera's image
    seen, table, inverse = np.zeros(c, np.bool_), np.empty((c, TABLE)), np.empty((3, 3))
    which, speed, toward = np.empty(c, np.int64), np.empty(3), np.empty((c, 3))
    taken = np.zeros(rays.shape[0], np.bool_)
    for i in range(n):
        for k in range(c):
            if members[i, k] >= 0:
                taken[start[k] + members[i, k]] = True
    given = (rays, views, covariance, extra_px2, sigma_px2, jitter_s)
    whole = usual = 0
    for i in range(first, n, every):
        if not (elapsed_s > 0.0 and cameras[i] >= 2 and _speed(i, xyz, before, elapsed_s, farthest_m, speed)):
            continue
        for k in range(c):
            which[k] = start[k] + members[i, k] if members[i, k] >= 0 else -1
        fit = _fitted(which, xyz[i], speed, given, seen, table, inverse)
        if cameras[i] >= min(3, c) and trusted[i] >= cameras[i] - 0.5:
            whole += 1
            if fit and _is_usual(seen, table):
                usual += 1
                _add_noise(seen, table, inverse, sigma_px2, jitter_s, normal, right, square, images)
        # the images of a camera that is late are left out of the points: look for them beside their place
        if cameras[i] < c and _adopt(which, xyz[i], rays, views, start, taken, adopt_px):
            fit = _fitted(which, xyz[i], speed, given, seen, table, inverse)
        if fit:
            _add_clocks(seen, table, inverse, toward, pull, clock, timed)
    return whole, usual, normal, right, square, images, pull, clock, timed


REST, FLOW, SLOPE, WEIGHT, OWN, TABLE = 0, 2, 4, 10, 13, 16
"""Columns of what is known of an image: residual and speed (2) each, its change by the point (2 x 3), weight and own
covariance (xx, xy, yy)."""


@bare_step
def _speed(i, xyz, before, elapsed_s, farthest_m, speed):  # type: ignore[no-untyped-def]
    """Fill the speed (3,) of point i since the set before; False where none is known."""
    there = _nearest(xyz[i], before, farthest_m)
    if there < 0 or _nearest(before[there], xyz, np.inf) != i:
        return False
    for p in range(3):
        speed[p] = (xyz[i, p] - before[there, p]) / max(elapsed_s, 1e-9)
    return True


@bare_step
def _nearest(point, others, within):  # type: ignore[no-untyped-def]
    """Return which of the others (m, 3) lies nearest to a point, -1 where none lies nearer than ``within``."""
    nearest, at = within * within, -1
    x, y, z = point[0], point[1], point[2]
    for j in range(others.shape[0]):
        away = (others[j, 0] - x) ** 2 + (others[j, 1] - y) ** 2 + (others[j, 2] - z) ** 2
        if away < nearest:
            nearest, at = away, j
    return at


@bare_step
def _fitted(which, point, speed, given, seen, table, inverse):  # type: ignore[no-untyped-def]
    """Fill the table of the images ``which`` (c,) of a point, as they are after it has moved to its best place.

    A ray gives the residual of its image to first order, as triangulation does: no point needs to be projected.
    ``given``: rays, views, covariance, extra_px2, sigma_px2 and jitter_s as in ``look``; ``inverse`` (3, 3):
    covariance of the point. False where its images do not tell its place.
    """
    rays, views, covariance, extra_px2, sigma_px2, jitter_s = given
    n00 = n01 = n02 = n11 = n12 = n22 = b0 = b1 = b2 = 0.0
    count = 0
    for c in range(which.shape[0]):
        k = which[c]
        seen[c] = False
        if k < 0:
            continue
        x, y, z = (
            point[0] - views[c, ORIGIN],
            point[1] - views[c, ORIGIN + 1],
            point[2] - views[c, ORIGIN + 2],
        )
        depth = rays[k, DIRECTION] * x + rays[k, DIRECTION + 1] * y + rays[k, DIRECTION + 2] * z
        if not depth > 0.0:
            continue
        seen[c] = True
        count += 1
        own = table[c]
        own[OWN], own[OWN + 1], own[OWN + 2] = covariance[k, 0, 0], covariance[k, 0, 1], covariance[k, 1, 1]
        # the rays are whitened by all that they were thought to err by
        l00 = np.sqrt(own[OWN] + extra_px2[c])
        l10 = own[OWN + 1] / l00
        l11 = np.sqrt(own[OWN + 2] + extra_px2[c] - l10 * l10)
        for p in range(3):
            own[SLOPE + p] = l00 * rays[k, WHITE + p] / depth
            own[SLOPE + 3 + p] = (l10 * rays[k, WHITE + p] + l11 * rays[k, WHITE + 3 + p]) / depth
        for row in range(2):
            a, b, d = own[SLOPE + 3 * row], own[SLOPE + 3 * row + 1], own[SLOPE + 3 * row + 2]
            own[REST + row] = -(a * x + b * y + d * z)
            own[FLOW + row] = a * speed[0] + b * speed[1] + d * speed[2]
        jitter2 = jitter_s * jitter_s
        t00 = own[OWN] + sigma_px2[c] + jitter2 * own[FLOW] ** 2
        t01 = own[OWN + 1] + jitter2 * own[FLOW] * own[FLOW + 1]
        t11 = own[OWN + 2] + sigma_px2[c] + jitter2 * own[FLOW + 1] ** 2
        det = t00 * t11 - t01 * t01
        own[WEIGHT], own[WEIGHT + 1], own[WEIGHT + 2] = t11 / det, -t01 / det, t00 / det
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
    c00, c01, c02 = n11 * n22 - n12 * n12, n02 * n12 - n01 * n22, n01 * n12 - n02 * n11
    c11, c12, c22 = n00 * n22 - n02 * n02, n01 * n02 - n00 * n12, n00 * n11 - n01 * n01
    det = n00 * c00 + n01 * c01 + n02 * c02
    # the least eigenvalue over the largest, within a factor of 9
    if count < 2 or not det > 1e-9 * (n00 + n11 + n22) * (c00 + c11 + c22):
        return False
    inverse[0, 0], inverse[1, 1], inverse[2, 2] = c00 / det, c11 / det, c22 / det
    inverse[0, 1], inverse[0, 2], inverse[1, 2] = c01 / det, c02 / det, c12 / det
    inverse[1, 0], inverse[2, 0], inverse[2, 1] = c01 / det, c02 / det, c12 / det
    x, y, z = (
        (c00 * b0 + c01 * b1 + c02 * b2) / det,
        (c01 * b0 + c11 * b1 + c12 * b2) / det,
        (c02 * b0 + c12 * b1 + c22 * b2) / det,
    )
    for c in range(which.shape[0]):
        if seen[c]:
            own = table[c]
            own[REST] -= own[SLOPE] * x + own[SLOPE + 1] * y + own[SLOPE + 2] * z
            own[REST + 1] -= own[SLOPE + 3] * x + own[SLOPE + 4] * y + own[SLOPE + 5] * z
    return True


@bare_step
def _weighted(own, row):  # type: ignore[no-untyped-def]
    """Return a column (3) of J'W: what the point feels of a residual along one axis of the image."""
    v, w = own[WEIGHT + row], own[WEIGHT + 1 + row]
    return (
        own[SLOPE] * v + own[SLOPE + 3] * w,
        own[SLOPE + 1] * v + own[SLOPE + 4] * w,
        own[SLOPE + 2] * v + own[SLOPE + 5] * w,
    )


@bare_step
def _is_usual(seen, table):  # type: ignore[no-untyped-def]
    for c in range(seen.shape[0]):
        if seen[c]:
            x, y = table[c, REST], table[c, REST + 1]
            away2 = (
                table[c, WEIGHT] * x * x + 2.0 * table[c, WEIGHT + 1] * x * y + table[c, WEIGHT + 2] * y * y
            )
            if not away2 < FARTHEST_SIGMAS**2:
                return False
    return True


@bare_step
def _add_noise(seen, table, inverse, sigma_px2, jitter_s, normal, right, square, images):  # type: ignore[no-untyped-def]
    """Add a point's images to the regression of squared residuals on the variances of cameras and triggers."""
    last = seen.shape[0]
    for c in range(last):
        if not seen[c]:
            continue
        own = table[c]
        whole = own[OWN] + own[OWN + 2] + 2.0 * sigma_px2[c]
        flow2 = own[FLOW] ** 2 + own[FLOW + 1] ** 2
        whole += jitter_s * jitter_s * flow2
        taken_up = 0.0
        for row in (SLOPE, SLOPE + 3):
            for p in range(3):
                for q in range(3):
                    taken_up += own[row + p] * inverse[p, q] * own[row + q]
        left = 1.0 - taken_up / whole
        squared = own[REST] ** 2 + own[REST + 1] ** 2
        square[c] += squared
        images[c] += 1.0
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
def _add_clocks(seen, table, inverse, toward, pull, clock, images):  # type: ignore[no-untyped-def]
    """Add what a point's residuals along its motion say of each camera's delay."""
    cameras = seen.shape[0]
    for c in range(cameras):
        if not seen[c]:
            continue
        own = table[c]
        v = own[WEIGHT] * own[FLOW] + own[WEIGHT + 1] * own[FLOW + 1]
        w = own[WEIGHT + 1] * own[FLOW] + own[WEIGHT + 2] * own[FLOW + 1]
        for p in range(3):
            toward[c, p] = own[SLOPE + p] * v + own[SLOPE + 3 + p] * w
        pull[c] += v * own[REST] + w * own[REST + 1]
        clock[c, c] += v * own[FLOW] + w * own[FLOW + 1]
        images[c] += 1.0
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
def _adopt(which, point, rays, views, start, taken, reach_px):  # type: ignore[no-untyped-def]
    """Give a point without an image in a camera the free ray nearest to it within reach; True where any was."""
    adopted = False
    for c in range(which.shape[0]):
        if which[c] >= 0:
            continue
        x, y, z = (
            point[0] - views[c, ORIGIN],
            point[1] - views[c, ORIGIN + 1],
            point[2] - views[c, ORIGIN + 2],
        )
        distance = np.sqrt(x * x + y * y + z * z)
        nearest = reach_px
        for k in range(start[c], start[c + 1]):
            if taken[k]:
                continue
            beside = np.sqrt(
                (x / distance - rays[k, DIRECTION]) ** 2
                + (y / distance - rays[k, DIRECTION + 1]) ** 2
                + (z / distance - rays[k, DIRECTION + 2]) ** 2
            )
            beside_px = beside * (2.0 * rays[k, RADIUS] / rays[k, ANGLE])
            if beside_px <= nearest:
                nearest, which[c], adopted = beside_px, k, True
    return adopted
