"""OpenCV's FileStorage (YAML, XML or JSON): one file per camera, or one for a stereo pair.

A camera's file: ``camera_matrix`` [px], ``distortion_coefficients``, ``image_width``, ``image_height`` (as OpenCV's
calibration sample writes them), ``fisheye_model`` 1 for ``cv2.fisheye``, and ``R``, ``T``: *camera_from_world*, a
matrix or a rotation vector. A stereo file: ``M1``, ``D1``, ``M2``, ``D2``, and ``R``, ``T``: *camera2_from_camera1*;
the first camera is the world unless ``R_world``, ``T_world`` (camera1_from_world, our own addition) give its pose.
OpenCV has no unit of length: metres are assumed unless the options specify millimetres.
"""

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from mosca.data.arrays import Array
from mosca.data.files.bounded import read_text
from mosca.data.files.whole_file import write_text
from mosca.data.rig import Camera, Pose
from mosca.data.rotations import rotation_from_vector
from mosca.errors import InputError
from mosca.formats.rigs.lens_conversion import (
    CALIBRATION,
    Notes,
    RigFileOptions,
    checked_camera,
    opencv_lens,
    opencv_parts,
    rotation_of,
)

SUFFIXES = (".yml", ".yaml", ".xml", ".json")
MOST_OPENED = 4000
"""Most characters of a file that may open a list or table: OpenCV's parsers are recursive.

They read 20,000 nested levels; 40,000 overflow a stack of 8 MiB. There are no more levels than characters that may
open one; OpenCV's own calibrations have some hundred of these."""
_MAY_OPEN = ":-[{<"
MATRIX = ("camera_matrix", "cameraMatrix", "Camera_Matrix", "intrinsic_matrix", "K", "mtx")
DISTORTION = (
    "distortion_coefficients",
    "Distortion_Coefficients",
    "distortion_coeffs",
    "dist_coeffs",
    "distCoeffs",
    "D",
    "dist",
)
ROTATION, TRANSLATION = ("R", "rvec", "rotation"), ("T", "t", "tvec", "translation")
SIZE = ("image_size", "imageSize", "size")
WIDTH, HEIGHT = ("image_width", "image_Width", "width"), ("image_height", "image_Height", "height")
FISHEYE = ("fisheye_model", "fisheye")


def read_opencv(path: Path, options: RigFileOptions) -> tuple[tuple[Camera, ...], Notes]:
    """Read a camera's file, a stereo file, or a folder of cameras' files, each camera named after its file.

    Raises InputError for a file that is no FileStorage and for missing or bad keys.
    """
    if path.is_dir():
        files = sorted(one for one in path.iterdir() if one.suffix.lower() in SUFFIXES)
        if not files:
            raise InputError(f"{path}: no {', '.join(SUFFIXES)} file in it; one a camera is wanted")
        found = [read_opencv(one, options) for one in files]
        return tuple(c for cameras, _ in found for c in cameras), tuple(n for _, notes in found for n in notes)
    storage = _opened(path)
    name = _text(storage, "name")
    if _node(storage, ("M1", "cameraMatrix1")) is not None:
        return _stereo(storage, path, options)
    camera_from_world = _pose(storage, ROTATION, TRANSLATION, str(path), options)
    notes: Notes = ()
    if camera_from_world is None:
        notes = (f"{path}: no R and T; the camera is put at the world's origin, looking along z",)
        camera_from_world = Pose(np.eye(3), np.zeros(3))
    camera = _camera(storage, name or path.stem, "", str(path), options, camera_from_world)
    return (camera,), notes


def write_opencv(cameras: tuple[Camera, ...], path: Path, options: RigFileOptions) -> Notes:
    """Write a camera's file, a stereo file of two cameras, or, without a suffix, a folder with a file a camera.

    Lengths in metres unless ``options.unit`` is mm.
    """
    if path.suffix.lower() not in SUFFIXES:
        if path.exists() and not path.is_dir():
            raise InputError(f"{path}: is a file; a folder, or a file ending in {', '.join(SUFFIXES)}, is wanted")
        path.mkdir(exist_ok=True)
        notes: Notes = ()
        for camera in cameras:
            notes += write_opencv((camera,), path / f"{camera.name}.yml", options)
        return notes
    if len(cameras) > 2:
        raise InputError(
            f"{path}: {len(cameras)} cameras given, one file holds one or two; name a folder, for a file a camera"
        )
    if len({(camera.width, camera.height) for camera in cameras}) > 1:
        raise InputError(f"{path}: a stereo file holds one image size, the cameras have two; name a folder instead")
    storage = cv2.FileStorage(path.suffix.lower(), cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    unit = 1 / options.metres("m")
    first = cameras[0].world_from_camera.inverse()
    notes = ()
    if len(cameras) == 1:
        notes = _put(storage, cameras[0], "", options)
        _put_pose(storage, first, "", unit)
    else:
        notes = _put(storage, cameras[0], "1", options) + _put(storage, cameras[1], "2", options)
        _put_pose(storage, cameras[1].world_from_camera.inverse() @ cameras[0].world_from_camera, "", unit)
        _put_pose(storage, first, "_world", unit)
    text = storage.releaseAndGetString()
    write_text(path, text)
    return notes


def _opened(path: Path) -> Any:
    text = read_text(path, CALIBRATION, "utf-8-sig")
    if not text.strip():
        raise InputError(f"{path}: is empty; a file of OpenCV's FileStorage is wanted")
    if "\0" in text:
        raise InputError(f"{path}: holds zero bytes; a text file of OpenCV's FileStorage is wanted")
    if sum(map(text.count, _MAY_OPEN)) > MOST_OPENED:
        raise InputError(
            f"{path}: holds more than {MOST_OPENED} of the characters {' '.join(_MAY_OPEN)} that may open a list or "
            "table; give the calibration without the points that it was computed from"
        )
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        opened = storage.isOpened() and storage.root().isMap()
    except (cv2.error, SystemError):
        opened = False
    if not opened:
        raise InputError(f"{path}: OpenCV's FileStorage cannot read it; YAML (%YAML:1.0 at its head), XML or JSON")
    return storage


def _node(storage: Any, keys: tuple[str, ...]) -> tuple[str, Any] | None:
    for key in keys:
        node = storage.getNode(key)
        if not node.empty():
            return key, node
    return None


def _numbers(storage: Any, keys: tuple[str, ...], where: str, counts: tuple[int, ...] | None) -> Array | None:
    """Return the numbers (n,) of a matrix, a sequence or one number; None where no key is there."""
    found = _node(storage, keys)
    if found is None:
        return None
    key, node = found
    kind, cells = "", None
    if node.isMap():
        kind = node.getNode("dt").string() if node.getNode("dt").isString() else ""
        cells = node.getNode("rows").real() * node.getNode("cols").real()
        node = node.getNode("data")
    items = [node.at(k) for k in range(node.size())] if node.isSeq() else [node]
    good = all(one.isInt() or one.isReal() for one in items)
    values = np.array([one.real() for one in items] if good else [np.nan])
    if not np.isfinite(values).all() or (counts is not None and len(values) not in counts):
        wanted = "" if counts is None else f"{' or '.join(str(n) for n in counts)} "
        raise InputError(f"{where}: key '{key}' holds {len(values)} values; {wanted}finite numbers are wanted")
    if cells is not None and (cells != len(values) or kind not in ("d", "f", "i")):
        raise InputError(
            f"{where}: matrix '{key}' of rows times cols = {cells:g} holds {len(values)} of dt = {kind!r}; as many "
            "are wanted, of dt d (float64), f (float32) or i (int32)"
        )
    if kind == "i" and (values != np.floor(values)).any():
        raise InputError(f"{where}: matrix '{key}' is of whole numbers (dt = i) and holds others; write dt: d")
    return values.astype(np.float32).astype(np.float64) if kind == "f" else values


def _text(storage: Any, key: str) -> str | None:
    node = storage.getNode(key)
    return node.string() if node.isString() else None


def _camera(
    storage: Any, name: str, number: str, where: str, options: RigFileOptions, camera_from_world: Pose
) -> Camera:
    """Return a camera; ``number`` "1" or "2" is the suffix of a stereo file's keys."""
    matrix_keys = (f"M{number}", f"cameraMatrix{number}") if number else MATRIX
    matrix = _numbers(storage, matrix_keys, where, (9,))
    if matrix is None:
        raise InputError(f"{where}: key '{matrix_keys[0]}' is missing; the 3 x 3 camera matrix in px is wanted")
    distortion_keys = (f"D{number}", f"distCoeffs{number}") if number else DISTORTION
    coefficients = _numbers(storage, distortion_keys, where, None)
    numbered = tuple(f"{key}{number}" for key in FISHEYE)
    fisheye = _numbers(storage, numbered + FISHEYE, where, (1,))
    lens = opencv_lens(
        matrix.reshape(3, 3),
        [] if coefficients is None else coefficients.tolist(),
        fisheye is not None and bool(fisheye[0]),
        where,
    )
    width, height = _size(storage, where, options)
    return checked_camera(Camera(name, width, height, lens, camera_from_world.inverse()), where)


def _size(storage: Any, where: str, options: RigFileOptions) -> tuple[int, int]:
    size = _numbers(storage, SIZE, where, (2,))
    if size is None:
        sides = [_numbers(storage, keys, where, (1,)) for keys in (WIDTH, HEIGHT)]
        if sides[0] is not None and sides[1] is not None:
            size = np.concatenate([sides[0], sides[1]])
        elif options.size_px is not None:
            return options.size_px
        else:
            raise InputError(
                f"{where}: keys 'image_width' and 'image_height' are missing; add them, or give the size"
            )
    if not ((size >= 1) & (size <= 65535) & (size == np.floor(size))).all():
        raise InputError(f"{where}: image of {size.tolist()} px given; two whole numbers, 1 to 65535, are wanted")
    return int(size[0]), int(size[1])


def _pose(
    storage: Any, rotations: tuple[str, ...], translations: tuple[str, ...], where: str, options: RigFileOptions
) -> Pose | None:
    turn, shift = _numbers(storage, rotations, where, (3, 9)), _numbers(storage, translations, where, (3,))
    if turn is None and shift is None:
        return None
    if turn is None or shift is None:
        missing = rotations[0] if turn is None else translations[0]
        raise InputError(f"{where}: key '{missing}' is missing; R and T belong together")
    if len(turn) == 3:
        with np.errstate(over="ignore", invalid="ignore"):
            turn = rotation_from_vector(turn)
    return Pose(rotation_of(turn, where), shift * options.metres("m"))


def _stereo(storage: Any, path: Path, options: RigFileOptions) -> tuple[tuple[Camera, ...], Notes]:
    between = _pose(storage, ROTATION, TRANSLATION, str(path), options)
    if between is None:
        raise InputError(f"{path}: keys 'R' and 'T' are missing; the second camera from the first is wanted")
    first = _pose(storage, ("R_world",), ("T_world",), str(path), options)
    notes: Notes = ()
    if first is None:
        first = Pose(np.eye(3), np.zeros(3))
        notes = (f"{path}: the world is the first camera's: x right, y down, z forward",)
    cameras = []
    for number, pose in (("1", first), ("2", between @ first)):
        name = _text(storage, f"name{number}") or f"cam_{number}"
        cameras.append(_camera(storage, name, number, str(path), options, pose))
    return tuple(cameras), notes


def _put(storage: Any, camera: Camera, number: str, options: RigFileOptions) -> Notes:
    matrix, coefficients, fisheye, notes = opencv_parts(camera, options)
    storage.write(f"name{number}", camera.name)
    if number in ("", "1"):
        storage.write("image_width", camera.width)
        storage.write("image_height", camera.height)
    storage.write(f"M{number}" if number else MATRIX[0], matrix)
    storage.write(f"D{number}" if number else DISTORTION[0], np.array(coefficients)[None])
    storage.write(f"{FISHEYE[0]}{number}", int(fisheye))
    return notes


def _put_pose(storage: Any, pose: Pose, ending: str, unit: float) -> None:
    storage.write(f"R{ending}", np.array(pose.rotation))
    storage.write(f"T{ending}", np.array(pose.translation * unit)[:, None])
