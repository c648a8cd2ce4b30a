"""Exposure times of numbered frames: from ``frames.csv``, or evenly spaced at ``--fps``.

``frames.csv`` has a header and the columns ``frame,camera,time_ns,exposure_ns,status``; the last two may be
left out. ``frame`` is the number in the file's name (in a video: counted from 0), ``camera`` the name of
the folder or of the rig's camera, ``time_ns`` the start of the exposure, ``status`` one of ok, dropped, corrupt.
"""

import csv
import io
import statistics
from bisect import bisect_left
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Protocol, cast, get_args

from mosca.data.files.bounded import MOST_TABLE_BYTES, read_text
from mosca.data.files.decimals import BLANKS, integers
from mosca.data.frames import FrameStatus
from mosca.errors import InputError

COLUMNS = ("frame", "camera", "time_ns", "exposure_ns", "status")
STATUSES = get_args(FrameStatus)


@dataclass(frozen=True, slots=True)
class Stamp:
    """A frame's exposure: start [ns] and length [ns], and its status as recorded."""

    time_ns: int
    exposure_ns: int = 0
    status: FrameStatus = "ok"


class Stamps(Protocol):
    """Gives each camera's numbered frames their times."""

    @property
    def rate_hz(self) -> float:
        """Nominal frame rate [1/s]."""
        ...

    def of(self, camera: str, number: int) -> Stamp:
        """Return the stamp of a camera's frame."""
        ...


@dataclass(frozen=True)
class EvenStamps:
    """Frame ``first`` is at 0 and each further one 1/rate later."""

    rate_hz: float
    first: int

    def of(self, camera: str, number: int) -> Stamp:
        """Return the stamp of frame ``number``, the same for each camera."""
        return Stamp(round((number - self.first) * 1e9 / self.rate_hz))


@dataclass(frozen=True)
class TableStamps:
    """Stamps of ``frames.csv``: camera -> number -> Stamp, and camera -> its numbers, rising."""

    rate_hz: float
    rows: dict[str, dict[int, Stamp]]
    numbers: dict[str, list[int]]

    def of(self, camera: str, number: int) -> Stamp:
        """Return the row's stamp; a frame without a row is dropped, its time derived from the row before."""
        rows, numbers = self.rows[camera], self.numbers[camera]
        if number in rows:
            return rows[number]
        near = numbers[max(bisect_left(numbers, number) - 1, 0)]
        return Stamp(rows[near].time_ns + round((number - near) * 1e9 / self.rate_hz), 0, "dropped")


def read_stamps(path: Path, cameras: dict[str, str], rate_hz: float | None) -> TableStamps:
    """Read ``frames.csv`` for ``cameras`` (name in the file system -> the camera's name).

    ``rate_hz`` overrides the rate that the median spacing of the rows implies. Raises InputError naming the
    line, the column and what is allowed; also where a camera has no row and where times do not rise.
    """
    names = {**{own: own for own in cameras.values()}, **cameras}
    rows: dict[str, dict[int, Stamp]] = {own: {} for own in cameras.values()}
    for line, row in _lines(path):
        number = _integer(row, "frame", path, line)
        stamp = Stamp(
            _integer(row, "time_ns", path, line),
            _integer(row, "exposure_ns", path, line) if row.get("exposure_ns") else 0,
            _status(row.get("status") or "ok", path, line),
        )
        camera = names.get(row["camera"])
        if camera is None:
            continue
        if number in rows[camera]:
            raise InputError(f"{path}, line {line}: frame {number} of {row['camera']} stands twice; keep one")
        rows[camera][number] = stamp
    implied_hz = _rate_hz(rows, path, rate_hz)
    return TableStamps(rate_hz or implied_hz, rows, {camera: sorted(r) for camera, r in rows.items()})


def _lines(path: Path) -> Iterator[tuple[int, dict[str, str]]]:
    """Yield the number of each line and its cells by column."""
    text = read_text(path, "a CSV table", "utf-8-sig", MOST_TABLE_BYTES)
    try:
        reader = csv.reader(io.StringIO(text, newline=""), strict=True)
        header = [name.strip(BLANKS) for name in next(reader, [])]
        missing = [name for name in COLUMNS[:3] if name not in header]
        if missing:
            raise InputError(
                f"{path}: its first line lacks '{missing[0]}'; wanted is {','.join(COLUMNS)} "
                "(exposure_ns and status may be left out)"
            )
        for cells in reader:
            if not cells:
                continue
            if len(cells) != len(header):
                raise InputError(f"{path}, line {reader.line_num}: {len(cells)} values for {len(header)} columns")
            row = dict(zip(header, (cell.strip(BLANKS) for cell in cells), strict=True))
            yield reader.line_num, row
    except csv.Error as error:
        raise InputError(f"{path}: cannot be read as CSV: {error}") from None


def _integer(row: dict[str, str], column: str, path: Path, line: int) -> int:
    try:
        (value,) = integers([row[column]])
    except ValueError:
        raise InputError(f"{path}, line {line}: {column} = {row[column][:40]!r}; a whole number is wanted") from None
    if not -(2**63) <= value < 2**63 or (column == "exposure_ns" and value < 0):
        raise InputError(f"{path}, line {line}: {column} = {value} is out of range")
    return value


def _status(value: str, path: Path, line: int) -> FrameStatus:
    if value not in STATUSES:
        raise InputError(f"{path}, line {line}: status = {value[:40]!r}; {', '.join(STATUSES)} are allowed")
    return cast(FrameStatus, value)


def _rate_hz(rows: dict[str, dict[int, Stamp]], path: Path, given_hz: float | None) -> float:
    """Return the rate that the median spacing per frame number implies; check that times rise."""
    spacings = []
    for camera, stamps in rows.items():
        if not stamps:
            raise InputError(f"{path}: no line for camera '{camera}'")
        ordered = sorted(stamps.items())
        for (a, earlier), (b, later) in pairwise(ordered):
            if later.time_ns <= earlier.time_ns:
                raise InputError(
                    f"{path}: times of camera '{camera}' do not rise from frame {a} to frame {b} "
                    f"({earlier.time_ns} to {later.time_ns} ns)"
                )
            spacings.append((later.time_ns - earlier.time_ns) / (b - a))
    if not spacings:
        if given_hz is not None:
            return given_hz
        raise InputError(f"{path}: one frame a camera does not tell the frame rate; pass --fps")
    return 1e9 / statistics.median(spacings)
