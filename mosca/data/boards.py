"""Checkerboards and ChArUco boards: squares, corners and marker numbers.

A board's frame has its origin in the middle of the face; the face's normal is +z; x is to the right and y up for a
viewer facing it. Lengths in m.
"""

from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array
from mosca.data.targets import above_zero, not_below_zero

DICTIONARIES: dict[str, tuple[int, int]] = {
    **{f"DICT_{side}X{side}_{count}": (side, count) for side in (4, 5, 6, 7) for count in (50, 100, 250, 1000)},
    "DICT_ARUCO_ORIGINAL": (5, 1024),
    "DICT_ARUCO_MIP_36H12": (6, 250),
    "DICT_APRILTAG_16H5": (4, 30),
    "DICT_APRILTAG_25H9": (5, 35),
    "DICT_APRILTAG_36H10": (6, 2320),
    "DICT_APRILTAG_36H11": (6, 587),
}
"""OpenCV's marker dictionaries by name: bits along a marker's edge, and how many markers there are."""


@dataclass(frozen=True)
class Board:
    """A checkerboard of ``columns`` x ``rows`` squares, the upper left one black, in a white margin.

    Its frame's origin is the middle of its face. With ``marker_m`` and ``dictionary`` it is a ChArUco board: each
    white square holds a marker of that edge, numbered from 0 row by row, as in OpenCV since 4.6. ``inverted``: black
    and white are exchanged, margin included. ``from_behind``: the other side shows its mirror image with the same
    corners (a transparent sheet, or a second print glued to the back). Raises ValueError for a board that cannot be
    built, or that is symmetric under rotation or, if seen from behind, under reflection.
    """

    columns: int
    rows: int
    square_m: float
    margin_m: float
    marker_m: float | None = None
    dictionary: str | None = None
    sigma_m: float = 0.0
    inverted: bool = False
    from_behind: bool = False

    def __post_init__(self) -> None:
        above_zero("square_m", self.square_m)
        not_below_zero("margin_m", self.margin_m)
        not_below_zero("sigma_m", self.sigma_m)
        if min(self.columns, self.rows) < 3:
            raise ValueError(f"columns = {self.columns}, rows = {self.rows}: at least 3 squares are wanted")
        if (self.marker_m is None) != (self.dictionary is None):
            raise ValueError("marker_m and dictionary go together: both for ChArUco, none for a checkerboard")
        if self.marker_m is None or self.dictionary is None:
            if self.from_behind:
                raise ValueError("from_behind = true: a checkerboard's two sides look alike; take a ChArUco board")
            if (self.columns + self.rows) % 2 == 0:
                raise ValueError(
                    f"columns = {self.columns}, rows = {self.rows}: half a turn changes nothing; "
                    "take an odd and an even number"
                )
            return
        if self.dictionary not in DICTIONARIES:
            raise ValueError(f"dictionary = '{self.dictionary}' given; allowed: {', '.join(DICTIONARIES)}")
        if not 0 < self.marker_m < self.square_m:
            raise ValueError(f"marker_m = {self.marker_m:g} given; above 0 and below square_m is allowed")
        markers, known = len(self.white_squares()), DICTIONARIES[self.dictionary][1]
        if markers > known:
            raise ValueError(f"dictionary = '{self.dictionary}' has {known} markers; this board takes {markers}")

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height of the board with its margin [m]."""
        return (self.columns * self.square_m + 2 * self.margin_m, self.rows * self.square_m + 2 * self.margin_m)

    def corners(self) -> Array:
        """Return the inner corners ((columns - 1) (rows - 1), 3) [m], row by row from the upper left."""
        x = (np.arange(1, self.columns) - self.columns / 2) * self.square_m
        y = (self.rows / 2 - np.arange(1, self.rows)) * self.square_m
        rows, columns = np.meshgrid(y, x, indexing="ij")
        return np.column_stack([columns.ravel(), rows.ravel(), np.zeros(columns.size)])

    def white_squares(self) -> tuple[tuple[int, int], ...]:
        """Return (column, row) of the white squares, row by row: square k holds marker k of a ChArUco board."""
        return tuple((c, r) for r in range(self.rows) for c in range(self.columns) if (c + r) % 2)

    def square_centre(self, column: int, row: int) -> tuple[float, float]:
        """Return x and y of a square's middle [m]."""
        return ((column + 0.5 - self.columns / 2) * self.square_m, (self.rows / 2 - row - 0.5) * self.square_m)
