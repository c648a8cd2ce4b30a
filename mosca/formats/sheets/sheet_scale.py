"""Whether a printer kept the size of a sheet, and what to write into the target file when it did not."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mosca.data.boards import Board
from mosca.data.found_targets import CodedDetections
from mosca.data.targets import CodedTarget
from mosca.errors import InputError
from mosca.formats.sheets.target_sheet import MM_PER_INCH, OnSheet

FARTHEST_OFF = 0.1
"""Share by which a printer may miss the size; beyond it the measurement or the input is wrong."""
LEAST_TARGETS = 3


@dataclass(frozen=True)
class PrintedScale:
    """True size over nominal size, along the sheet's x axis and its y axis; ``residual_mm``: rms residual that no
    scale and shear explain (a crumpled or bent sheet).
    """

    x: float
    y: float
    residual_mm: float

    @property
    def mean(self) -> float:
        """The scale of lengths that run both ways, such as a dot's radius."""
        return float(np.sqrt(self.x * self.y))


def scale_of_ruler(measured_mm: float, nominal_mm: float) -> float:
    """Return the scale of a sheet whose ruler of ``nominal_mm`` measures ``measured_mm`` between its end ticks.

    Raises InputError for an implausible ratio, as from another ruler or unit.
    """
    if not abs(measured_mm - nominal_mm) <= FARTHEST_OFF * nominal_mm:
        raise InputError(
            f"sheet: ruler measured as {measured_mm:g} mm, {nominal_mm:g} mm is printed beside it; a tenth off is "
            "allowed: measure from the first tick to the last, in mm"
        )
    return measured_mm / nominal_mm


def scale_of_scan(found: CodedDetections, places: Sequence[OnSheet], dpi: float) -> PrintedScale:
    """Return the scales of a sheet from the coded targets found in its scan of ``dpi`` pixels an inch.

    ``places``: their positions on the sheet (``lay_out_sheets``). An affine map is fitted to the centres. The lengths
    of its axes are the scales, independent of the sheet's orientation on the scanner. Raises InputError for fewer
    than three targets, collinear targets, or a scale that is a tenth off.
    """
    where = {placed.target.number: (placed.x_mm, placed.y_mm) for placed in places}
    seen = [k for k, number in enumerate(found.number.tolist()) if number in where]
    sheet = np.array([where[int(found.number[k])] for k in seen]).reshape(-1, 2)
    system = np.column_stack([sheet, np.ones(len(sheet))])
    if len(seen) < LEAST_TARGETS or np.linalg.matrix_rank(system - system.mean(axis=0), tol=1.0) < 2:
        raise InputError(
            f"sheet: {len(seen)} of its {len(places)} targets found in the scan; three not on a line are needed"
        )
    scanned = found.xy_px[seen] * MM_PER_INCH / dpi
    affine = np.linalg.lstsq(system, scanned, rcond=None)[0]
    scales = np.linalg.norm(affine[:2], axis=1)
    if not np.abs(scales - 1).max() <= FARTHEST_OFF:
        raise InputError(
            f"sheet: scale {scales[0]:.3f} x {scales[1]:.3f} found at dpi = {dpi:g}; a tenth off is allowed: "
            "give the resolution that the scanner used"
        )
    residual = float(np.sqrt(np.mean(np.square(system @ affine - scanned)) * 2))
    return PrintedScale(float(scales[0]), float(scales[1]), residual)


def as_printed(target: CodedTarget | Board, scale: float) -> CodedTarget | Board:
    """Return a target or board with all lengths as they were printed."""
    if isinstance(target, Board):
        marker = None if target.marker_m is None else target.marker_m * scale
        return replace(target, square_m=target.square_m * scale, margin_m=target.margin_m * scale, marker_m=marker)
    lengths = ("dot_radius_m", "ring_inner_m", "ring_outer_m", "plate_m")
    return replace(target, **{name: getattr(target, name) * scale for name in lengths})
