"""Finding checkerboards and ChArUco boards (with ArUco or AprilTag markers) through OpenCV.

OpenCV finds the corners; they are refined, sorted as ``Board.corners()``, and rejected where uncertain. A
checkerboard must be seen as a whole (``findChessboardCornersSB``; Duda and Frese 2018); of a ChArUco board, whose
markers name the corners, at least half of them must be seen, and all corners must lie where one board before a camera
can have them.

Refinement is a fit of the corner's image (``mosca.coded_targets.corner_fit``), which also gives the covariance. How
long the edges are and how the lens bends them is computed from the board's view.
"""

import math
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np

from mosca.coded_targets.board_view import BoardView, fitted_view
from mosca.coded_targets.corner_fit import fitted_corners, places_of
from mosca.coded_targets.pixel_noise import noise_of
from mosca.data.arrays import Array
from mosca.data.boards import Board
from mosca.data.found_targets import BoardDetections
from mosca.errors import InputError

LEAST_SHARE = 0.5
"""Share of a ChArUco board's corners that must be seen."""
LEAST_FITTING = 0.9
"""Share of a ChArUco board's seen corners that must fit. A few that a marker or a finger displaced are left out; more
do not fit where the board is bent."""
BAND = 0.7
"""Share that is looked at of a ChArUco board's white gap between lines and markers. Its markers are not always where
they should be (OpenCV draws them on whole pixels): on such a board 1.4 gives corners that are 0.08 px off, 1.0 gives
0.05, up to 0.75 gives 0.01 px. On boards printed well it hardly matters (sleap-anipose: 0.4 to 1.4 leave the
same)."""
FARTHEST_STEP = 0.25
"""Largest distance of a refined corner from the place that the finder gave, in narrowest squares."""
SYSTEMATIC_PX = 0.001
"""Error that is no noise: corners of noise-free supersampled boards are 0.0001 to 0.0013 px rms off (blurs of 0.05 to
1.2 px, squares wider than 4 blurs and 3 px)."""
FARTHEST_SHARE = 0.15
"""Largest distance of a corner from its place in the board's view, in distances between corners."""
BEYOND_SHARE = 0.3
"""Distance beyond a checkerboard's border at which its continuation is tested, in squares."""
LEAST_ALTERNATING = 0.95
"""Share of neighbouring squares that must be black and white."""
NO_CORNER = "no corner of squares is where the checkerboard would have one"
NO_PLANE = "the corners are not those of a plane before a camera"
FEWEST_CORNERS = 6
"""Below that a view has no redundancy."""


def find_board(image: Array, board: Board, camera: str = "") -> BoardDetections:
    """Return the inner corners of ``board`` in an image (H, W) of uint8 or uint16, rows of ``Board.corners()``.

    A board that is absent, half occluded or cut off gives none, with the reason in ``refused``. A board that can be
    seen from behind (``Board.from_behind``) is also searched for from there. Raises InputError for another kind of
    image.
    """
    if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16) or 0 in image.shape:
        raise InputError(
            f"boards: camera '{camera}': image {image.shape} of {image.dtype} given; (H, W) of uint8 or uint16 is "
            "allowed: reduce colour to grey first"
        )
    grey = _eight_bits(image)
    if board.inverted:
        grey = 255 - grey
    found = _found(grey, image, board, camera)
    if found.refused and board.from_behind:
        behind = _found(np.ascontiguousarray(grey[:, ::-1]), np.ascontiguousarray(image[:, ::-1]), board, camera)
        if not behind.refused:
            xy = [grey.shape[1] - 1, 0] + behind.xy_px * [-1, 1]
            return BoardDetections(camera, behind.corner, xy, behind.covariance_px2 * [[1, -1], [-1, 1]])
    return found


def other_looks(image: Array, board: Board) -> dict[str, bool]:
    """Return the keys, with values, with which ``board`` would be found in an image where it was refused.

    Empty where it is not found inverted, mirrored or both either.
    """
    for inverted, from_behind in ((True, False), (False, True), (True, True)):
        if board.dictionary is None and from_behind:
            continue
        other = replace(board, inverted=board.inverted != inverted, from_behind=board.from_behind or from_behind)
        if other != board and len(find_board(image, other)):
            keys = ("inverted", "from_behind")
            return {key: getattr(other, key) for key in keys if getattr(other, key) != getattr(board, key)}
    return {}


def _found(grey: Array, image: Array, board: Board, camera: str) -> BoardDetections:
    """Return the corners of a board that faces the camera; ``grey``: ``image`` as black on white in 8 bits."""
    found = _checkerboard(grey, board) if board.dictionary is None else _charuco(grey, board)
    if isinstance(found, str):
        return BoardDetections.none(camera, found)
    corner, xy = found
    if len(xy) < FEWEST_CORNERS:
        return BoardDetections.none(camera, f"{len(xy)} corners seen; {FEWEST_CORNERS} are wanted")
    size = (grey.shape[1], grey.shape[0])
    rough = _view(board, corner, xy, size)
    if rough is None:
        return BoardDetections.none(camera, NO_PLANE)
    refined, covariance = _refined(image, board, rough, corner, xy)
    # a corner that moves far has followed other edges
    still = np.linalg.norm(refined - xy, axis=1) <= FARTHEST_STEP * rough.spacing_px
    if board.dictionary is None and not still.all():
        return BoardDetections.none(camera, NO_CORNER)
    fitting = _fitting(board, corner[still], refined[still], size)
    if isinstance(fitting, str):
        return BoardDetections.none(camera, fitting)
    kept, xy, view = fitting
    other = _other_pattern(grey, board, view) if board.dictionary is None else ""
    if other:
        return BoardDetections.none(camera, f"{other}: are columns and rows those of the board?")
    covariance = covariance[np.searchsorted(corner, kept)] + SYSTEMATIC_PX**2 * np.eye(2)
    return BoardDetections(camera, kept, xy, covariance)


def _refined(image: Array, board: Board, rough: "_Fit", corner: Array, xy: Array) -> tuple[Array, Array]:
    """Return refined places (n, 2) [px] and their covariances (n, 2, 2) [px^2]."""
    markers = (0.0, 1.0)
    if board.marker_m is not None:
        gap = 0.5 * (1 - board.marker_m / board.square_m)
        markers = (-1.0 if board.inverted else 1.0, BAND * gap)
    left, top = np.maximum(np.floor(xy.min(axis=0)).astype(int), 0)
    right, bottom = np.ceil(xy.max(axis=0)).astype(int) + 1
    noise = noise_of(image[top:bottom, left:right])
    return fitted_corners(image, places_of(board, rough.view, corner, xy), markers, _full_dn(image), noise)


def _full_dn(image: Array) -> float:
    """Return the grey value from which pixels are saturated: 255, or the largest of an image that has 2^n - 1."""
    most = int(image.max())
    return float(most) if most & (most + 1) == 0 and most >= 255 else math.inf


class _Fit(NamedTuple):
    """A view, its narrowest square's width, and how far (n,) the corners are from it [narrowest squares]."""

    view: BoardView
    spacing_px: float
    off: Array


def _view(board: Board, corner: Array, xy: Array, size: tuple[int, int]) -> _Fit | None:
    """Return how an image of ``size`` shows corners ``corner`` (n,) at ``xy`` (n, 2) [px].

    The view is straight where that is near enough, else has radial terms where these are nearer; None where neither
    can be fitted.
    """
    plane = board.corners()[corner, :2]
    best: _Fit | None = None
    for bent in (False, True):
        if (view := fitted_view(plane, xy, size, bent)) is None:
            continue
        spacing = board.square_m * view.narrowest(plane)
        fit = _Fit(view, spacing, np.linalg.norm(view.image(plane) - xy, axis=1) / spacing)
        if best is None or fit.off.max() < best.off.max():
            best = fit
        if fit.off.max() <= FARTHEST_SHARE:
            break
    return best


def _fitting(board: Board, corner: Array, xy: Array, size: tuple[int, int]) -> tuple[Array, Array, BoardView] | str:
    """Return the corners (n,) and positions (n, 2) [px] that fit one board, and its view; or the reason for none."""
    enough = len(xy) if board.dictionary is None else math.ceil(LEAST_FITTING * len(xy))
    first = math.nan
    while len(xy) >= max(enough, FEWEST_CORNERS) and (fit := _view(board, corner, xy, size)) is not None:
        if fit.off.max() <= FARTHEST_SHARE:
            return corner, xy, fit.view
        first = fit.off.max() if math.isnan(first) else first
        others = np.arange(len(xy)) != fit.off.argmax()
        corner, xy = corner[others], xy[others]
    if math.isnan(first):
        return NO_PLANE
    return f"{len(xy) + 1} corners, one of them {first:.2f} squares from where the board would have it"


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
    # between the first four corners lies the second square of the second row: black, as the first of the first row is
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


def _other_pattern(image: Array, board: Board, view: BoardView) -> str:
    """Return why the corners found are not those of the whole checkerboard, "" where they are.

    OpenCV also finds a part of a larger board, or every second row of it, and different ones in each image. Within
    the board squares must alternate between black and white; beyond its sides is its margin, or the background.
    """
    size = np.array([board.columns, board.rows])
    column, row = np.meshgrid(np.arange(-1, size[0] + 1), np.arange(-1, size[1] + 1))
    # sampled near the border: a narrow margin is smaller than a square
    middle = np.stack([column, row], axis=-1) + 0.5
    middle = np.clip(middle, -BEYOND_SHARE, size + BEYOND_SHARE)
    plane = (middle - size / 2) * board.square_m * [1, -1]
    there = view.image(plane.reshape(-1, 2))
    seen = np.all((there >= 0) & (there <= np.array(image.shape[::-1]) - 1), axis=1)
    at = np.floor(np.where(np.expand_dims(seen, 1), there, 0.0) + 0.5).astype(int)
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
