"""Reads the corners of a checkerboard or ChArUco board in an image."""

import numpy as np

from mosca.coded_targets.boards import find_board
from mosca.data.arrays import Array
from mosca.data.boards import Board
from mosca.data.sightings import Part


class BoardReader:
    """Finds a board's inner corners; marks are counted as ``Board.corners()`` counts them."""

    def __init__(self, board: Board) -> None:
        self._board = board
        self.refusals: dict[str, int] = {}
        """Why boards were not found, and in how many images."""

    def read(self, image: Array, camera: str, bit_depth: int) -> Part:
        """Return the board's corners in an image (H, W)."""
        found = find_board(image, self._board, camera)
        if found.refused:
            self.refusals[found.refused] = self.refusals.get(found.refused, 0) + 1
        return Part(0, 0, found.corner, found.xy_px, found.covariance_px2, np.full(len(found), np.nan))
