"""Boards drawn by OpenCV (``cv2.aruco``) and imaged through its lens models, with the true corners."""

import cv2
import numpy as np

SQUARE_PX = 90
OVERSAMPLING = 2


def charuco(columns, rows, square_m, marker_m, dictionary):
    """Return OpenCV's own board of these squares; lengths [m], dictionary by name."""
    markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    return cv2.aruco.CharucoBoard((columns, rows), square_m, marker_m, markers)


def imaged(board, rotation, translation, matrix, bend, size, *, fisheye=False, inverted=False, white=205, black=45):
    """Return the image (H, W) uint8 of a board and its true corners (n, 2) [px], by OpenCV's functions alone.

    ``rotation`` (3,), ``translation`` (3,) [m]: camera_from_board of OpenCV's board (x right, y down); ``matrix``,
    ``bend``: of ``cv2.projectPoints``, or ``cv2.fisheye``; ``size`` (width, height). Without noise.
    """
    columns, rows = board.getChessboardSize()
    square = board.getSquareLength()
    drawn = board.generateImage((columns * SQUARE_PX, rows * SQUARE_PX), marginSize=0)
    drawn = cv2.copyMakeBorder(drawn, SQUARE_PX, SQUARE_PX, SQUARE_PX, SQUARE_PX, cv2.BORDER_CONSTANT, value=255)
    drawn = 255 - drawn if inverted else drawn
    wide = OVERSAMPLING * np.array(size)
    x, y = np.meshgrid(*((np.arange(n) + 0.5) / OVERSAMPLING - 0.5 for n in wide))
    pixels = np.stack([x, y], axis=-1).reshape(-1, 1, 2)
    undistort = cv2.fisheye.undistortPoints if fisheye else cv2.undistortPoints
    rays = undistort(pixels, matrix, bend)[:, 0]
    turn = cv2.Rodrigues(np.asarray(rotation, dtype=float))[0]
    # board point X, Y with turn [X Y 0] + t parallel to (ray, 1)
    plane = np.linalg.inv(np.column_stack([turn[:, :2], translation]))
    at = np.column_stack([rays, np.ones(len(rays))]) @ plane.T
    at = at[:, :2] / at[:, 2:] / square * SQUARE_PX + SQUARE_PX - 0.5
    at = np.clip(np.nan_to_num(at, nan=-10.0), -10.0, 1e4).reshape(wide[1], wide[0], 2).astype(np.float32)
    shown = cv2.remap(drawn, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderValue=90)
    shown = cv2.resize(shown, size, interpolation=cv2.INTER_AREA).astype(float)
    image = np.clip(black + (white - black) / 255 * shown, 0, 255).round().astype(np.uint8)
    points = board.getChessboardCorners().reshape(-1, 1, 3).astype(float)
    given = (np.asarray(rotation, float), np.asarray(translation, float), matrix, bend)
    corners = cv2.fisheye.projectPoints(points, *given)[0] if fisheye else cv2.projectPoints(points, *given)[0]
    return image, corners.reshape(-1, 2)
