"""Check of planes seen with little perspective: does the mirrored pose fit as well?

Under weak perspective a plane and its reflection in the plane across the line of sight have the same image
(Oberkampf, DeMenthon and Davis 1996; Schweighofer and Pinz 2006). Sufficient perspective distinguishes them.
"""

from dataclasses import dataclass, replace

import numpy as np

from mosca.calibration.quality.findings import note, refuse, warn
from mosca.calibration.quality.limits import QualityLimits
from mosca.calibration.single_camera.least_squares import ROUGHLY_CONVERGED, fit_camera
from mosca.data.arrays import Array
from mosca.data.calibration import Calibration, Finding
from mosca.data.distributions import f as f_distribution
from mosca.data.rig import Camera, Pose

FEWEST_POINTS = 4
MOST_FRAMES = 60
"""Largest number of placements examined for a camera, evenly chosen."""


@dataclass(frozen=True)
class MirroredPose:
    """The second pose of a camera before a plane.

    ``turn_rad`` from the first; ``ratio`` of the two weighted sums of squares (second over first); ``chance``
    that a difference as large comes from noise.
    """

    turn_rad: float
    ratio: float
    chance: float


def mirrored_poses(calibration: Calibration, settings: QualityLimits) -> tuple[Finding, ...]:
    """Return the cameras and frames whose mirrored pose cannot be distinguished from the one taken."""
    found: list[Finding] = []
    world = calibration.points_in_world()
    tied = _tied(calibration)
    for k, camera in enumerate(calibration.rig.cameras):
        mine = calibration.used & (calibration.sightings.camera == k)
        rows = np.flatnonzero(mine & tied)
        if len(rows):
            mirror = second_pose(calibration, camera, rows, world[rows], settings)
            if mirror is not None and mirror.chance > settings.mirror_significance:
                found.append(refuse("mirrored-pose", _camera_text(camera, mirror, settings), camera.name))
                continue
        found += _alone(calibration, k, mine & ~tied, bool(len(rows)), settings)
    return tuple(found)


def second_pose(
    calibration: Calibration, camera: Camera, rows: Array, points: Array, settings: QualityLimits
) -> MirroredPose | None:
    """Return the mirrored pose of ``camera`` before ``points`` (n, 3) seen as sightings ``rows`` (n,).

    The lens is held. None where the points are no plane, or there is no second pose.
    """
    if len(np.unique(points, axis=0)) < FEWEST_POINTS:
        return None
    middle = points.mean(axis=0)
    _, sizes, axes = np.linalg.svd(points - middle, full_matrices=False)
    if sizes[2] > settings.mirror_relief * sizes[1] or sizes[1] < 0.01 * sizes[0]:
        return None
    start = _mirrored(camera, middle, axes[2])
    xy = calibration.sightings.xy_px[rows]
    sigma = calibration.sightings.sigma_px[rows]
    weights = 1.0 / sigma**2
    here = fit_camera(camera, (), xy, points, weights, ROUGHLY_CONVERGED)
    there = fit_camera(start, (), xy, points, weights, ROUGHLY_CONVERGED)
    turn = here.camera.world_from_camera.rotation.T @ there.camera.world_from_camera.rotation
    angle = float(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)))
    if angle < settings.mirror_turn_rad:
        return None
    freedom = max(2 * len(rows) - 6, 1)
    variance = max(here.cost / freedom, calibration.sigma0**2, 1e-12)
    # cost of the other pose, against the noise: F with 1 and all degrees of freedom
    total = max(2 * int(calibration.used.sum()) - len(calibration.parameters), 1)
    statistic = max(there.cost - here.cost, 0.0) / variance
    chance = float(f_distribution.sf(statistic, 1, total))
    return MirroredPose(angle, float(there.cost / max(here.cost, 1e-300)), chance)


def _mirrored(camera: Camera, middle: Array, normal: Array) -> Camera:
    """Return the camera that sees the plane through ``middle`` mirrored across the line of sight."""
    pose = camera.world_from_camera
    sight = middle - pose.translation
    sight = sight / np.linalg.norm(sight)
    # two reflections make a rotation: one across the line of sight, and one in the plane, which leaves it unchanged
    turn = (np.eye(3) - 2 * np.outer(sight, sight)) @ (np.eye(3) - 2 * np.outer(normal, normal))
    centre = middle + turn.T @ (pose.translation - middle)
    return replace(camera, world_from_camera=Pose(turn.T @ pose.rotation, centre))


def _tied(calibration: Calibration) -> Array:
    """Return which sightings (n,) are of points that another camera also determines."""
    count = len(calibration.target_translation)
    rows = calibration.used & (calibration.placement >= 0)
    seen = np.zeros((count, len(calibration.rig.cameras)), dtype=bool)
    seen[calibration.placement[rows], calibration.sightings.camera[rows]] = True
    shared = seen.sum(axis=1) >= 2
    if count == 0:
        return np.ones(len(calibration.placement), dtype=bool)
    return np.asarray((calibration.placement < 0) | shared[calibration.placement])


def _alone(calibration: Calibration, index: int, mine: Array, tied: bool, settings: QualityLimits) -> list[Finding]:
    """Return findings on the placements that only this camera saw."""
    camera = calibration.rig.cameras[index]
    frames = np.unique(calibration.placement[mine])
    frames = frames[:: max(1, -(-len(frames) // MOST_FRAMES))]
    open_ones = []
    for frame in frames:
        rows = np.flatnonzero(mine & (calibration.placement == frame))
        target = Pose(calibration.target_rotation[frame], calibration.target_translation[frame])
        seen_from = replace(camera, world_from_camera=target.inverse() @ camera.world_from_camera)
        points = calibration.marks_m[calibration.sightings.mark[rows]]
        mirror = second_pose(calibration, seen_from, rows, points, settings)
        if mirror is not None and mirror.chance > settings.mirror_significance:
            open_ones.append(mirror)
    if not open_ones:
        return []
    text = (
        f"camera '{camera.name}': in {len(open_ones)} of {len(frames)} views of the plane its mirrored pose "
        f"(turned by {np.degrees(np.median([m.turn_rad for m in open_ones])):.0f} deg) fits as well; come nearer or "
        "tilt the plane by 20 deg and more"
    )
    if len(open_ones) == len(frames) and not tied:
        return [refuse("mirrored-pose", text, camera.name)]
    raise_ = warn if 2 * len(open_ones) > len(frames) and not tied else note
    return [raise_("mirrored-pose", text, camera.name)]


def _camera_text(camera: Camera, mirror: MirroredPose, settings: QualityLimits) -> str:
    return (
        f"camera '{camera.name}': it saw a plane so flatly that the mirrored pose, turned by "
        f"{np.degrees(mirror.turn_rad):.0f} deg, fits as well (sum of squares {mirror.ratio:.3g} times that of the "
        f"one taken, by chance with p = {mirror.chance:.1g}, {settings.mirror_significance:g} allowed); show the "
        "target at two tilts, or one with depth"
    )
