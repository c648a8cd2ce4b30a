"""A scenario's ``[self_orientation]``: calibration of the drone's camera, registration of the field, flight, clocks.

Everything comes from rendered images: the camera's calibration from the field held before it by hand, the field's
pose from the rig's cameras, the poses from the flight's frames, the clocks' offset from the lamp in both takes.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from mosca.calibration.session import EstimateSettings, Shown, calibrate_session
from mosca.calibration.single_camera.interior_orientation import LensChoice
from mosca.data.bodies import BodyPoses, RigidBody
from mosca.data.calibration import Calibration
from mosca.data.frames import Frame, FrameSource
from mosca.data.rig import Camera, FisheyeLens, Pose
from mosca.data.targets import TestField
from mosca.data.truth import Truth
from mosca.diagnostics.light_marker.brightness import Brightness
from mosca.diagnostics.light_marker.offsets import FlashOffset
from mosca.diagnostics.light_marker.window import LampWatch, LampWindow, clock_offset
from mosca.errors import CalibrationError
from mosca.machines.self_orientation.camera_path import CameraPath
from mosca.machines.self_orientation.images import coded_in, coded_settings, target_images
from mosca.machines.self_orientation.lamp import lamp_in_flight
from mosca.machines.self_orientation.registration import Registration, register_field
from mosca.machines.self_orientation.resection import LensErrors, Resected, ResectionSettings, resect_frames
from mosca.machines.self_orientation.rig_side import LeverArm, body_path, with_calibration
from mosca.machines.self_orientation.shutter import TargetImages
from scenarios.build.survey import own_camera, survey_field, survey_flight, told_field, told_lever_arm
from scenarios.session.estimated import SESSION_SEED, SessionCalibration, at_rest
from scenarios.spec.scenario import Scenario
from twin.cameras.exposure.mount import Mount
from twin.cameras.virtual_camera import VirtualCamera
from twin.scenes.scene import Scene, SceneSampler
from twin.scenes.survey_flight import FACING_DRONE, SurveyField, field_at_rest, field_by_hand, seen_by_drone
from twin.source import TwinSource
from twin.streams import rng

SESSION_M = 1.7
"""Distance from the camera at which the field is shown for calibration: about the middle of those in flight."""
TILT_RAD, SHIFT_M = np.deg2rad(35.0), 0.25
RATE_HZ = 10.0
"""Rate of the exposures of the field at rest."""
BODY = "drone"


@dataclass(frozen=True, eq=False)
class Prepared:
    """Data known before the flight."""

    there: SurveyField
    """The true field."""
    told: TestField
    """The field described by its file."""
    virtual: VirtualCamera
    """The drone's camera."""
    calibration: Calibration
    """Calibration of that camera."""
    registration: Registration

    @property
    def camera(self) -> Camera:
        """Return the calibrated camera."""
        return self.calibration.rig.cameras[0]


@dataclass(frozen=True, eq=False)
class FlightTake:
    """The drone camera's flight, its images read, and the truth of its frames."""

    seen: tuple[TargetImages, ...]
    frames: tuple[Frame, ...]
    truth: Truth


@dataclass(frozen=True, eq=False)
class SelfOrientation:
    """Both sides by the scenario's keys, and the data on which they rest."""

    prepared: Prepared
    take: FlightTake
    own: Resected
    lever: LeverArm
    body: CameraPath
    """The drone in the rig's world, with the errors of the rig's calibration."""
    offset_s: float
    """Assumed lead of the camera's stamps over those of the rig."""
    offset_sigma_s: float
    clock: FlashOffset
    """Estimate of the offset from the lamp, used or not."""
    rig_light: Brightness
    own_light: Brightness


def prepare(spec: Scenario, cameras: tuple[VirtualCamera, ...], rig: SessionCalibration, workers: int) -> Prepared:
    """Calibrate the drone's camera and register the field; CalibrationError, InputError where that is impossible."""
    given = spec.self_orientation
    assert given is not None
    there = survey_field(spec)
    told, virtual = told_field(spec, there), own_camera(spec, cameras)
    calibration = _calibrated(spec, there, told, virtual, workers)
    source = TwinSource(
        field_at_rest(there, given.registration_frames / RATE_HZ),
        at_rest(cameras),
        frame_rate_hz=RATE_HZ,
        exposure_s=spec.capture.exposure_s,
        pulses=given.registration_frames,
        seed=spec.seed + SESSION_SEED + 11,
        workers=workers,
    )
    settings = coded_settings(told, "white")
    with source:
        frames = list(source)
        found = [one for info in source.cameras for _, one in coded_in(frames, info, settings)]
    registration = register_field(rig.calibration.rig, found, told, rig.calibration)
    return Prepared(there, told, virtual, calibration, registration)


def watched(source: FrameSource, prepared: Prepared, rig: SessionCalibration) -> LampWatch:
    """Return the rig's source, watched for the lamp beside the field."""
    there = prepared.there
    place = prepared.registration.world_from_field.transform(there.light_m[None])[0]
    return LampWatch(source, rig.calibration.rig, place, there.light_diameter_m)


def self_orientation(
    spec: Scenario,
    prepared: Prepared,
    watch: LampWatch,
    poses: BodyPoses,
    bodies: tuple[RigidBody, ...],
    rig: SessionCalibration,
    workers: int,
) -> SelfOrientation:
    """Fly, resect, and find the clocks' offset."""
    given = spec.self_orientation
    assert given is not None
    take = _flown(spec, prepared, workers)
    row_s = prepared.virtual.timing.row_time_s
    settings = ResectionSettings(row_time_s=row_s if given.shutter == "rolling" else 0.0)
    lens = LensErrors.of(prepared.calibration, prepared.camera.name)
    own = resect_frames(take.seen, prepared.camera, prepared.told, lens, settings)
    own_light = _light(prepared, take.frames, own, row_s)
    rig_light = watch.best()
    clock = clock_offset(prepared.camera.name, rig_light, own_light)
    by_light = given.clock == "light"
    body = next(one for one in bodies if one.name == BODY)
    return SelfOrientation(
        prepared,
        take,
        own,
        told_lever_arm(spec, true_lever_arm(spec, prepared)),
        with_calibration(body_path(poses, BODY), body, rig.calibration),
        clock.offset_s if by_light else 0.0,
        clock.offset_sigma_s if by_light else 1e-6,
        clock,
        rig_light,
        own_light,
    )


def true_lever_arm(spec: Scenario, prepared: Prepared) -> Pose:
    """Return body_from_camera in the axes of the body's definition."""
    drone_from_camera = prepared.virtual.camera.world_from_camera
    return drone_from_definition(survey_flight(spec).scene).inverse() @ drone_from_camera


def drone_from_definition(scene: Scene) -> Pose:
    """Return the pose of the body's definition on the drone: axes of the world at the start, origin in the markers'
    middle (``scenarios.score.bodies.rigid_bodies``).
    """
    sampler = scene.sampler()
    middle = sampler.at(0.0).marker_xyz.mean(axis=0)
    return drone_pose(scene, sampler).inverse() @ Pose(np.eye(3), middle)


def drone_pose(scene: Scene, sampler: SceneSampler) -> Pose:
    """Return world_from_drone at the last instant evaluated by ``sampler``."""
    number = scene.model.body(BODY).id
    return Pose(sampler.data.xmat[number].reshape(3, 3).copy(), sampler.data.xpos[number].copy())


def _calibrated(
    spec: Scenario, there: SurveyField, told: TestField, virtual: VirtualCamera, workers: int
) -> Calibration:
    given = spec.self_orientation
    assert given is not None
    place = np.array([0.0, 0.0, 1.25])
    # the camera looks along x: right is -y, down is -z
    facing = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    standing = VirtualCamera(
        replace(virtual.camera, world_from_camera=Pose(facing, place)),
        virtual.optics,
        mount=Mount(body_px=virtual.mount.body_px),
        sensor=virtual.sensor,
    )
    hold_s = given.calibration_frames / RATE_HZ
    exposure_s = virtual.timing.exposure_s or spec.capture.exposure_s
    scene = field_by_hand(
        there.field,
        Pose(FACING_DRONE, place + [SESSION_M, 0.0, 0.0]),
        given.calibration_stands,
        hold_s,
        lead_s=(1 / RATE_HZ - exposure_s) / 2,
        tilt_rad=TILT_RAD,
        shift_m=SHIFT_M,
        rng=rng(spec.seed, "self_orientation/session"),
    )
    source = TwinSource(
        scene,
        (standing,),
        frame_rate_hz=RATE_HZ,
        exposure_s=exposure_s,
        pulses=given.calibration_stands * given.calibration_frames,
        seed=spec.seed + SESSION_SEED + 10,
        workers=workers,
    )
    model = "fisheye" if isinstance(virtual.camera.lens, FisheyeLens) else spec.pipeline.lens_model
    pitch = {virtual.camera.name: virtual.optics.pixel_pitch_mm}
    settings = EstimateSettings(LensChoice(model, own_pitch_mm=pitch))
    made_from = f"rendered images of the test field, seed {spec.seed}"
    calibration, _ = calibrate_session(Shown(told, lambda _: source), settings, made_from=made_from)
    if calibration.refused:
        first = calibration.refused[0]
        raise CalibrationError(f"camera '{virtual.camera.name}': {first.code}: {first.message}")
    return calibration


def _flown(spec: Scenario, prepared: Prepared, workers: int) -> FlightTake:
    scene = seen_by_drone(survey_flight(spec), prepared.there)
    exposure_s = prepared.virtual.timing.exposure_s or spec.capture.exposure_s
    with TwinSource(
        scene,
        (prepared.virtual,),
        frame_rate_hz=spec.capture.frame_rate_hz,
        exposure_s=min(exposure_s, spec.capture.exposure_s),
        pulses=spec.capture.pulses,
        seed=spec.seed,
        workers=workers,
    ) as source:
        settings = coded_settings(prepared.told, "white")
        read = list(coded_in(source, source.cameras[0], settings))
        truth = source.truth()
    return FlightTake(tuple(target_images(*one) for one in read), tuple(frame for frame, _ in read), truth)


def _light(prepared: Prepared, frames: Iterable[Frame], own: Resected, row_s: float) -> Brightness:
    """Return the lamp's brightness in the flight's frames, at the position computed from the poses."""
    there, camera = prepared.there, prepared.camera
    window = LampWindow(camera.name, prepared.virtual.sensor.bits)
    for frame, xy, radius, away in lamp_in_flight(own, camera, frames, there.light_m, there.light_diameter_m, row_s):
        window.take(frame, xy, radius, away)
    return window.brightness()
