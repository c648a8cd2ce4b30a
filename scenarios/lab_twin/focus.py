"""Focus and aperture of the cameras' lenses from targets at rest, whose depths the calibrated cameras give."""

from collections.abc import Mapping, Sequence

import numpy as np

from mosca.accuracy.lab_twin.defocus import FEWEST, LEAST_PSF_PX, LEAST_SIGNIFICANCE, Defocus, defocus_of
from mosca.accuracy.lab_twin.estimates import NotTold, ParameterEstimate, Told
from mosca.accuracy.lab_twin.pixel_statistics import PixelStatistics
from mosca.accuracy.lab_twin.target_images import FittedTarget, refitted, sharper
from mosca.camera.projection import project
from mosca.camera.ray_table import make_ray_table
from mosca.correspondence.match import MatchSettings, match
from mosca.data.arrays import Array
from mosca.data.detections import Detections
from mosca.data.rays import Predicted
from mosca.data.rig import Camera, FisheyeLens, Rig
from scenarios.build.camera_library import pitch_and_focal_mm
from scenarios.spec.cameras import Cameras

FOCUS_KEYS = ("optics.focus_m", "optics.f_number")
PSF = "errors.psf_sigma_px"
ROUNDS = 2
"""Rounds of fitting targets with the shares of defocus that the last fits gave."""
NEEDS_RIG = "needs the targets' distances: --rig RIG.toml (mosca calibrate)"
NEEDS_DEPTH = (
    f"needs {FEWEST} targets at rest or more, each seen by two cameras or more, near and far from this camera: their "
    "blur does not change significantly with distance"
)


def depths_m(
    rig: Rig, detections: Mapping[str, Detections], targets: Mapping[str, Sequence[FittedTarget]]
) -> dict[str, Array]:
    """Return the depths of each camera's targets, along its axis, with a fisheye in space [m]; NaN: not known.

    ``detections``: all targets in each camera's mean image; they are matched by epipolar geometry.
    """
    settings = MatchSettings()
    table = make_ray_table(rig, detections, settings.camera_sigma_px, settings.target)
    xyz = np.asarray(match(table, Predicted.nothing(), settings).xyz)
    told = {}
    for name, found in targets.items():
        camera = rig.camera(name)
        image, away = project(camera, xyz), xyz - camera.world_from_camera.translation
        fisheye = isinstance(camera.lens, FisheyeLens)
        depth = np.linalg.norm(away, axis=1) if fisheye else away @ camera.world_from_camera.rotation[:, 2]
        told[name] = np.full(len(found), np.nan)
        for k, one in enumerate(found):
            near = np.flatnonzero(np.hypot(*(image - one.xy_px).T) < one.fit.radius_px)
            if len(near) == 1:
                told[name][k] = depth[near[0]]
    return told


def focused(
    sums: PixelStatistics, targets: Sequence[FittedTarget], depth_m: Array, shake_px: float
) -> tuple[Defocus | None, list[FittedTarget]]:
    """Return the blur over depth, and the targets at known depths fitted with it.

    None, with the targets as they are, where focus and aperture cannot be told.
    """
    known = np.isfinite(depth_m)
    found = [one for one, there in zip(targets, known, strict=True) if there]
    defocus = None
    for k in range(ROUNDS + 1):
        defocus = defocus_of(depth_m[known], np.array([sharper(one, shake_px) for one in found]))
        if defocus is None or not defocus.is_told:
            return None, list(targets)
        if k < ROUNDS:
            found = refitted(sums, found, defocus.share(depth_m[known], shake_px))
    return defocus, found


def with_focus(told: Sequence[Told], camera: Camera | None, defocus: Defocus | None) -> list[Told]:
    """Return a camera's estimates with focus and aperture, and the blur in focus in place of the mean blur.

    The f-number is that of a lens on a sensor of the pixel pitch that a scenario takes by default.
    """
    name = told[0].camera
    if camera is None or defocus is None:
        why = NEEDS_RIG if camera is None else NEEDS_DEPTH
        return [*told, *(NotTold(name, key, why) for key in FOCUS_KEYS)]
    pitch_mm, focal_mm = pitch_and_focal_mm(camera, None, Cameras.model_fields["pixel_pitch_mm"].default)
    values, covariance = defocus.lens(1e-3 * focal_mm, 1e-3 * pitch_mm)
    sigma = np.sqrt(np.diag(covariance))
    what = f"blur of {defocus.targets} targets at rest over their distances, scatter {defocus.scatter_px:.3f} px"
    least = f", not above {LEAST_PSF_PX} px by {LEAST_SIGNIFICANCE:g} standard deviations" if sigma[0] == 0.0 else ""
    evidence = (what + least, what, f"{what}; for a pixel pitch of {1e3 * pitch_mm:.4g} um")
    keys, made = (PSF, *FOCUS_KEYS), []
    for k, key in enumerate(keys):
        pairs = [(keys[j], covariance[k, j] / sigma[k] / sigma[j]) for j in range(k) if sigma[j] > 0.0]
        beside = tuple((other, float(np.clip(value, -1.0, 1.0))) for other, value in pairs)
        made.append(ParameterEstimate(name, key, float(values[k]), float(sigma[k]), evidence[k], beside))
    return [*(one for one in told if one.key != PSF), *made]
