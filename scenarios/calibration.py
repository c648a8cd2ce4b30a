"""The calibration session of a scenario: rendered, read and adjusted as in a lab, then held against the truth."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from mosca.calibrate.estimate import EstimateSettings, calibrate_frames
from mosca.calibrate.interior import LensChoice
from mosca.camera import image_grid, rays
from mosca.data.arrays import Array
from mosca.data.calibration import Calibration
from mosca.data.frames import FrameSource
from mosca.data.rig import Rig
from mosca.data.targets import TestField
from mosca.triangulate import triangulate
from scenarios.spec import Scenario
from scenarios.spec_calibration import CalibrationSpec
from twin.cameras.camera import VirtualCamera
from twin.cameras.lens import TwinLens
from twin.scenes.field_layout import lay_out_field
from twin.scenes.scene import Scene
from twin.scenes.target_field import field_scene
from twin.scenes.target_motion import put_from_stand_to_stand
from twin.source import TwinSource
from twin.streams import rng

SESSION_SEED = 0x5E55
"""Added to the scenario's seed: the session's shake and noise are not those of the measurement."""
VOLUME_GRID = 7


@dataclass(frozen=True, eq=False)
class Estimated:
    """A calibration from rendered images, and how far it is from the truth.

    ``ray_rms_px``, ``ray_max_px``: over all cameras' whole images, between where a place at the working space's
    distance is imaged and where the calibrated rig has it, poses and lenses together. ``volume_rms_m``,
    ``volume_max_m``: of points on a grid in the working space, imaged without noise and triangulated with the rig.
    """

    calibration: Calibration
    ray_rms_px: float
    ray_max_px: float
    volume_rms_m: float
    volume_max_m: float


def estimated(
    spec: Scenario,
    cameras: tuple[VirtualCamera, ...],
    pitch_mm: float,
    workers: int,
    progress: Callable[[int], None] | None = None,
) -> Estimated:
    """Render the session of ``spec.calibration``, calibrate from its frames, and hold the rig against the truth."""
    assert spec.calibration is not None
    fixed = tuple(one for one in cameras if one.mount.body is None)
    scene, target = session(spec, spec.calibration)
    pulses = spec.calibration.frames * spec.calibration.stands
    source: FrameSource = TwinSource(
        scene,
        fixed,
        frame_rate_hz=spec.capture.frame_rate_hz,
        exposure_s=spec.capture.exposure_s,
        pulses=pulses,
        seed=spec.seed + SESSION_SEED,
        workers=workers,
    )
    settings = EstimateSettings(LensChoice(spec.pipeline.lens_model, pitch_mm))
    with source:
        calibration = calibrate_frames(source, target, settings, progress=progress)
    return against_truth(calibration, fixed, spec)


def session(spec: Scenario, wanted: CalibrationSpec) -> tuple[Scene, TestField]:
    """Return the session's scene, and the field as it was measured beforehand: in the world's frame, with errors."""
    draw = rng(spec.seed, "calibration")
    size = np.array(wanted.size_m or spec.working_space.size_m)
    center = np.array(spec.working_space.center_m)
    laid = lay_out_field(size, draw, n=wanted.markers, layout=wanted.layout)
    hold_s = wanted.frames / spec.capture.frame_rate_hz
    path = put_from_stand_to_stand(
        center,
        wanted.stands,
        hold_s,
        lead_s=(1 / spec.capture.frame_rate_hz - spec.capture.exposure_s) / 2,
        shift_m=wanted.shift * size,
        tilt_rad=np.deg2rad(wanted.tilt_deg),
        rng=draw,
    )
    made = field_scene(laid, path, hold_s * wanted.stands, origin=np.zeros(3), floor=False)
    sigma = wanted.known_to * float(size.max())
    measured = tuple(
        replace(one, position=one.position + center + sigma * draw.standard_normal(3))
        for one in laid.field.targets
    )
    return made, TestField(measured, sigma)


def against_truth(calibration: Calibration, cameras: tuple[VirtualCamera, ...], spec: Scenario) -> Estimated:
    """Return how far a calibrated rig is from the cameras as they really are."""
    rig = calibration.rig
    center, size = np.array(spec.working_space.center_m), np.array(spec.working_space.size_m)
    off = np.concatenate([_ray_errors(rig, one, center) for one in cameras])
    axis = np.linspace(-0.5, 0.5, VOLUME_GRID)
    grid = center + size * np.stack(np.meshgrid(axis, axis, axis), -1).reshape(-1, 3)
    xy = np.stack([true_pixels(one, grid) for one in cameras], axis=1)
    found = triangulate(rig, xy)[0]
    away = np.linalg.norm(found - grid, axis=1)
    away = away[np.isfinite(away)]
    return Estimated(
        calibration,
        float(np.sqrt(np.mean(off**2))),
        float(off.max()),
        float(np.sqrt(np.mean(away**2))) if len(away) else np.nan,
        float(away.max(initial=0.0)),
    )


def true_pixels(virtual: VirtualCamera, points: Array) -> Array:
    """Return where a camera really images points (n, 3) [m, world] (n, 2); NaN outside its image."""
    camera = virtual.camera
    lens = TwinLens.of(camera.lens, camera.width, camera.height, virtual.optics)
    xy = lens.pixels(camera.world_from_camera.inverse().transform(points))
    inside = (xy >= -0.5).all(axis=1) & (xy <= np.array([camera.width, camera.height]) - 0.5).all(axis=1)
    return np.asarray(np.where(inside[:, None], xy, np.nan))


def _ray_errors(rig: Rig, virtual: VirtualCamera, center: Array) -> Array:
    """Return the distances (n,) [px] over a camera's image between the truth and the rig's rays.

    At each pixel's own true place at the distance of the working space's centre.
    """
    camera = virtual.camera
    grid = image_grid(camera.width, camera.height)
    pose = camera.world_from_camera
    lens = TwinLens.of(camera.lens, camera.width, camera.height, virtual.optics)
    away = float(np.linalg.norm(pose.translation - center))
    place = pose.transform(away * lens.directions(grid, away))
    seen = rays(rig.camera(camera.name), grid)
    along = np.einsum("ni,ni->n", place - seen.origin, seen.direction)
    across = place - seen.origin - along[:, None] * seen.direction
    error = np.einsum("nki,ni->nk", seen.pixel_by_direction, across) / along[:, None]
    return np.asarray(np.linalg.norm(error[np.isfinite(error).all(axis=1)], axis=1))
