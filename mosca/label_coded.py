"""Coded targets as points with numbers: the number is the correspondence and the identity."""

from collections.abc import Mapping

import numpy as np

from mosca.data.arrays import Array
from mosca.data.detections import Detections
from mosca.data.found_targets import CodedDetections
from mosca.data.rig import Rig
from mosca.data.tracks import Points, Samples
from mosca.triangulate import Bundle, bundle_rays

BLUNDER_CHI2 = 25.0
"""A ray without which the others meet better by more than this, chi-square, was misread."""
REWEIGHTINGS = 4


def coded_points(
    rig: Rig, found: Mapping[str, CodedDetections], camera_sigma_px: float = 0.03
) -> tuple[Points, Array]:
    """Return the coded targets of one frame set as points, and their numbers (n,), rising.

    A number seen by two cameras or more is one point; of three and more rays one that does not meet the others is
    left out (a number misread, a mirror). ``camera_sigma_px``: what besides the detection's own error moves an image
    point at random. ``diameter_m`` is that of the centre dot. A camera of ``found`` that the rig lacks is not used.
    """
    bundle = bundle_rays(rig, {name: _plain(coded) for name, coded in found.items()}, camera_sigma_px)
    numbers = [found[c.name].number if c.name in found else np.empty(0, int) for c in rig.cameras]
    every = np.unique(np.concatenate(numbers))
    rays = np.full((len(every), len(rig.cameras)), -1)
    for c, mine in enumerate(numbers):
        rays[np.searchsorted(every, mine), c] = np.arange(len(mine))
    rays, xyz, covariance, total = _without_blunders(rays, bundle)
    met = np.flatnonzero(np.isfinite(total))
    rays, used = rays[met], rays[met] >= 0
    count, row = used.sum(axis=1), np.where(used, rays + bundle.start[:-1], 0)
    away = np.linalg.norm(xyz[met, None] - bundle.origin, axis=2)
    square_px = np.where(used, bundle.sigma_px[row] ** 2, 0.0).sum(axis=1) if len(met) else np.empty(0)
    points = Points(
        xyz[met],
        covariance[met],
        count,
        np.sqrt(total[met] / (2 * count) * square_px / count),
        rays,
        np.where(used, bundle.angle[row] * away, 0.0).max(axis=1) if len(met) else np.empty(0),
        count.astype(float),
    )
    return points, every[met]


def coded_samples(points: Points, number: Array, frame: int, time_ns: int) -> Samples:
    """Return coded points of one instant as measured samples whose tracks are their numbers."""
    n = len(points)
    return Samples(
        np.full(n, frame), np.full(n, time_ns), np.asarray(number), points.xyz, points.covariance,
        points.n_cameras, points.residual_px, np.zeros(n, np.int8),
    )  # fmt: skip


def coded_label(number: int) -> str:
    """Return the label of a coded target: as its name in ``mosca.data.targets``."""
    return f"code/{number:03d}"


def _plain(coded: CodedDetections) -> Detections:
    n, axes = len(coded), np.asarray(coded.semi_axes_px)
    # elongation 1: an ellipse seen at a slant is no pair of targets
    diameter = 2.0 * np.sqrt(axes[:, 0] * axes[:, 1])
    return Detections(coded.camera, coded.xy_px, coded.covariance_px2, diameter, np.zeros(n), np.ones(n))


def _without_blunders(rays: Array, bundle: Bundle) -> tuple[Array, Array, Array, Array]:
    """Return rays (n, c), points, covariances, squared errors, without a ray that spoils its point (one at most)."""
    xyz, covariance, total = _solved(rays, bundle)
    best = rays.copy()
    for c in range(rays.shape[1]):
        tried = np.flatnonzero((rays[:, c] >= 0) & ((rays >= 0).sum(axis=1) > 2))
        fewer = rays[tried]
        fewer[:, c] = -1
        one_xyz, one_covariance, one_total = _solved(fewer, bundle)
        gain = np.nan_to_num(total[tried], nan=np.inf) - one_total
        kept = gain > np.where((rays[tried] == best[tried]).all(axis=1), BLUNDER_CHI2, 0.0)
        rows = tried[kept]
        best[rows], xyz[rows], covariance[rows] = fewer[kept], one_xyz[kept], one_covariance[kept]
        total[rows] = one_total[kept]
    return best, xyz, covariance, total


def _solved(rays: Array, bundle: Bundle) -> tuple[Array, Array, Array]:
    """Intersect rays (n, c): points (n, 3), covariances (n, 3, 3), sums of squared whitened errors (n,).

    As in ``mosca.triangulate``; NaN where fewer than two rays meet in front of the cameras.
    """
    used = rays >= 0
    row = np.where(used, rays + bundle.start[:-1], 0)
    if not len(rays):
        return np.empty((0, 3)), np.empty((0, 3, 3)), np.empty(0)
    white, direction = bundle.white[row], bundle.direction[row]
    depth = np.ones(rays.shape)
    xyz, normal = np.full((len(rays), 3), np.nan), np.zeros((len(rays), 3, 3))
    enough = used.sum(axis=1) >= 2
    for _step in range(REWEIGHTINGS):
        scaled = white * (used / depth)[:, :, None, None]
        each = np.swapaxes(scaled, 2, 3) @ scaled
        normal[enough] = each.sum(axis=1)[enough]
        right = (each @ bundle.origin[:, :, None]).sum(axis=1)
        xyz[enough] = np.linalg.solve(normal[enough], right[enough])[:, :, 0]
        depth = np.einsum("nci,nci->nc", direction, xyz[:, None] - bundle.origin)
    behind = (used & ~(depth > 0)).any(axis=1)
    offset = xyz[:, None] - bundle.origin
    error = np.einsum("ncij,ncj->nci", white, offset) / depth[:, :, None]
    total = np.where(used[:, :, None], error**2, 0.0).sum(axis=(1, 2))
    covariance = np.full(normal.shape, np.nan)
    covariance[enough] = np.linalg.inv(normal[enough])
    return xyz, covariance, np.where(enough & ~behind, total, np.nan)
