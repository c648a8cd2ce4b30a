"""``tracks.csv``: one line a track and frame, every number at full precision.

Columns ``frame,time_ns,track,label,x,y,z,sxx,syy,szz,sxy,sxz,syz,n_cameras,residual_px,status``: position in m
and covariance of the measurement in m^2, world frame; empty where unknown. The covariance is symmetric, so
six of its elements are written.
"""

import csv
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mosca.data.arrays import Array
from mosca.data.tracks import STATUSES, Tracks
from mosca.data.whole_file import whole_file
from mosca.errors import InputError

COLUMNS = (
    "frame", "time_ns", "track", "label", "x", "y", "z", "sxx", "syy", "szz", "sxy", "sxz", "syz",
    "n_cameras", "residual_px", "status",
)  # fmt: skip
_ELEMENTS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


def write_tracks_csv(tracks: Tracks, path: Path) -> None:
    """Write ``tracks`` to ``path``, whole or not at all. Raises InputError where that cannot be."""
    columns = [
        _integers(tracks.frame),
        _integers(tracks.time_ns),
        _integers(tracks.track),
        tracks.label.tolist(),
        *(_reals(tracks.xyz[:, k]) for k in range(3)),
        *(_reals(tracks.covariance[:, i, j]) for i, j in _ELEMENTS),
        _integers(tracks.n_cameras),
        _reals(tracks.residual_px),
        tracks.status.tolist(),
    ]
    with whole_file(Path(path)) as temporary, open(temporary, "w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        writer.writerows(zip(*columns, strict=True))


def read_tracks_csv(path: Path) -> Tracks:
    """Read a ``tracks.csv``. Raises InputError naming the line or column and what is allowed."""
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
        rows = list(csv.reader(io.StringIO(text, newline=""), strict=True))
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: cannot be read as CSV: {error}") from None
    if not rows or tuple(rows[0]) != COLUMNS:
        raise InputError(f"{path}: its first line is not that of a tracks.csv; wanted is {','.join(COLUMNS)}")
    for line, row in enumerate(rows[1:], start=2):
        if len(row) != len(COLUMNS):
            raise InputError(f"{path}, row {line}: {len(row)} values given, {len(COLUMNS)} wanted")
    cells = dict(zip(COLUMNS, zip(*rows[1:], strict=True), strict=True)) if len(rows) > 1 else {}
    if not cells:
        return Tracks.none()
    for line, status in enumerate(cells["status"], start=2):
        if status not in STATUSES:
            raise InputError(f"{path}, row {line}: status {status!r}; {', '.join(STATUSES)} are allowed")
    covariance = np.empty((len(rows) - 1, 3, 3))
    for (i, j), name in zip(_ELEMENTS, COLUMNS[7:13], strict=True):
        covariance[:, i, j] = covariance[:, j, i] = _parsed(cells[name], name, float, path)
    return Tracks(
        frame=_parsed(cells["frame"], "frame", int, path),
        time_ns=_parsed(cells["time_ns"], "time_ns", int, path),
        track=_parsed(cells["track"], "track", int, path),
        label=np.array(cells["label"], dtype=np.str_),
        xyz=np.stack([_parsed(cells[name], name, float, path) for name in "xyz"], axis=1),
        covariance=covariance,
        n_cameras=_parsed(cells["n_cameras"], "n_cameras", int, path),
        residual_px=_parsed(cells["residual_px"], "residual_px", float, path),
        status=np.array(cells["status"], dtype=np.str_),
    )


def _integers(values: Array) -> list[str]:
    return list(map(str, values.tolist()))


def _reals(values: Array) -> list[str]:
    """Return the shortest decimal that reads back to the same float64; nothing for an unknown one."""
    return ["" if value != value else repr(value) for value in values.tolist()]


def _parsed(cells: Sequence[str], name: str, kind: type[int] | type[float], path: Path) -> Array:
    try:
        if kind is int:
            return np.array(list(map(int, cells)), dtype=np.int64)
        return np.array([float(cell) if cell else np.nan for cell in cells])
    except (ValueError, OverflowError):
        line, cell = next((k, c) for k, c in enumerate(cells, start=2) if not _is(kind, c))
        wanted = "a whole number of 64 bit" if kind is int else "a number or nothing"
        raise InputError(f"{path}, row {line}: {name} = {cell[:40]!r}; {wanted} is wanted") from None


def _is(kind: type[int] | type[float], cell: str) -> bool:
    try:
        return -(2**63) <= int(cell) < 2**63 if kind is int else not cell or float(cell) is not None
    except ValueError:
        return False
