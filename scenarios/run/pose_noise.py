"""Errors of the poses of a scenario's rig, from a few rendered frames and the rig's calibration."""

from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np

from mosca.data.arrays import Array
from mosca.diagnostics.camera_health import Health
from mosca.errors import InputError
from mosca.pipeline import run
from scenarios.build.cameras import calibrated, true_rig, twin_source, virtual_cameras
from scenarios.build.scene import build_scene, pipeline_settings
from scenarios.flight.loop import steered_point
from scenarios.flight.predicted import PoseNoise
from scenarios.run.kept_calibrations import kept
from scenarios.session.estimated import SessionCalibration, calibrate_in_session, inputs_of
from scenarios.spec.scenario import Scenario

SETS = 24
"""Number of frame sets rendered, over the whole flight."""
NEAR_PX = 3.0
"""Largest distance of a marker's detection from its true image."""


def shared_error_m2(spec: Scenario, own: SessionCalibration | None) -> Array:
    """Return the covariance (3, 3) [m^2] of the error that the calibration gives all poses, at the space's centre."""
    if own is None:
        return np.zeros((3, 3))
    found: Array = own.covariance_m2(np.array([spec.working_space.center_m]))[0]
    return found


def pose_noise(spec: Scenario, folder: Path, workers: int) -> PoseNoise:
    """Return the errors of the scenario's poses: its rig is calibrated, and a few frame sets are rendered.

    The standard deviation of a marker's image is that stated by detection (median of the sets), and infinite where it
    was detected in less than half of them. The error that a camera's images share is the pipeline's estimate of
    errors besides detection noise (``mosca.diagnostics.noise_model``).
    """
    cameras = virtual_cameras(spec, true_rig(spec, folder))
    known, own = calibrated(spec, cameras), None
    if spec.session is not None:
        own = kept(
            inputs_of(spec, cameras, known.rig), lambda: calibrate_in_session(spec, cameras, known.rig, workers)
        )
    rig = known.rig if own is None else own.calibration.rig
    rate_hz = SETS / spec.capture.duration_s
    slow = spec.model_copy(
        update={"capture": spec.capture.model_copy(update={"frame_rate_hz": rate_hz}), "flight": None}
    )
    scene = build_scene(slow, folder)
    found: list[Array] = []
    with twin_source(slow, scene, cameras, workers) as source:
        settings = replace(pipeline_settings(slow), lookahead=SETS)
        health = Health.of(rig, settings.match)
        steps = list(islice(run(source, rig, settings, health=health), SETS))
        truth = source.truth()
    for step in steps:
        sigma = np.full((len(truth.names), len(rig.cameras)), np.inf)
        for c, camera in enumerate(rig.cameras):
            seen = step.detections[camera.name]
            for m, true in enumerate(truth.image_xy_px[step.frame_set.pulse, :, c]):
                away = np.linalg.norm(seen.xy_px - true, axis=1)
                if len(away) and np.isfinite(true).all() and away.min() < NEAR_PX:
                    sigma[m, c] = np.sqrt(np.trace(seen.covariance_px2[away.argmin()]) / 2)
        found.append(sigma)
    if not found:
        raise InputError("flight: no frame set came to measure the noise of the images")
    sampled = scene.sampler().at(0.0).marker_xyz
    markers = sampled - sampled.mean(axis=0) - steered_point(scene)
    return PoseNoise(rig, markers, np.median(found, axis=0), health.noise.sigma_px, shared_error_m2(spec, own))
