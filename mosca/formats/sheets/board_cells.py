"""The black parts of a checkerboard or ChArUco board, as rectangles in the board's frame."""

import cv2
import numpy as np

from mosca.data.arrays import Array
from mosca.data.boards import Board


def black_cells(board: Board) -> Array:
    """Return (n, 4) left, bottom, width and height [m] of the black parts (``inverted``: white ones), in the frame of
    ``Board``.

    These are the squares, and each unbroken row of black bits of the markers; none overlap.
    """
    square = board.square_m
    cells = [
        (x - square / 2, y - square / 2, square, square)
        for x, y in (
            board.square_centre(c, r) for c in range(board.columns) for r in range(board.rows) if not (c + r) % 2
        )
    ]
    if board.marker_m is None:
        return np.array(cells)
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, str(board.dictionary)))
    bits = dictionary.markerSize + 2  # with the black border
    edge = board.marker_m / bits
    for number, (column, row) in enumerate(board.white_squares()):
        x, y = board.square_centre(column, row)
        left, top = x - board.marker_m / 2, y + board.marker_m / 2
        image = cv2.aruco.generateImageMarker(dictionary, number, bits)
        for k, line in enumerate(image == 0):
            edges = np.flatnonzero(np.diff(np.concatenate([[False], line, [False]]).astype(np.int8)))
            cells += [
                (left + a * edge, top - (k + 1) * edge, (b - a) * edge, edge)
                for a, b in edges.reshape(-1, 2).tolist()
            ]
    return np.array(cells)
