"""TRC files (Motion Analysis; read by OpenSim and Pose2Sim): tab-separated text, here in millimetres.

A missing sample is left blank. The axes stay those of the world, Z up; OpenSim expects Y up and rotates
them on import. Numbers are written at full precision.
"""

from pathlib import Path

import numpy as np

from mosca.data.files.bounded import MOST_TABLE_BYTES, read_text
from mosca.data.files.decimals import BLANKS, real
from mosca.data.files.whole_file import write_text
from mosca.errors import InputError
from mosca.formats.tracks.marker_table import MarkerTable, plain_names

METRES_PER = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
"""Metres in the units that a TRC file may state."""
_MISSING = ("", "nan")


def write_trc(table: MarkerTable, path: Path) -> None:
    """Write a marker table as TRC, whole or not at all; InputError where it holds no sample."""
    n_frames, n_markers = table.xyz.shape[:2]
    if n_frames == 0 or n_markers == 0:
        raise InputError(f"{path}: no track to write; a TRC file holds at least one marker and one frame")
    path = Path(path)
    rate = repr(float(table.rate_hz))
    lines = [
        f"PathFileType\t4\t(X/Y/Z)\t{path.name}",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{rate}\t{rate}\t{n_frames}\t{n_markers}\tmm\t{rate}\t{table.first_frame}\t{n_frames}",
        "Frame#\tTime\t" + "\t\t\t".join(plain_names(table.names)) + "\t\t",
        "\t\t" + "\t".join(f"{axis}{k + 1}" for k in range(n_markers) for axis in "XYZ"),
        "",
    ]
    for k, row in enumerate((1e3 * table.xyz).reshape(n_frames, -1).tolist()):
        frame = table.first_frame + k
        cells = "\t".join("" if value != value else repr(value) for value in row)
        lines.append(f"{frame}\t{frame / table.rate_hz!r}\t{cells}")
    write_text(path, "\n".join(lines) + "\n")


def read_trc(path: Path) -> MarkerTable:
    """Read a TRC file; blank or NaN samples are absent (NaN).

    Raises InputError naming the line, its content and what is expected.
    """
    path = Path(path)
    text = read_text(path, "a TRC file", "utf-8-sig", MOST_TABLE_BYTES)
    lines = text.removesuffix("\n").split("\n")
    if len(lines) < 5 or not lines[0].startswith("PathFileType"):
        raise InputError(f"{path}: not a TRC file; its first line starts with PathFileType")
    head = dict(zip(lines[1].split("\t"), (cell.strip(BLANKS) for cell in lines[2].split("\t")), strict=False))
    rate_hz = _number(head.get("DataRate", ""), path, 3, "DataRate")
    unit = head.get("Units", "").lower()
    if unit not in METRES_PER or not rate_hz > 0:
        raise InputError(
            f"{path}, line 3: Units = {unit!r} and DataRate = {rate_hz:g}; "
            f"{', '.join(METRES_PER)} and a rate above 0 are allowed"
        )
    names = tuple(cell.strip(BLANKS) for cell in lines[3].split("\t")[2:] if cell.strip(BLANKS))
    if not names or len(set(names)) != len(names) or head.get("NumMarkers") != str(len(names)):
        raise InputError(
            f"{path}, line 4: {len(names)} marker names ({len(set(names))} of them distinct), "
            f"NumMarkers = {head.get('NumMarkers')}; as many distinct names are wanted"
        )
    frames, values = [], []
    for number, line in enumerate(lines[5:], start=6):
        cells = [cell.strip(BLANKS) for cell in line.split("\t")]
        if not any(cells):
            continue
        frames.append(_number(cells[0], path, number, "Frame#"))
        values.append(_row(cells[2:], 3 * len(names), path, number))
    if not values:
        raise InputError(f"{path}: holds no frame")
    if head.get("NumFrames") != str(len(values)):
        raise InputError(
            f"{path}, line 3: NumFrames = {head.get('NumFrames', '')[:40]!r}, and {len(values)} frames follow; "
            "the file is cut short or its header is wrong: write it again, or correct NumFrames"
        )
    first = frames[0]
    if first != round(first) or frames != [first + k for k in range(len(frames))] or abs(first) > 2**53:
        raise InputError(f"{path}: its frame numbers do not rise one by one from line to line")
    xyz = np.array(values).reshape(len(values), len(names), 3) * METRES_PER[unit]
    seen = np.asarray(np.isfinite(xyz).all(axis=2))
    return MarkerTable(names, xyz, seen, np.full(seen.shape, np.nan), int(first), rate_hz)


def _row(cells: list[str], n: int, path: Path, line: int) -> list[float]:
    """Return ``n`` values; what is missing at the end of a line is NaN."""
    if any(cells[n:]):
        raise InputError(f"{path}, line {line}: {len(cells)} values given, {n} wanted")
    cells = cells[:n] + [""] * (n - len(cells))
    return [np.nan if c.lower() in _MISSING else _number(c, path, line, "a coordinate") for c in cells]


def _number(cell: str, path: Path, line: int, what: str) -> float:
    try:
        value = real(cell)
    except ValueError:
        value = np.inf
    if not np.isfinite(value):
        raise InputError(f"{path}, line {line}: {what} is {cell[:40]!r}; a number is wanted")
    return value
