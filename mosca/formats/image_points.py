"""Tables of image points that other programs detected: CSV with a row for each point of each frame.

Columns, in any order: ``camera`` (its name in the rig file), ``x_px``, ``y_px`` (pixel centres at whole numbers; in
the camera's original images, with lens distortion), and ``time_s`` (mid-exposure by the camera's own clock) or
``frame`` (its number, with a frame rate). Optional: ``point``, the point's name; ``sigma_px``, its standard deviation
an axis. Rows without x or y are frames in which the point was not seen.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mosca.data.arrays import Array
from mosca.errors import InputError
from mosca.formats.tracks.csv_columns import parsed, read_named

NEEDED, OPTIONAL = ("camera", "x_px", "y_px"), ("time_s", "frame", "point", "sigma_px")
KIND = "table of image points"
LONGEST_S = 1e9
"""Times beyond this many seconds cannot be resolved to the nanosecond."""


@dataclass(frozen=True, eq=False)
class ImagePointTable:
    """n image points: ``camera`` and ``point`` (n,) names, ``point`` empty where none is given; ``time_ns`` (n,) by
    the camera's own clock; ``xy_px`` (n, 2); ``sigma_px`` (n,), NaN where not stated.
    """

    path: Path
    camera: Array
    point: Array
    time_ns: Array
    xy_px: Array
    sigma_px: Array


def read_image_points(path: Path, fps: float | None = None) -> ImagePointTable:
    """Return the image points of a CSV table; ``fps``: frame rate [Hz], needed where ``frame`` replaces ``time_s``.

    InputError names the row that cannot be used: a missing column, a cell that is no number, a point that occurs
    twice in a frame, and tables in which some points have names and others have none.
    """
    cells = read_named(path, NEEDED, OPTIONAL, KIND)
    xy = np.column_stack([parsed(cells[name], name, float, path) for name in ("x_px", "y_px")])
    n = len(xy)
    time_ns = _times(path, cells, fps)
    sigma = parsed(cells["sigma_px"], "sigma_px", float, path) if "sigma_px" in cells else np.full(n, np.nan)
    if (sigma <= 0.0).any():
        row = int(np.flatnonzero(sigma <= 0.0)[0])
        raise InputError(f"{path}, row {row + 2}: sigma_px = {sigma[row]:g}; above 0 px is allowed, or nothing")
    camera = np.array(cells["camera"], dtype=np.str_)
    point = np.array(cells.get("point", ("",) * n), dtype=np.str_)
    seen = np.flatnonzero(np.isfinite(xy).all(axis=1))
    if not len(seen):
        raise InputError(f"{path}: no row has both x_px and y_px; a {KIND} has one point a row")
    nameless = point[seen] == ""
    if nameless.any() and not nameless.all():
        row = int(seen[np.argmax(nameless)])
        raise InputError(
            f"{path}, row {row + 2}: point is empty, others have names; name all points, or leave the column out"
        )
    order = seen[np.lexsort((point[seen], time_ns[seen], camera[seen]))]
    same = (camera[order[1:]] == camera[order[:-1]]) & (time_ns[order[1:]] == time_ns[order[:-1]])
    same &= (point[order[1:]] == point[order[:-1]]) & (point[order[1:]] != "")
    if same.any():
        row = int(order[1:][same][0])
        raise InputError(f"{path}, row {row + 2}: point '{point[row]}' is twice in this frame of '{camera[row]}'")
    return ImagePointTable(path, camera[order], point[order], time_ns[order], xy[order], sigma[order])


def _times(path: Path, cells: Mapping[str, Sequence[str]], fps: float | None) -> Array:
    """Return the instants (n,) [ns] of a table's rows."""
    if "time_s" in cells:
        time_s = parsed(cells["time_s"], "time_s", float, path)
        wrong = ~(np.abs(time_s) < LONGEST_S)
        if wrong.any():
            row = int(np.flatnonzero(wrong)[0])
            raise InputError(
                f"{path}, row {row + 2}: time_s = {cells['time_s'][row]!r}; seconds of the camera's own clock, at "
                f"most {LONGEST_S:g}, are wanted: count from the recording's begin"
            )
        return np.asarray(np.rint(time_s * 1e9).astype(np.int64))
    if "frame" not in cells:
        raise InputError(f"{path}: its first line has neither 'time_s' nor 'frame'; one of them is wanted")
    if fps is None:
        raise InputError(
            f"{path}: has frame numbers and no column 'time_s'; give the frame rate, for example --fps 30"
        )
    if not 0.0 < fps <= 1e6:
        raise InputError(f"--fps {fps:g}: above 0 and at most 1e6 Hz is allowed")
    frame = parsed(cells["frame"], "frame", int, path)
    if np.abs(frame).max(initial=0) > LONGEST_S * fps:
        raise InputError(f"{path}: frame {int(np.abs(frame).max())} at {fps:g} Hz is beyond {LONGEST_S:g} s")
    return np.asarray(np.rint(frame * (1e9 / fps)).astype(np.int64))
