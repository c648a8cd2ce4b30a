"""Printable sheets of coded targets: SVG and PDF in true size, with a ruler that shows whether the printer kept it.

Dot, sectors counter-clockwise from the x axis as one sees the sheet, and the plate, its edge a hairline to cut along.
Print at 100 % ("actual size") and measure the ruler: a printer that shrinks the page by 3 % shrinks the targets by as
much. The number stands below each plate, where no camera takes it for a part of the target.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Patch, Rectangle, Wedge

from mosca.data.target_codes import SECTORS, code_bits
from mosca.data.targets import CodedTarget
from mosca.data.whole_file import whole_file
from mosca.errors import InputError

PAGES_MM = {"A4": (210.0, 297.0), "A3": (297.0, 420.0), "A2": (420.0, 594.0), "letter": (215.9, 279.4)}
MARGIN_MM, FOOT_MM, GAP_MM, LABEL_MM = 10.0, 14.0, 3.0, 4.0
LONGEST_RULER_MM, TICK_MM = 150.0, 10.0
FORMATS = (".svg", ".pdf")
MM_PER_INCH, POINTS_PER_MM = 25.4, 72 / 25.4
HAIRLINE_PT = 0.2
SECTOR_DEG = 360 / SECTORS


@dataclass(frozen=True)
class OnSheet:
    """A target with its centre at (``x_mm``, ``y_mm``) from the sheet's lower left corner."""

    target: CodedTarget
    x_mm: float
    y_mm: float


def write_target_sheets(
    path: Path,
    targets: Sequence[CodedTarget],
    page: str = "A4",
    colour: Literal["white", "black"] = "white",
) -> tuple[Path, ...]:
    """Write ``targets`` on as many sheets as they take, and return the files.

    ``path`` ends in .svg or .pdf; from the second sheet on a number stands before the ending ("targets-2.svg").
    ``colour``: of dot and sectors, on plates of the other one. Raises InputError for another ending, page or colour,
    no targets, a number that stands twice, or a plate larger than the page.
    """
    path = Path(path)
    if path.suffix.lower() not in FORMATS:
        raise InputError(f"{path}: ending '{path.suffix}' given; {' or '.join(FORMATS)} is allowed")
    if colour not in ("white", "black"):
        raise InputError(f"{path}: colour = {colour!r} given; 'white' or 'black' is allowed")
    files = []
    for k, places in enumerate(lay_out_sheets(targets, page)):
        file = path if k == 0 else path.with_name(f"{path.stem}-{k + 1}{path.suffix}")
        _write(file, places, page, colour)
        files.append(file)
    return tuple(files)


def lay_out_sheets(targets: Sequence[CodedTarget], page: str = "A4") -> tuple[tuple[OnSheet, ...], ...]:
    """Return where each target stands on which sheet: in rows from the upper left, each with room for the largest.

    Raises InputError as ``write_target_sheets`` does.
    """
    if page not in PAGES_MM:
        raise InputError(f"target sheet: page = {page!r} given; allowed: {', '.join(PAGES_MM)}")
    numbers = [target.number for target in targets]
    if not numbers:
        raise InputError("target sheet: no targets given; give one at least")
    for number in numbers:
        if numbers.count(number) > 1:
            raise InputError(f"target sheet: number {number} stands twice; give each target its own number")
    width, height = PAGES_MM[page]
    edge = 1000 * max(target.plate_m for target in targets)
    room_x, room_y = width - 2 * MARGIN_MM, height - 2 * MARGIN_MM - FOOT_MM
    columns = int((room_x + GAP_MM) / (edge + GAP_MM))
    rows = int((room_y + GAP_MM) / (edge + LABEL_MM + GAP_MM))
    if min(columns, rows) < 1:
        raise InputError(
            f"target sheet: plate of {edge:g} mm given; page '{page}' holds {min(room_x, room_y - LABEL_MM):g} mm: "
            "take a larger page or smaller targets"
        )
    places = []
    for k, target in enumerate(targets):
        row, column = divmod(k % (columns * rows), columns)
        x = MARGIN_MM + column * (edge + GAP_MM) + edge / 2
        y = height - MARGIN_MM - row * (edge + LABEL_MM + GAP_MM) - edge / 2
        places.append(OnSheet(target, x, y))
    each = columns * rows
    return tuple(tuple(places[k : k + each]) for k in range(0, len(places), each))


def white_runs_deg(number: int) -> tuple[tuple[float, float], ...]:
    """Return start and end [deg, counter-clockwise] of each unbroken run of sectors: neighbours have no seam."""
    bits = code_bits(number)
    starts = [k for k in range(SECTORS) if bits[k] and not bits[k - 1]]
    lengths = [next(n for n in range(1, SECTORS) if not bits[(k + n) % SECTORS]) for k in starts]
    return tuple((SECTOR_DEG * k, SECTOR_DEG * (k + n)) for k, n in zip(starts, lengths, strict=True))


def _write(path: Path, places: Sequence[OnSheet], page: str, colour: str) -> None:
    width, height = PAGES_MM[page]
    figure = Figure(figsize=(width / MM_PER_INCH, height / MM_PER_INCH))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(0, width), ylim=(0, height))
    axes.set_axis_off()
    for placed in places:
        for patch in _patches(placed, colour):
            axes.add_patch(patch)
        low = placed.y_mm - 500 * placed.target.plate_m
        axes.text(
            placed.x_mm, low - 0.5, str(placed.target.number), ha="center", va="top", fontsize=7, color="0.4"
        )
    length = min(LONGEST_RULER_MM, TICK_MM * int((width - 2 * MARGIN_MM) / TICK_MM))
    ends, foot = (MARGIN_MM, MARGIN_MM + length), MARGIN_MM
    axes.plot(ends, (foot, foot), color="black", lw=0.1 * POINTS_PER_MM, solid_capstyle="butt")
    for k in range(round(length / TICK_MM) + 1):
        x = ends[0] + k * TICK_MM
        axes.plot((x, x), (foot, foot + 3), color="black", lw=0.1 * POINTS_PER_MM, solid_capstyle="butt")
    axes.text(
        ends[0],
        foot + 4,
        f"{length:g} mm from first to last tick: print at 100 %, then measure",
        fontsize=8,
    )
    date = {"CreationDate": None} if path.suffix.lower() == ".pdf" else {"Date": None}
    # the same sheet is the same file: no date, and names in the SVG that do not change
    with whole_file(path) as temporary, rc_context({"svg.hashsalt": "target sheet"}):
        figure.savefig(temporary, format=path.suffix.lower()[1:], metadata=date)


def _patches(placed: OnSheet, colour: str) -> list[Patch]:
    """Return plate, dot and sectors of a target, in mm of the sheet."""
    target, x, y = placed.target, placed.x_mm, placed.y_mm
    half, plate = 500 * target.plate_m, "black" if colour == "white" else "white"
    corner = (x - half, y - half)
    outer, width = 1000 * target.ring_outer_m, 1000 * (target.ring_outer_m - target.ring_inner_m)
    drawn: list[Patch] = [
        Rectangle(corner, 2 * half, 2 * half, facecolor=plate, edgecolor="0.5", lw=HAIRLINE_PT),
        Circle((x, y), 1000 * target.dot_radius_m, facecolor=colour, lw=0),
    ]
    drawn += [
        Wedge((x, y), outer, start, end, width=width, facecolor=colour, lw=0)
        for start, end in white_runs_deg(target.number)
    ]
    return drawn
