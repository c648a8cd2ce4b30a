"""The calibration session of a scenario: rendered, read and adjusted as in a lab, then compared with the truth."""

from dataclasses import dataclass, replace

import numpy as np

from mosca.calibration.quality.point_covariance import calibration_covariance
from mosca.calibration.session import EstimateSettings, Shown, Target_co, calibrate_session
from mosca.calibration.single_camera.interior_orientation import LensChoice
from mosca.camera.projection import image_grid, inside_image, project, rays
from mosca.data.arrays import Array
from mosca.data.calibration import Calibration
from mosca.data.calibration_evidence import CalibrationEvidence
from mosca.data.files.target_tables import CalibrationTarget
from mosca.data.rig import Rig
from mosca.triangulation.triangulate import triangulate
from scenarios.session.faults import swapped, turned
from scenarios.session.scenes import Session, axes_session, bar_session, target_session
from scenarios.spec.calibration import MovedCameraFault, SwappedSessionFault
from scenarios.spec.scenario import Scenario
from scenarios.types import Score
from twin.cameras.exposure.mount import Mount
from twin.cameras.optics.lens import TwinLens
from twin.cameras.virtual_camera import VirtualCamera
from twin.source import TwinSource

SESSION_SEED = 0x5E55
"""Added to the scenario's seed, so that the session's shake and noise are not those of the measurement."""
VOLUME_GRID = 7
AT_ONCE = 2000
"""Number of points whose covariance by the calibration is computed at once: 2,000 of 200 parameters fill 10 MB."""


@dataclass(frozen=True, eq=False)
class SessionCalibration:
    """A calibration from rendered images, and its errors."""

    calibration: Calibration
    evidence: CalibrationEvidence
    ray_px: Array
    """(n,) over the whole images of all cameras: distance of the calibrated ray of a pixel from the point that the
    pixel really shows, at the working space's distance; poses and lenses together."""
    volume_m: Array
    """(k,) errors of points on a grid in the working space, imaged without noise and triangulated with the rig."""

    def scores(self) -> dict[str, Score]:
        """Return the metrics of the calibration."""
        sigma = np.sqrt(np.mean(np.asarray(self.calibration.sigma_m) ** 2, axis=0))
        return {
            "calibration_rays_rms": _score(np.sqrt(np.mean(self.ray_px**2)), len(self.ray_px)),
            "calibration_volume_rms": _score(np.sqrt(np.mean(self.volume_m**2)), len(self.volume_m)),
            "calibration_sigma_x": _score(sigma[0], len(self.calibration.used)),
            "calibration_sigma_y": _score(sigma[1], len(self.calibration.used)),
        }

    def covariance_m2(self, xyz: Array) -> Array:
        """Return the covariance (n, 3, 3) [m^2] that the calibration's own error gives to points (n, 3) [m, world].

        All cameras whose images contain a point are assumed to have measured it, equally well; 0 for fewer than two.
        """
        found = [np.zeros((0, 3, 3))]
        for first in range(0, len(xyz), AT_ONCE):
            some = xyz[first : first + AT_ONCE]
            seen = np.column_stack([inside_image(one, project(one, some)) for one in self.calibration.rig.cameras])
            found.append(np.nan_to_num(calibration_covariance(self.calibration, some, seen)))
        return np.concatenate(found)


def _score(value: float, n: int) -> Score:
    return Score(float(value), n, None)


def calibrate_in_session(
    spec: Scenario, cameras: tuple[VirtualCamera, ...], earlier: Rig, workers: int
) -> SessionCalibration:
    """Render the session of ``spec.calibration``, calibrate from it, judge the result and compare it with the truth.

    ``earlier``: the true calibration, used as the earlier calibration where the scenario has one. CalibrationError
    where the session is insufficient.
    """
    wanted = spec.calibration
    assert wanted is not None
    fixed = at_rest(cameras)
    fault = wanted.fault
    if isinstance(fault, MovedCameraFault):
        fixed = turned(fixed, fault.camera, fault.turn_px)
    center, size = np.array(spec.working_space.center_m), np.array(spec.working_space.size_m)
    settings = EstimateSettings(
        _lens_choice(spec, fixed),
        exterior_only=wanted.exterior_only,
        volume=((center - size / 2).tolist(), (center + size / 2).tolist()),
    )
    held = wanted.earlier or wanted.exterior_only
    known = earlier if held or isinstance(fault, SwappedSessionFault | MovedCameraFault) else None

    def shown(session: Session[Target_co], number: int) -> Shown[Target_co]:
        return Shown(session.target, lambda _: session_source(spec, session, fixed, workers, number))

    field = shown(target_session(spec, wanted), 0)
    main = field
    if isinstance(fault, SwappedSessionFault):
        main = Shown(field.target, lambda rig: swapped(field.opened(rig), fault.cameras))
    calibration, evidence = calibrate_session(
        main,
        settings,
        axes=shown(axes_session(spec), 1) if wanted.target != "field" else None,
        lengths=shown(bar_session(spec), 2) if wanted.lengths else None,
        known=known,
        made_from=f"rendered images of a {wanted.target}, seed {spec.seed}",
    )
    ray_px, volume_m = against_truth(calibration.rig, fixed, center, size)
    return SessionCalibration(calibration, evidence, ray_px, volume_m)


def inputs_of(spec: Scenario, cameras: tuple[VirtualCamera, ...], earlier: Rig) -> tuple[object, ...]:
    """Return all inputs of the session's calibration: all of the scenario that ``calibrate_in_session`` reads."""
    exposure_s, lens_model = spec.capture.exposure_s, spec.pipeline.lens_model
    return spec.calibration, spec.working_space, exposure_s, lens_model, spec.seed, at_rest(cameras), earlier


def at_rest(cameras: tuple[VirtualCamera, ...]) -> tuple[VirtualCamera, ...]:
    """Return the cameras fixed in the room as they are in the session, before the measurement.

    Lenses, sensors and shake are the same; there is no drift, warming or bump yet, no delay, the background is even,
    and the light is that of the target.
    """
    return tuple(
        VirtualCamera(
            one.camera,
            replace(one.optics, principal_distance_ppm_per_s=0.0, principal_point_px_per_s=(0.0, 0.0)),
            mount=Mount(body_px=one.mount.body_px),
            sensor=one.sensor,
        )
        for one in cameras
        if one.mount.body is None
    )


def against_truth(rig: Rig, cameras: tuple[VirtualCamera, ...], center: Array, size: Array) -> tuple[Array, Array]:
    """Return the errors of rays (n,) [px] and of points in the working space (k,) [m]; see ``SessionCalibration``."""
    off = np.concatenate([_ray_errors(rig, one, center) for one in cameras])
    axis = np.linspace(-0.5, 0.5, VOLUME_GRID)
    grid = center + size * np.stack(np.meshgrid(axis, axis, axis), -1).reshape(-1, 3)
    xy = np.stack([true_pixels(one, grid) for one in cameras], axis=1)
    away = np.asarray(np.linalg.norm(triangulate(rig, xy)[0] - grid, axis=1))
    return off, away[np.isfinite(away)]


def true_pixels(virtual: VirtualCamera, points: Array) -> Array:
    """Return the true images (n, 2) [px] of points (n, 3) [m, world]; NaN outside the camera's image."""
    camera = virtual.camera
    lens = TwinLens.of(camera.lens, camera.width, camera.height, virtual.optics)
    xy = lens.pixels(camera.world_from_camera.inverse().transform(points))
    end = np.array([camera.width, camera.height]) - 0.5
    xy[((xy < -0.5) | (xy > end)).any(axis=1)] = np.nan
    return xy


def _ray_errors(rig: Rig, virtual: VirtualCamera, center: Array) -> Array:
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


def session_source(
    spec: Scenario, session: Session[CalibrationTarget], cameras: tuple[VirtualCamera, ...], workers: int, number: int
) -> TwinSource:
    """Return the frames of a session before ``cameras``; ``number``: 0 for target, 1 for axes, 2 for bar."""
    assert spec.calibration is not None
    return TwinSource(
        session.scene,
        cameras,
        frame_rate_hz=spec.calibration.rate_hz,
        exposure_s=spec.capture.exposure_s,
        pulses=session.pulses,
        seed=spec.seed + SESSION_SEED + number,
        workers=workers,
    )


def _lens_choice(spec: Scenario, cameras: tuple[VirtualCamera, ...]) -> LensChoice:
    """Return the lens model with the pixel pitches of the sensors' data sheets (mx of Mosca lenses)."""
    pitches = {one.camera.name: one.optics.pixel_pitch_mm for one in cameras}
    return LensChoice(spec.pipeline.lens_model, own_pitch_mm=pitches)
