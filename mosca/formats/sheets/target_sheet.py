"""Printable sheets of coded targets and boards: SVG and PDF in true size, with a ruler to check the printed size.

A target consists of the dot, sectors counter-clockwise from the x axis as seen from the front, and the plate, its
edge a hairline to cut along; its number is below, outside the plate. Print at 100 % ("actual size") and measure the
ruler: a printer that shrinks the page by 3 % shrinks the targets by as much. ``mosca.formats.sheets.sheet_scale``
computes the printed scale from the ruler's length or from a scan.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Patch, PathPatch, Rectangle, Wedge
from matplotlib.path import Path as Outline

from mosca.data.boards import Board
from mosca.data.files.target_tables import CalibrationTarget
from mosca.data.files.whole_file import whole_file
from mosca.data.target_codes import SECTORS, code_bits
from mosca.data.targets import CodedTarget, ScaleBar, TestField
from mosca.errors import InputError
from mosca.formats.sheets.board_cells import black_cells

PAGES_MM = {"A4": (210.0, 297.0), "A3": (297.0, 420.0), "A2": (420.0, 594.0), "letter": (215.9, 279.4)}
"""Width and height of the pages (ISO 216), upright."""
LARGER = ("A4", "A3", "A2")
MARGIN_MM, FOOT_MM, GAP_MM, LABEL_MM = 10.0, 14.0, 3.0, 4.0
"""White border (more than printers leave blank), height of the foot with the ruler, gap between cells, label
height."""
LONGEST_RULER_MM, TICK_MM = 150.0, 10.0
"""The ruler that shows the scale of the print: its largest length, and the distance of its ticks."""
FORMATS = (".svg", ".pdf")
MM_PER_INCH, POINTS_PER_MM = 25.4, 72 / 25.4
"""The typographic point is 1/72 inch."""
HAIRLINE_PT = 0.2
"""Width [pt] of outlines that mark where to cut."""
SECTOR_DEG = 360 / SECTORS
Size = tuple[float, float]


@dataclass(frozen=True)
class OnSheet:
    """A target with its centre at (``x_mm``, ``y_mm``) from the sheet's lower left corner."""

    target: CodedTarget
    x_mm: float
    y_mm: float


def write_sheets(
    target: CalibrationTarget, path: Path, page: str | None = None, colour: Literal["white", "black"] = "white"
) -> tuple[Path, ...]:
    """Write the printable parts of a calibration target on sheets, and return the files.

    For a field, or a scale bar with coded ends, these are the coded targets, on as many sheets as they take; a board
    takes one sheet. ``page``: "A4", "A3", "A2" or "letter"; None: the first of A4, A3 and A2 that holds a plate or
    the board (a board also across); a larger one gets a sheet of its own size. ``path`` and ``colour``: see
    ``write_target_sheets``. Raises InputError for a target that has nothing to print, and as that function does.
    """
    path = Path(path)
    match target:
        case Board():
            return write_board_sheets(path, target, page)
        case TestField():
            coded = [placed.target for placed in target.targets if isinstance(placed.target, CodedTarget)]
        case ScaleBar():
            coded = [end for end in target.ends if isinstance(end, CodedTarget)]
        case _:
            coded = []
    if not coded:
        raise InputError(
            f"{path}: this target has no coded plates to print; give a field or scale bar with numbers, or a board"
        )
    return write_target_sheets(path, coded, page, colour)


def write_target_sheets(
    path: Path, targets: Sequence[CodedTarget], page: str | None = None, colour: Literal["white", "black"] = "white"
) -> tuple[Path, ...]:
    """Write ``targets`` on as many sheets as they take, and return the files.

    ``path`` ends in .svg or .pdf; from the second sheet on a number precedes the ending ("targets-2.svg").
    ``colour``: of dot and sectors, on plates of the other one. Raises InputError for another ending, page or colour,
    no targets, a duplicate number, or a plate larger than the page.
    """
    path = _checked(path)
    if colour not in ("white", "black"):
        raise InputError(f"{path}: colour = {colour!r} given; 'white' or 'black' is allowed")
    files = []
    for k, places in enumerate(lay_out_sheets(targets, page)):
        file = path if k == 0 else path.with_name(f"{path.stem}-{k + 1}{path.suffix}")
        patches = [patch for placed in places for patch in _patches(placed, colour)]
        labels = [(p.x_mm, p.y_mm - 500 * p.target.plate_m - 0.5, str(p.target.number)) for p in places]
        _write(file, patches, labels, sheet_size_mm(targets, page))
        files.append(file)
    return tuple(files)


def write_board_sheets(path: Path, board: Board, page: str | None = None) -> tuple[Path, ...]:
    """Write a board in true size in the middle of a sheet, and return the files.

    A board that is seen from behind takes a second sheet ("board-back.svg"): its mirror image. ``page`` as for
    ``write_sheets``. Raises InputError for another ending or page, or a board larger than the page.
    """
    path = _checked(path)
    wide, high = (1000 * edge for edge in board.size_m)
    room = (wide + 2 * MARGIN_MM, high + 2 * MARGIN_MM + FOOT_MM)
    pages = [_page(page)] if page is not None else [PAGES_MM[name] for name in LARGER]
    fitting = [
        size for narrow in pages for size in (narrow, narrow[::-1]) if size[0] >= room[0] and size[1] >= room[1]
    ]
    if page is not None and not fitting:
        raise InputError(
            f"{path}: board of {wide:g} x {high:g} mm given, too large for page '{page}' with its ruler: "
            "leave out the page for a sheet of its own size, or make the squares smaller"
        )
    size = fitting[0] if fitting else (max(room[0], 2 * MARGIN_MM + 5 * TICK_MM), room[1])
    middle = (size[0] / 2, size[1] - MARGIN_MM - high / 2)
    paper, ink = ("black", "white") if board.inverted else ("white", "black")
    edge = (middle[0] - wide / 2, middle[1] - high / 2)
    files = (path, path.with_name(f"{path.stem}-back{path.suffix}")) if board.from_behind else (path,)
    for file in files:
        corners, codes = [], []
        for x0, bottom, width, height in 1000 * black_cells(board):
            left = x0 if file == path else -x0 - width
            x, y = middle[0] + left, middle[1] + bottom
            corners += [(x, y), (x + width, y), (x + width, y + height), (x, y + height), (x, y)]
            codes += [Outline.MOVETO, Outline.LINETO, Outline.LINETO, Outline.LINETO, Outline.CLOSEPOLY]
        margin = Rectangle(edge, wide, high, facecolor=paper, edgecolor="0.5", lw=HAIRLINE_PT)
        # one path: where cells meet there is no seam between two fillings
        _write(file, [margin, PathPatch(Outline(corners, codes), facecolor=ink, lw=0)], [], size)
    return files


def sheet_size_mm(targets: Sequence[CodedTarget], page: str | None = None) -> Size:
    """Return width and height [mm] of the sheets that ``write_target_sheets`` writes."""
    if page is not None:
        return _page(page)
    edge = 1000 * max((target.plate_m for target in targets), default=0.0)
    return next((PAGES_MM[name] for name in LARGER if min(_cells(PAGES_MM[name], edge)) >= 1), PAGES_MM["A2"])


def ruler_mm(size_mm: Size) -> float:
    """Return the length of the ruler on a sheet of this size, from its first to its last tick [mm]."""
    return min(LONGEST_RULER_MM, TICK_MM * int((size_mm[0] - 2 * MARGIN_MM) / TICK_MM))


def lay_out_sheets(targets: Sequence[CodedTarget], page: str | None = None) -> tuple[tuple[OnSheet, ...], ...]:
    """Return sheet and position of each target: in rows from the upper left, in cells of the largest one's size.

    Raises InputError as ``write_target_sheets`` does.
    """
    numbers = [target.number for target in targets]
    if not numbers:
        raise InputError("target sheet: no targets given; give one at least")
    for number in numbers:
        if numbers.count(number) > 1:
            raise InputError(f"target sheet: number {number} stands twice; give each target its own number")
    size = sheet_size_mm(targets, page)
    edge = 1000 * max(target.plate_m for target in targets)
    columns, rows = _cells(size, edge)
    if min(columns, rows) < 1:
        room = min(size[0] - 2 * MARGIN_MM, size[1] - 2 * MARGIN_MM - FOOT_MM - LABEL_MM)
        raise InputError(
            f"target sheet: plate of {edge:g} mm given; page '{page or LARGER[-1]}' holds {room:g} mm: "
            "take a larger page or smaller targets"
        )
    places = []
    for k, target in enumerate(targets):
        row, column = divmod(k % (columns * rows), columns)
        x = MARGIN_MM + column * (edge + GAP_MM) + edge / 2
        y = size[1] - MARGIN_MM - row * (edge + LABEL_MM + GAP_MM) - edge / 2
        places.append(OnSheet(target, x, y))
    each = columns * rows
    return tuple(tuple(places[k : k + each]) for k in range(0, len(places), each))


def white_runs_deg(number: int) -> tuple[tuple[float, float], ...]:
    """Return start and end [deg, counter-clockwise] of each unbroken run of white sectors, drawn without seams."""
    bits = code_bits(number)
    starts = [k for k in range(SECTORS) if bits[k] and not bits[k - 1]]
    lengths = [next(n for n in range(1, SECTORS) if not bits[(k + n) % SECTORS]) for k in starts]
    return tuple((SECTOR_DEG * k, SECTOR_DEG * (k + n)) for k, n in zip(starts, lengths, strict=True))


def _checked(path: Path) -> Path:
    if Path(path).suffix.lower() not in FORMATS:
        raise InputError(f"{path}: ending '{Path(path).suffix}' given; {' or '.join(FORMATS)} is allowed")
    return Path(path)


def _page(page: str) -> Size:
    if page not in PAGES_MM:
        raise InputError(f"target sheet: page = {page!r} given; allowed: {', '.join(PAGES_MM)}")
    return PAGES_MM[page]


def _cells(size_mm: Size, edge_mm: float) -> tuple[int, int]:
    """Return the number of columns and rows of plates of this edge on a sheet."""
    room_x, room_y = size_mm[0] - 2 * MARGIN_MM, size_mm[1] - 2 * MARGIN_MM - FOOT_MM
    return int((room_x + GAP_MM) / (edge_mm + GAP_MM)), int((room_y + GAP_MM) / (edge_mm + LABEL_MM + GAP_MM))


def _write(path: Path, patches: Sequence[Patch], labels: Sequence[tuple[float, float, str]], size_mm: Size) -> None:
    """Write patches, labels (x, y [mm], text) and the ruler on a sheet."""
    width, height = size_mm
    figure = Figure(figsize=(width / MM_PER_INCH, height / MM_PER_INCH))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(0, width), ylim=(0, height))
    axes.set_axis_off()
    for patch in patches:
        axes.add_patch(patch)
    for x, y, text in labels:
        axes.text(x, y, text, ha="center", va="top", fontsize=7, color="0.4")
    length, foot = ruler_mm(size_mm), MARGIN_MM
    ends = (MARGIN_MM, MARGIN_MM + length)
    axes.plot(ends, (foot, foot), color="black", lw=0.1 * POINTS_PER_MM, solid_capstyle="butt")
    for k in range(round(length / TICK_MM) + 1):
        x = ends[0] + k * TICK_MM
        axes.plot((x, x), (foot, foot + 3), color="black", lw=0.1 * POINTS_PER_MM, solid_capstyle="butt")
    text = f"{length:g} mm from first to last tick: print at 100 %, then measure"
    axes.text(ends[0], foot + 4, text, fontsize=8)
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
