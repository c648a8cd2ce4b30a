"""Calibrations of aniposelib, Caliscope and Pose2Sim: one TOML dialect in three variants.

A table per camera holds ``size``, ``matrix`` (3 x 3, px), ``distortions`` (OpenCV's order, or four of ``cv2.fisheye``
where ``fisheye = true``), ``rotation`` (a rotation vector, or a 3 x 3 matrix in older Caliscope files) and
``translation``; the last two are *camera_from_world*, in metres, or in the unit in which the board was described.

- aniposelib, Pose2Sim: ``[cam_0]`` ... with ``name``, beside ``[metadata]``.
- Caliscope: ``[cameras.0]`` ... with ``cam_id`` (older: ``port``), no name. Its videos are called
  ``cam_0.mp4``, so the camera is called ``cam_0``. Cameras with ``ignore = true`` are left out.

``rotation_count`` of Caliscope rotates images for display only and is not applied.
"""

from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from mosca.data.arrays import Array
from mosca.data.files.toml import check
from mosca.data.rig import Camera, FisheyeLens, OpenCVLens, Pose, Rig
from mosca.data.rotations import nearest_rotation, rotation_from_vector
from mosca.errors import InputError

Vector = tuple[float, float, float]
Matrix = tuple[Vector, Vector, Vector]
LARGEST_TRANSLATION_M = 1000.0
"""A camera farther from the origin is taken to be in another unit than metres."""
LARGEST_ROTATION = 100.0
"""Largest element of a rotation; many turns mean damage or another unit."""
LARGEST_TILT_RAD = 1.5
"""Largest tilt of a sensor: the tilt's projection ends at 90 deg."""


class CaliscopeCamera(BaseModel):
    """The keys read of a camera's table; others (exposure, error, ...) are ignored."""

    model_config = ConfigDict(extra="ignore", frozen=True, allow_inf_nan=False)

    size: tuple[Annotated[int, Field(gt=0)], Annotated[int, Field(gt=0)]]
    matrix: Matrix
    distortions: tuple[float, ...]
    rotation: Vector | Matrix
    translation: Vector
    name: str | None = None
    cam_id: int | None = None
    port: int | None = None
    fisheye: bool = False


def is_caliscope(document: dict[str, Any]) -> bool:
    """Return whether the content of a TOML document is a calibration of this dialect."""
    tables = document["cameras"] if isinstance(document.get("cameras"), dict) else document
    return "camera" not in document and any(
        isinstance(table, dict) and ("matrix" in table or "distortions" in table) for table in tables.values()
    )


def rig_from_caliscope(document: dict[str, Any], path: Path, unit_m: float = 1.0) -> Rig:
    """Return the cameras of ``document``, whose translations have the unit ``unit_m`` [m]; errors name ``path``.

    Raises InputError for a camera without calibration that is not marked ``ignore``, for a number of
    distortion coefficients that OpenCV's model does not have, for skew, and for millimetres.
    """
    nested = isinstance(document.get("cameras"), dict)
    tables = document["cameras"] if nested else document
    cameras: dict[str, Camera] = {}
    for key, table in tables.items():
        where = f"{path}: [{'cameras.' if nested else ''}{key}]"
        if not isinstance(table, dict) or key == "metadata" or table.get("ignore") is True:
            continue
        camera = _camera(check(CaliscopeCamera, table, where), key, where, unit_m)
        if camera.name in cameras:
            raise InputError(f"{where}: camera name '{camera.name}' stands twice; give each its own name")
        cameras[camera.name] = camera
    if not cameras:
        raise InputError(f"{path}: no calibrated camera; every table is marked ignore = true")
    return Rig(tuple(cameras.values()))


def _camera(table: CaliscopeCamera, key: str, where: str, unit_m: float) -> Camera:
    number = table.cam_id if table.cam_id is not None else table.port
    name = table.name or (f"cam_{number}" if number is not None else str(key))
    translation = unit_m * np.array(table.translation)
    if np.abs(translation).max() > LARGEST_TRANSLATION_M:
        raise InputError(
            f"{where}: translation {list(table.translation)} given; metres are wanted, at most "
            f"{LARGEST_TRANSLATION_M:g}; a board measured in millimetres gives these: "
            "mosca rig convert --unit mm, or divide by 1000"
        )
    rotation = _rotation(table.rotation, where)
    camera_from_world = Pose(rotation, translation)
    return Camera(name, *table.size, _lens(table, where), camera_from_world.inverse())


def _rotation(given: Vector | Matrix, where: str) -> Array:
    largest = float(np.abs(given).max())
    if largest > LARGEST_ROTATION:
        raise InputError(
            f"{where}: rotation holds {largest:g}; a vector of its angle [rad], or a matrix, of elements up to "
            f"{LARGEST_ROTATION:g} is allowed"
        )
    if isinstance(given[0], float):
        return rotation_from_vector(np.array(given))
    rotation, misfit = nearest_rotation(np.array(given))
    if misfit > 1e-3:
        raise InputError(f"{where}: rotation is {misfit:.3g} off the nearest rotation matrix; 0.001 is allowed")
    return rotation


def _lens(table: CaliscopeCamera, where: str) -> OpenCVLens | FisheyeLens:
    (fx, skew, cx), (low, fy, cy), last = table.matrix
    if abs(skew) > 1e-6 * fx or not (fx > 0 and fy > 0) or (low, *last) != (0, 0, 0, 1):
        raise InputError(
            f"{where}: matrix has skew {skew:g}, focal lengths {fx:g}, {fy:g} and below them {low:g}, {list(last)}; "
            "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with fx, fy above 0 is allowed"
        )
    d = table.distortions
    if table.fisheye:
        if len(d) != 4:
            raise InputError(f"{where}: {len(d)} distortions given; a fisheye has 4 (k1 k2 k3 k4)")
        return FisheyeLens(fx, fy, cx, cy, *d)
    if len(d) not in (4, 5, 8, 12, 14):
        raise InputError(
            f"{where}: {len(d)} distortions given; 4, 5, 8, 12 or 14 are allowed, in OpenCV's order "
            "(k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 tauX tauY)"
        )
    if any(abs(tau) > LARGEST_TILT_RAD for tau in d[12:]):
        raise InputError(
            f"{where}: distortions tauX, tauY = {d[12]:g}, {d[13]:g} given; they are the sensor's tilt in rad, "
            f"at most {LARGEST_TILT_RAD:g} is allowed"
        )
    return OpenCVLens(fx, fy, cx, cy, *d)
