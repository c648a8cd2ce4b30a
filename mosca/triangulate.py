"""Points from rays, with their covariance.

A ray seen at a pixel with covariance S has the whitened reprojection error ``A (X - O) / (d . (X - O))``, A = L^-1 G
with L L' = S and G from ``mosca.camera.Rays``. For a given depth along the ray it is linear in X, so that the point
follows from 3 x 3 normal equations, re-weighted with the new depths; the depths' own influence is of second
order in the error. Covariance: ``(sum A'A / s^2)^-1`` (field notes, section 4).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit

from mosca.data.arrays import Array
from mosca.data.detections import Detections
from mosca.data.rig import Rig
from mosca.ray_kernels import NO_FIELDS, ball_fields, fill_rays, rig_table

REWEIGHTINGS = 3


@dataclass(frozen=True, eq=False)
class Bundle:
    """The rays of one frame set, all cameras in one table, whitened by their errors.

    ``origin`` (c, 3) centres of projection; ``rotation`` (c, 3, 3) world_from_camera; ``pairs`` (p, 2) of cameras,
    best base first; ``density`` (c,) rays over the image's area [1/px^2]; ``start`` (c + 1,) first row of each
    camera's rays. Columns of the rays: ``direction`` (n, 3) unit, world; ``white`` (n, 2, 3) whitened reprojection
    error by direction; ``spread`` (n, 3, 2) direction error of one standard deviation (pseudo-inverse of
    ``white``); ``normal`` (n, 9) share in the normal equations: A'A (xx, xy, xz, yy, yz, zz) and A'A O;
    ``sigma_px`` (n,) geometric mean of the error ellipse's axes, to turn whitened errors back into px;
    ``radius_px`` (n,) of the target's image and ``angle`` (n,) that its diameter fills [rad]; ``flags`` (n,) of
    the detections. NaN in a ray where the lens images nothing at the pixel.
    """

    origin: Array
    rotation: Array
    pairs: Array
    density: Array
    start: Array
    direction: Array
    white: Array
    spread: Array
    normal: Array
    sigma_px: Array
    radius_px: Array
    angle: Array
    flags: Array


def bundle_rays(
    rig: Rig, detections: Mapping[str, Detections], camera_sigma_px: float, target: str = "point"
) -> Bundle:
    """Return the rays of all detections of a frame set.

    ``camera_sigma_px``: what besides the detection's own error moves an image point at random (camera body,
    trigger, lens model), standard deviation an axis; added to each detection's covariance. ``target``: "ball"
    frees each image of a ball's eccentricity, by its own size (``mosca.eccentricity``); "point" takes the image as
    it is.
    """
    table = rig_table(rig)
    found = [detections.get(c.name) for c in rig.cameras]
    counts = np.array([0 if f is None else len(f.diameter_px) for f in found])
    start = np.zeros(len(found) + 1, dtype=np.int64)
    np.cumsum(counts, out=start[1:])
    n = int(start[-1])
    there = [f for f in found if f is not None] or [Detections.none("")]
    flags = np.concatenate([f.flags for f in there])
    direction, white, spread = np.empty((n, 3)), np.empty((n, 2, 3)), np.empty((n, 3, 2))
    normal, sigma, radius, angle = np.empty((n, 9)), np.empty(n), np.empty(n), np.empty(n)
    fill_rays(
        table.kind, table.lens, table.size, table.rotation, table.origin, start,
        ball_fields(rig) if target == "ball" else NO_FIELDS,
        np.concatenate([f.xy_px for f in there]), np.concatenate([f.covariance_px2 for f in there]),
        camera_sigma_px**2,
        np.concatenate([f.diameter_px for f in there]), np.concatenate([f.elongation for f in there]),
        direction, white, spread, normal, sigma, radius, angle,
    )  # fmt: skip
    return Bundle(
        table.origin, table.rotation, table.pairs, counts / (table.size[:, 0] * table.size[:, 1]), start,
        direction, white, spread, normal, sigma, radius, angle, flags,
    )  # fmt: skip


@njit(nogil=True, cache=True, error_model="numpy")
def solve_point(  # type: ignore[no-untyped-def]
    count, chosen, owner, trust, origin, direction, white, normal, steps, depth, point, covariance
):
    """Intersect the first ``count`` rays of ``chosen`` (k,), of cameras ``owner`` (k,).

    ``trust`` (k,): factor on each ray's whitened error, 1 or less. ``depth`` (k,): of the point along each ray,
    roughly (any one number for all will do where ``steps`` is 3); holds the last ones afterwards. Fills ``point``
    (3,) and ``covariance`` (3, 3). Returns the sum of squared whitened errors, or -1 where the rays do not meet in
    front of the cameras.
    """
    for _step in range(steps):
        n00 = n01 = n02 = n11 = n12 = n22 = b0 = b1 = b2 = 0.0
        for k in range(count):
            m = normal[chosen[k]]
            w = (trust[k] / depth[k]) ** 2
            n00 += w * m[0]
            n01 += w * m[1]
            n02 += w * m[2]
            n11 += w * m[3]
            n12 += w * m[4]
            n22 += w * m[5]
            b0 += w * m[6]
            b1 += w * m[7]
            b2 += w * m[8]
        c00, c01, c02 = n11 * n22 - n12 * n12, n02 * n12 - n01 * n22, n01 * n12 - n02 * n11
        det = n00 * c00 + n01 * c01 + n02 * c02
        if not det > 1e-18 * n00 * n11 * n22:
            return -1.0
        c11, c12, c22 = n00 * n22 - n02 * n02, n01 * n02 - n00 * n12, n00 * n11 - n01 * n01
        x = (c00 * b0 + c01 * b1 + c02 * b2) / det
        y = (c01 * b0 + c11 * b1 + c12 * b2) / det
        z = (c02 * b0 + c12 * b1 + c22 * b2) / det
        for k in range(count):
            d, o = direction[chosen[k]], origin[owner[k]]
            depth[k] = d[0] * (x - o[0]) + d[1] * (y - o[1]) + d[2] * (z - o[2])
            if not depth[k] > 0.0:
                return -1.0
    point[0], point[1], point[2] = x, y, z
    covariance[0, 0], covariance[1, 1], covariance[2, 2] = c00 / det, c11 / det, c22 / det
    covariance[0, 1] = covariance[1, 0] = c01 / det
    covariance[0, 2] = covariance[2, 0] = c02 / det
    covariance[1, 2] = covariance[2, 1] = c12 / det
    total = 0.0
    for k in range(count):
        total += trust[k] ** 2 * squared_error(white[chosen[k]], origin[owner[k]], depth[k], point)
    return total


@njit(nogil=True, cache=True, error_model="numpy")
def squared_error(white, origin, depth, point):  # type: ignore[no-untyped-def]
    """Squared whitened reprojection error of one ray (chi-square with 2 degrees of freedom)."""
    x, y, z = point[0] - origin[0], point[1] - origin[1], point[2] - origin[2]
    u = (white[0, 0] * x + white[0, 1] * y + white[0, 2] * z) / depth
    v = (white[1, 0] * x + white[1, 1] * y + white[1, 2] * z) / depth
    return u * u + v * v


def triangulate(rig: Rig, xy_px: Any, sigma_px: float = 1.0) -> tuple[Array, Array, Array]:
    """Triangulate points whose images are known in each camera.

    ``xy_px`` (n, c, 2): pixel in each camera of the rig, NaN where it is not seen; ``sigma_px`` its standard
    deviation an axis. Returns xyz (n, 3) [m], covariance (n, 3, 3) [m^2] and rms reprojection error
    (n,) [px]; NaN where fewer than two rays meet.
    """
    xy = np.asarray(xy_px, dtype=float)
    found, row_of = {}, np.full(xy.shape[:2], -1, dtype=np.int64)
    first = 0
    for c, camera in enumerate(rig.cameras):
        rows = np.flatnonzero(np.isfinite(xy[:, c]).all(axis=1))
        k = len(rows)
        found[camera.name] = Detections(
            camera.name,
            xy[rows, c],
            np.tile(sigma_px**2 * np.eye(2), (k, 1, 1)),
            np.ones(k),
            np.ones(k),
            np.ones(k),
        )
        row_of[rows, c] = first + np.arange(k)
        first += k
    bundle = bundle_rays(rig, found, 0.0)
    xyz, covariance, total, count = _solve_rows(
        row_of, bundle.origin, bundle.direction, bundle.white, bundle.normal
    )
    return xyz, covariance, sigma_px * np.sqrt(total / (2 * np.maximum(count, 1)))


@njit(nogil=True, cache=True, error_model="numpy")
def _solve_rows(rows, origin, direction, white, normal):  # type: ignore[no-untyped-def]
    """Intersect the rays (n, c), -1 for none, of each row; NaN where fewer than two meet."""
    n, cameras = rows.shape
    xyz, covariance = np.full((n, 3), np.nan), np.full((n, 3, 3), np.nan)
    total, counts = np.full(n, np.nan), np.zeros(n, dtype=np.int64)
    chosen, owner = np.empty(cameras, dtype=np.int64), np.empty(cameras, dtype=np.int64)
    trust, depth = np.ones(cameras), np.ones(cameras)
    for i in range(n):
        k = 0
        for c in range(cameras):
            if rows[i, c] >= 0:
                chosen[k], owner[k] = rows[i, c], c
                k += 1
        counts[i] = k
        if k < 2:
            continue
        depth[:] = 1.0
        error = solve_point(
            k, chosen, owner, trust, origin, direction, white, normal, REWEIGHTINGS, depth, xyz[i], covariance[i]
        )  # fmt: skip
        if error < 0.0:
            xyz[i], covariance[i] = np.nan, np.nan
        else:
            total[i] = error
    return xyz, covariance, total, counts
