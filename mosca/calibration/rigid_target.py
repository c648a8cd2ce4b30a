"""Calibration from a rigid target with known marks: a test field or a board, fixed or moved by hand.

1. Frame sets between which nothing moved are one *stationary interval* of the target.
2. Each camera's interior orientation starts from its own views (``interior_orientation``), the target's poses
   in the camera frame from ``target_pose``; a pose graph (``pose_graph``) brings all into one world, that of
   the reference interval.
3. One bundle adjustment of all cameras, lenses and target poses at once (Mosca paper, section 2.2), the marks'
   positions fixed, or weighted by their a-priori covariance; blunders are found by data snooping. Before the last
   round the images' centres are corrected for the eccentricity of round marks and the shake of whole images
   (``bundle.exposure_shake``).
"""

from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from mosca.calibration.bundle.exposure_shake import body_shake, shaken_covariance, steadied
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
from mosca.calibration.bundle.systematic_errors import systematic_covariance, systematic_errors
from mosca.calibration.initial.pose_graph import View, chain
from mosca.calibration.initial.target_pose import TargetPoseFit, poses_of
from mosca.calibration.single_camera.interior_orientation import CameraViews, LensChoice, TargetView, starting_camera
from mosca.calibration.targets.stationary_intervals import stationary_intervals
from mosca.camera.eccentricity import eccentricity_px
from mosca.camera.projection import lens_directions
from mosca.data.arrays import Array
from mosca.data.calibration import Calibration
from mosca.data.rig import Camera, Pose, Rig
from mosca.data.sightings import Sightings
from mosca.errors import CalibrationError, InputError

FREE: dict[str, tuple[str, ...]] = {
    "mosca": (
        "c_mm", "xp_px", "yp_px", "my_mm_per_px", "a",
        "K1_per_mm2", "K2_per_mm4", "K3_per_mm6", "P1_per_mm", "P2_per_mm"
    ),
    "opencv": ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "p1", "p2", "k3"),
    "fisheye": ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "k3", "k4")
}  # fmt: skip
"""Lens parameters that are estimated: the Mosca paper's (section 2.2), mx held."""
LEAST_SIGMA_PX = 0.003
"""Least standard deviation of a centre: errors by the mark's shape and light that remain after all corrections."""
SEED = 2002
ECCENTRICITY_ROUNDS = 2
EXACTLY = 1e-6
"""Tolerance of an exact solution: share of its standard deviation by which an unknown may still move."""


@dataclass(frozen=True, eq=False)
class RigidTarget:
    """Marks at ``marks_m`` (m, 3) [m] of a rigid target, known to ``sigma_m`` (0: without error), one
    standard deviation or one for each of the target's axes.

    Flat round marks have ``normals`` (m, 3) and ``radii_m`` (m,), for their images' eccentricity; None for corners.
    ``kind``: name of the kind of target.
    """

    kind: str
    marks_m: Array
    sigma_m: float | Array = 0.0
    normals: Array | None = None
    radii_m: Array | None = None


@dataclass(frozen=True)
class RigidSettings:
    """Settings of a calibration from a rigid target."""

    lens: LensChoice = field(default_factory=LensChoice)
    """Lens model to estimate."""
    free: tuple[str, ...] | None = None
    """Lens parameters to estimate; None for all of the model's."""
    exterior_only: bool = False
    """Hold the lenses of the known rig."""
    reference: int | None = None
    """Frame set in which the target defines the world; None: the first stationary interval."""
    blunder_significance: float | None = 0.01
    """Chance that a good image point is rejected."""
    steady: bool = True
    """Treat shakes of whole images as noise of the cameras' bodies; False where they are the target's motion
    between the exposures of cameras that are not synchronised."""


def calibrate_rigid(
    sightings: Sightings, target: RigidTarget, settings: RigidSettings | None = None, known: Rig | None = None
) -> Calibration:
    """Calibrate the cameras of ``sightings`` from a rigid target.

    ``known``: an earlier calibration to start from; with ``exterior_only`` its lenses are kept. The world is the
    target's frame in the reference interval. CalibrationError, in one line, where the sightings do not suffice.
    """
    settings = settings or RigidSettings()
    sightings = sightings.only(sightings.mark >= 0)
    stand = stationary_intervals(sightings)[sightings.frame]
    seen = _seen(sightings, stand)
    cameras = _starting_cameras(sightings, seen, target, settings, known)
    fits = {view: _poses(cameras[view[0]], one, target) for view, one in seen.items()}
    views = {view: found[0].camera_from_target for view, found in fits.items() if found}
    reference = _reference(sightings, stand, views, settings)
    placed, stands = chain(views, {v: _doubt(fits[v], seen[v]) for v in views}, reference, sightings.cameras)
    cameras = tuple(replace(camera, world_from_camera=placed[k]) for k, camera in enumerate(cameras))
    usable = np.isin(stand, list(stands)) & (np.bincount(stand, minlength=stand.max() + 1)[stand] >= 3)
    sightings, stand = sightings.only(usable), stand[usable]
    numbers = np.array([reference, *sorted(k for k in np.unique(stand) if k != reference)])
    placement = np.searchsorted(numbers[1:], stand) if len(numbers) > 1 else np.zeros(len(stand), np.int64)
    placement = np.where(stand == reference, -1, placement)
    poses = Placements.of([stands[int(k)] for k in numbers[1:]])
    return _adjusted(sightings, placement, poses, cameras, target, settings)


def _adjusted(
    sightings: Sightings,
    placement: Array,
    poses: Placements,
    cameras: tuple[Camera, ...],
    target: RigidTarget,
    settings: RigidSettings,
) -> Calibration:
    held = ObjectPoints.fixed(target.marks_m)
    free = () if settings.exterior_only else settings.free or FREE[cameras[0].lens.model]
    sigma = np.maximum(sightings.sigma_px, LEAST_SIGMA_PX)
    unknowns = tuple(CameraUnknowns(camera, free=_allowed(camera, free)) for camera in cameras)
    bundle = BundleSettings(blunder_significance=settings.blunder_significance)
    xy = sightings.xy_px
    rough = replace(bundle, precision=False, blunder_significance=None, loss="huber")
    problem = Problem(unknowns, Observations(sightings.camera, sightings.mark, xy, placement, sigma), held, poses)
    result = solve(problem, rough)
    for _ in range(ECCENTRICITY_ROUNDS if target.radii_m is not None else 0):
        xy = sightings.xy_px - _eccentricity(result, sightings, placement, target)
        problem = replace(problem, observations=replace(problem.observations, xy_px=xy))
        result = solve(problem, rough, result)
    # shakes can be estimated only after blunders are rejected; and image residuals left by a descent that
    # ended early would be taken for shake
    result = solve(problem, replace(bundle, tolerance=EXACTLY), result)
    shake = body_shake(problem, result, sightings.frame) if settings.steady else 0.0
    steady = steadied(problem, result, sightings.frame, shake)
    problem = replace(problem, observations=replace(problem.observations, xy_px=steady))
    if np.any(np.asarray(target.sigma_m) > 0):
        # only now: with the marks' positions among the unknowns every step costs a hundred times as much
        problem = replace(
            problem,
            points=ObjectPoints.weighted(target.marks_m, np.broadcast_to(target.sigma_m, target.marks_m.shape)),
        )
    result = solve(problem, bundle, result)
    assert result.precision is not None
    covariance = shaken_covariance(problem, result, sightings.frame, shake)
    # a mark in one stationary interval and camera has the same systematic error in each exposure
    seen_as = np.column_stack([sightings.camera, placement, sightings.mark])
    cell = np.unique(seen_as, axis=0, return_inverse=True)[1].reshape(-1)
    lasting = systematic_errors(result, sightings.camera, cell, sigma)
    covariance = covariance + systematic_covariance(problem, result, cell, lasting)
    precision = result.precision
    variance = [np.mean(sigma[result.used & (sightings.camera == k)] ** 2) for k in range(len(cameras))]
    return Calibration(
        Rig(result.cameras),
        target.kind,
        replace(sightings, xy_px=steady),
        result.parameters,
        covariance,
        result.residuals_px,
        result.used,
        result.points,
        placement,
        result.placements.rotation,
        result.placements.translation,
        result.sigma0,
        np.column_stack([precision.sigma_x_px, precision.sigma_y_px]),
        np.column_stack([precision.sigma_x_m, precision.sigma_y_m]),
        result.weak,
        result.held,
        shake,
        f"the {target.kind}'s marks",
        lasting_px=lasting * np.sqrt(variance),
    )


def _allowed(camera: Camera, free: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(name for name in free if hasattr(camera.lens, name) or name == "f_px")


def _eccentricity(result: Adjustment, sightings: Sightings, placement: Array, target: RigidTarget) -> Array:
    """Return the offsets (n, 2) [px] of the centroids of the marks' images from the images of their centres."""
    assert target.normals is not None
    assert target.radii_m is not None
    at, normal = result.points[sightings.mark], np.asarray(target.normals)[sightings.mark]
    moved = placement >= 0
    if moved.any():
        rotation = result.placements.rotation[placement[moved]]
        at, normal = at.copy(), normal.copy()
        at[moved] = np.einsum("nij,nj->ni", rotation, at[moved]) + result.placements.translation[placement[moved]]
        normal[moved] = np.einsum("nij,nj->ni", rotation, normal[moved])
    out = np.zeros((len(at), 2))
    radius = np.asarray(target.radii_m)[sightings.mark]
    for k, camera in enumerate(result.cameras):
        mine = sightings.camera == k
        out[mine] = eccentricity_px(camera, at[mine], normal[mine], radius[mine])
    # a mark that the trial geometry shows from behind is a blunder, but it must not lose its position
    return np.nan_to_num(out)


def _starting_cameras(
    sightings: Sightings,
    seen: dict[View, TargetView],
    target: RigidTarget,
    settings: RigidSettings,
    known: Rig | None,
) -> tuple[Camera, ...]:
    if settings.exterior_only and known is None:
        raise CalibrationError("exterior orientation alone needs the rig whose lenses are to be kept; give it")
    cameras = []
    rngs = np.random.default_rng(SEED).spawn(len(sightings.cameras))
    for k, name in enumerate(sightings.cameras):
        size = (int(sightings.sizes[k, 0]), int(sightings.sizes[k, 1]))
        if known is not None and name in known.names:
            camera = known.camera(name)
            if (camera.width, camera.height) != size:
                raise CalibrationError(
                    f"camera '{name}': images of {size[0]} x {size[1]} px, the known rig has {camera.width} x "
                    f"{camera.height}; use the rig made at this size"
                )
            cameras.append(camera)
            continue
        if settings.exterior_only:
            raise CalibrationError(
                f"camera '{name}' is not in the known rig ({', '.join(known.names if known else ())}); "
                "give the cameras the same names in both"
            )
        views = [one for (camera_k, _), one in seen.items() if camera_k == k]
        shown = CameraViews(name, size, views, target.marks_m)
        cameras.append(starting_camera(shown, settings.lens.of(name), rngs[k]))
    return tuple(cameras)


def _seen(sightings: Sightings, stand: Array) -> dict[View, TargetView]:
    """Return the mean positions of the marks by camera and stationary interval."""
    marks = int(sightings.mark.max(initial=0)) + 1
    key = (sightings.camera * (int(stand.max(initial=0)) + 1) + stand) * marks + sightings.mark
    every, inverse, count = np.unique(key, return_inverse=True, return_counts=True)
    xy = np.column_stack([np.bincount(inverse, sightings.xy_px[:, axis]) for axis in (0, 1)]) / count[:, None]
    view, mark = np.divmod(every, marks)
    camera, at = np.divmod(view, int(stand.max(initial=0)) + 1)
    bounds = np.flatnonzero(np.r_[True, np.diff(view) != 0, True])
    return {(int(camera[i]), int(at[i])): TargetView(mark[i:j], xy[i:j]) for i, j in pairwise(bounds)}


def _poses(camera: Camera, seen: TargetView, target: RigidTarget) -> tuple[TargetPoseFit, ...]:
    return poses_of(lens_directions(camera.lens, seen.xy_px), target.marks_m[seen.mark])


def _doubt(fits: tuple[TargetPoseFit, ...], seen: TargetView) -> float:
    """Return the unreliability of a pose: high with few marks, or if a mirrored pose fits nearly as well."""
    ambiguous = 0.0 if len(fits) < 2 else min(1.0, (fits[0].rms_rad / max(fits[1].rms_rad, 1e-300)) ** 2)
    return 1 / len(seen.mark) + ambiguous**4


def _reference(sightings: Sightings, stand: Array, views: dict[View, Pose], settings: RigidSettings) -> int:
    if settings.reference is not None:
        where = f"reference = {settings.reference} given, but frame set {settings.reference}: the target, which "
        if not 0 <= settings.reference < sightings.frames:
            raise InputError(
                f"{where}was to be the world there, has no images; 0 to {sightings.frames - 1} are allowed, name one "
                "in which it is seen"
            )
        chosen = stand[sightings.frame == settings.reference]
        if len(chosen) == 0:
            raise CalibrationError(f"{where}was to be the world there, was not seen; name a frame set that shows it")
        return int(chosen[0])
    if not views:
        raise CalibrationError(
            "few-views: no camera saw four marks of the target at a time; show it larger or nearer"
        )
    return min(number for _, number in views)
