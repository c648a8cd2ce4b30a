"""Flat figures: the print on a plate, as closed contours of lines and arcs.

A figure lies in the +z face of its geom; x and y are the geom's axes [m]. The light of a contour is that of its
inside times the contour's gain. Gains add up, so that a black square on white paper is a contour of negative gain.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array, read_only

LINE, ARC = 0, 1
JOIN = 1e-9
"""Pieces of a contour join to within this share of its size."""


@dataclass(frozen=True, eq=False)
class Figure:
    """Contours whose pieces join end to end, the inside on their left (counter-clockwise seen from +z)."""

    pieces: Array
    """(n, 7) kind; x0, y0, x1, y1, 0 of a line or cx, cy, radius, angle0, angle1 [rad] of an arc; contour's gain."""
    radius: float
    """Radius of the circle about the origin that encloses all contours [m]."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "pieces", read_only(self.pieces, (None, 7), "pieces"))
        if not np.isfinite(self.pieces).all() or not np.isin(self.pieces[:, 0], (LINE, ARC)).all():
            raise ValueError("pieces: finite numbers are wanted, and a first one that is LINE or ARC")
        if not 0 < self.radius < np.inf:
            raise ValueError(f"radius = {self.radius:g} given; a finite number above zero is wanted")


def figure(contours: Sequence[Array]) -> Figure:
    """Return the figure of contours, each an array of pieces (k, 7).

    Raises ValueError for a contour whose pieces do not join: its inside would be undefined.
    """
    for pieces in contours:
        starts, ends = piece_ends(pieces)
        gap = np.abs(ends - np.roll(starts, -1, axis=0)).max()
        if gap > JOIN * max(np.abs(pieces[:, 1:4]).max(), np.abs(ends).max()):
            raise ValueError(f"a contour's pieces are {gap:g} m apart where they should join")
    pieces = np.concatenate(contours)
    line = pieces[:, 0] == LINE
    reach = np.where(
        line,
        np.maximum(np.hypot(pieces[:, 1], pieces[:, 2]), np.hypot(pieces[:, 3], pieces[:, 4])),
        np.hypot(pieces[:, 1], pieces[:, 2]) + pieces[:, 3],
    )
    return Figure(pieces, float(reach.max()))


def piece_ends(pieces: Array) -> tuple[Array, Array]:
    """Return where pieces (n, 7) start and end: (n, 2) and (n, 2) [m]."""
    line = (pieces[:, 0] == LINE)[:, None]
    centre, radius, angle = pieces[:, 1:3], pieces[:, 3:4], pieces[:, 4:6]
    first, last = (centre + radius * np.column_stack([np.cos(angle[:, k]), np.sin(angle[:, k])]) for k in (0, 1))
    return np.where(line, pieces[:, 1:3], first), np.where(line, pieces[:, 3:5], last)


def circle(x: float, y: float, radius: float, gain: float = 1.0) -> Array:
    """Return the contour of a circle (1, 7)."""
    return np.array([[ARC, x, y, radius, 0.0, 2 * np.pi, gain]])


def polygon(corners: Array, gain: float = 1.0) -> Array:
    """Return the contour (k, 7) through ``corners`` (k, 2), counter-clockwise."""
    following = np.roll(corners, -1, axis=0)
    zero = np.zeros(len(corners))
    return np.column_stack([zero + LINE, corners, following, zero, zero + gain])


def ring_sector(x: float, y: float, inner: float, outer: float, start: float, end: float, gain: float = 1.0) -> Array:
    """Return the contour (4, 7) of a part of a ring between the angles ``start`` < ``end`` [rad]."""

    def at(radius: float, angle: float) -> tuple[float, float]:
        return x + radius * np.cos(angle), y + radius * np.sin(angle)

    return np.array(
        [
            [ARC, x, y, outer, start, end, gain],
            [LINE, *at(outer, end), *at(inner, end), 0.0, gain],
            [ARC, x, y, inner, end, start, gain],
            [LINE, *at(inner, start), *at(outer, start), 0.0, gain],
        ]
    )


def outlines(cells: Array) -> list[Array]:
    """Return the outlines of the True ones of ``cells`` (rows, columns), each by its corners (k, 2).

    The unit is a cell: x to the right from the left edge, y up from the upper edge, so that row r lies between
    -r - 1 and -r. Outer edges run counter-clockwise, those of holes clockwise, and no edge lies between two True
    cells: the contours of all outlines add up to the light of the cells without seams.
    """
    filled = np.pad(np.asarray(cells, dtype=bool), 1)
    following: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for row, column in np.argwhere(filled):
        x, y = int(column) - 1, 1 - int(row)  # the cell's upper left corner
        sides = (
            (filled[row + 1, column], (x, y - 1), (x + 1, y - 1)),
            (filled[row, column + 1], (x + 1, y - 1), (x + 1, y)),
            (filled[row - 1, column], (x + 1, y), (x, y)),
            (filled[row, column - 1], (x, y), (x, y - 1)),
        )
        for inner, start, end in sides:
            if not inner:
                following.setdefault(start, []).append(end)
    loops = []
    while following:
        first = next(iter(following))
        loop = [first]
        while True:
            here = loop[-1]
            there = following[here].pop()
            if not following[here]:
                del following[here]
            if there == first:
                break
            loop.append(there)
        loops.append(_without_straight_corners(np.array(loop, dtype=np.float64)))
    return loops


def _without_straight_corners(corners: Array) -> Array:
    before, after = corners - np.roll(corners, 1, axis=0), np.roll(corners, -1, axis=0) - corners
    turns = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    result: Array = corners[turns != 0]
    return result
