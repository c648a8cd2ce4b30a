"""From a scenario's words to things: scene, true rig, virtual cameras, the calibration that the pipeline gets."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from mosca.camera import Conversion, fit_lens, image_grid, lens_directions, project
from mosca.data.arrays import Array
from mosca.data.rig import Camera, MoscaLens, Pose, Rig
from mosca.data.rig_file import read_rig
from mosca.data.toml import Table
from mosca.detect import DetectionSettings
from mosca.errors import InputError
from mosca.match import MatchSettings
from mosca.pipeline import PipelineSettings
from mosca.track import TrackSettings
from scenarios.spec import (
    ActorScene,
    Cameras,
    ClockFault,
    CloudScene,
    DetectionSpec,
    DroneScene,
    LensFault,
    MatchSpec,
    RobotScene,
    ScaleFault,
    Scenario,
    SwapFault,
    TrackSpec,
    TurnFault,
    WorkingSpace,
)
from twin.cameras.camera import VirtualCamera
from twin.cameras.lens import TwinLens
from twin.cameras.mount import Mount, pixels_per_radian
from twin.cameras.optics import Optics
from twin.cameras.sensor import Sensor
from twin.cameras.shutter import Timing
from twin.scenes.scene import Scene
from twin.streams import rng

GAP_PX = {"none": 0.0, "measured": 0.05, "stress": 0.25}
"""Amplitude of the lens gap that each ``model_gap`` stands for; what it leaves after a fit is measured."""
MARGIN = 1.15
"""Points are looked for in the working space grown by this factor, so that nothing real at its edge is cut."""
VIEW_GRID = 7
PERSON_SPACE_M = 2.5
WORST_SIGMA_M = 0.005
Volume = tuple[tuple[float, float, float], tuple[float, float, float]]


class Stages(Protocol):
    """Anything that has the tables of the stages' settings."""

    @property
    def detection(self) -> DetectionSpec:
        """Settings of target detection."""
        ...

    @property
    def match(self) -> MatchSpec:
        """Settings of correspondence."""
        ...

    @property
    def track(self) -> TrackSpec:
        """Settings of tracking."""
        ...


@dataclass(frozen=True, eq=False)
class Calibrated:
    """The rig that the pipeline believes in, and what its lens model cannot follow: rms over the cameras [px]."""

    rig: Rig
    gap_rms_px: float
    gap_max_px: float


def true_rig(spec: Scenario, folder: Path) -> Rig:
    """Return the rig as it stands; InputError where it cannot work."""
    if spec.cameras.rig is not None:
        rig = read_rig(_beside(spec.cameras.rig, folder))
    else:
        rig = ring(spec.cameras, spec.working_space)
    check_rig(rig, spec.working_space)
    return rig


def ring(spec: Cameras, space: WorkingSpace) -> Rig:
    """Return cameras on a ring around the working space, all looking at one point."""
    centre = np.array(space.center_m)
    target = centre if spec.look_at_m is None else np.array(spec.look_at_m)
    azimuth = spec.azimuth_deg or tuple(45.0 + 360.0 * k / spec.count for k in range(spec.count))
    height = spec.height_m if isinstance(spec.height_m, tuple) else (spec.height_m,) * spec.count
    width, rows = spec.size_px
    cameras = []
    for k in range(spec.count):
        turn = np.deg2rad(azimuth[k])
        place = centre + spec.radius_m * np.array([np.cos(turn), np.sin(turn), 0.0])
        place[2] = height[k]
        # no two lenses are alike: principal point and distortion differ a little from camera to camera
        lens = MoscaLens(
            spec.c_mm * (1 + 0.004 * k),
            (width - 1) / 2 + 3.0 - 2.0 * k,
            (rows - 1) / 2 - 2.0 + 1.5 * k,
            spec.pixel_pitch_mm,
            spec.pixel_pitch_mm * 1.001,
            spec.a,
            spec.K1_per_mm2 * (1 + 0.1 * k),
            spec.K2_per_mm4,
            0.0,
            spec.P1_per_mm,
            spec.P2_per_mm,
        )
        cameras.append(Camera(f"cam{k + 1}", width, rows, lens, _looking(place, target, f"cam{k + 1}")))
    return Rig(tuple(cameras))


def check_rig(rig: Rig, space: WorkingSpace) -> None:
    """Raise InputError for a rig that cannot measure the working space; says why."""
    centre, size = np.array(space.center_m), np.array(space.size_m)
    places = np.array([c.world_from_camera.translation for c in rig.cameras])
    for k, camera in enumerate(rig.cameras):
        if np.all(np.abs(places[k] - centre) < size / 2):
            raise InputError(
                f"camera '{camera.name}' stands inside the working space at {_text(places[k])} m; "
                "move it out (cameras.radius_m, cameras.height_m) or make working_space.size_m smaller"
            )
        for other in range(k):
            if np.linalg.norm(places[k] - places[other]) < 1e-3 * size.max():
                raise InputError(
                    f"cameras '{rig.cameras[other].name}' and '{camera.name}' stand at the same place "
                    f"{_text(places[k])} m and see no depth; give them different cameras.azimuth_deg"
                )
    grid = centre + size * (
        np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, VIEW_GRID)] * 3), -1).reshape(-1, 3)
    )
    views = np.array([_sees(camera, grid) for camera in rig.cameras])
    blind = [camera.name for camera, seen in zip(rig.cameras, views, strict=True) if not seen.any()]
    if not (views.sum(axis=0) >= 2).any():
        who = f"{', '.join(blind)} see nothing of it" if blind else "their views do not overlap"
        raise InputError(
            f"no point of the working space is seen by two cameras: {who}; "
            "check poses, principal distance c_mm and look_at_m"
        )


def virtual_cameras(spec: Scenario, rig: Rig) -> tuple[VirtualCamera, ...]:
    """Return the rig's cameras with the scenario's errors; a clock fault is built in here."""
    e = spec.errors
    late = dict.fromkeys(spec.fault.cameras, spec.fault.delay_s) if isinstance(spec.fault, ClockFault) else {}
    for name in late:
        rig.camera(name)
    sensor = Sensor(e.full_well_e, e.read_noise_e, e.bits, background_e=e.background_e)
    return tuple(
        VirtualCamera(
            camera,
            Optics(psf_sigma_px=e.psf_sigma_px, gap_px=GAP_PX[spec.model_gap]),
            Timing(e.trigger_jitter_s, late.get(camera.name, 0.0)),
            Mount(e.body_px),
            sensor,
            e.marker_signal,
        )
        for camera in rig.cameras
    )


def calibrated(spec: Scenario, cameras: tuple[VirtualCamera, ...]) -> Calibrated:
    """Return the true calibration: true poses, and the pipeline's lens model fitted to the true lenses' rays."""
    made, fits = [], []
    for virtual in cameras:
        camera = virtual.camera
        fit = _fitted(virtual, spec.pipeline.lens_model)
        made.append(replace(camera, lens=fit.lens))
        fits.append(fit)
    rms = float(np.sqrt(np.mean([f.rms_px**2 for f in fits])))
    return Calibrated(Rig(tuple(made)), rms, max(f.max_px for f in fits))


def with_fault(rig: Rig, fault: Table | None) -> Rig:
    """Return the rig that the pipeline believes in, with the scenario's fault."""
    if isinstance(fault, SwapFault):
        one, two = (rig.camera(name) for name in fault.cameras)
        swapped = {one.name: two, two.name: one}
        return Rig(tuple(replace(swapped.get(c.name, c), name=c.name) for c in rig.cameras))
    if isinstance(fault, LensFault):
        return Rig(tuple(_undistorted(camera) for camera in rig.cameras))
    if isinstance(fault, ScaleFault):
        return Rig(tuple(_scaled(camera, fault.factor) for camera in rig.cameras))
    if isinstance(fault, TurnFault):
        rig.camera(fault.camera)
        return Rig(tuple(_turned(c, fault.turn_px) if c.name == fault.camera else c for c in rig.cameras))
    return rig


def build_scene(spec: Scenario, folder: Path) -> Scene:
    """Return the scene; files that the scenario names are looked for beside it (``folder``)."""
    scene = spec.scene
    space = spec.working_space
    where: dict[str, Any] = {
        "duration_s": spec.capture.duration_s,
        "box_center_m": np.array(space.center_m),
        "box_size_m": np.array(space.size_m),
        "rng": rng(spec.seed, "scene"),
    }
    if isinstance(scene, ActorScene):
        from twin.scenes.actor import build_actor

        motion: dict[str, Any] = {
            name: None if given is None else _beside(given, folder)
            for name, given in (("motion_file", scene.motion), ("skeleton_file", scene.skeleton))
        }
        return build_actor(
            **where,
            **motion,
            start_s=scene.start_s,
            markers=scene.markers,
            marker_diameter_m=scene.marker_diameter_m,
        )
    if isinstance(scene, DroneScene):
        from twin.scenes.drone import build_drone

        return build_drone(
            **where,
            path=scene.path,
            speed_mps=scene.speed_mps,
            markers=scene.markers,
            marker_diameter_m=scene.marker_diameter_m,
        )
    if isinstance(scene, RobotScene):
        from twin.scenes.robot import build_robot

        return build_robot(
            **where,
            average_pwm=scene.average_pwm,
            difference_pwm=scene.difference_pwm,
            target_diameter_m=scene.marker_diameter_m,
        )
    if isinstance(scene, CloudScene):
        from twin.scenes.cloud import build_cloud

        return build_cloud(
            **where, n=scene.markers, marker_diameter_m=scene.marker_diameter_m, speed_mps=scene.speed_mps
        )
    from twin.scenes.own import build_own

    files: dict[str, Any] = {
        "model_file": _beside(scene.model, folder),
        "markers_file": _beside(scene.markers, folder),
    }
    if scene.motion == "turntable":
        return build_own(**where, **files, motion="turntable", speed_mps=scene.speed_mps)
    if scene.motion == "physics":
        return build_own(**where, **files, motion="physics")
    return build_own(**where, **files, motion="table", motion_file=_beside(scene.motion, folder))


def pipeline_settings(spec: Scenario) -> PipelineSettings:
    """Return the pipeline's settings: its defaults, the scenario's differences, and where points can be."""
    centre, size = np.array(spec.working_space.center_m), np.array(spec.working_space.size_m)
    low, high = centre - MARGIN * size / 2, centre + MARGIN * size / 2
    return stage_settings(spec.pipeline, ((low[0], low[1], low[2]), (high[0], high[1], high[2])))


def stage_settings(stages: Stages, volume: Volume | None) -> PipelineSettings:
    """Return the pipeline's defaults with what ``stages`` gives in its tables detection, match and track.

    The tracker's defaults are lengths and speeds of a person in 2.5 m; they are scaled to the volume's longest
    edge, because things move as far as they have room. Points less certain than 0.2 % of it are withheld.
    """
    track, match = TrackSettings(), MatchSettings()
    if volume is not None:
        scale = max(high - low for low, high in zip(*volume, strict=True)) / (MARGIN * PERSON_SPACE_M)
        track = replace(
            track,
            acceleration_mps2=track.acceleration_mps2 * scale,
            speed_mps=track.speed_mps * scale,
            gate_m=track.gate_m * scale,
        )
        match = replace(match, worst_sigma_m=WORST_SIGMA_M * scale)
    return PipelineSettings(
        replace(DetectionSettings(), **_given(stages.detection)),
        replace(match, **_given(stages.match)),
        replace(track, **_given(stages.track)),
        volume,
    )


def _given(table: Table) -> dict[str, Any]:
    return {name: value for name, value in table.model_dump().items() if value is not None}


def _beside(name: str, folder: Path) -> Path:
    path = Path(name)
    return path if path.is_absolute() else folder / path


def _sees(camera: Camera, points: Array) -> Array:
    xy = project(camera, points)
    inside = np.asarray(np.isfinite(xy).all(axis=1))
    xy = np.where(inside[:, None], xy, -1.0)
    return (
        inside
        & (xy >= -0.5).all(axis=1)
        & (xy[:, 0] <= camera.width - 0.5)
        & (xy[:, 1] <= camera.height - 0.5)
    )


def _looking(place: Array, target: Array, name: str) -> Pose:
    """Return the pose of a camera at ``place`` that looks at ``target`` with its x axis level."""
    forward = target - place
    distance = np.linalg.norm(forward)
    if distance < 1e-9:
        raise InputError(
            f"camera '{name}' stands at the point that it looks at; change look_at_m or height_m"
        )
    forward = forward / distance
    right = np.cross(forward, [0.0, 0.0, 1.0])
    if np.linalg.norm(right) < 1e-6:
        right = np.array([1.0, 0.0, 0.0])
    right = right / np.linalg.norm(right)
    return Pose(np.column_stack([right, np.cross(forward, right), forward]), place)


def _fitted(virtual: VirtualCamera, model: str) -> Conversion:
    camera = virtual.camera
    grid = image_grid(camera.width, camera.height)
    lens = TwinLens.of(camera.lens, camera.width, camera.height, virtual.optics.gap_px)
    return fit_lens(model, grid, lens.directions(grid), camera.lens)


def _undistorted(camera: Camera) -> Camera:
    """Return the camera with its lens's distortion forgotten (principal distance and point kept)."""
    lens = camera.lens
    if isinstance(lens, MoscaLens):
        plain = MoscaLens(lens.c_mm, lens.xp_px, lens.yp_px, lens.mx_mm_per_px, lens.my_mm_per_px)
        return replace(camera, lens=plain)
    return replace(camera, lens=type(lens)(lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px))


def _scaled(camera: Camera, factor: float) -> Camera:
    """Return the camera with its place scaled about the world's origin."""
    pose = camera.world_from_camera
    return replace(camera, world_from_camera=Pose(pose.rotation, factor * pose.translation))


def _turned(camera: Camera, turn_px: float) -> Camera:
    lens = TwinLens.of(camera.lens, camera.width, camera.height).vector
    turn = Rotation.from_rotvec([0.0, turn_px / pixels_per_radian(lens), 0.0]).as_matrix()
    pose = camera.world_from_camera
    return replace(camera, world_from_camera=Pose(pose.rotation @ turn, pose.translation))


def overlap_of(camera: Camera, other: Camera) -> float:
    """Return the share of a camera's image whose rays another camera sees somewhere in front of both."""
    grid = image_grid(camera.width, camera.height, 40.0)
    v = lens_directions(camera.lens, grid) @ camera.world_from_camera.rotation.T
    base = np.linalg.norm(camera.world_from_camera.translation - other.world_from_camera.translation)
    seen = np.zeros(len(grid), bool)
    for distance in base * np.geomspace(0.05, 20.0, 40):
        seen |= _sees(other, camera.world_from_camera.translation + distance * v)
    return float(seen.mean())


def _text(point: Array) -> str:
    return "(" + ", ".join(f"{x:g}" for x in point) + ")"
