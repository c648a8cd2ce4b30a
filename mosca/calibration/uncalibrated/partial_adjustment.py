"""Bundle adjustments of a growing network: some cameras, their common points and rods, in stages."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mosca.calibration.bundle.solver import (
    Adjustment,
    BundleSettings,
    CameraUnknowns,
    Distances,
    ObjectPoints,
    Observations,
    Problem,
    solve,
)  # fmt: skip
from mosca.calibration.common.robust_fit import SIGMA_BY_MEDIAN_1D, SIGMA_BY_MEDIAN_2D
from mosca.calibration.uncalibrated.image_points import PointViews
from mosca.camera.projection import lens_directions, project
from mosca.data.arrays import Array
from mosca.data.rig import Camera
from mosca.errors import CalibrationError

CLEANINGS, ROD_SIGMAS = 6, 10.0
"""Largest number of rounds that remove outliers; standard deviations from which a rod's length is an outlier."""
# residuals above so many robust standard deviations are left out while the network grows
CLEAR_SIGMAS = 12.0
FIRST = BundleSettings(loss="cauchy", loss_scale=3.0, tolerance=1.0, most_steps=20, hold_weak=True, precision=False)
"""The first adjustment, robust against wrong images."""
SECOND = BundleSettings(tolerance=0.3, most_steps=20, precision=False)
"""The second adjustment, of the remaining image points: to convergence of a third of a unit of weight."""


@dataclass(frozen=True, eq=False)
class Network:
    """Cameras by index, the image points ``tracks`` of the adjustment, and the adjustment itself.

    ``points`` (p, 3): of all object points, NaN where unknown.
    """

    cameras: Mapping[int, Camera]
    tracks: PointViews
    points: Array
    adjustment: Adjustment

    @property
    def residuals_px(self) -> Array:
        """Observed minus projected (n, 2) of each image point, NaN where it is not imaged."""
        return self.adjustment.residuals_px

    @property
    def spread(self) -> float:
        """Robust standard deviation of a coordinate, in a-priori standard deviations of the image points."""
        far = np.linalg.norm(self.residuals_px, axis=1) / self.tracks.sigma_px
        return SIGMA_BY_MEDIAN_2D * float(np.median(np.nan_to_num(far, nan=1e6)))


def rough(tracks: PointViews, cameras: Mapping[int, Camera], free: tuple[str, ...]) -> Network:
    """Adjust some cameras robustly from poor starting values; residuals as large as at the start are admitted."""
    usable = imaged(tracks.of_cameras(cameras), cameras)
    if len(np.unique(usable.camera)) < len(cameras):
        raise CalibrationError("few-views: a camera's points have no rays in the lens that was guessed")
    done = network(usable, cameras, free, FIRST, max(_misfit(usable, cameras), 1.0))
    clean = cleaned(imaged(usable, done.cameras), done.cameras, CLEAR_SIGMAS * done.spread)
    clean = clean.of_cameras(cameras)
    if len(np.unique(clean.camera)) < len(cameras):
        return done
    return network(clean, done.cameras, free, SECOND, max(done.spread, 1.0), done.points)


def network(
    tracks: PointViews,
    cameras: Mapping[int, Camera],
    free: tuple[str, ...] | Mapping[int, tuple[str, ...]],
    settings: BundleSettings,
    inflate: float = 1.0,
    points: Array | None = None,
) -> Network:
    """Adjust some cameras, their common points and rods, all a-priori standard deviations times ``inflate``.

    ``points`` (p, 3): starting values, NaN or None where the rays are to be intersected.
    """
    order = sorted(cameras)
    number = np.full(len(tracks.names), -1)
    number[order] = np.arange(len(order))
    start = np.full((tracks.points, 3), np.nan) if points is None else points
    problem = Problem(
        tuple(CameraUnknowns(cameras[k], free[k] if isinstance(free, Mapping) else free) for k in order),
        Observations(
            number[tracks.camera], tracks.point, tracks.xy_px, sigma_px=tracks.sigma_px * inflate
        ),
        ObjectPoints.free(start),
        distances=rods_between(tracks, inflate),
        datum="points"
    )  # fmt: skip
    done = solve(problem, settings)
    return Network(dict(zip(order, done.cameras, strict=True)), tracks, done.points, done)


def rods_between(tracks: PointViews, inflate: float) -> Distances:
    """Return the rods with both ends seen by two cameras, their standard deviations times ``inflate``.

    Far from the solution a rod's weight must not exceed that of the rays so much that rounding errors outweigh these.
    """
    rays = np.bincount(tracks.point, minlength=tracks.points)
    rods = tracks.rods
    both = (rays[rods.first] >= 2) & (rays[rods.second] >= 2)
    # distances on one line are sums of others: each ball is joined only to the first one that is known
    one = np.flatnonzero(both)
    one = one[np.unique(rods.second[one], return_index=True)[1]]
    return Distances(rods.first[one], rods.second[one], rods.length_m[one], rods.sigma_m[one] * inflate)


def imaged(tracks: PointViews, cameras: Mapping[int, Camera]) -> PointViews:
    """Return the image points that have a ray in their camera's lens and whose object point a second camera sees."""
    good = np.zeros(len(tracks), dtype=bool)
    for k, camera in cameras.items():
        mine = tracks.camera == k
        good[mine] = np.isfinite(lens_directions(camera.lens, tracks.xy_px[mine])).all(axis=1)
    return tracks.only(good).of_cameras(cameras)


def intersected(tracks: PointViews, cameras: Mapping[int, Camera]) -> Array:
    """Return the points (p, 3) nearest to their rays (least squares of distances), NaN without two rays."""
    normal, right = np.zeros((tracks.points, 3, 3)), np.zeros((tracks.points, 3))
    rays = np.zeros(tracks.points, dtype=np.int64)
    for k, camera in cameras.items():
        mine = tracks.camera == k
        pose = camera.world_from_camera
        v = lens_directions(camera.lens, tracks.xy_px[mine]) @ pose.rotation.T
        good = np.isfinite(v).all(axis=1)
        point, v = tracks.point[mine][good], v[good]
        across = np.eye(3) - v[:, :, None] * v[:, None, :]
        # a camera sees a point once
        normal[point] += across
        right[point] += across @ pose.translation
        rays[point] += 1
    out = np.full((tracks.points, 3), np.nan)
    firm = np.flatnonzero(rays >= 2)
    firm = firm[np.linalg.eigvalsh(normal[firm])[:, 0] > 1e-5]
    out[firm] = np.linalg.solve(normal[firm], right[firm][:, :, None])[:, :, 0]
    return out


def cleaned(tracks: PointViews, cameras: Mapping[int, Camera], limit: float) -> PointViews:
    """Return the image points without those that contradict these cameras by more than ``limit`` a-priori sigmas.

    The worst ray of each object point is removed, then the others are intersected again. If two rays do not meet,
    both are removed, since it is unknown which is wrong. Both ends of a rod of a very different length are also
    removed. Image points of other cameras stay.
    """
    for _ in range(CLEANINGS):
        mine = np.isin(tracks.camera, list(cameras))
        points = intersected(tracks.only(mine), cameras)
        far = np.linalg.norm(residuals(tracks, cameras, points), axis=1) / tracks.sigma_px
        # a point with a ray that its camera does not image counts as infinitely wrong
        lost = mine & np.isfinite(points[tracks.point]).all(axis=1) & ~np.isfinite(far)
        far = np.where(lost, np.inf, np.where(np.isfinite(far), far, 0.0))
        worst = np.zeros(tracks.points)
        np.maximum.at(worst, tracks.point, far)
        rays = np.bincount(tracks.point[mine], minlength=tracks.points)
        bad = mine & (far > limit) & ((far == worst[tracks.point]) | (rays[tracks.point] <= 2))
        if not bad.any():
            bad = mine & _of_wrong_length(tracks, points)[tracks.point]
        if not bad.any():
            break
        tracks = tracks.only(~bad)
    return tracks


def _of_wrong_length(tracks: PointViews, points: Array) -> Array:
    """Return which points (p,) are ends of rods with very different lengths, in robust sigmas of all rods."""
    rods, out = tracks.rods, np.zeros(tracks.points, dtype=bool)
    off = np.linalg.norm(points[rods.first] - points[rods.second], axis=1) / rods.length_m
    known = np.isfinite(off)
    if not known.any():
        return out
    off = np.abs(off - np.median(off[known]))
    wrong = known & (off > ROD_SIGMAS * SIGMA_BY_MEDIAN_1D * np.median(off[known]))
    out[rods.first[wrong]] = out[rods.second[wrong]] = True
    return out


def residuals(tracks: PointViews, cameras: Mapping[int, Camera], points: Array) -> Array:
    """Return observed minus projected (n, 2) [px] of all image points of these cameras, else NaN."""
    out = np.full((len(tracks), 2), np.nan)
    for k, camera in cameras.items():
        mine = np.flatnonzero((tracks.camera == k) & np.isfinite(points[tracks.point]).all(axis=1))
        out[mine] = tracks.xy_px[mine] - project(camera, points[tracks.point[mine]])
    return out


def _misfit(tracks: PointViews, cameras: Mapping[int, Camera]) -> float:
    """Return the robust size of the residuals before an adjustment, in a-priori standard deviations."""
    far = np.linalg.norm(residuals(tracks, cameras, intersected(tracks, cameras)), axis=1) / tracks.sigma_px
    # points that are not imaged count as far away
    return SIGMA_BY_MEDIAN_2D * float(np.median(np.where(np.isfinite(far), far, np.nanmax([*far, 1.0]))))
