"""Finding checkerboards and ChArUco boards (with ArUco or AprilTag markers) through OpenCV.

A thin wrapper: OpenCV finds the corners, their places are refined, their order made that of ``Board.corners()``,
and what is not sure is refused. A checkerboard must be seen as a whole (``findChessboardCornersSB``; Duda and
Frese 2018); of a ChArUco board, whose markers name the corners, at least half of them must be seen, and all corners
must lie where one board before a camera can have them.

Refinement is OpenCV's ``cornerSubPix`` (Foerstner and Guelch 1987) on the image blurred by 1 px: the point c to which
all grey-value gradients g of a window are perpendicular, ``sum w g g^T (p - c) = 0``. The finder's own corners are
five times as far off. The covariance is that of the pixels' noise, measured in the image, at first order, and
``SYSTEMATIC_PX`` for what the finite window leaves of edges one or two pixels wide (measured on rendered boards).
"""

import math

import cv2
import numpy as np

from mosca.coded import noise_of
from mosca.data.arrays import Array
from mosca.data.boards import Board
from mosca.data.found_targets import BoardDetections
from mosca.errors import InputError

LEAST_SHARE = 0.5
"""Share of a ChArUco board's corners that must be seen."""
WINDOW_SHARE, SMALLEST_WINDOW_PX, LARGEST_WINDOW_PX = 0.35, 3, 11
"""Half the window of the refinement: share of the smallest distance of two corners, and its limits."""
BLUR_PX, BLUR_REACH = 1.0, 4
SYSTEMATIC_PX = 0.01
FARTHEST_SHARE = 0.15
"""How far a corner may lie from where its board's homography has it, in distances of corners."""
NO_ROOM = "a corner is too near to the image's border"
FEWEST_CORNERS = 6
"""Below that nothing checks a homography."""


def find_board(image: Array, board: Board, camera: str = "") -> BoardDetections:
    """Return the inner corners of ``board`` in an image (H, W) of uint8 or uint16, rows of ``Board.corners()``.

    A board that is not there, half hidden or cut off gives none, and ``refused`` says why. Raises InputError for
    another kind of image.
    """
    if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16) or 0 in image.shape:
        raise InputError(
            f"boards: camera '{camera}': image {image.shape} of {image.dtype} given; (H, W) of uint8 or uint16 is "
            "allowed: reduce colour to grey first"
        )
    grey = _eight_bits(image)
    found = _checkerboard(grey, board) if board.dictionary is None else _charuco(grey, board)
    if isinstance(found, str):
        return BoardDetections.none(camera, found)
    corner, xy = found
    spacing = _spacing(xy)
    half = _half_window(board, spacing)
    if not _has_room(image, xy, half):
        return BoardDetections.none(camera, NO_ROOM)
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 40, 1e-4)
    start = xy.astype(np.float32).reshape(-1, 1, 2)
    soft = _soft(grey.astype(np.float32))
    refined = cv2.cornerSubPix(soft, start.copy(), (half, half), (-1, -1), stop).reshape(-1, 2)
    xy = refined.astype(np.float64)
    off = _off_homography(board.corners()[corner, :2], xy) / spacing
    if len(xy) < FEWEST_CORNERS or off.max() > FARTHEST_SHARE:
        return BoardDetections.none(
            camera,
            f"{len(xy)} corners, one of them {off.max():.2f} squares from where the board would have it",
        )
    if not _has_room(image, xy, half):
        return BoardDetections.none(camera, NO_ROOM)
    left, top = np.floor(xy.min(axis=0)).astype(int)
    right, bottom = np.ceil(xy.max(axis=0)).astype(int) + 1
    noise = noise_of(grey[top:bottom, left:right])
    random = np.array([corner_covariance(soft, at, half, noise) for at in xy])
    covariance = random + SYSTEMATIC_PX**2 * np.eye(2)
    return BoardDetections(camera, corner, xy, covariance)


def corner_covariance(image: Array, xy_px: Array, half_px: int, noise_dn: float) -> Array:
    """Return the covariance (2, 2) [px^2] of a corner refined in a window of +-``half_px`` of the blurred ``image``.

    ``noise_dn``: standard deviation of a pixel before the blur. First order in the pixels' noise: the corner moves by
    ``A^-1 sum w [g (d . grad n) + (g . d) grad n]``, ``A = sum w g g^T``, with g the gradients, d the pixels' places
    about the corner, n the blurred noise and w the window's weights. Infinite where no gradients meet.
    """
    column, row = np.floor(xy_px + 0.5).astype(int)
    reach = half_px + 1 + BLUR_REACH
    window = image[row - reach : row + reach + 1, column - reach : column + reach + 1].astype(np.float64)
    inner = slice(BLUR_REACH + 1, -BLUR_REACH - 1)
    gx, gy = (np.gradient(window, axis=axis)[inner, inner] for axis in (1, 0))
    steps = np.arange(-half_px, half_px + 1)
    dx, dy = np.meshgrid(steps + column - xy_px[0], steps + row - xy_px[1])
    weight = np.exp(-(dx**2 + dy**2) / half_px**2)
    g = np.stack([gx, gy])
    normal = np.einsum("iyx,jyx,yx->ij", g, g, weight)
    if not np.linalg.det(normal) > 1e-9 * np.trace(normal) ** 2:
        return np.full((2, 2), np.inf)
    # what the noise of each pixel adds: central differences and blur, both turned round
    pull = np.zeros((2, *window.shape))
    along = g[0] * dx + g[1] * dy  # 0 on ideal edges
    for axis, d in ((1, dy), (2, dx)):
        shares = np.zeros_like(pull)
        shares[:, inner, inner] = weight * g * d / 2
        shares[2 - axis, inner, inner] += weight * along / 2
        pull += np.roll(shares, 1, axis) - np.roll(shares, -1, axis)
    pull = np.stack([_soft(part) for part in pull])
    inverse = np.linalg.inv(normal)
    return np.asarray(noise_dn**2 * inverse @ np.einsum("iyx,jyx->ij", pull, pull) @ inverse)


def _soft(image: Array) -> Array:
    """Return an image blurred by ``BLUR_PX``."""
    return np.asarray(cv2.GaussianBlur(image, (2 * BLUR_REACH + 1, 2 * BLUR_REACH + 1), BLUR_PX))


def _has_room(image: Array, xy: Array, half_px: int) -> bool:
    """Tell whether the windows about all corners (n, 2) lie within the image, blur and all."""
    room = half_px + BLUR_REACH + 2
    return bool((xy >= room).all() and (xy <= np.array(image.shape[::-1]) - room - 1).all())


def _half_window(board: Board, spacing_px: float) -> int:
    """Return half the window's width for corners this far apart: it must not reach into a marker."""
    share = WINDOW_SHARE
    if board.marker_m is not None:
        share = min(share, 0.5 * (1 - board.marker_m / board.square_m))
    return int(min(max(round(share * spacing_px), SMALLEST_WINDOW_PX), LARGEST_WINDOW_PX))


def _checkerboard(image: Array, board: Board) -> tuple[Array, Array] | str:
    """Return corners' numbers and places of a whole checkerboard, or why there is none."""
    size = (board.columns - 1, board.rows - 1)
    found, corners = cv2.findChessboardCornersSB(image, size)
    if not found:
        found, corners = cv2.findChessboardCornersSB(image, size, flags=cv2.CALIB_CB_EXHAUSTIVE)
    if not found:
        return f"no checkerboard of {size[0]} x {size[1]} inner corners is seen as a whole"
    xy = np.asarray(corners, dtype=np.float64).reshape(size[1], size[0], 2)
    along, down = xy[0, -1] - xy[0, 0], xy[-1, 0] - xy[0, 0]
    if along[0] * down[1] - along[1] * down[0] < 0:  # from the front, rows run to the left of columns' down
        xy = xy[:, ::-1]
    colours = [_mean_of_square(image, at) for at in (xy[:2, :2], xy[:2, 1:3])]
    # between the first four corners lies the second square of the second row: black as the first of the first
    if colours[0] > colours[1]:
        xy = xy[::-1, ::-1]
    return np.arange(size[0] * size[1]), xy.reshape(-1, 2)


def _charuco(image: Array, board: Board) -> tuple[Array, Array] | str:
    """Return corners' numbers and places of a ChArUco board, or why there are none."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, str(board.dictionary)))
    size = (board.columns, board.rows)
    theirs = cv2.aruco.CharucoBoard(size, float(board.square_m), float(board.marker_m or 0.0), dictionary)
    corners, ids, _, _ = cv2.aruco.CharucoDetector(theirs).detectBoard(image)
    number = 0 if ids is None else len(ids)
    every = (board.columns - 1) * (board.rows - 1)
    if number < max(LEAST_SHARE * every, FEWEST_CORNERS):
        return f"{number} of {every} corners seen; at least half are wanted"
    corner = np.asarray(ids, dtype=np.int64).ravel()
    order = np.argsort(corner)
    return corner[order], np.asarray(corners, dtype=np.float64).reshape(-1, 2)[order]


def _eight_bits(image: Array) -> Array:
    """Return an image as OpenCV's finders take it: 8 bits, the brightest pixel near the top where it had more."""
    if image.dtype == np.uint8:
        return np.ascontiguousarray(image)
    return np.asarray(cv2.convertScaleAbs(image, alpha=255.0 / max(float(image.max()), 255.0)))


def _mean_of_square(image: Array, corners: Array) -> float:
    """Return the mean grey value about the middle of four corners (2, 2, 2) [px], a quarter of their square wide."""
    middle = corners.mean(axis=(0, 1))
    half = max(0, math.floor(0.125 * _spacing(corners.reshape(-1, 2))))
    column, row = np.floor(middle + 0.5).astype(int)
    return float(image[max(row - half, 0) : row + half + 1, max(column - half, 0) : column + half + 1].mean())


def _spacing(xy: Array) -> float:
    """Return the smallest distance of two of the points (n, 2)."""
    apart = np.linalg.norm(xy[:, None] - xy[None], axis=2)
    return float(apart[~np.eye(len(xy), dtype=bool)].min())


def _off_homography(plane: Array, xy: Array) -> Array:
    """Return the distances (n,) [px] of points from the best homography of their places on the board."""
    if len(xy) < 4:
        return np.zeros(len(xy))
    homography, _ = cv2.findHomography(plane, xy)
    if homography is None:
        return np.full(len(xy), np.inf)
    there = cv2.perspectiveTransform(plane[None].astype(np.float64), homography)[0]
    return np.asarray(np.linalg.norm(there - xy, axis=1))
