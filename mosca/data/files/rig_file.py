"""The project's rig file: one TOML for twin and rig, checked; read and written.

::

    [[camera]]
    name = "left"
    size = [1280, 1024]                            # width, height [px]
    residual_px = 0.02                             # optional: systematic errors left by the lens model, rms an axis
    shake_px = 0.03                                # optional: shift of whole images, anew in each exposure
    [camera.lens]
    model = "opencv"                               # or "mosca", "fisheye": see mosca.data.rig
    fx_px = 1400.0                                 # ... the field names of the lens's dataclass
    [camera.pose]
    position_m = [2.0, -1.5, 2.2]                  # the camera's centre in the world
    rotation_wxyz = [0.5, -0.5, 0.5, -0.5]         # world_from_camera
    [camera.hardware]                              # optional: read by hardware, kept as it is
    [camera.twin]                                  # optional: read by twin, kept as it is

A file may also hold ``[hardware]`` and ``[twin]`` tables for what all cameras share (trigger, clock). A camera that
is not calibrated yet has no lens or pose; ``read_rig_file`` returns it, ``read_rig`` raises.
"""

import math
from collections.abc import Mapping
from dataclasses import MISSING, asdict, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Union

import numpy as np
import tomli_w
from pydantic import Field, create_model, field_validator

from mosca.data.files.caliscope import is_caliscope, rig_from_caliscope
from mosca.data.files.toml import Positive, Table, check, described, read_toml
from mosca.data.files.whole_file import write_text
from mosca.data.rig import (
    LENS_MODELS,
    Camera,
    FisheyeLens,
    Lens,
    MoscaLens,
    OpenCVLens,
    Pose,
    Rig,
    principal_point_px,
)
from mosca.data.rotations import quaternion_from_rotation, rotation_from_quaternion
from mosca.errors import InputError

LARGEST_POSITION_M = 1000.0
"""A camera farther from the world's origin than this is taken to be in millimetres."""

Tilt = Annotated[float, Field(ge=-1.5, le=1.5, description="tilt of the sensor [rad], below 90 deg")]
LIMITS = {
    **dict.fromkeys(("c_mm", "mx_mm_per_px", "my_mm_per_px", "fx_px", "fy_px"), Positive),
    **dict.fromkeys(("tauX", "tauY"), Tilt),
}
"""Limits of those lens fields that have any."""
LENS_KEYS = {
    "c_mm": "principal distance [mm]",
    "xp_px": "principal point, x [px]",
    "yp_px": "principal point, y [px]",
    "mx_mm_per_px": "pixel pitch along x [mm], held in adjustments",
    "my_mm_per_px": "pixel pitch along y [mm]",
    "a": "affinity: shear of the image axes",
    **{f"K{k}_per_mm{2 * k}": f"radial distortion of order {2 * k + 1} [1/mm^{2 * k}]" for k in (1, 2, 3)},
    **{f"P{k}_per_mm": f"decentring distortion, coefficient {k} [1/mm]" for k in (1, 2)},
    **{f"f{axis}_px": f"focal length along {axis} [px]" for axis in "xy"},
    **{f"c{axis}_px": f"principal point, {axis} [px]" for axis in "xy"},
    **{f"k{k}": f"distortion coefficient k{k}, as OpenCV has it" for k in range(1, 7)},
    **{f"p{k}": f"tangential distortion p{k}, as OpenCV has it" for k in (1, 2)},
    **{f"s{k}": f"thin prism s{k}, as OpenCV has it" for k in range(1, 5)},
    **{f"tau{axis}": f"tilt of the sensor about its {axis.lower()} axis [rad]" for axis in "XY"},
}
"""What each field of the lenses is."""
Pixels = Annotated[int, Field(gt=0, le=65535)]


class LensTable(Table):
    """``[camera.lens]``: the fields of the lens's dataclass in ``mosca.data.rig``, within LIMITS."""

    model: str


def _table_of(lens: type[Lens], text: str) -> type[LensTable]:
    columns: dict[str, Any] = {
        f.name: (
            LIMITS.get(f.name, f.type),
            Field(... if f.default is MISSING else f.default, description=LENS_KEYS[f.name]),
        )
        for f in fields(lens)
    }
    columns["model"] = (Literal[lens.model], Field(description="lens model"))
    return create_model(f"{lens.__name__}Table", __base__=LensTable, __doc__=text, **columns)


if TYPE_CHECKING:
    AnyLensTable = LensTable
else:
    AnyLensTable = Union[  # noqa: UP007  (of what is made here)
        _table_of(
            MoscaLens,
            '``model = "mosca"``: principal distance, principal point, pixel pitch, affinity, K1-K3, P1, P2.',
        ),
        _table_of(
            OpenCVLens,
            '``model = "opencv"``: radial k1-k6, tangential p1, p2, thin prism s1-s4, tilt tauX, tauY, as in OpenCV.',
        ),
        _table_of(FisheyeLens, '``model = "fisheye"``: equidistant with k1-k4, as ``cv2.fisheye`` has them.'),
    ]


class PoseTable(Table):
    """Exterior orientation ``world_from_camera``: centre [m] and rotation, a unit quaternion wxyz."""

    position_m: tuple[float, float, float] = Field(description="centre of projection in the world [m]")
    rotation_wxyz: tuple[float, float, float, float] = Field(
        description="world_from_camera, unit quaternion; camera axes: right, down, ahead"
    )

    @field_validator("position_m")
    @classmethod
    def _in_metres(cls, position: tuple[float, float, float]) -> tuple[float, float, float]:
        if max(abs(value) for value in position) > LARGEST_POSITION_M:
            raise ValueError(
                f"metres are wanted, at most {LARGEST_POSITION_M:g} from the origin; "
                "if these are millimetres, divide by 1000"
            )
        return position

    @field_validator("rotation_wxyz")
    @classmethod
    def _unit(cls, rotation: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
        norm = math.hypot(*rotation)
        if abs(norm - 1.0) > 1e-3:
            raise ValueError(f"a unit quaternion (w, x, y, z) is wanted, this one's norm is {norm:.6g}")
        w, x, y, z = rotation
        return w / norm, x / norm, y / norm, z / norm


class CameraTable(Table):
    """``[[camera]]``: one camera; lens and pose are missing until it is calibrated."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_ .-]*$", description="letters, digits, _ . -")]
    size: Annotated[tuple[Pixels, Pixels], Field(description="[width, height] in px")]
    lens: Annotated[AnyLensTable | None, Field(discriminator="model")] = Field(
        None, description="interior orientation, by the lens's model"
    )
    pose: PoseTable | None = None
    residual_px: Annotated[
        float, Field(ge=0, description="what the lens model leaves of the images, rms an axis [px]")
    ] = 0.0
    shake_px: Annotated[
        float, Field(ge=0, description="shift of whole images from exposure to exposure, rms an axis [px]")
    ] = 0.0
    hardware: dict[str, Any] = Field(default_factory=dict, description="the device and how it is set; kept as it is")
    twin: dict[str, Any] = Field(
        default_factory=dict, description="the virtual camera's own settings; kept as they are"
    )


class RigFile(Table):
    """The whole rig file; ``hardware`` and ``twin`` hold what all cameras share."""

    FILE_KIND: ClassVar[str] = "rig"

    camera: Annotated[tuple[CameraTable, ...], Field(min_length=1, description="one [[camera]] a camera")]
    hardware: dict[str, Any] = Field(
        default_factory=dict, description="what all cameras share: rate, trigger; kept as it is"
    )
    twin: dict[str, Any] = Field(default_factory=dict, description="what all virtual cameras share; kept as it is")


def rig_schema() -> dict[str, Any]:
    """Return the JSON schema of the rig file, for editors that complete and check it."""
    return described(RigFile.model_json_schema())


def read_rig_file(path: Path) -> RigFile:
    """Return the checked rig file at ``path`` with its hardware and twin tables; lens and pose may be missing.

    Raises InputError naming file, key, value and what is allowed.
    """
    return check(RigFile, read_toml(Path(path)), path)


def read_rig(path: Path, unit_m: float = 1.0) -> Rig:
    """Return the calibrated cameras of a rig file, or of an aniposelib/Caliscope/Pose2Sim calibration TOML.

    ``unit_m``: unit of another program's translations [m]. Which of the two kinds a file is, is determined from its
    content. Raises InputError naming file, key, value and what is allowed; also for a camera without lens or pose, a
    position in millimetres, or a principal point more than half an image outside the image.
    """
    path = Path(path)
    document = read_toml(path)
    if is_caliscope(document):
        rig = rig_from_caliscope(document, path, unit_m)
    elif unit_m != 1:
        raise InputError(f"{path}: a rig file of this project is in metres; leave the unit out")
    else:
        tables = check(RigFile, document, path).camera
        names = [table.name for table in tables]
        for name in names:
            if names.count(name) > 1:
                raise InputError(f"{path}: camera name '{name}' stands twice; give each camera its own name")
        rig = Rig(tuple(camera_of(table, path) for table in tables))
    for camera in rig.cameras:
        _check_plausible(camera, path)
    return rig


def write_rig(
    rig: Rig,
    path: Path,
    hardware: Mapping[str, Mapping[str, Any]] | None = None,
    twin: Mapping[str, Mapping[str, Any]] | None = None,
) -> None:
    """Write ``rig`` as a rig file, every number at full precision, whole or not at all.

    ``hardware`` and ``twin`` map camera name -> table to be kept beside lens and pose.
    """
    write_text(Path(path), rig_toml(rig, hardware, twin))


def rig_toml(
    rig: Rig,
    hardware: Mapping[str, Mapping[str, Any]] | None = None,
    twin: Mapping[str, Mapping[str, Any]] | None = None,
) -> str:
    """Return the text that ``write_rig`` writes."""
    tables = []
    for camera in rig.cameras:
        table: dict[str, Any] = {
            "name": camera.name,
            "size": [camera.width, camera.height],
            "lens": {"model": camera.lens.model, **asdict(camera.lens)},
            "pose": {
                "position_m": camera.world_from_camera.translation.tolist(),
                "rotation_wxyz": quaternion_from_rotation(camera.world_from_camera.rotation).tolist(),
            },
        }
        table |= {key: value for key in ("residual_px", "shake_px") if (value := getattr(camera, key))}
        for key, kept in (("hardware", hardware), ("twin", twin)):
            if kept and camera.name in kept:
                table[key] = dict(kept[camera.name])
        tables.append(table)
    return tomli_w.dumps({"camera": tables})


def camera_of(table: CameraTable, path: Path) -> Camera:
    """Return the camera of a ``[[camera]]`` table; InputError where lens or pose are missing."""
    if table.lens is None or table.pose is None:
        missing = "lens" if table.lens is None else "pose"
        raise InputError(
            f"{path}: camera '{table.name}' has no [camera.{missing}]; calibrate it first (mosca calibrate)"
        )
    lens: Lens = LENS_MODELS[table.lens.model](**table.lens.model_dump(exclude={"model"}))
    pose = Pose(rotation_from_quaternion(table.pose.rotation_wxyz), np.array(table.pose.position_m))
    return Camera(table.name, table.size[0], table.size[1], lens, pose, table.residual_px, table.shake_px)


def _check_plausible(camera: Camera, path: Path) -> None:
    """Raise InputError for a principal point more than half an image outside: wrong units or wrong size."""
    keys = ("xp_px", "yp_px") if isinstance(camera.lens, MoscaLens) else ("cx_px", "cy_px")
    for key, value, size in zip(keys, principal_point_px(camera.lens), (camera.width, camera.height), strict=True):
        if not -0.5 * size <= value <= 1.5 * size:
            raise InputError(
                f"{path}: camera '{camera.name}': lens.{key} = {value:g} is far outside the image of "
                f"{camera.width}x{camera.height} px; allowed is {-0.5 * size:g} to {1.5 * size:g}; "
                "check its unit (px) and the camera's size"
            )
