"""Sessions of MultiCamSelfCal (Svoboda et al. 2005): image points of one light, a folder of text tables; read only.

``points.dat``: three rows a camera (x, y, 1), a column a frame. ``IdMat.dat``: a row a camera, 1 where the light was
seen, else 0; without this file, points count as seen that are neither NaN nor 0. ``Res.dat``: width and height of
each camera's images.
``camera_order.txt``: the cameras' names.
"""

from pathlib import Path

import numpy as np

from mosca.data.arrays import Array
from mosca.data.files.bounded import MOST_TABLE_BYTES, read_text
from mosca.data.files.target_tables import PIXEL_ORIGINS
from mosca.data.sightings import Sightings
from mosca.data.wands import SingleLight
from mosca.errors import InputError
from mosca.formats.number_table import number_table
from mosca.formats.rigs.lens_conversion import NAME, RigFileOptions
from mosca.formats.rigs.selfcal import camera_names, image_sizes

POINTS = "points.dat"


def read_selfcal_points(folder: Path, light: SingleLight) -> Sightings:
    """Return a session's image points, mark 0 in each frame; InputError names file, row and column of what is wrong.

    ``light``: how pixels are counted, and their standard deviation.
    """
    path = folder / POINTS
    table = _numbers(path)
    count, left = divmod(len(table), 3)
    if left or count < 2:
        raise InputError(
            f"{path}: {len(table)} rows given; three a camera (x, y, 1) of two cameras and more are wanted"
        )
    sizes = np.array(image_sizes(folder, count, RigFileOptions()))
    xy = np.moveaxis(table.reshape(count, 3, -1)[:, :2], 1, 2)
    seen = _seen(folder / "IdMat.dat", xy)
    pixel = xy - PIXEL_ORIGINS[light.pixel_origin]
    _check_inside(path, xy, pixel, seen, sizes)
    frame, camera = np.nonzero(seen.T)
    n = len(frame)
    return Sightings(
        _names(folder, count), sizes, xy.shape[1], camera, frame, np.zeros(n, dtype=np.int64),
        pixel[camera, frame], np.tile(light.sigma_px**2 * np.eye(2), (n, 1, 1)), np.full(n, np.nan),
    )  # fmt: skip


def _names(folder: Path, count: int) -> tuple[str, ...]:
    """Return the cameras' names; InputError for those that no rig file can hold."""
    names = camera_names(folder, count)
    for name in names:
        if names.count(name) > 1 or not NAME.fullmatch(name):
            raise InputError(
                f"{folder / 'camera_order.txt'}: {name[:40]!r} given; a name of letters, digits, _ . - is wanted, "
                "another one for each camera"
            )
    return names


def _seen(path: Path, xy: Array) -> Array:
    """Return (c, f) whether each camera saw the light; taken from the file at ``path`` where it exists."""
    there = np.asarray(np.isfinite(xy).all(axis=2))
    if not path.is_file():
        return np.asarray(there & (xy != 0).any(axis=2))
    found = _numbers(path)
    if found.shape != there.shape:
        (rows, columns), (cameras, frames) = found.shape, there.shape
        raise InputError(
            f"{path}: {rows} rows of {columns} given; {cameras} rows of {frames} are wanted, a row a camera of "
            f"{POINTS}, a column a frame"
        )
    odd = np.argwhere((found != 0) & ((found != 1) | ~there))
    if len(odd):
        k, f = odd[0]
        why = "0 or 1 is wanted" if found[k, f] != 1 else f"but {POINTS} has no point there"
        raise InputError(f"{path}, row {k + 1}, column {f + 1}: {found[k, f]:g} given; {why}")
    return np.asarray(found == 1)


def _numbers(path: Path) -> Array:
    """Return the rows of a text table as numbers, NaN included."""
    text = read_text(path, "a session of MultiCamSelfCal: points.dat, Res.dat", "utf-8-sig", MOST_TABLE_BYTES)
    rows = [(number, line.split()) for number, line in enumerate(text.split("\n"), start=1) if line.strip()]
    if not rows:
        raise InputError(f"{path}: no numbers in it; a row of them for each camera is wanted")
    return number_table(path, rows, "line", "a number or NaN")


def _check_inside(path: Path, given: Array, pixel: Array, seen: Array, sizes: Array) -> None:
    """Raise InputError where a point that was seen (camera, frame, 2) lies outside its image."""
    outside = seen & ((pixel < -0.5) | (pixel > sizes[:, None] - 0.5)).any(axis=2)
    if outside.any():
        k, f = np.argwhere(outside)[0]
        (x, y), (width, height) = given[k, f], sizes[k]
        raise InputError(
            f"{path}, rows {3 * k + 1} and {3 * k + 2}, column {f + 1}: ({x:g}, {y:g}) lies outside the image of "
            f"{width} x {height} px; {int(outside.sum())} points do: check Res.dat, 'pixel_origin' and the order"
        )
