"""Writes calibrations of aniposelib (which Pose2Sim shares) and Caliscope; ``mosca.data.files.caliscope`` reads them.

Tables of ``size``, ``matrix`` [px], ``distortions`` (OpenCV's order, or four of ``cv2.fisheye``), ``rotation`` (a
rotation vector) and ``translation`` [m], the last two *camera_from_world*.
"""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tomli_w

from mosca.data.files.rig_file import read_rig
from mosca.data.files.whole_file import write_text
from mosca.data.rig import Camera
from mosca.formats.rigs.lens_conversion import Notes, RigFileOptions, opencv_parts


def read_toml_rig(path: Path, options: RigFileOptions) -> tuple[tuple[Camera, ...], Notes]:
    """Read the project's rig file or one of this dialect, whichever it is
    (``mosca.data.files.rig_file.read_rig``).
    """
    return read_rig(path, options.metres("m")).cameras, ()


def write_aniposelib(cameras: tuple[Camera, ...], path: Path, options: RigFileOptions) -> Notes:
    """Write ``[cam_0]`` ... with the camera's name, and ``[metadata]``."""
    document: dict[str, Any] = {}
    notes: Notes = ()
    for k, camera in enumerate(cameras):
        table, more = _table(camera, options)
        document[f"cam_{k}"] = {"name": camera.name, **table}
        notes += more
    document["metadata"] = {"adjusted": True, "error": 0.0}
    write_text(path, tomli_w.dumps(document))
    return notes


def write_caliscope(cameras: tuple[Camera, ...], path: Path, options: RigFileOptions) -> Notes:
    """Write ``[cameras.0]`` ...; the format has no names: cameras are read back as cam_0, cam_1 ..."""
    document: dict[str, Any] = {}
    notes: Notes = ()
    for k, camera in enumerate(cameras):
        table, more = _table(camera, options)
        document[str(k)] = {"cam_id": k, "rotation_count": 0, "ignore": False, **table}
        notes += more
        if camera.name != f"cam_{k}":
            notes += (f"camera '{camera.name}' becomes number {k}: Caliscope's cameras have no names",)
    write_text(path, tomli_w.dumps({"cameras": document}))
    return notes


def _table(camera: Camera, options: RigFileOptions) -> tuple[dict[str, Any], Notes]:
    camera_from_world = camera.world_from_camera.inverse()
    matrix, coefficients, fisheye, notes = opencv_parts(camera, options)
    table = {
        "size": [camera.width, camera.height],
        "matrix": matrix.tolist(),
        "distortions": coefficients,
        "fisheye": fisheye,
        "rotation": cv2.Rodrigues(np.array(camera_from_world.rotation))[0].ravel().tolist(),
        "translation": camera_from_world.translation.tolist(),
    }
    return table, notes
