"""Results of MultiCamSelfCal (Svoboda et al. 2005): a folder of ``camN.Pmat.cal`` and ``basenameN.rad``; read only.

``.rad``: K11 ... K33 and kc1 ... kc4 (OpenCV's k1, k2, p1, p2), with which the images were undistorted into pixels of
the same K; ``.Pmat.cal``: the 3 x 4 matrix from world to undistorted pixels, whose own interior orientation differs
from K and has skew. OpenCV's or the Mosca model, whichever is closer, is fitted to both together. ``Res.dat``: image
sizes; ``camera_order.txt``: names. The unit of length is that of the alignment, often none.
"""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from mosca.camera.projection import fit_lens, image_grid, lens_directions
from mosca.data.arrays import Array
from mosca.data.files.bounded import read_text
from mosca.data.rig import Camera, OpenCVLens, Pose
from mosca.errors import InputError
from mosca.formats.rigs.lens_conversion import (
    CALIBRATION,
    Notes,
    RigFileOptions,
    checked_camera,
    fit_note,
    matrix_of,
    numbers,
    opencv_lens,
    rotation_of,
)

VALUE = re.compile(r"^[^\S\n]*(K\d\d|kc\d)[^\S\n]*=(.*)$", re.MULTILINE)


def read_selfcal(path: Path, options: RigFileOptions) -> tuple[tuple[Camera, ...], Notes]:
    """Read a folder of MultiCamSelfCal's results; InputError where a file is missing or bad."""
    if not path.is_dir():
        raise InputError(f"{path}: a folder with camera1.Pmat.cal, basename1.rad ... is wanted")
    count = 0
    while (path / f"basename{count + 1}.rad").is_file():
        count += 1
    if count == 0:
        raise InputError(f"{path}: no basename1.rad in it")
    sizes, names = image_sizes(path, count, options), camera_names(path, count)
    notes: Notes = (
        f"{path}: lengths are in the unit of MultiCamSelfCal's alignment, read as {options.unit or 'm'}; "
        "without an alignment the scale is arbitrary",
    )
    cameras = []
    for k in range(count):
        camera, note = _camera(path, k + 1, names[k], sizes[k], options)
        cameras.append(camera)
        notes += (note,)
    return tuple(cameras), notes


def _camera(
    folder: Path, number: int, name: str, size: tuple[int, int], options: RigFileOptions
) -> tuple[Camera, str]:
    radial, matrix_path = folder / f"basename{number}.rad", folder / f"camera{number}.Pmat.cal"
    lens = _radial(radial)
    projection = np.array(numbers(_without_comments(read_text(matrix_path, CALIBRATION, "utf-8-sig")), matrix_path))
    if len(projection) != 12:
        raise InputError(f"{matrix_path}: {len(projection)} numbers given; a 3 x 4 matrix is wanted")
    interior, rotation, centre = _factors(projection.reshape(3, 4), matrix_path)
    grid = image_grid(*size, step_px=32.0)
    flat = lens_directions(lens, grid)
    undistorted = flat / flat[:, 2:] @ matrix_of(lens).T
    directions = np.linalg.solve(interior, undistorted.T).T
    # with skew; the Mosca model's affinity can represent it
    fit = min((fit_lens(model, grid, directions) for model in ("opencv", "mosca")), key=lambda one: one.max_px)
    pose = Pose(rotation.T, centre * options.metres("m"))
    camera = checked_camera(Camera(name, *size, fit.lens, pose), str(matrix_path))
    return camera, fit_note(
        replace(camera, lens=lens), fit, f"the {fit.lens.model} model with the skew of the matrix", options
    )


def _radial(path: Path) -> OpenCVLens:
    values = {}
    for key, text in VALUE.findall(read_text(path, CALIBRATION, "utf-8-sig")):
        found = numbers(text, path)
        if len(found) != 1:
            raise InputError(f"{path}: '{key} ={text[:40]}' given; one number is wanted")
        values[key] = found[0]
    wanted = [f"K{i}{j}" for i in "123" for j in "123"] + [f"kc{i}" for i in "1234"]
    missing = [key for key in wanted if key not in values]
    if missing:
        raise InputError(f"{path}: '{missing[0]} = ' is missing; K11 ... K33 and kc1 ... kc4 are wanted")
    matrix = np.array([values[key] for key in wanted[:9]]).reshape(3, 3)
    lens = opencv_lens(matrix, [values[key] for key in wanted[9:]], False, str(path))
    assert isinstance(lens, OpenCVLens)
    return lens


def _factors(projection: Array, path: Path) -> tuple[Array, Array, Array]:
    """Return interior (3, 3), camera_from_world rotation (3, 3) and centre (3,) of a projection (3, 4)."""
    square = projection[:, :3]
    determinant = np.linalg.det(square)
    if not np.isfinite(determinant) or abs(determinant) <= 1e-12 * np.linalg.norm(square) ** 3:
        raise InputError(f"{path}: the matrix is singular, no camera's")
    square = square * np.sign(determinant)
    # an upper triangle times a rotation, by the QR decomposition of the inverse
    turn, triangle = np.linalg.qr(np.linalg.inv(square))
    signs = np.sign(np.diag(triangle))
    interior = np.linalg.inv(signs[:, None] * triangle)
    rotation = rotation_of((turn * signs).T, str(path))
    return interior / interior[2, 2], rotation, -np.linalg.solve(projection[:, :3], projection[:, 3])


def image_sizes(folder: Path, count: int, options: RigFileOptions) -> list[tuple[int, int]]:
    """Return width and height [px] of each camera's images, from ``Res.dat``."""
    path = folder / "Res.dat"
    if not path.is_file() and options.size_px is not None:
        return [options.size_px] * count
    values = numbers(read_text(path, CALIBRATION, "utf-8-sig"), path)
    if len(values) != 2 * count or not all(0 < v <= 65535 and v.is_integer() for v in values):
        raise InputError(
            f"{path}: {len(values)} numbers given; width and height of {count} cameras are wanted, whole px"
        )
    return [(int(values[2 * k]), int(values[2 * k + 1])) for k in range(count)]


def camera_names(folder: Path, count: int) -> tuple[str, ...]:
    """Return the cameras' names, from ``camera_order.txt`` where it lists ``count`` of them."""
    path = folder / "camera_order.txt"
    names = read_text(path, CALIBRATION, "utf-8-sig").split() if path.is_file() else []
    return tuple(names) if len(names) == count else tuple(f"cam_{k + 1}" for k in range(count))


def _without_comments(text: str) -> str:
    return "\n".join(line for line in text.split("\n") if not line.lstrip().startswith(("#", "%")))
