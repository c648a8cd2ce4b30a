"""Printed sheets: the scale of the print, and the lengths that the target file must then have."""

from pathlib import Path
from typing import Literal

from mosca.coded_targets.detect import CodedSettings, find_coded
from mosca.data.boards import Board
from mosca.data.files.target_file import PointsTarget, read_target_file
from mosca.data.targets import CodedTarget, ScaleBar, TestField
from mosca.errors import InputError
from mosca.formats.sheets.sheet_scale import as_printed, scale_of_ruler, scale_of_scan
from mosca.formats.sheets.target_sheet import lay_out_sheets
from mosca.recording.folder import read_image

LARGEST_DOT_PX = 10_000.0
TARGET_KEYS = ("dot_radius_m", "ring_inner_m", "ring_outer_m", "plate_m")
BOARD_KEYS = ("square_m", "margin_m", "marker_m")
"""Lengths of a target file that a printer scales."""


def scale_from_ruler(path: Path, measured_mm: float, nominal_mm: float) -> list[str]:
    """Return lines with the scale of the printed sheet of target file ``path``, and its true lengths."""
    printed = _printed(path)
    scale = scale_of_ruler(measured_mm, nominal_mm)
    target = printed if isinstance(printed, Board) else printed[0]
    return [f"printed at {100 * scale:.2f} % of its size", *_lengths(target, scale)]


def scale_from_scan(
    path: Path, scan: Path, dpi: float, page: str | None, colour: Literal["white", "black"]
) -> list[str]:
    """Return the same lines from the coded targets in a scan; ``page``, ``colour``: as for ``mosca target sheet``."""
    targets = _printed(path)
    if isinstance(targets, Board):
        raise InputError(f"{path}: a board has no coded targets that a scan shows; measure its ruler, --ruler")
    if not scan.exists():
        raise InputError(f"{scan}: no such file")
    image, fault = read_image(scan)
    if image is None:
        raise InputError(fault)
    settings = CodedSettings(colour=colour, maximum_dot_px=LARGEST_DOT_PX)
    found = find_coded(image, scan.name, settings, 8 * image.dtype.itemsize)
    sheets = lay_out_sheets(targets, page)
    seen = set(found.number.tolist())
    places = max(sheets, key=lambda sheet: sum(place.target.number in seen for place in sheet))
    scale = scale_of_scan(found, places, dpi)
    return [
        f"printed at {100 * scale.x:.2f} % of its size across and {100 * scale.y:.2f} % along the sheet, "
        f"{scale.residual_mm:.3f} mm rms from that",
        *_lengths(targets[0], scale.mean),
    ]


def _printed(path: Path) -> Board | list[CodedTarget]:
    """Return the board or the targets that ``mosca target sheet`` prints from a target file."""
    target = read_target_file(path)
    coded: list[CodedTarget] = []
    if isinstance(target, Board):
        return target
    if isinstance(target, TestField):
        coded = [placed.target for placed in target.targets if isinstance(placed.target, CodedTarget)]
    elif isinstance(target, ScaleBar):
        coded = [end for end in target.ends if isinstance(end, CodedTarget)]
    if not coded:
        kind = "points" if isinstance(target, PointsTarget) else type(target).__name__
        raise InputError(f"{path}: describes {kind}, which has no printed sheet; a field, board or scale bar has")
    return coded


def _lengths(target: CodedTarget | Board, scale: float) -> list[str]:
    true = as_printed(target, scale)
    keys = BOARD_KEYS if isinstance(target, Board) else TARGET_KEYS
    values = {key: getattr(true, key) for key in keys if getattr(true, key) is not None}
    return ["write into the target file:", *(f"{key} = {value:.6g}" for key, value in values.items())]
