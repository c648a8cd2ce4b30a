"""Checks of a wand calibration and its report: an implausible rig is refused, a doubtful one gets findings."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from mosca.calibration.quality.findings import note, warn
from mosca.calibration.uncalibrated.final_adjustment import depths, focal_sigmas
from mosca.calibration.uncalibrated.image_points import PointViews
from mosca.calibration.uncalibrated.partial_adjustment import Network, residuals
from mosca.calibration.uncalibrated.view_graph import FEWEST_POINTS
from mosca.data.arrays import Array
from mosca.data.calibration import Calibration, Finding
from mosca.data.rig import Camera, Rig, principal_distances_px, principal_point_px
from mosca.data.sightings import Sightings
from mosca.errors import CalibrationError

FOCAL_WIDTHS = (0.3, 10.0)
"""Focal lengths of real cameras, in widths of the image."""
MIDDLE_SHARE = 0.2
"""Largest distance of a principal point from the image's middle, in widths of the image."""
WORST_FOCAL = 0.03
"""Relative standard deviation beyond which a focal length counts as undetermined."""
WORST_LEFT_OUT, MANY_LEFT_OUT = 0.3, 0.1
"""Shares of a camera's images left out as outliers that are an error, and a warning."""
WORST_RMS_WIDTHS = 0.003
"""Largest rms of residuals over the image's width; a wrong solution's is larger."""
FEW_LINKS = 100


def check(one: Network, tracks: PointViews) -> None:
    """Raise CalibrationError where the result cannot be a rig of real cameras."""
    sigma = focal_sigmas(one)
    tracks = tracks.of_cameras(one.cameras)
    for k, camera in one.cameras.items():
        focal, middle = _interior(camera)
        where = f"camera '{camera.name}'"
        if not FOCAL_WIDTHS[0] <= focal <= FOCAL_WIDTHS[1]:
            raise CalibrationError(
                f"interior-ran-away: {where}: focal length {focal:.2f} image widths found; real ones are "
                f"{FOCAL_WIDTHS[0]:g} to {FOCAL_WIDTHS[1]:g}; wave through the depth of the volume and in more "
                "directions, or give the lens from another calibration"
            )
        if middle > MIDDLE_SHARE:
            raise CalibrationError(
                f"interior-ran-away: {where}: principal point {100 * middle:.0f} % of the width from the image's "
                f"middle; up to {100 * MIDDLE_SHARE:g} % is plausible; wave through all of this camera's image"
            )
        if not sigma[k] <= WORST_FOCAL:
            raise CalibrationError(
                f"little-depth: {where}: focal length known to {100 * sigma[k]:.1f} % only, {100 * WORST_FOCAL:g} % "
                "is wanted; wave through the depth of the volume, with the wand in all directions"
            )
        mine = tracks.camera == k
        kept = int((one.adjustment.used & (one.tracks.camera == k)).sum())
        share = 1 - kept / max(int(mine.sum()), 1)
        if kept < FEWEST_POINTS:
            raise CalibrationError(
                f"few-views: {where}: {kept} usable points, {FEWEST_POINTS} at least are needed; wave longer there"
            )
        if share > WORST_LEFT_OUT:
            raise CalibrationError(
                f"blunders: {where}: {100 * share:.0f} % of its points contradict the other cameras; check that its "
                "images are its own (cables, names), of the same instants, and free of reflections"
            )
        rms = float(np.sqrt(np.mean(one.residuals_px[one.adjustment.used & (one.tracks.camera == k)] ** 2)))
        if rms > WORST_RMS_WIDTHS * camera.width:
            raise CalibrationError(
                f"lens-model: {where}: residuals of {rms:.1f} px rms remain; check that its images are its own and "
                "of the same instants, or calibrate a very wide lens with a test field"
            )
    behind = float(np.mean(depths(one) <= 0))
    if behind > 0:
        raise CalibrationError(
            f"interior-ran-away: {100 * behind:.1f} % of the points would lie behind cameras; wave longer, through "
            "the depth of the volume"
        )
    if not one.adjustment.converged:
        raise CalibrationError(
            "the adjustment did not settle; wave longer and through more of each image, or start from known lenses"
        )


def findings_of(one: Network, tracks: PointViews) -> tuple[Finding, ...]:
    """Return the warnings and notes on a rig that passed ``check``."""
    tracks = tracks.of_cameras(one.cameras)
    out: list[Finding] = []
    common = tracks.common()
    np.fill_diagonal(common, 0)
    for k, camera in one.cameras.items():
        mine = tracks.camera == k
        kept = one.adjustment.used & (one.tracks.camera == k)
        share = 1 - kept.sum() / max(int(mine.sum()), 1)
        if share > MANY_LEFT_OUT:
            out.append(
                warn(
                    "blunders",
                    f"camera '{camera.name}': {100 * share:.0f} % of its points were left out, up to "
                    f"{100 * MANY_LEFT_OUT:g} % is usual; look for reflections and for images that are late",
                    camera.name,
                )
            )
        links = int(common[k].max())
        if links < FEW_LINKS:
            other = tracks.names[int(np.argmax(common[k]))]
            out.append(
                warn(
                    "weak-link",
                    f"camera '{camera.name}': {links} points at the most in common with another camera ({other}); "
                    f"{FEW_LINKS} are wanted; wave longer where both see",
                    camera.name,
                )
            )
    out += [
        note("weak-parameter", f"{name} was held near its start: the data hardly determine it", name.split(".")[0])
        for name in one.adjustment.held
    ]
    return tuple(out)


def calibration_of(
    one: Network, tracks: PointViews, sightings: Sightings, scaled_by: str, scale_sigma: float
) -> Calibration:
    """Return the calibration; in its sightings each mark of one frame is a point of the world, a mark of its own.

    ``scale_sigma``: relative standard deviation of the length that gives the scale.
    """
    adjusted, precision = one.adjustment, one.adjustment.precision
    assert precision is not None  # finished() asks for it
    rig = Rig(tuple(one.cameras[k] for k in sorted(one.cameras)))
    n = len(sightings)
    used, residual, xy = np.zeros(n, dtype=bool), np.full((n, 2), np.nan), np.array(sightings.xy_px)
    residual[tracks.row] = residuals(tracks, one.cameras, one.points)
    residual[one.tracks.row] = one.residuals_px
    used[one.tracks.row], xy[one.tracks.row] = adjusted.used, one.tracks.xy_px
    marks = np.full(n, -1)
    marks[tracks.row] = tracks.point
    body, inflation = _shake(one)
    covariance = np.asarray(precision.covariance) * inflation
    if scale_sigma:
        covariance = covariance + scale_sigma**2 * _stretch(adjusted.parameters, one.cameras, one.points)
    sigma_px = np.column_stack([precision.sigma_x_px, precision.sigma_y_px])
    sigma_m = np.column_stack([precision.sigma_x_m, precision.sigma_y_m])
    # an undetermined mark has no position: the last row
    places = np.vstack([one.points, np.full((1, 3), np.nan)])
    return Calibration(
        rig,
        "wand",
        replace(sightings, mark=np.where(marks >= 0, marks, len(places) - 1), xy_px=xy),
        adjusted.parameters,
        covariance,
        residual,
        used,
        places,
        np.full(n, -1),
        np.zeros((0, 3, 3)),
        np.zeros((0, 3)),
        adjusted.sigma0,
        sigma_px,
        sigma_m,
        adjusted.weak,
        adjusted.held,
        body,
        scaled_by,
        findings_of(one, tracks),
    )


def _interior(camera: Camera) -> tuple[float, float]:
    """Return focal length and distance of the principal point from the image's middle, in image widths."""
    focal, (x, y) = principal_distances_px(camera.lens)[0], principal_point_px(camera.lens)
    off = float(np.hypot(x - (camera.width - 1) / 2, y - (camera.height - 1) / 2))
    return focal / camera.width, off / camera.width


def _shake(one: Network) -> tuple[float, float]:
    """Return the shake of whole images [px rms, an axis], and the factor by which it raises variances.

    It is estimated from the mean product of the residuals of different balls in one image. An image whose k balls
    share all errors has the weight of one ball: variances rise by 1 + (k - 1) rho (Kish 1965).
    """
    adjusted = one.adjustment
    group = np.arange(one.tracks.points)
    np.minimum.at(group, one.tracks.rods.second, one.tracks.rods.first)
    good = adjusted.used & np.isfinite(one.residuals_px).all(axis=1)
    key = group[one.tracks.point[good]] * len(one.tracks.names) + one.tracks.camera[good]
    _, image = np.unique(key, return_inverse=True)
    r = one.residuals_px[good]
    count = np.bincount(image)
    several = count >= 2
    sums = np.column_stack([np.bincount(image, r[:, axis]) for axis in (0, 1)])
    squares = np.column_stack([np.bincount(image, r[:, axis] ** 2) for axis in (0, 1)])
    pairs = (count * (count - 1))[several]
    products = ((sums**2 - squares)[several]).sum(axis=1) / 2
    if pairs.sum() == 0:
        return 0.0, 1.0
    shared = products.sum() / pairs.sum()
    doubt = np.sqrt((products**2).sum()) / pairs.sum()
    if shared < 3 * doubt:
        return 0.0, 1.0
    own = float((r**2).mean())
    # residuals are smaller than errors, by the same share in both parts
    precision = adjusted.precision
    assert precision is not None
    left = float(np.nanmean(precision.redundancy_numbers))
    rho = min(shared / own, 1.0)
    return float(np.sqrt(shared / max(left, 1e-3))), float(1 + (count[several].mean() - 1) * rho)


def _stretch(parameters: tuple[str, ...], cameras: Mapping[int, Camera], points: Array) -> Array:
    """Return the covariance (u, u) of a common stretch of unit relative variance about the points' middle."""
    middle = np.nanmean(points, axis=0)
    move = np.zeros(len(parameters))
    place = {name: k for k, name in enumerate(parameters)}
    for camera in cameras.values():
        for axis, name in enumerate(("X_m", "Y_m", "Z_m")):
            away = camera.world_from_camera.translation[axis] - middle[axis]
            move[place[f"{camera.name}.{name}"]] = away
    return np.outer(move, move)
