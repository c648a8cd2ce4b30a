"""Points from rays, with their covariance.

A ray seen at a pixel with covariance S has the whitened reprojection error ``A (X - O) / (d . (X - O))``, A = L^-1 G
with L L' = S and G from ``mosca.camera.projection.Rays``. For a given depth along the ray the error is linear in X,
so the point follows from 3 x 3 normal equations. They are solved again with weights from the new depths; the
influence of the depths themselves is of second order in the error. Covariance with the depths s: ``(sum A'A /
s^2)^-1`` (field notes, section 4).
"""

from typing import Any

import numpy as np

from mosca.camera.projection import project
from mosca.camera.ray_table import make_ray_table
from mosca.data.arrays import Array
from mosca.data.detections import Detections
from mosca.data.rays import NORMAL, WHITE
from mosca.data.rig import Rig
from mosca.numba_support.decorators import inlined_step, kernel
from mosca.numba_support.linalg3 import Symmetric3, cofactors3, determinant3, scaled3, times3

REWEIGHTINGS = np.int64(3)
SINGULAR = 1e-18
"""Determinant of the normal equations over the product of their diagonal at which rays are parallel in double
precision: directions that differ by some 1e-9 rad."""
TRUST, SHARE, DEPTH, WHOLE, RANKS = 0, 1, 2, 3, 4
"""Columns of the values of each ray of a hypothesis: trust, expected number of equally near chance rays, depth, size
[m] of the image of a whole target."""


@inlined_step
def solve_rays(members, ranks, rays, views, steps, solved):
    """Intersect the rays ``members`` (c,), one of each camera or -1.

    ``ranks`` (c, RANKS): TRUST, a factor of 1 or less on each ray's whitened error; DEPTH, the approximate depth of
    the point along each ray (where ``steps`` is 3, any one number for all will do), replaced by the final depth.
    Fills the first 12 of ``solved``: point (3) and covariance (3 x 3). Returns the sum of squared whitened errors, or
    -1 where the rays do not meet in front of the cameras. Elements are read one by one: a view of a row costs more
    than the arithmetic.
    """
    cameras = members.shape[0]
    x = y = z = inverse = 0.0
    cofactors = Symmetric3(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    for _step in range(steps):
        n00 = n01 = n02 = n11 = n12 = n22 = b0 = b1 = b2 = 0.0
        for c in range(cameras):
            k = members[c]
            if k < 0:
                continue
            w = (ranks[c, TRUST] / ranks[c, DEPTH]) ** 2
            n00 += w * rays[k, NORMAL + 0]
            n01 += w * rays[k, NORMAL + 1]
            n02 += w * rays[k, NORMAL + 2]
            n11 += w * rays[k, NORMAL + 3]
            n12 += w * rays[k, NORMAL + 4]
            n22 += w * rays[k, NORMAL + 5]
            b0 += w * rays[k, NORMAL + 6]
            b1 += w * rays[k, NORMAL + 7]
            b2 += w * rays[k, NORMAL + 8]
        normal = Symmetric3(n00, n01, n02, n11, n12, n22)
        cofactors = cofactors3(normal)
        determinant = determinant3(normal, cofactors)
        if not determinant > SINGULAR * n00 * n11 * n22:
            return -1.0
        inverse = 1.0 / determinant
        x, y, z = times3(cofactors, b0, b1, b2)
        x, y, z = x * inverse, y * inverse, z * inverse
        for c in range(cameras):
            k = members[c]
            if k >= 0:
                ranks[c, DEPTH] = (
                    rays[k, 0] * (x - views[c, 0]) + rays[k, 1] * (y - views[c, 1]) + rays[k, 2] * (z - views[c, 2])
                )
                if not ranks[c, DEPTH] > 0.0:
                    return -1.0
    solved[0], solved[1], solved[2] = x, y, z
    covariance = scaled3(cofactors, inverse)
    solved[3], solved[7], solved[11] = covariance.xx, covariance.yy, covariance.zz
    solved[4] = solved[6] = covariance.xy
    solved[5] = solved[9] = covariance.xz
    solved[8] = solved[10] = covariance.yz
    total = 0.0
    for c in range(cameras):
        k = members[c]
        if k >= 0:
            p, q, r = x - views[c, 0], y - views[c, 1], z - views[c, 2]
            u = rays[k, WHITE + 0] * p + rays[k, WHITE + 1] * q + rays[k, WHITE + 2] * r
            v = rays[k, WHITE + 3] * p + rays[k, WHITE + 4] * q + rays[k, WHITE + 5] * r
            total += (ranks[c, TRUST] / ranks[c, DEPTH]) ** 2 * (u * u + v * v)
    return total


def triangulate(
    rig: Rig, xy_px: Any, sigma_px: float = 1.0, covariance_px2: Array | None = None
) -> tuple[Array, Array, Array]:
    """Triangulate points whose images are known in each camera.

    ``xy_px`` (n, c, 2): pixel in each camera of the rig, NaN where it is not seen; ``sigma_px`` its standard
    deviation an axis, or ``covariance_px2`` (n, c, 2, 2) that of each. Returns xyz (n, 3) [m], covariance (n, 3, 3)
    [m^2] and rms reprojection error (n,) [px]; NaN where fewer than two rays meet.
    """
    xy = np.asarray(xy_px, dtype=float)
    equal = np.broadcast_to(sigma_px**2 * np.eye(2), (*xy.shape[:2], 2, 2))
    weight = equal if covariance_px2 is None else np.asarray(covariance_px2, dtype=float)
    n, found, row_of = len(xy), {}, np.full(xy.shape[:2], -1, dtype=np.int64)
    first = 0
    for c, camera in enumerate(rig.cameras):
        rows = np.flatnonzero(np.isfinite(xy[:, c]).all(axis=1))
        k = len(rows)
        found[camera.name] = Detections(camera.name, xy[rows, c], weight[rows, c], np.ones(k), np.ones(k), np.ones(k))
        row_of[rows, c] = first + np.arange(k)
        first += k
    bundle = make_ray_table(rig, found, 0.0)
    solved, total, count = _solve_rows(row_of, bundle.rays, bundle.views)
    xyz, values = solved[:, :3], 2 * np.maximum(count, 1)
    residual = sigma_px * np.sqrt(total / values)
    if covariance_px2 is not None:
        off = np.stack([project(camera, xyz) for camera in rig.cameras], axis=1) - xy
        residual = np.where(np.isfinite(total), np.sqrt(np.nansum(off**2, axis=(1, 2)) / values), np.nan)
    return xyz, solved[:, 3:].reshape(n, 3, 3), residual


@kernel
def _solve_rows(rows, rays, views):
    """Intersect the rays (n, c), -1 for none, of each row; NaN where fewer than two meet."""
    n, cameras = rows.shape
    solved, total, counts = np.full((n, 12), np.nan), np.full(n, np.nan), np.zeros(n, dtype=np.int64)
    ranks = np.empty((cameras, RANKS))
    for i in range(n):
        for c in range(cameras):
            counts[i] += rows[i, c] >= 0
        if counts[i] < 2:
            continue
        for c in range(cameras):
            ranks[c, TRUST] = ranks[c, SHARE] = ranks[c, DEPTH] = 1.0
        error = solve_rays(rows[i], ranks, rays, views, REWEIGHTINGS, solved[i])
        if error >= 0.0:
            total[i] = error
    return solved, total, counts
