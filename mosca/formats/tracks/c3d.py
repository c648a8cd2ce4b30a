"""C3D files (c3d.org), written and read through ezc3d; millimetres inside, metres outside.

The residual field follows the C3D user guide: -1 where there is no sample, 0 where one was filled, above 0
where it was measured; here it is the standard deviation of the 3D position in mm, in steps of
``-POINT:SCALE``, at least one step. Coordinates are float32, as the format has them. The world is
right-handed with Z up and stays so (``POINT:X_SCREEN`` = +X, ``POINT:Y_SCREEN`` = +Z).
"""

import math
import struct
from collections.abc import Sequence
from pathlib import Path

import ezc3d
import numpy as np

from mosca.data.arrays import Array
from mosca.data.files.bounded import read_bytes
from mosca.data.files.whole_file import whole_file
from mosca.errors import InputError
from mosca.formats.tracks.c3d_checks import MOST_BYTES, fault_of, frames_of_parameters
from mosca.formats.tracks.marker_table import MarkerTable, plain_names

# Errors that ezc3d, and reading its output, raise on damaged files.
_DAMAGE = (OSError, ArithmeticError, LookupError, MemoryError, RuntimeError, ValueError, struct.error)
LARGEST_COUNT = 65535
"""Largest number of 16 bit, which hold the count of points and the number of the last frame."""
OTHER_KINDS = ("ANGLES", "FORCES", "MOMENTS", "POWERS", "SCALARS")
"""Parameters of POINT that list points which are not positions, as Vicon's models write them."""
LONGEST_LABEL = 120
"""Characters: a dimension is one byte, and some readers take it for a signed one."""
METRES_PER = {"mm": 1e-3, "cm": 1e-2, "dm": 1e-1, "m": 1.0, "in": 0.0254}
"""Metres in the units that POINT:UNITS may state."""


def write_c3d(table: MarkerTable, path: Path) -> None:
    """Write a marker table as C3D, whole or not at all; InputError as ``c3d_document``."""
    document = c3d_document(table, path)
    with whole_file(Path(path)) as temporary:
        document.write(str(temporary))


def c3d_document(table: MarkerTable, path: Path) -> ezc3d.c3d:
    """Return a marker table as a document of ezc3d, to be written to ``path``, which messages name.

    Raises InputError where it holds no sample, or more frames or markers than a C3D file can count.
    """
    n_frames, n_markers = table.xyz.shape[:2]
    if n_frames == 0 or n_markers == 0:
        raise InputError(f"{path}: no track to write; a C3D file holds at least one point and one frame")
    if n_markers > LARGEST_COUNT or not 0 <= table.first_frame <= LARGEST_COUNT - n_frames:
        raise InputError(
            f"{path}: {n_markers} points in frames {table.first_frame} to {table.first_frame + n_frames - 1}; "
            f"a C3D file counts to {LARGEST_COUNT}; write .npz, .csv or .trc, or fewer frames"
        )
    seen = np.isfinite(table.xyz).all(axis=2).T
    points = np.zeros((4, n_markers, n_frames))
    points[:3] = np.where(seen, 1e3 * table.xyz.transpose(2, 1, 0), np.nan)
    points[3] = 1.0
    document = ezc3d.c3d()
    point = document["parameters"]["POINT"]
    point["RATE"]["value"] = [table.rate_hz]
    point["UNITS"]["value"] = ["mm"]
    point["LABELS"]["value"] = list(plain_names(table.names, LONGEST_LABEL))
    document.add_parameter("POINT", "X_SCREEN", ["+X"])
    document.add_parameter("POINT", "Y_SCREEN", ["+Z"])
    document["data"]["points"] = points
    residuals, step = _residuals_mm(table)
    point["SCALE"]["value"] = [-step]
    document["data"]["meta_points"]["residuals"] = residuals.T[np.newaxis]
    document["data"]["meta_points"]["camera_masks"] = np.zeros((7, n_markers, n_frames), dtype=bool)
    document["header"]["points"]["first_frame"] = table.first_frame
    document["header"]["points"]["last_frame"] = table.first_frame + n_frames - 1
    return document


def read_c3d(path: Path) -> MarkerTable:
    """Read the points of a C3D file; samples with a negative residual or no coordinates are absent (NaN).

    Points listed in ``POINT:ANGLES`` and the others of ``OTHER_KINDS`` are not points in space and are left out.

    Raises InputError where it cannot be read, is cut short or damaged, has no points or an unknown unit.
    """
    path = Path(path)
    try:
        data = read_bytes(path, MOST_BYTES)
        fault = fault_of(data)
        if fault:
            raise InputError(f"{path}: cannot be read as C3D: {fault}")
        document = ezc3d.c3d(str(path))
        points = np.asarray(document["data"]["points"], dtype=np.float64)
        residuals = np.asarray(document["data"]["meta_points"]["residuals"], dtype=np.float64)
        parameters = document["parameters"]["POINT"]
        rate_hz = float(parameters["RATE"]["value"][0])
        unit = parameters["UNITS"]["value"][0].strip().lower() if parameters["UNITS"]["value"] else "mm"
        first_frame = int(document["header"]["points"]["first_frame"])
        n_bytes = _bytes_needed(document, data)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; a C3D file is wanted") from None
    except _DAMAGE as error:
        raise InputError(f"{path}: cannot be read as C3D: {getattr(error, 'strerror', None) or error}") from None
    if n_bytes > len(data):
        raise InputError(f"{path}: cannot be read as C3D: cut short, {len(data)} of {n_bytes} bytes")
    if unit not in METRES_PER:
        raise InputError(f"{path}: POINT:UNITS = {unit!r}; {', '.join(METRES_PER)} are known")
    if points.size == 0 or not rate_hz > 0:
        raise InputError(f"{path}: holds no points ({points.shape[1]} markers at {rate_hz:g} frames/s)")
    xyz = points[:3].transpose(2, 1, 0) * METRES_PER[unit]
    xyz[(residuals[0].T < 0)] = np.nan
    seen = np.asarray(np.isfinite(xyz).all(axis=2))
    # Many writers leave every residual 0: then filled samples are not marked.
    stated = residuals[0].T > 0
    measured = seen & stated if stated.any() else seen
    deviation = np.where(stated, residuals[0].T * METRES_PER[unit], np.nan)
    names = _names(parameters, points.shape[1])
    others = {str(label).strip() for kind in OTHER_KINDS for label in parameters.get(kind, {}).get("value", [])}
    kept = [k for k, name in enumerate(names) if name not in others]
    if not kept:
        raise InputError(f"{path}: all its points are {', '.join(OTHER_KINDS).lower()}; none is a place")
    names = tuple(names[k] for k in kept)
    return MarkerTable(names, xyz[:, kept], measured[:, kept], deviation[:, kept], first_frame, rate_hz)


def _bytes_needed(document: ezc3d.c3d, data: bytes) -> int:
    """Return how long the file must be to hold its frames: ezc3d reads truncated files without an error.

    (C3D user guide, header section: words 4 and 5 are the first and last frame, word 9 the data's block.) Where the
    header and POINT:FRAMES differ, one of them is stale: some writers change only one when they cut a file.
    """
    first, last, block = struct.unpack_from("<6x2H6xH", data)
    stated = frames_of_parameters(data) or math.inf
    n_frames = max(min(last - first + 1, stated), document["data"]["points"].shape[2])
    header = document["header"]
    per_point_frame = round(header["analogs"]["frame_rate"] / header["points"]["frame_rate"])
    values = 4 * header["points"]["size"] + header["analogs"]["size"] * per_point_frame
    width = 4 if document["parameters"]["POINT"]["SCALE"]["value"][0] < 0 else 2  # float32 or int16
    return int(512 * (block - 1) + n_frames * values * width)


def _residuals_mm(table: MarkerTable) -> tuple[Array, float]:
    """Return the residual field (t, m) [mm] and its step [mm]: the file holds it in 7 bit as a number of steps."""
    if not np.isfinite(table.deviation_m).any() and (table.measured == np.isfinite(table.xyz).all(axis=2)).all():
        # errors unknown and nothing filled: residual 0 throughout
        return np.where(table.measured, 0.0, -1.0), 1e-3
    deviation_mm = 1e3 * np.nan_to_num(table.deviation_m, nan=0.0, posinf=0.0)
    step = max(float(deviation_mm.max()) / 127.0, 1e-3)
    residuals = np.where(table.measured, np.maximum(deviation_mm, step), 0.0)
    residuals[np.isnan(table.xyz).any(axis=2)] = -1.0
    return residuals, step


def _names(parameters: dict[str, dict[str, Sequence[str]]], n: int) -> tuple[str, ...]:
    """Return LABELS, LABELS2, ... (255 a parameter) as distinct names; unnamed points get their number."""
    labels: list[str] = []
    for k in range(1, 2 + n // 255):
        key = "LABELS" if k == 1 else f"LABELS{k}"
        labels += [label.strip() for label in parameters.get(key, {}).get("value", [])]
    names: list[str] = []
    for k in range(n):
        label = labels[k] if k < len(labels) and labels[k] else f"point_{k + 1}"
        names.append(label if label not in names else f"{label}_{k + 1}")
    return tuple(names)
