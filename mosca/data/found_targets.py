"""Coded targets and boards found in an image: number, position and covariance."""

from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array, set_read_only


@dataclass(frozen=True, eq=False)
class CodedDetections:
    """Coded targets found and read in one image, no number twice, by rising number."""

    camera: str
    number: Array
    """(n,) int."""
    xy_px: Array
    """(n, 2) sub-pixel centroid of the centre dot."""
    covariance_px2: Array
    """(n, 2, 2) covariance of the centroid's random error."""
    semi_axes_px: Array
    """(n, 2) semi-axes of the dot's ellipse, the longer one first."""
    angle_rad: Array
    """(n,) angle of the longer semi-axis, from the image's x axis to its y axis (down), in (-pi / 2, pi / 2]."""
    roll_rad: Array
    """(n,) direction of the plate's x axis in the image, same sense of rotation, in (-pi, pi]."""
    confidence: Array
    """(n,) distance of the least certain sector from its threshold, 0 (on it) to about 1 (as bright or as dark as
    those beside it)."""
    twice: Array
    """(m,) numbers that were read at more than one position: ambiguous, so none of them is reported."""

    def __post_init__(self) -> None:
        set_read_only(self, np.int64, number=(None,), twice=(None,))
        n = len(self.number)
        set_read_only(self, xy_px=(n, 2), covariance_px2=(n, 2, 2), semi_axes_px=(n, 2))
        set_read_only(self, angle_rad=(n,), roll_rad=(n,), confidence=(n,))

    def __len__(self) -> int:
        return len(self.number)


@dataclass(frozen=True, eq=False)
class BoardDetections:
    """Inner corners of a board found in one image; none where the board was not found as a whole.

    ``corner`` (n,) int: rows of ``Board.corners()``; ``xy_px`` (n, 2) sub-pixel; ``covariance_px2`` (n, 2, 2) of the
    random error; ``refused``: why there are no corners ("" where there are).
    """

    camera: str
    corner: Array
    xy_px: Array
    covariance_px2: Array
    refused: str = ""

    def __post_init__(self) -> None:
        set_read_only(self, np.int64, corner=(None,))
        n = len(self.corner)
        set_read_only(self, xy_px=(n, 2), covariance_px2=(n, 2, 2))

    def __len__(self) -> int:
        return len(self.corner)

    @classmethod
    def none(cls, camera: str, refused: str) -> "BoardDetections":
        """Return no corners, with the reason ``refused``."""
        return cls(camera, np.empty(0), np.empty((0, 2)), np.empty((0, 2, 2)), refused)
