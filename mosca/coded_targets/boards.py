"""Finding checkerboards and ChArUco boards (with ArUco or AprilTag markers) through OpenCV.

A thin wrapper: OpenCV finds the corners; they are refined, sorted as ``Board.corners()``, and rejected where
uncertain. A checkerboard must be seen as a whole (``findChessboardCornersSB``; Duda and
Frese 2018); of a ChArUco board, whose markers name the corners, at least half of them must be seen, and all corners
must lie where one board before a camera can have them.

Refinement is OpenCV's ``cornerSubPix`` (Foerstner and Guelch 1987) on the image blurred by 1 px: the point c to which
all grey-value gradients g of a window are perpendicular, ``sum w g g^T (p - c) = 0``. The errors of the unrefined
corners are five times as large. The covariance is that of the pixel noise, measured in the image, at first order,
plus ``SYSTEMATIC_PX``.
"""

import math

import cv2
import numpy as np

from mosca.coded_targets.detect import noise_of
from mosca.data.arrays import Array
from mosca.data.boards import Board
from mosca.data.found_targets import BoardDetections
from mosca.errors import InputError

LEAST_SHARE = 0.5
"""Share of a ChArUco board's corners that must be seen."""
WINDOW_SHARE, SMALLEST_WINDOW_PX, LARGEST_WINDOW_PX = 0.35, 3, 11
"""Half the window of the refinement: share of the smallest distance of two corners, and its limits."""
BLUR_PX, BLUR_REACH = 1.0, 4
"""Standard deviation of the blur before refinement, and half the width of its kernel [px]."""
SYSTEMATIC_PX = 0.01
"""Error that a finite window leaves of edges one or two pixels wide (measured on rendered boards)."""
FARTHEST_SHARE = 0.15
"""Largest residual of a corner from its board's homography, in distances between corners."""
BEYOND_SHARE = 0.3
"""Distance beyond a checkerboard's border at which its continuation is tested, in squares."""
LEAST_ALTERNATING = 0.95
"""Share of neighbouring squares that must be black and white."""
NO_ROOM = "a corner is too near to the image's border"
FEWEST_CORNERS = 6
"""Below that a homography has no redundancy."""


def find_board(image: Array, board: Board, camera: str = "") -> BoardDetections:
    """Return the inner corners of ``board`` in an image (H, W) of uint8 or uint16, rows of ``Board.corners()``.

    A board that is absent, half occluded or cut off gives none, with the reason in ``refused``. Raises InputError
    for another kind of image.
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
    if len(xy) < FEWEST_CORNERS:
        return BoardDetections.none(camera, f"{len(xy)} corners seen; {FEWEST_CORNERS} are wanted")
    plane = board.corners()[corner, :2]
    spacing = board.square_m * _narrowest(np.asarray(cv2.findHomography(plane, xy)[0]), plane)
    half = _half_window(board, spacing)
    if not _has_room(image, xy, half):
        return BoardDetections.none(camera, NO_ROOM)
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 40, 1e-4)
    start = xy.astype(np.float32).reshape(-1, 1, 2)
    soft = _soft(grey.astype(np.float32))
    refined = cv2.cornerSubPix(soft, start.copy(), (half, half), (-1, -1), stop).reshape(-1, 2)
    xy = refined.astype(np.float64)
    homography = np.asarray(cv2.findHomography(plane, xy)[0])
    off = np.linalg.norm(_mapped(homography, plane) - xy, axis=1) / spacing
    if not off.max() <= FARTHEST_SHARE:
        return BoardDetections.none(
            camera, f"{len(xy)} corners, one of them {off.max():.2f} squares from where the board would have it"
        )
    if not _has_room(image, xy, half):
        return BoardDetections.none(camera, NO_ROOM)
    other = _other_pattern(grey, board, homography) if board.dictionary is None else ""
    if other:
        return BoardDetections.none(camera, f"{other}: are columns and rows those of the board?")
    left, top = np.floor(xy.min(axis=0)).astype(int)
    right, bottom = np.ceil(xy.max(axis=0)).astype(int) + 1
    noise = noise_of(grey[top:bottom, left:right])
    random = np.array([corner_covariance(soft, at, half, noise) for at in xy])
    covariance = random + SYSTEMATIC_PX**2 * np.eye(2)
    return BoardDetections(camera, corner, xy, covariance)


def corner_covariance(image: Array, xy_px: Array, half_px: int, noise_dn: float) -> Array:
    """Return the covariance (2, 2) [px^2] of a corner refined in a window of +-``half_px`` of the blurred ``image``.

    ``noise_dn``: standard deviation of a pixel before the blur. First order in the pixels' noise: the corner moves by
    ``A^-1 sum w [g (d . grad n) + (g . d) grad n]``, ``A = sum w g g^T``, with g the gradients, d the pixels' offsets
    from the corner, n the blurred noise and w the window's weights. Infinite where A is singular.
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
    # response to the noise of each pixel: adjoints of central differences and blur
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
    """Return whether the windows about all corners (n, 2) lie within the image, blur and all."""
    room = half_px + BLUR_REACH + 2
    return bool((xy >= room).all() and (xy <= np.array(image.shape[::-1]) - room - 1).all())


def _narrowest(homography: Array, points: Array) -> float:
    """Return by how much the board's squares are magnified across where they are narrowest [px/m].

    The least distance of opposite sides, at any of ``points`` (n, 2): a leaning square is a rhombus, narrower
    than its sides are long.
    """
    step = 1e-3 * np.ptp(points, axis=0).max()
    here = _mapped(homography, points)
    along, down = (_mapped(homography, points + by) - here for by in ([step, 0.0], [0.0, step]))
    area = np.abs(along[:, 0] * down[:, 1] - along[:, 1] * down[:, 0])
    longer = np.maximum(np.linalg.norm(along, axis=1), np.linalg.norm(down, axis=1))
    return float((area / longer).min() / step)


def _half_window(board: Board, spacing_px: float) -> int:
    """Return half the window's width where lines of the board are this far apart: it must not reach into a marker."""
    half = round(WINDOW_SHARE * spacing_px)
    if board.marker_m is not None:
        half = min(half, math.floor(0.5 * (1 - board.marker_m / board.square_m) * spacing_px - BLUR_PX))
    return min(max(half, SMALLEST_WINDOW_PX), LARGEST_WINDOW_PX)


def _checkerboard(image: Array, board: Board) -> tuple[Array, Array] | str:
    """Return indices and positions of a whole checkerboard's corners, or the reason for none."""
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
    """Return indices and positions of a ChArUco board's corners, or the reason for none."""
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


def _mapped(homography: Array, points: Array) -> Array:
    """Return points (n, 2) of the board as a homography (3, 3) maps them into the image."""
    return np.asarray(cv2.perspectiveTransform(points[None].astype(np.float64), homography)[0])


def _other_pattern(image: Array, board: Board, homography: Array) -> str:
    """Return why the corners found are not those of the whole checkerboard, "" where they are.

    OpenCV also finds a part of a larger board, or every second row of it, other ones in each image. Within the board
    squares must alternate between black and white; beyond its sides is its margin, or the background.
    """
    size = np.array([board.columns, board.rows])
    column, row = np.meshgrid(np.arange(-1, size[0] + 1), np.arange(-1, size[1] + 1))
    # sampled near the border: a narrow margin is smaller than a square
    middle = np.stack([column, row], axis=-1) + 0.5
    middle = np.clip(middle, -BEYOND_SHARE, size + BEYOND_SHARE)
    plane = (middle - size / 2) * board.square_m * [1, -1]
    at = np.floor(_mapped(homography, plane.reshape(-1, 2)) + 0.5).astype(int)
    seen = ((at >= 0) & (at < image.shape[::-1])).all(axis=1)
    at[~seen] = 0
    grey = np.where(seen, image[at[:, 1], at[:, 0]].astype(float), np.nan).reshape(column.shape)
    grey *= np.where((column + row) % 2, 1, -1)  # white less black: the sum of two neighbours
    inside = grey[1:-1, 1:-1]
    steps = np.concatenate([(inside[1:] + inside[:-1]).ravel(), (inside[:, 1:] + inside[:, :-1]).ravel()])
    steps = steps[np.isfinite(steps)]
    usual = np.median(steps)
    if not (usual > 0 and np.mean(steps > usual / 4) > LEAST_ALTERNATING):
        return "squares of what is seen are not black and white in turns"
    for side in (grey[0, 1:-1], grey[-1, 1:-1], grey[1:-1, 0], grey[1:-1, -1]):
        if np.median(side[1:] + side[:-1]) > usual / 2:
            return f"the checkerboard seen goes on beyond {board.columns} x {board.rows} squares"
    return ""
