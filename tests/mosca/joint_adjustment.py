"""All cameras of a rig adjusted together to known points that were measured in their images.

The single cameras' adjustment (``adjust``) holds the points. All cameras together can also determine errors of the
points: each may be off by ``point_sigma_m``, and a flat target that was moved along a traverse may have a small shift
and rotation at each of its stations (``StandError``). Errors common to all cameras are the target's, since one
camera's lens cannot explain them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mosca.calibration.bundle.solver import (
    Adjustment,
    BundleSettings,
    CameraUnknowns,
    ObjectPoints,
    Observations,
    Placements,
    Problem,
    solve,
)
from mosca.calibration.initial.resection import aim, resect
from mosca.data.arrays import Array
from mosca.data.files.target_file import MeasuredPoints
from mosca.data.rig import Camera, Lens, MoscaLens, OpenCVLens, Pose
from mosca.errors import InputError


@dataclass(frozen=True)
class StandError:
    """Standard errors of the poses of a target on a traverse along ``axis`` (0, 1, 2: x, y, z).

    Of each station's rotation about x, y, z ``turn_rad`` and shift ``shift_m`` along x, y, z, above 0.
    """

    axis: int
    turn_rad: float
    shift_m: tuple[float, float, float]


def resected_camera(
    name: str,
    size: tuple[int, int],
    model: str,
    measured: MeasuredPoints,
    rng: np.random.Generator,
    pixel_pitch_mm: float = 0.01,
) -> Camera:
    """Return a camera without distortion, its principal point in the middle of the image, to start from.

    ``model``: opencv or mosca. CalibrationError where the points do not determine it; InputError for another model.
    """
    first = resect(f"camera '{name}'", measured.xy_px, measured.xyz, rng)
    centre = ((size[0] - 1) / 2, (size[1] - 1) / 2)
    fx, fy = first.lens.fx_px, first.lens.fy_px
    lens: Lens
    if model == "opencv":
        lens = OpenCVLens(fx, fy, *centre)
    elif model == "mosca":
        lens = MoscaLens(fx * pixel_pitch_mm, *centre, pixel_pitch_mm, pixel_pitch_mm * fx / fy)
    else:
        raise InputError(f"camera '{name}': lens model '{model}' given; opencv and mosca are adjusted together")
    return Camera(name, *size, lens, aim(first, centre))


def adjust_together(
    cameras: Sequence[Camera],
    measured: Sequence[MeasuredPoints],
    free: Sequence[str],
    sigma_px: float = 1.0,
    point_sigma_m: float = 0.0,
    stands: StandError | None = None,
    settings: BundleSettings | None = None,
) -> Adjustment:
    """Adjust pose and the ``free`` lens parameters of all cameras to what each of them measured.

    Points of the same coordinates are one point. ``sigma_px``: of an image coordinate; ``point_sigma_m``: of the
    points' coordinates, 0 holds them. The result's ``points`` are in the order of ``distinct_points``; with
    ``stands`` in their stand's frame, whose origin is ``stand_centres`` and which starts parallel to the world, and
    ``placements`` are the stands' poses. CalibrationError where the points do not determine a camera.
    """
    points, index = distinct_points(measured)
    camera = np.repeat(np.arange(len(cameras)), [len(one.xy_px) for one in measured])
    placements, stand_of, local = _standing(points, stands)
    observations = Observations(
        camera,
        index,
        np.concatenate([one.xy_px for one in measured]),
        stand_of[index] if stands is not None else None,
        sigma_px,
    )
    known = ObjectPoints.weighted(local, point_sigma_m) if point_sigma_m > 0 else ObjectPoints.fixed(local)
    unknowns = tuple(CameraUnknowns(one, free=tuple(free)) for one in cameras)
    return solve(Problem(unknowns, observations, known, placements), settings)


def distinct_points(measured: Sequence[MeasuredPoints]) -> tuple[Array, Array]:
    """Return the distinct points (p, 3) [m] of all cameras and, camera after camera, each measurement's index."""
    points, index = np.unique(np.concatenate([one.xyz for one in measured]), axis=0, return_inverse=True)
    return points, np.asarray(index).reshape(-1)


def stand_centres(points: Array, axis: int) -> tuple[Array, Array]:
    """Return the middle of each stand (s, 3) [m] of points (p, 3), and each point's stand (p,)."""
    _, stand = np.unique(points[:, axis], return_inverse=True)
    count = np.bincount(stand)
    return np.column_stack([np.bincount(stand, points[:, k]) / count for k in range(3)]), stand


def _standing(points: Array, stands: StandError | None) -> tuple[Placements, Array, Array]:
    """Return the stands' poses, each point's stand and the points in their stand's frame."""
    if stands is None:
        return Placements(np.zeros((0, 3, 3)), np.zeros((0, 3))), np.full(len(points), -1), points
    centres, stand = stand_centres(points, stands.axis)
    sigma = np.array([stands.turn_rad] * 3 + list(stands.shift_m))
    poses = [Pose(np.eye(3), centre) for centre in centres]
    placements = Placements.of(poses, np.tile(sigma, (len(poses), 1)))
    return placements, stand, points - centres[stand]
