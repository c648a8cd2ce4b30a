"""A checkerboard or ChArUco board, waved before the cameras by hand.

The board is one target with one figure: white paper with black parts subtracted. Black squares meet in points only,
so that no edge is given twice and every corner is exactly at its position in ``Board.corners``.
"""

import cv2
import numpy as np

from mosca.data.arrays import Array
from mosca.data.boards import DICTIONARIES, Board
from mosca.data.targets import face_axes
from mosca.errors import InputError
from twin.scenes.emission import Glow
from twin.scenes.figure import Figure, figure, outlines, polygon
from twin.scenes.scene import Scene
from twin.scenes.target_motion import carried_body, carried_by_hand, carried_scene, room_around
from twin.scenes.target_plate import PAPER, add_plate, black_of, rectangle
from twin.scenes.world import Box, new_stage, positive

BOARD = "board"
_COLUMNS, _ROWS = 9, 6
_EDGE_SHARE = 0.35  # of the box's shortest edge: the default board's longer side
_MOST_TILT_RAD = np.pi / 2


def build_board(
    *,
    duration_s: float,
    box_center_m: Array,
    box_size_m: Array,
    rng: np.random.Generator,
    board: Board | None = None,
    speed_mps: float = 0.2,
    turn_rad_s: float = 0.4,
    facing: tuple[float, float, float] | None = None,
    tilt_rad: float = 0.6,
    glow: Glow = PAPER,
    floor: bool = True,
) -> Scene:
    """Return ``board`` (by default 9 x 6 squares, a third of the box) carried through the working space.

    ``speed_mps``: rms speed of its middle; ``turn_rad_s``: rms rate of its tilt and roll. ``facing`` (3,):
    direction of its face at rest, tilted by ``tilt_rad`` at most; None: all directions, a revolution about the
    vertical in 2 pi / turn_rad_s. ``rng`` draws the path. The only marker is "board". Raises InputError where
    it does not fit into the box.
    """
    box = Box(box_center_m, box_size_m)
    positive({"duration_s": duration_s, "speed_mps": speed_mps, "turn_rad_s": turn_rad_s, "tilt_rad": tilt_rad})
    if tilt_rad > _MOST_TILT_RAD:
        raise InputError(f"tilt_rad = {tilt_rad:g} given; at most {_MOST_TILT_RAD:.4g} is allowed")
    board = default_board(box) if board is None else board
    if board.from_behind:
        raise InputError(
            "from_behind = true: a board's back is blank here; leave it out, the front is what cameras see"
        )
    width, height = board.size_m
    toward = (1.0, 0.0, 0.0) if facing is None else facing
    try:
        rest = face_axes(np.array(toward))
    except ValueError:
        raise InputError(f"facing = {list(toward)} given; a direction (3 numbers) is wanted") from None
    path = carried_by_hand(
        room_around(box, float(np.hypot(width, height)) / 2, "this board"),
        center=box.center,
        rotation=rest,
        sway_rad=np.array([tilt_rad / np.sqrt(2), tilt_rad / np.sqrt(2), tilt_rad]),
        speed_mps=speed_mps,
        turn_rad_s=turn_rad_s,
        spin=turn_rad_s if facing is None else 0.0,
        rng=rng,
    )
    spec = new_stage(floor=floor)
    body = carried_body(spec, BOARD)
    add_plate(body, BOARD, width / 2, height / 2, np.zeros(3), np.eye(3))
    figures = {BOARD: board_figure(board, black_of(glow))}
    return carried_scene(spec, (BOARD,), path, duration_s, body=BOARD, glow=glow, figures=figures)


def default_board(box: Box) -> Board:
    """Return a checkerboard that is a third of the box's shortest edge wide."""
    square = _EDGE_SHARE * float(box.size.min()) / (_COLUMNS + 2)
    return Board(_COLUMNS, _ROWS, square, square)


def board_figure(board: Board, black: float = 0.0) -> Figure:
    """Return the figure of a board; ``black``: light of its black parts over that of its white parts."""
    width, height = board.size_m
    half = board.square_m / 2
    white = set(board.white_squares())
    paper, ink = (black, 1 - black) if board.inverted else (1.0, black - 1)
    contours = [] if paper == 0 else [polygon(rectangle(width / 2, height / 2), paper)]
    contours += [
        polygon(rectangle(half, half, *board.square_centre(column, row)), ink)
        for row in range(board.rows)
        for column in range(board.columns)
        if (column, row) not in white
    ]
    if board.marker_m is not None and board.dictionary is not None:
        for number, (column, row) in enumerate(board.white_squares()):
            cells = marker_cells(board.dictionary, number)
            cell = board.marker_m / len(cells)
            x, y = board.square_centre(column, row)
            corner = np.array([x - board.marker_m / 2, y + board.marker_m / 2])
            contours += [polygon(corner + cell * loop, ink) for loop in outlines(cells)]
    return figure(contours)


def marker_cells(dictionary: str, number: int) -> Array:
    """Return the black cells of a marker and its border, bool (b + 2, b + 2), first row uppermost."""
    bits, _ = DICTIONARIES[dictionary]
    markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    pixels = cv2.aruco.generateImageMarker(markers, number, bits + 2, borderBits=1)
    result: Array = np.asarray(pixels) == 0
    return result
