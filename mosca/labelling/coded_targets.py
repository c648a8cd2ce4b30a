"""Coded targets as points with numbers: the number gives correspondence and identity."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mosca.camera.projection import rays
from mosca.data.arrays import Array
from mosca.data.found_targets import CodedDetections
from mosca.data.rig import Rig
from mosca.data.tracks import Points, Samples

BLUNDER_CHI2 = 25.0
"""A ray was misread if chi-square of the others is smaller by more than this without it."""
REWEIGHTINGS = 4


def coded_points(
    rig: Rig, found: Mapping[str, CodedDetections], camera_sigma_px: float = 0.03
) -> tuple[Points, Array]:
    """Return the coded targets of one frame set as points, and their numbers (n,), rising.

    A number seen by two cameras or more is one point. Of three or more rays, one that does not meet the others (a
    misread number, a mirror) is left out. ``camera_sigma_px``: random error of an image point besides the detection's
    own error. ``diameter_m`` is that of the centre dot. A camera of ``found`` that the rig lacks is not used.
    """
    seen = [found.get(camera.name) for camera in rig.cameras]
    every = np.unique(np.concatenate([one.number for one in seen if one is not None] or [np.empty(0, int)]))
    table = _Table.of(rig, seen, every, camera_sigma_px)
    used, xyz, covariance, total = _without_blunders(table)
    met = np.flatnonzero(np.isfinite(total))
    used, count = used[met], used[met].sum(axis=1)
    away = np.linalg.norm(xyz[met, None] - table.origin, axis=2)
    square_px = np.where(used, table.sigma_px[met] ** 2, 0.0).sum(axis=1) / np.maximum(count, 1)
    residual_px = np.sqrt(total[met] / (2 * np.maximum(count, 1)) * square_px)
    row, diameter_m = np.where(used, table.row[met], -1), np.where(used, table.angle[met] * away, 0.0).max(axis=1)
    return Points(xyz[met], covariance[met], count, residual_px, row, diameter_m, count.astype(float)), every[met]


def coded_samples(points: Points, number: Array, frame: int, time_ns: int) -> Samples:
    """Return coded points of one instant as measured samples, with their numbers as tracks."""
    n = len(points)
    return Samples(
        np.full(n, frame), np.full(n, time_ns), np.asarray(number), points.xyz, points.covariance,
        points.n_cameras, points.residual_px, np.zeros(n, np.int8),
    )  # fmt: skip


def coded_label(number: int) -> str:
    """Return the label of a coded target, which is its name in ``mosca.data.targets``."""
    return f"code/{number:03d}"


@dataclass(frozen=True, eq=False)
class _Table:
    """Rays of n numbers in c cameras, NaN or -1 where a camera has none."""

    origin: Array
    """(c, 3)"""
    row: Array
    """(n, c) row of the detection."""
    direction: Array
    """(n, c, 3)"""
    white: Array
    """(n, c, 2, 3) derivative of the whitened reprojection error by direction."""
    sigma_px: Array
    """(n, c)"""
    angle: Array
    """(n, c) the dot's diameter [rad]."""

    @classmethod
    def of(cls, rig: Rig, seen: Sequence[CodedDetections | None], every: Array, camera_sigma_px: float) -> "_Table":
        """Return the table of the numbers ``every`` (n,)."""
        n, c = len(every), len(rig.cameras)
        row = np.full((n, c), -1)
        direction, white = np.full((n, c, 3), np.nan), np.full((n, c, 2, 3), np.nan)
        sigma, angle = np.full((n, c), np.nan), np.full((n, c), np.nan)
        for k, (camera, one) in enumerate(zip(rig.cameras, seen, strict=True)):
            if one is None or not len(one):
                continue
            at, bundle = np.searchsorted(every, one.number), rays(camera, one.xy_px)
            covariance = one.covariance_px2 + camera_sigma_px**2 * np.eye(2)
            gram = bundle.pixel_by_direction @ np.swapaxes(bundle.pixel_by_direction, 1, 2)
            row[at, k] = np.arange(len(one))
            direction[at, k] = bundle.direction
            white[at, k] = np.linalg.solve(np.linalg.cholesky(covariance), bundle.pixel_by_direction)
            sigma[at, k] = np.linalg.det(covariance) ** 0.25
            # pixels per radian across the ray: geometric mean of both axes
            angle[at, k] = 2 * np.sqrt(one.semi_axes_px.prod(axis=1)) / np.linalg.det(gram) ** 0.25
        origin = np.array([camera.world_from_camera.translation for camera in rig.cameras])
        return cls(origin, row, direction, white, sigma, angle)


def _without_blunders(table: _Table) -> tuple[Array, Array, Array, Array]:
    """Return rays used (n, c), points, covariances, squared errors; a ray that spoils its point is not used."""
    whole = np.asarray(np.isfinite(table.direction).all(axis=2))
    xyz, covariance, total = _solved(whole, table)
    best = whole.copy()
    for c in range(whole.shape[1]):
        fewer = whole.copy()
        fewer[:, c] = False
        one_xyz, one_covariance, one_total = _solved(fewer, table)
        tried = whole[:, c] & (whole.sum(axis=1) > 2) & np.isfinite(one_total)
        gain = np.nan_to_num(total, nan=np.inf) - one_total
        least = np.where((best == whole).all(axis=1), BLUNDER_CHI2, 0.0)
        rows = np.flatnonzero(tried & (gain > least))
        best[rows], xyz[rows], covariance[rows] = fewer[rows], one_xyz[rows], one_covariance[rows]
        total[rows] = one_total[rows]
    return best, xyz, covariance, total


def _solved(used: Array, table: _Table) -> tuple[Array, Array, Array]:
    """Intersect the rays ``used`` (n, c): points (n, 3), covariances (n, 3, 3), squared whitened errors (n,).

    The problem is linear in the point for given depths, and re-weighted with the new depths, as in
    ``mosca.triangulation.triangulate``. NaN where fewer than two rays meet in front of the cameras.
    """
    n = len(used)
    white = np.where(used[:, :, None, None], table.white, 0.0)
    direction = np.where(used[:, :, None], table.direction, 0.0)
    depth, enough = np.ones(used.shape), used.sum(axis=1) >= 2
    xyz, covariance = np.full((n, 3), np.nan), np.full((n, 3, 3), np.nan)
    for _step in range(REWEIGHTINGS):
        scaled = white / depth[:, :, None, None]
        each = np.swapaxes(scaled, 2, 3) @ scaled
        normal = each.sum(axis=1)[enough]
        right = (each @ table.origin[:, :, None]).sum(axis=1)[enough]
        xyz[enough] = np.linalg.solve(normal, right)[:, :, 0]
        offset = xyz[:, None] - table.origin
        depth = np.where(used, np.einsum("nci,nci->nc", direction, offset), 1.0)
    covariance[enough] = np.linalg.inv(normal)
    total = (np.einsum("ncij,ncj->nci", white, offset) ** 2 / depth[:, :, None] ** 2).sum(axis=(1, 2))
    return xyz, covariance, np.where(enough & ~(used & ~(depth > 0)).any(axis=1), total, np.nan)
