"""Cameras of a scenario: the true rig, the virtual cameras, the calibration that the pipeline gets."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mosca.camera.projection import Conversion, fit_lens, image_grid, lens_directions
from mosca.data.files.rig_file import read_rig
from mosca.data.files.toml import Table
from mosca.data.rig import Camera, FisheyeLens, Lens, MoscaLens, Rig
from mosca.errors import InputError
from scenarios.build.camera_library import (
    CHIP_KEYS,
    check_fits,
    named_lens,
    named_sensor,
    pitch_and_focal_mm,
    with_chip,
)
from scenarios.build.camera_ring import check_rig, ring, sees, windowed
from scenarios.build.scene import beside
from scenarios.build.worn_lamps import rider_pose
from scenarios.spec.cameras import CameraSpec, ErrorsSpec
from scenarios.spec.faults import ClockFault
from scenarios.spec.scenario import Scenario
from scenarios.spec.unused_keys import check_no_unused_keys
from twin.cameras.delivery import Delivery
from twin.cameras.exposure.mount import Mount
from twin.cameras.exposure.shutter import Timing
from twin.cameras.optics.blur_parameters import Optics
from twin.cameras.optics.lens import GAPS, TwinLens
from twin.cameras.sensor.background_light import Backdrop
from twin.cameras.sensor.sensor import Sensor
from twin.cameras.stray_light.context_image import Cloth, Context
from twin.cameras.stray_light.glare import Glare
from twin.cameras.stray_light.mirror import PlaneMirror
from twin.cameras.stray_light.stray import Surroundings
from twin.cameras.stray_light.world import RingLight, ShinySpot
from twin.cameras.virtual_camera import VirtualCamera
from twin.scenes.scene import Scene
from twin.source import LOOK_AHEAD, TwinSource


@dataclass(frozen=True, eq=False)
class Calibrated:
    """The rig that the pipeline gets, and the misfit of its lens model: rms over the cameras [px]."""

    rig: Rig
    gap_rms_px: float
    gap_max_px: float


def true_rig(spec: Scenario, folder: Path) -> Rig:
    """Return the true rig; InputError where it cannot measure."""
    if spec.cameras.rig is not None:
        rig = read_rig(beside(spec.cameras.rig, folder))
    else:
        rig = ring(with_chip(spec), spec.working_space)
    windows = {camera.name: camera.window_px for camera in spec.camera if camera.window_px is not None}
    rig = Rig(tuple(windowed(c, windows[c.name]) if c.name in windows else c for c in rig.cameras))
    check_rig(rig, spec.working_space)
    return rig


def virtual_cameras(spec: Scenario, rig: Rig) -> tuple[VirtualCamera, ...]:
    """Return the rig's cameras, then those on bodies, with all their settings in the scenario."""
    names = [camera.name for camera in spec.camera]
    for camera in spec.camera:
        if names.count(camera.name) > 1:
            raise InputError(f"[[camera]] name = '{camera.name}' stands twice; say all of it in one table")
        if camera.body is None and camera.name not in rig.names:
            raise InputError(
                f"[[camera]] name = '{camera.name}': the rig has {', '.join(rig.names)}; "
                "a new camera needs the body that it rides on"
            )
        if camera.body is not None and camera.name in rig.names:
            raise InputError(
                f"[[camera]] name = '{camera.name}' rides on '{camera.body}', but the rig has a camera of that name; "
                "give it another one"
            )
    late = dict.fromkeys(spec.fault.cameras, spec.fault.delay_s) if isinstance(spec.fault, ClockFault) else {}
    for name in late:
        rig.camera(name)
    riders = [_rider(camera, spec) for camera in spec.camera if camera.body is not None]
    return tuple(
        _virtual(camera, _own(spec, camera.name), spec, late.get(camera.name, 0.0))
        for camera in (*rig.cameras, *riders)
    )


def twin_source(spec: Scenario, scene: Scene, cameras: tuple[VirtualCamera, ...], workers: int) -> TwinSource:
    """Return the scenario's twin source with the cameras that film ``scene``."""
    return TwinSource(
        scene,
        cameras,
        frame_rate_hz=spec.capture.frame_rate_hz,
        exposure_s=spec.capture.exposure_s,
        pulses=spec.capture.pulses,
        seed=spec.seed,
        workers=workers,
        deliveries=deliveries(spec, (v.camera.name for v in cameras)),
        surroundings=surroundings(spec),
        look_ahead=LOOK_AHEAD if spec.flight is None else 0,
    )


def deliveries(spec: Scenario, names: Iterable[str]) -> dict[str, Delivery]:
    """Return the faults in the delivery of each camera's frames."""
    return {name: Delivery(**_merged(spec.delivery, _own(spec, name).delivery)) for name in names}


def surroundings(spec: Scenario) -> Surroundings:
    """Return the surroundings of rig and subject."""
    given = spec.surroundings
    context = None
    if given.context is not None:
        keys = given.context.model_dump()
        context = Context(**{**keys, "clothes": tuple(Cloth(**cloth) for cloth in keys["clothes"])})
    return Surroundings(
        context,
        None if given.ring_light is None else RingLight(**given.ring_light.model_dump()),
        tuple(ShinySpot(**spot.model_dump()) for spot in given.spots),
        tuple(PlaneMirror(**mirror.model_dump()) for mirror in given.mirrors),
        Glare(**given.glare.model_dump()),
    )


def _own(spec: Scenario, name: str) -> CameraSpec:
    for camera in spec.camera:
        if camera.name == name:
            return camera
    return CameraSpec(name=name)


def _merged(common: Table, own: Table) -> dict[str, Any]:
    """Return the common table, overridden by the keys that the camera's own table sets."""
    return {**common.model_dump(), **own.model_dump(exclude_unset=True)}


def _virtual(camera: Camera, own: CameraSpec, spec: Scenario, late_s: float) -> VirtualCamera:
    errors = ErrorsSpec(**_merged(spec.errors, own.errors))
    optics, timing = _merged(spec.optics, own.optics), _merged(spec.timing, own.timing)
    sensor = _merged(spec.sensor, own.sensor) | {
        key: getattr(errors, key) for key in ("full_well_e", "read_noise_e", "bits", "background_e")
    }
    chip, lens = named_sensor(sensor.pop("name")), named_lens(optics.pop("lens"))
    if chip is not None:
        given_keys = {
            key
            for table in (spec.errors, own.errors, spec.sensor, own.sensor, spec.timing, own.timing)
            for key in table.model_fields_set
        }
        sensor |= {key: getattr(chip, key) for key in CHIP_KEYS if key not in given_keys}
        if "row_time_s" not in given_keys:
            timing["row_time_s"] = chip.row_time_s
    mount, delivery = _merged(spec.mount, own.mount), _merged(spec.delivery, own.delivery)
    check_no_unused_keys(camera.name, {"timing": timing, "mount": mount, "delivery": delivery})
    pitch_mm, f_mm = pitch_and_focal_mm(camera, chip, spec.cameras.pixel_pitch_mm)
    rate_hz = timing["rate_hz"] or spec.capture.frame_rate_hz
    check_fits(camera, chip, lens, pitch_mm, optics["f_number"], rate_hz)
    if lens is not None:
        f_mm = lens.focal_length_mm
    if optics["focus_m"] is not None and optics["focus_m"] <= f_mm * 1e-3:
        raise InputError(
            f"camera '{camera.name}': optics.focus_m = {optics['focus_m']:g} given; farther than the focal length, "
            f"{f_mm * 1e-3:g} m, is wanted"
        )
    gap = GAPS[spec.model_gap]
    for key in ("tilt_deg", "pupil_shift_m"):
        if optics[key] is None:
            optics[key] = getattr(gap, key)
    timing["delay_s"] += late_s
    return VirtualCamera(
        camera,
        Optics(psf_sigma_px=errors.psf_sigma_px, gap_px=gap.gap_px, f_mm=f_mm, pixel_pitch_mm=pitch_mm, **optics),
        Timing(jitter_s=errors.trigger_jitter_s, **timing),
        Mount(body_px=errors.body_px, body=own.body, **mount),
        Sensor(**sensor),
        errors.marker_signal,
        Backdrop(**spec.surroundings.backdrop.model_dump()),
    )


def _rider(own: CameraSpec, spec: Scenario) -> Camera:
    """Return a camera on a body; its pose is ``body_from_camera``."""
    pose = rider_pose(own)
    assert own.size_px is not None
    width, height = own.size_px
    middle = ((width - 1) / 2, (height - 1) / 2)
    if own.fisheye_deg is not None:
        scale = width / np.deg2rad(own.fisheye_deg)
        lens: Lens = FisheyeLens(scale, scale, *middle)
    else:
        assert own.c_mm is not None
        chip = named_sensor(own.sensor.name or spec.sensor.name)
        pitch = spec.cameras.pixel_pitch_mm if chip is None else chip.pixel_pitch_um * 1e-3
        lens = MoscaLens(own.c_mm, *middle, pitch, pitch)
    camera = Camera(own.name, width, height, lens, pose)
    return camera if own.window_px is None else windowed(camera, own.window_px)


def calibrated(spec: Scenario, cameras: tuple[VirtualCamera, ...]) -> Calibrated:
    """Return the true calibration: true poses, and the pipeline's lens model fitted to the true lenses' rays.

    The rays are those to the distance of the working space's centre. Cameras on bodies have no constant pose in the
    world and are left out.
    """
    standing = tuple(v for v in cameras if v.mount.body is None)
    return fitted_cameras(spec, standing, None)


def fitted_cameras(spec: Scenario, cameras: tuple[VirtualCamera, ...], away_m: float | None) -> Calibrated:
    """Return ``cameras`` with the pipeline's lens model fitted to their true rays, to ``away_m`` [m].

    ``away_m`` None: to the distance of the working space's centre.
    """
    made, fits = [], []
    for virtual in cameras:
        camera = virtual.camera
        center = np.array(spec.working_space.center_m)
        away = np.linalg.norm(camera.world_from_camera.translation - center) if away_m is None else away_m
        fit = _fitted(virtual, spec.pipeline.lens_model, float(away))
        # on each axis: the misfit is a distance in the image
        made.append(replace(camera, lens=fit.lens, residual_px=fit.rms_px / np.sqrt(2)))
        fits.append(fit)
    rms = float(np.sqrt(np.mean([f.rms_px**2 for f in fits])))
    return Calibrated(Rig(tuple(made)), rms, max(f.max_px for f in fits))


def overlap_of(camera: Camera, other: Camera) -> float:
    """Return the share of a camera's image whose rays are visible to another camera somewhere in front of both."""
    grid = image_grid(camera.width, camera.height, 40.0)
    v = lens_directions(camera.lens, grid) @ camera.world_from_camera.rotation.T
    base = np.linalg.norm(camera.world_from_camera.translation - other.world_from_camera.translation)
    seen = np.zeros(len(grid), bool)
    for distance in base * np.geomspace(0.05, 20.0, 40):
        seen |= sees(other, camera.world_from_camera.translation + distance * v)
    return float(seen.mean())


def _fitted(virtual: VirtualCamera, model: str, distance_m: float) -> Conversion:
    camera = virtual.camera
    grid = image_grid(camera.width, camera.height)
    lens = TwinLens.of(camera.lens, camera.width, camera.height, virtual.optics)
    return fit_lens(model, grid, lens.directions(grid, distance_m), camera.lens)
