"""Coded targets and boards found in an image: number, position and covariance."""

from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array, read_only


@dataclass(frozen=True, eq=False)
class CodedDetections:
    """Coded targets found and read in one image, no number twice, by rising number."""

    camera: str
    number: Array
    """(n,) int."""
    xy_px: Array
    """(n, 2) sub-pixel centroid of the centre dot."""
    covariance_px2: Array
    """(n, 2, 2) of its random error."""
    semi_axes_px: Array
    """(n, 2) of the dot's ellipse, the longer one first."""
    angle_rad: Array
    """(n,) of the longer semi-axis, from the image's x axis to its y axis (down), above -pi / 2 and up to pi / 2."""
    roll_rad: Array
    """(n,) direction of the plate's x axis in the image, same sense of rotation, above -pi and up to pi."""
    confidence: Array
    """(n,) distance of the least certain sector from its threshold, 0 (on it) to about 1 (as bright or as dark as
    those beside it)."""
    twice: Array
    """(m,) numbers that were read at more than one position: ambiguous, so none of them is reported."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "number", read_only(self.number, (None,), "number", np.int64))
        object.__setattr__(self, "twice", read_only(self.twice, (None,), "twice", np.int64))
        n = len(self.number)
        for name, shape in (
            ("xy_px", (n, 2)),
            ("covariance_px2", (n, 2, 2)),
            ("semi_axes_px", (n, 2)),
            ("angle_rad", (n,)),
            ("roll_rad", (n,)),
            ("confidence", (n,)),
        ):
            object.__setattr__(self, name, read_only(getattr(self, name), shape, name))

    def __len__(self) -> int:
        return len(self.number)


@dataclass(frozen=True, eq=False)
class BoardDetections:
    """Inner corners of a board found in one image; none where the board was not found as a whole.

    ``corner`` (n,) int: which rows of ``Board.corners()``; ``xy_px`` (n, 2) sub-pixel; ``covariance_px2``
    (n, 2, 2) of the random error; ``refused``: why there are none ("" where there are).
    """

    camera: str
    corner: Array
    xy_px: Array
    covariance_px2: Array
    refused: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "corner", read_only(self.corner, (None,), "corner", np.int64))
        n = len(self.corner)
        object.__setattr__(self, "xy_px", read_only(self.xy_px, (n, 2), "xy_px"))
        object.__setattr__(self, "covariance_px2", read_only(self.covariance_px2, (n, 2, 2), "covariance_px2"))

    def __len__(self) -> int:
        return len(self.corner)

    @classmethod
    def none(cls, camera: str, refused: str) -> "BoardDetections":
        """No corners, and why."""
        return cls(camera, np.empty(0), np.empty((0, 2)), np.empty((0, 2, 2)), refused)
