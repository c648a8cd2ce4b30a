"""Points from rays, with their covariance.

A ray seen at a pixel with covariance S has the whitened reprojection error ``A (X - O) / (d . (X - O))``, A = L^-1 G
with L L' = S and G from ``mosca.camera.Rays``. For a given depth along the ray it is linear in X, so that the point
follows from 3 x 3 normal equations, re-weighted with the new depths; the depths' own influence is of second
order in the error. Covariance: ``(sum A'A / s^2)^-1`` (field notes, section 4).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit

from mosca.camera import rays
from mosca.data.arrays import Array
from mosca.data.detections import Detections
from mosca.data.rig import Camera, Rig

REWEIGHTINGS = 3
LONG = 1.6
"""Ratio of a box's sides from which an image is taken for two targets (a small disc's box reaches 3 : 2)."""
LEAST_DIAMETER_PX = 0.5
"""A target of one pixel has no measurable size; taken for this one."""


@dataclass(frozen=True, eq=False)
class Bundle:
    """The rays of one frame set, all cameras in one table, whitened by their errors.

    ``origin`` (c, 3) centres of projection; ``start`` (c + 1,) first row of each camera's rays;
    ``direction`` (n, 3) unit, world; ``white`` (n, 2, 3) whitened reprojection error by direction;
    ``spread`` (n, 3, 2) direction error of one standard deviation (pseudo-inverse of ``white``);
    ``sigma_px`` (n,) geometric mean of the error ellipse's axes, to turn whitened errors back into px;
    ``radius_px`` (n,) of the target's image and ``angle`` (n,) that its diameter fills [rad].
    """

    origin: Array
    start: Array
    direction: Array
    white: Array
    spread: Array
    sigma_px: Array
    radius_px: Array
    angle: Array


def bundle_rays(rig: Rig, detections: dict[str, Detections], camera_sigma_px: float) -> Bundle:
    """Return the rays of all detections of a frame set.

    ``camera_sigma_px``: what besides the detection's own error moves an image point at random (camera body,
    trigger, lens model), standard deviation an axis; added to each detection's covariance.
    """
    parts = [
        _camera_rays(c, detections.get(c.name, Detections.none(c.name)), camera_sigma_px) for c in rig.cameras
    ]
    return Bundle(
        np.array([c.world_from_camera.translation for c in rig.cameras]),
        np.concatenate([[0], np.cumsum([len(p[0]) for p in parts])]).astype(np.int64),
        *(np.ascontiguousarray(np.concatenate([p[k] for p in parts])) for k in range(6)),
    )


def _camera_rays(camera: Camera, found: Detections, sigma_px: float) -> tuple[Array, ...]:
    bundle = rays(camera, found.xy_px)
    covariance = found.covariance_px2 + sigma_px**2 * np.eye(2)
    white = np.linalg.solve(np.linalg.cholesky(covariance), bundle.pixel_by_direction)
    # rows of white are at right angles to the direction: white' (white white')^-1
    spread = np.swapaxes(np.linalg.solve(white @ np.swapaxes(white, 1, 2), white), 1, 2)
    # px a radian across the ray: the geometric mean of both axes
    gram = bundle.pixel_by_direction @ np.swapaxes(bundle.pixel_by_direction, 1, 2)
    # two targets grown together are long, and their flux and peak tell no diameter: the longer axis does
    longer = np.where(found.elongation > LONG, np.sqrt(found.elongation), 1.0)
    diameter = np.maximum(found.diameter_px * longer, LEAST_DIAMETER_PX)
    # a detection where the lens images nothing has no ray: NaN, which no gate lets through
    with np.errstate(invalid="ignore"):
        angle = diameter / np.linalg.det(gram) ** 0.25
    return bundle.direction, white, spread, np.linalg.det(covariance) ** 0.25, diameter / 2, angle


@njit(nogil=True, cache=True)
def solve_point(chosen, owner, trust, origin, direction, white, point, covariance):  # type: ignore[no-untyped-def]
    """Intersect the rays ``chosen`` (k,) of cameras ``owner`` (k,); fills point (3,) and covariance (3, 3).

    ``trust`` (k,): factor on each ray's whitened error, 1 or less. Returns the sum of squared whitened errors, or
    -1 where the rays do not meet in front of the cameras.
    """
    count = chosen.shape[0]
    depth = np.ones(count)
    for _step in range(REWEIGHTINGS):
        n00 = n01 = n02 = n11 = n12 = n22 = b0 = b1 = b2 = 0.0
        for k in range(count):
            a, o = white[chosen[k]], origin[owner[k]]
            w = (trust[k] / depth[k]) ** 2
            for row in range(2):
                p, q, r = a[row, 0], a[row, 1], a[row, 2]
                s = w * (p * o[0] + q * o[1] + r * o[2])
                n00 += w * p * p
                n01 += w * p * q
                n02 += w * p * r
                n11 += w * q * q
                n12 += w * q * r
                n22 += w * r * r
                b0 += s * p
                b1 += s * q
                b2 += s * r
        c00, c01, c02 = n11 * n22 - n12 * n12, n02 * n12 - n01 * n22, n01 * n12 - n02 * n11
        det = n00 * c00 + n01 * c01 + n02 * c02
        if not det > 1e-12 * n00 * n11 * n22 * 1e-6:
            return -1.0
        c11, c12, c22 = n00 * n22 - n02 * n02, n01 * n02 - n00 * n12, n00 * n11 - n01 * n01
        point[0] = (c00 * b0 + c01 * b1 + c02 * b2) / det
        point[1] = (c01 * b0 + c11 * b1 + c12 * b2) / det
        point[2] = (c02 * b0 + c12 * b1 + c22 * b2) / det
        for k in range(count):
            d, o = direction[chosen[k]], origin[owner[k]]
            depth[k] = d[0] * (point[0] - o[0]) + d[1] * (point[1] - o[1]) + d[2] * (point[2] - o[2])
            if depth[k] <= 0.0:
                return -1.0
    covariance[0, 0], covariance[1, 1], covariance[2, 2] = c00 / det, c11 / det, c22 / det
    covariance[0, 1] = covariance[1, 0] = c01 / det
    covariance[0, 2] = covariance[2, 0] = c02 / det
    covariance[1, 2] = covariance[2, 1] = c12 / det
    total = 0.0
    for k in range(count):
        total += trust[k] ** 2 * squared_error(white[chosen[k]], origin[owner[k]], depth[k], point)
    return total


@njit(nogil=True, cache=True)
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
    n = len(xy)
    xyz, covariance, residual = np.full((n, 3), np.nan), np.full((n, 3, 3), np.nan), np.full(n, np.nan)
    found, row_of = {}, np.full(xy.shape[:2], -1)
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
    for i in range(n):
        owner = np.flatnonzero(row_of[i] >= 0)
        if len(owner) < 2:
            continue
        point, spread = np.empty(3), np.empty((3, 3))
        total = solve_point(
            row_of[i, owner],
            owner,
            np.ones(len(owner)),
            bundle.origin,
            bundle.direction,
            bundle.white,
            point,
            spread,
        )
        if total >= 0:
            xyz[i], covariance[i] = point, spread
            residual[i] = sigma_px * np.sqrt(total / (2 * len(owner)))
    return xyz, covariance, residual
