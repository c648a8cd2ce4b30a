"""Flat figures: what is printed on a plate, as closed contours of lines and arcs.

A figure lies in the +z face of its geom; x and y are the geom's axes [m]. Light is what lies inside a contour
times the contour's gain; gains add up, so that a black square on white paper is a contour of negative gain.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array, read_only

LINE, ARC = 0, 1


@dataclass(frozen=True, eq=False)
class Figure:
    """``pieces`` (n, 7): kind, then x0, y0, x1, y1, 0 of a line or cx, cy, radius, angle0, angle1 [rad] of an arc,
    then the gain of the contour that it belongs to. Pieces of a contour join end to end, the inside on their
    left (counter-clockwise seen from +z). ``radius`` encloses all of them about the origin [m].
    """

    pieces: Array
    radius: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "pieces", read_only(self.pieces, (None, 7), "pieces"))


def figure(contours: Sequence[Array]) -> Figure:
    """Return the figure of contours, each an array of pieces (k, 7)."""
    pieces = np.concatenate(contours)
    line = pieces[:, 0] == LINE
    reach = np.where(
        line,
        np.maximum(np.hypot(pieces[:, 1], pieces[:, 2]), np.hypot(pieces[:, 3], pieces[:, 4])),
        np.hypot(pieces[:, 1], pieces[:, 2]) + pieces[:, 3],
    )
    return Figure(pieces, float(reach.max()))


def circle(x: float, y: float, radius: float, gain: float = 1.0) -> Array:
    """Return the contour of a circle (1, 7)."""
    return np.array([[ARC, x, y, radius, 0.0, 2 * np.pi, gain]])


def polygon(corners: Array, gain: float = 1.0) -> Array:
    """Return the contour (k, 7) through ``corners`` (k, 2), counter-clockwise."""
    following = np.roll(corners, -1, axis=0)
    zero = np.zeros(len(corners))
    return np.column_stack([zero + LINE, corners, following, zero, zero + gain])


def ring_sector(
    x: float, y: float, inner: float, outer: float, start: float, end: float, gain: float = 1.0
) -> Array:
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
