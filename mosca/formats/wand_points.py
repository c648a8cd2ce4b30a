"""Tables of a wand's image points that were digitised elsewhere: CSV with a row for each frame.

The columns are those of EasyWand (Theriault et al. 2014, J. Exp. Biol. 217, 1843), DLTdv and Argus: x and y in each
camera of the first point, then of the second, and so on; NaN or nothing where a point was not seen. The first line
may name them: ``pt1_cam1_X,pt1_cam1_Y,pt1_cam2_X,...``. Sizes of the images, and whether y is counted from above or
from below, are stated in ``[points]`` of the wand's file. The latter cannot be determined from the points:
upside-down images fit the mirror image of the rig equally well.
"""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mosca.data.arrays import Array
from mosca.data.files.decimals import BLANKS
from mosca.data.files.target_tables import PIXEL_ORIGINS, WandPointsTable
from mosca.data.sightings import Sightings
from mosca.errors import InputError
from mosca.formats.number_table import number_table
from mosca.formats.tracks.csv_columns import read_rows

NAME = re.compile(r"(.+)_cam_?(\d{1,4})_([xy])", re.IGNORECASE)
FEWEST_CAMERAS = 2


def read_wand_points(path: Path, layout: WandPointsTable, balls: int) -> Sightings:
    """Return the image points of a table as a session's sightings, a frame a row; marks are the wand's ``balls``.

    InputError names row and column of a value that does not fit ``layout`` or the wand.
    """
    rows = read_rows(path)
    first = 1 if rows and any(NAME.fullmatch(cell.strip(BLANKS)) for cell in rows[0]) else 0
    if len(rows) == first:
        raise InputError(f"{path}: no image points; a row of x and y for each frame is wanted")
    cameras = _cameras(path, len(rows[0]), layout, balls)
    if first:
        _check_names(path, rows[0], len(cameras))
    xy = _numbers(path, rows, first).reshape(-1, balls, len(cameras), 2)
    sizes = np.array([size for _, size in cameras])
    origin = PIXEL_ORIGINS[layout.pixel_origin]
    pixel = xy - origin
    if layout.y_axis == "up":
        pixel[..., 1] = sizes[:, 1] - 1 - pixel[..., 1]
    _check_inside(path, xy, pixel, sizes, first)
    frame, ball, camera = np.nonzero(np.isfinite(pixel).all(axis=3))
    n = len(frame)
    return Sightings(
        tuple(name for name, _ in cameras),
        sizes,
        len(xy),
        camera,
        frame,
        ball,
        pixel[frame, ball, camera],
        np.tile(layout.sigma_px**2 * np.eye(2), (n, 1, 1)),
        np.full(n, np.nan),
    )


def _cameras(path: Path, columns: int, layout: WandPointsTable, balls: int) -> list[tuple[str, tuple[int, int]]]:
    """Return the cameras' names and sizes."""
    count, left = divmod(columns, 2 * balls)
    if left or count < FEWEST_CAMERAS or (layout.camera and len(layout.camera) != count):
        wanted = (
            f"of {len(layout.camera)} cameras {2 * balls * len(layout.camera)} are"
            if layout.camera
            else f"a multiple of {2 * balls} is"
        )
        raise InputError(
            f"{path}: {columns} columns given; {wanted} wanted: x and y of {balls} balls are {2 * balls} a camera"
        )
    if not layout.camera:
        assert layout.size_px is not None  # the wand's file is checked for it
        return [(f"cam{k + 1}", layout.size_px) for k in range(count)]
    return [(one.name, one.size_px or layout.size_px or (0, 0)) for one in layout.camera]


def _check_names(path: Path, names: Sequence[str], cameras: int) -> None:
    """Raise InputError where the first line names other columns than those of points, in these cameras, x and y."""
    point = ""
    for k, name in enumerate(names):
        match = NAME.fullmatch(name.strip(BLANKS))
        camera = k // 2 % cameras + 1
        point = match[1] if match and k % (2 * cameras) == 0 else point
        if match is None or match[1] != point or int(match[2]) != camera or match[3].lower() != "xy"[k % 2]:
            wanted = f"{point or 'pt1'}_cam{camera}_{'XY'[k % 2]}"
            raise InputError(
                f"{path}, row 1, column {k + 1}: {name[:40]!r} given; '{wanted}' is wanted: all cameras' x and y of "
                "one point, then of the next"
            )


def _numbers(path: Path, rows: Sequence[Sequence[str]], first: int) -> Array:
    """Return the cells (n, columns) as numbers, NaN where there is none."""
    table = number_table(path, list(enumerate(rows, 1))[first:], "row", "a number, NaN or nothing")
    half = np.isnan(table[:, ::2]) != np.isnan(table[:, 1::2])
    if half.any():
        k, j = np.argwhere(half)[0]
        raise InputError(
            f"{path}, row {first + k + 1}, columns {2 * j + 1} and {2 * j + 2}: one of x and y is given; both, or "
            "NaN for both, are wanted"
        )
    return table


def _check_inside(path: Path, given: Array, pixel: Array, sizes: Array, first: int) -> None:
    """Raise InputError where a point (frame, ball, camera, 2) lies outside its image."""
    outside = ((pixel < -0.5) | (pixel > sizes - 0.5)).any(axis=3)
    if outside.any():
        frame, ball, camera = np.argwhere(outside)[0]
        (x, y), (width, height) = given[frame, ball, camera], sizes[camera]
        column = 2 * (ball * len(sizes) + camera) + 1
        raise InputError(
            f"{path}, row {first + frame + 1}, columns {column} and {column + 1}: ({x:g}, {y:g}) lies outside the "
            f"image of {width} x {height} px; {int(outside.sum())} points do: check 'size_px' and 'pixel_origin', "
            "and the order of the columns"
        )
