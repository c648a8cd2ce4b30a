"""Checks of the interior orientation: is it that of a real camera, and had the target the depth to determine it?"""

import numpy as np

from mosca.calibration.bundle.layout import POSE_NAMES
from mosca.calibration.quality.findings import note, refuse, warn
from mosca.calibration.quality.jacobian import aspect, principal_distance_column, sigma_of_principal_distance
from mosca.calibration.quality.limits import QualityLimits
from mosca.camera.projection import image_grid, lens_directions, lens_pixels
from mosca.data.arrays import Array
from mosca.data.calibration import Calibration, Finding
from mosca.data.rig import Camera, FisheyeLens, Rig, principal_distances_px, principal_point_px

DO_AGAIN = "calibrate again with the target filling the image, tilted and at several distances, or hold"


def ran_away(calibration: Calibration, settings: QualityLimits) -> tuple[Finding, ...]:
    """Return findings on interior orientations that no real camera has."""
    found: list[Finding] = []
    for k, camera in enumerate(calibration.rig.cameras):
        for complaint in (_impossible_scale(camera, settings), _impossible_centre(camera, settings),
                          _impossible_aspect(camera, settings)):  # fmt: skip
            if complaint:
                found.append(refuse("interior-ran-away", f"camera '{camera.name}': {complaint}", camera.name))
        found += _impossible_distortion(calibration, k, settings)
        sigma = sigma_of_principal_distance(calibration, k)
        if (
            sigma is not None
            and sigma > settings.refused_sigma_c
            and not _for_lack_of_depth(calibration, k, settings)
        ):
            found.append(
                refuse(
                    "interior-ran-away",
                    f"camera '{camera.name}': the principal distance is known to {sigma:.1%} only (standard "
                    f"deviation), {settings.refused_sigma_c:.0%} allowed; {DO_AGAIN} its lens as it was",
                    camera.name,
                )
            )
    return tuple(found)


def changed_interior(calibration: Calibration, known: Rig, settings: QualityLimits) -> tuple[Finding, ...]:
    """Return the cameras whose principal distance is not that of the same camera in ``known``."""
    found = []
    for k, camera in enumerate(calibration.rig.cameras):
        sigma = sigma_of_principal_distance(calibration, k)
        if sigma is None or camera.name not in known.names:
            continue
        before, now = (
            principal_distances_px(known.camera(camera.name).lens)[0],
            principal_distances_px(camera.lens)[0],
        )
        change = now / before - 1
        if abs(change) > max(settings.changed_share, settings.changed_sigmas * sigma):
            found.append(
                refuse(
                    "interior-ran-away",
                    f"camera '{camera.name}': the principal distance is {now:.1f} px, {change:+.1%} from the "
                    f"{before:.1f} px of the earlier rig, {settings.changed_share:.0%} allowed; if nobody "
                    "turned zoom or focus the new calibration is wrong: repeat it",
                    camera.name,
                )
            )
    return tuple(found)


def little_depth(calibration: Calibration, settings: QualityLimits) -> tuple[Finding, ...]:
    """Return the cameras whose principal distance and distance from the target the images cannot separate."""
    found = []
    for k, camera in enumerate(calibration.rig.cameras):
        sigma = sigma_of_principal_distance(calibration, k)
        if sigma is None or not _for_lack_of_depth(calibration, k, settings):
            continue
        held = _principal_distance_name(calibration, k) in calibration.held
        if sigma <= settings.warned_sigma_c and not held:
            continue
        shown = depth_range(calibration, k)
        correlation, inflation = distance_correlation(calibration, k)
        raise_ = refuse if sigma > settings.refused_sigma_c or held else warn
        found.append(
            raise_(
                "little-depth",
                f"camera '{camera.name}': the target's points differ in distance by {shown:.1%} only, so "
                f"that principal distance ({sigma:.1%} uncertain, {settings.warned_sigma_c:.1%} allowed) and "
                f"distance look alike (correlation {correlation:.4f}, variance inflated {inflation:.0f} "
                "times); show the target at other distances and tilted, or hold the principal distance",
                camera.name,
            )
        )
    return tuple(found)


def weak_parameters(calibration: Calibration) -> tuple[Finding, ...]:
    """Return, for each camera, the parameters that the data hardly determine."""
    found = []
    for camera in calibration.rig.cameras:
        mine = [name for name in calibration.weak if name.rpartition(".")[0] == camera.name]
        if not mine:
            continue
        held = [name for name in mine if name in calibration.held]
        words = ", ".join(name.rpartition(".")[2] for name in mine)
        what = "all held near their start" if len(held) == len(mine) else f"{len(held)} held near their start"
        found.append(
            note(
                "weak-parameter",
                f"camera '{camera.name}': the images hardly determine {words} ({what}); nothing to do where the "
                "residuals are small, else show the target in the image's corners and tilted",
                camera.name,
            )
        )
    return tuple(found)


def distance_correlation(calibration: Calibration, camera: int) -> tuple[float, float]:
    """Return correlation of the principal distance with the camera's position along its axis, and its inflation.

    The inflation is the factor by which the camera's own other parameters increase the variance of the principal
    distance. (0, 1) where either was held.
    """
    one, column = calibration.rig.cameras[camera], principal_distance_column(calibration, camera)
    place = [f"{one.name}.{name}" for name in POSE_NAMES[3:]]
    if column is None or not all(name in calibration.parameters for name in place):
        return 0.0, 1.0
    at = [calibration.parameters.index(name) for name in place]
    axis = one.world_from_camera.rotation[:, 2]
    covariance = calibration.covariance
    along = axis @ covariance[np.ix_(at, at)] @ axis
    both = covariance[column, at] @ axis
    mine = [k for k, name in enumerate(calibration.parameters) if name.rpartition(".")[0] == one.name]
    mine = [*mine, column] if column not in mine else mine
    block = covariance[np.ix_(mine, mine)]
    root = np.sqrt(np.diag(block))
    inverse = np.linalg.pinv(block / np.outer(root, root), rcond=1e-13, hermitian=True)
    place_of_c = mine.index(column)
    return (
        float(both / np.sqrt(max(along * covariance[column, column], 1e-300))),
        float(max(inverse[place_of_c, place_of_c], 1.0)),
    )


def depth_range(calibration: Calibration, camera: int) -> float:
    """Return the spread of the used points along the camera's axis (1 to 99 %), over their mean distance."""
    depth = _depths(calibration, camera)
    if len(depth) == 0:
        return 0.0
    low, high = np.percentile(depth, (1, 99))
    return float((high - low) / np.mean(np.abs(depth)))


def _depths(calibration: Calibration, camera: int) -> Array:
    rows = calibration.used & (calibration.sightings.camera == camera)
    one = calibration.rig.cameras[camera]
    seen = one.world_from_camera.inverse().transform(calibration.points_in_world()[rows])
    return np.asarray(np.linalg.norm(seen, axis=1) if isinstance(one.lens, FisheyeLens) else seen[:, 2])


def _for_lack_of_depth(calibration: Calibration, camera: int, settings: QualityLimits) -> bool:
    held = _principal_distance_name(calibration, camera) in calibration.held
    correlation = abs(distance_correlation(calibration, camera)[0])
    return held or correlation > settings.distance_correlation


def _principal_distance_name(calibration: Calibration, camera: int) -> str:
    column = principal_distance_column(calibration, camera)
    return "" if column is None else calibration.parameters[column]


def _impossible_scale(camera: Camera, settings: QualityLimits) -> str:
    widths = principal_distances_px(camera.lens)[0] / camera.width
    low, high = settings.principal_distance_widths
    if low <= widths <= high:
        return ""
    return (
        f"the principal distance is {widths:.3g} image widths, {low:g} to {high:g} allowed; check the target's "
        f"dimensions and pairs, and {DO_AGAIN} the principal distance"
    )


def _impossible_centre(camera: Camera, settings: QualityLimits) -> str:
    x, y = principal_point_px(camera.lens)
    off_x, off_y = (x + 0.5) / camera.width - 0.5, (y + 0.5) / camera.height - 0.5
    if max(abs(off_x), abs(off_y)) <= settings.principal_point_share:
        return ""
    return (
        f"the principal point ({x:.0f}, {y:.0f}) px lies {abs(off_x):.0%} of the width and {abs(off_y):.0%} of the "
        f"height from the image's middle, {settings.principal_point_share:.0%} allowed; {DO_AGAIN} the principal "
        "point"
    )


def _impossible_aspect(camera: Camera, settings: QualityLimits) -> str:
    off = aspect(camera.lens) - 1
    if abs(off) <= settings.aspect_error:
        return ""
    return (
        f"pixels are {off:+.1%} off square, {settings.aspect_error:.0%} allowed; check the image size and that no "
        f"column is scaled, and {DO_AGAIN} the aspect"
    )


def _impossible_distortion(calibration: Calibration, index: int, settings: QualityLimits) -> list[Finding]:
    """Return a finding where the distortion folds inside the image or moves a corner too far."""
    camera, lens = calibration.rig.cameras[index], calibration.rig.cameras[index].lens
    if _impossible_scale(camera, settings):
        return []
    centre = np.array(principal_point_px(lens))
    grid = image_grid(camera.width, camera.height, camera.width / 24)
    directions = lens_directions(lens, grid)
    with np.errstate(invalid="ignore"):
        back = np.linalg.norm(lens_pixels(lens, np.nan_to_num(directions)) - grid, axis=1)
    folded = ~(back < 0.5)
    rows = calibration.used & (calibration.sightings.camera == index)
    reach = np.linalg.norm(calibration.sightings.xy_px[rows] - centre, axis=1).max(initial=0.0)
    if folded.any():
        radius = float(np.linalg.norm(grid[folded] - centre, axis=1).min())
        # beyond the measured points a fold is harmless, since the lens has no rays there, but it is reported
        raise_ = refuse if radius < reach else note
        return [
            raise_(
                "interior-ran-away",
                f"camera '{camera.name}': the distortion folds back {radius:.0f} px from the principal "
                f"point, inside the image (points were measured out to {reach:.0f} px); show the target out "
                "to the image's corners, or estimate fewer distortion parameters",
                camera.name,
            )
        ]
    if isinstance(lens, FisheyeLens):
        return []  # its corners are moved by design
    tangent = directions[:, :2] / directions[:, 2:]
    f = principal_distances_px(lens)[0]
    ideal = np.linalg.norm(tangent * (f, f * aspect(lens)), axis=1)
    measured = np.linalg.norm(grid - centre, axis=1)
    far = measured > 0.5 * measured.max()
    shift = float(np.maximum(ideal[far] / measured[far], measured[far] / ideal[far]).max()) - 1
    if shift <= settings.corner_shift:
        return []
    return [
        warn(
            "interior-ran-away",
            f"camera '{camera.name}': the distortion moves the image's corners by {shift:.0%}, "
            f"{settings.corner_shift:.0%} allowed; if this is no wide-angle lens, estimate fewer distortion "
            "parameters; if it is one, use the lens model 'fisheye'",
            camera.name,
        )
    ]
