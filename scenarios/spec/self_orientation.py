"""Keys of a scenario file: a drone that finds its own pose from a test field, compared with that by the rig."""

from collections.abc import Iterable, Sequence
from typing import Literal

from pydantic import Field

from mosca.data.files.toml import NotNegative, Positive, Table, Vector
from scenarios.spec.cameras import CameraSpec
from scenarios.spec.scenes import DroneScene, SceneSpec

METRICS = (
    "self_position_rms", "self_angle_rms", "self_nees", "self_completeness", "rig_camera_position_rms",
    "rig_camera_angle_rms", "rig_camera_nees", "light_clock_error", "budget_explained",
)  # fmt: skip
"""Metrics that only a scenario with ``[self_orientation]`` has."""


class SelfOrientationSpec(Table):
    """``[self_orientation]``: a camera on the drone sees a test field in flight (Mosca paper, section 4.2).

    The camera is calibrated from images of the field, its poses found by resection, and compared with what the rig
    tells of the drone's markers.
    """

    camera: str = Field("frontal", description="the [[camera]] on the drone")
    targets: int = Field(24, ge=6, le=200, description="coded targets of the field")
    size_m: tuple[Positive, Positive] = Field((2.0, 1.3), description="width and height of the field [m]")
    relief_m: NotNegative = Field(0.2, le=1, description="depth over which its targets are spread [m]")
    dot_radius_m: Positive = Field(0.02, description="radius of the targets' dots [m]")
    sigma_m: NotNegative = Field(0.0003, le=0.05, description="how far its file is wrong, each coordinate [m]")
    center_m: Vector = Field((1.9, 0.0, 1.25), description="where its middle stands; it faces -x [m]")
    light_m: Vector = Field(
        (0.0, 0.8, 0.0), description="the blinking lamp, field axes: right, up, towards the drone [m]"
    )
    light_diameter_m: Positive = Field(0.04, description="diameter of the lamp [m]")
    bit_s: Positive = Field(0.087, description="length of a bit of its code; more than two frames of each camera [s]")
    calibration_stands: int = Field(12, ge=3, le=100, description="poses of the field in the camera's calibration")
    calibration_frames: int = Field(2, ge=1, le=100, description="images at each of them")
    registration_frames: int = Field(5, ge=1, le=100, description="images in which the rig measures the field")
    lever_sigma_m: NotNegative = Field(
        0.003, le=0.2, description="how well it is known where the camera sits on the body, each coordinate [m]"
    )
    lever_sigma_deg: NotNegative = Field(0.2, le=20, description="and how it is turned there, each axis [deg]")
    shutter: Literal["rolling", "global"] = Field(
        "rolling", description="what the resection believes: 'global' ignores that rows are exposed one after another"
    )
    clock: Literal["light", "stamps"] = Field(
        "light", description="'light': the clocks' offset from the lamp; 'stamps': both are believed to be one"
    )


def check_self_orientation(
    given: SelfOrientationSpec | None,
    scene: SceneSpec,
    cameras: Sequence[CameraSpec],
    limits: Iterable[str],
    bodies: bool,
    session: bool,
) -> None:
    """Raise ValueError where a scenario's keys and its ``[self_orientation]`` cannot be combined."""
    if given is None:
        for name in limits:
            if name in METRICS:
                raise ValueError(f"limits.{name} needs a camera that orients itself; add [self_orientation]")
        return
    if not isinstance(scene, DroneScene):
        raise ValueError(f"[self_orientation] with scene.kind = '{scene.kind}': only a 'drone' flies; leave it out")
    if not bodies:
        raise ValueError("[self_orientation] needs the drone's poses; set pipeline.bodies = true")
    if not session:
        raise ValueError("[self_orientation] needs an estimated rig, with its covariance; add [calibration]")
    riders = [one.name for one in cameras if one.body == "drone"]
    if given.camera not in riders:
        raise ValueError(
            f"self_orientation.camera = '{given.camera}': cameras on the drone are {', '.join(riders) or 'none'}; "
            "add a [[camera]] with body = 'drone', or name one of them"
        )
