"""Paths of named points in a CSV table: ``time`` and then ``NAME.x``, ``NAME.y``, ``NAME.z`` per point.

BVH converters write this as ``*_worldpos.csv``; spreadsheets of marker or joint positions have this form. An empty
cell or ``nan`` is a point that is missing at that time.
"""

import csv
import io
from pathlib import Path

import numpy as np

from mosca.data.arrays import Array
from mosca.data.files.bounded import MOST_TABLE_BYTES, read_text
from mosca.data.files.decimals import BLANKS
from mosca.data.motion.motion import PointMotion, in_world, number
from mosca.errors import InputError


def read_points_csv(path: Path, *, metres_per_unit: float = 1.0, y_up: bool = False) -> PointMotion:
    """Return the point paths in CSV file ``path`` in the world (Z up, m).

    The header's first column is ``time`` [s] (any case); ``y_up``: the file's world has Y up, as in converted BVH
    files. Raises InputError naming file, line and what is expected.
    """
    text = read_text(path, "a CSV table", "utf-8-sig", MOST_TABLE_BYTES)
    try:
        rows = [row for row in csv.reader(io.StringIO(text, newline=""), strict=True) if row]
    except csv.Error as error:
        raise InputError(f"{path}: not a CSV table: {error}") from None
    if len(rows) < 2:
        raise InputError(f"{path}: {len(rows)} lines given; a header and one line of numbers at least wanted")
    names = _point_names([cell.strip(BLANKS) for cell in rows[0]], path)
    table = np.array([_row(row, len(rows[0]), f"{path}: row {k}") for k, row in enumerate(rows[1:], 2)])
    time_s = table[:, 0]
    if np.isnan(time_s).any() or np.any(np.diff(time_s) <= 0):
        raise InputError(f"{path}: column 'time' must be filled and rise from line to line")
    xyz = table[:, 1:].reshape(len(table), len(names), 3) * metres_per_unit
    return PointMotion(names, time_s, in_world(xyz) if y_up else xyz)


def _point_names(header: list[str], path: Path) -> tuple[str, ...]:
    columns = header[1:]
    names = tuple(column[:-2] for column in columns[::3])
    wanted = [f"{name}.{axis}" for name in names for axis in "xyz"]
    given = [column[:-1] + column[-1:].lower() for column in columns]
    if header[0].lower() != "time" or not names or given != wanted or len(set(names)) < len(names):
        raise InputError(
            f"{path}: header '{','.join(header)[:60]}' given; 'time,NAME.x,NAME.y,NAME.z,...' wanted, each name once"
        )
    return names


def _row(cells: list[str], width: int, where: str) -> Array:
    if len(cells) != width:
        raise InputError(f"{where}: {len(cells)} cells given, {width} wanted as in the header")
    empty = ("", "nan")
    return np.array([np.nan if c.lower() in empty else number(c, where) for c in (c.strip(BLANKS) for c in cells)])
