"""Boards rendered by the twin: corners where they truly are, in the right order, and none of half a board."""

from functools import cache

import cv2
import numpy as np
import pytest
from scene_poses import body_pose

from mosca.camera.projection import project
from mosca.coded_targets.boards import find_board
from mosca.data.arrays import Array
from mosca.data.boards import DICTIONARIES, Board
from mosca.data.rig import Camera, OpenCVLens, Pose
from mosca.errors import InputError
from twin.cameras.exposure.mount import Mount
from twin.cameras.exposure.shutter import Timing
from twin.cameras.optics.blur_parameters import Optics
from twin.cameras.sensor.sensor import Sensor
from twin.cameras.virtual_camera import VirtualCamera
from twin.scenes.target_boards import build_board
from twin.source import TwinSource

CHECKERS = Board(9, 6, 0.04, 0.04)
CHARUCO = Board(9, 6, 0.04, 0.04, 0.028, "DICT_5X5_100")
APRILTAGS = Board(9, 6, 0.04, 0.04, 0.028, "DICT_APRILTAG_36H11")
BOARDS = {"checkerboard": CHECKERS, "charuco": CHARUCO, "apriltags": APRILTAGS}
FRAMES = 3


@cache
def rendered(name: str, read_noise_e: float = 10.0) -> tuple[tuple[Array, Array], ...]:
    """Return images (H, W) with the true corners (k, 2) [px]; squares of about 40 px, up to 35 deg of lean."""
    board = BOARDS[name]
    looking = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])
    lens = OpenCVLens(2000.0, 2000.0, 639.5, 479.5)
    eye = Camera("eye", 1280, 960, lens, Pose(looking, np.array([0, -2.0, 1.0])))
    scene = build_board(
        duration_s=20.0, box_center_m=np.array([0, 0, 1.0]), box_size_m=np.array([0.9, 0.7, 0.8]), board=board,
        rng=np.random.default_rng(5), facing=(0, -1, 0), tilt_rad=0.6, speed_mps=0.05, turn_rad_s=0.3, floor=False,
    )  # fmt: skip
    steady = VirtualCamera(
        eye, Optics(gap_px=0.0), Timing(jitter_s=0.0), Mount(body_px=0.0), Sensor(read_noise_e=read_noise_e)
    )
    source = TwinSource(scene, (steady,), frame_rate_hz=0.25, exposure_s=1e-3, pulses=FRAMES, seed=2)
    views = []
    for frame in source:
        assert frame.image is not None
        position, rotation = body_pose(scene, frame.time_ns * 1e-9 + 0.5e-3)
        true = project(eye, position + board.corners() @ rotation.T)
        views.append((frame.image, true))
    return tuple(views)


@pytest.mark.parametrize(("name", "limit_px"), [("checkerboard", 0.004), ("charuco", 0.004), ("apriltags", 0.004)])
def test_corners_are_where_they_truly_are(name, limit_px):
    errors = []
    for image, true in rendered(name):
        found = find_board(image, BOARDS[name], "eye")
        assert found.refused == ""
        assert found.camera == "eye"
        assert found.corner.tolist() == list(range(40))
        errors.append(found.xy_px - true)
    assert np.sqrt(np.mean(np.square(errors))) < limit_px


@pytest.mark.parametrize("quarters", [1, 2, 3])
@pytest.mark.parametrize("name", list(BOARDS))
def test_corners_keep_their_numbers_however_the_board_is_turned(name, quarters):
    image, true = rendered(name)[0]
    height, width = image.shape
    for _ in range(quarters):  # counter-clockwise: (x, y) -> (y, width - 1 - x)
        true = np.column_stack([true[:, 1], width - 1 - true[:, 0]])
        height, width = width, height
    found = find_board(np.ascontiguousarray(np.rot90(image, quarters)), BOARDS[name])
    assert len(found) == 40
    assert np.abs(found.xy_px - true[found.corner]).max() < 0.15


def test_sixteen_bits_read_as_eight():
    image, true = rendered("checkerboard")[0]
    found = find_board(image.astype(np.uint16) * 16, CHECKERS)
    assert np.abs(found.xy_px - true).max() < 0.15


def test_the_covariance_is_that_of_the_errors():
    """Read noise of 600 electrons (7.6 grey values); the median over all corners, as a factor."""
    errors, variances = [], []
    for image, true in rendered("checkerboard", 600.0):
        found = find_board(image, CHECKERS)
        errors.append(found.xy_px - true)
        variances.append(np.trace(found.covariance_px2, axis1=1, axis2=2) / 2)
    assert 0.75 < np.sqrt(np.mean(np.square(errors)) / np.mean(variances)) < 1.33


def warped(board: Board, tilt: float, lean: float, roll: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return an image (480, 640) of the board as OpenCV draws it, before a pinhole camera, and its corners (k, 2).

    It leans by ``tilt`` to the side ``lean`` and is rolled by ``roll`` [rad]; its longer side is about 400 px.
    """
    cell = 40
    size = (board.columns * cell, board.rows * cell)
    if board.dictionary is None:
        column, row = np.meshgrid(np.arange(size[0]) // cell, np.arange(size[1]) // cell)
        flat = np.where((column + row) % 2, 230, 20).astype(np.uint8)
    else:
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
        drawn = cv2.aruco.CharucoBoard((board.columns, board.rows), board.square_m, board.marker_m or 0.0, dictionary)
        flat = np.clip(drawn.generateImage(size), 20, 230).astype(np.uint8)
    flat = cv2.copyMakeBorder(flat, cell, cell, cell, cell, cv2.BORDER_CONSTANT, value=230)
    c, s = np.cos(lean), np.sin(lean)
    k = np.array([[0, 0, s], [0, 0, -c], [-s, c, 0]])  # about the axis (c, s, 0)
    turn = np.eye(3) + np.sin(tilt) * k + (1 - np.cos(tilt)) * k @ k
    turn = turn @ np.array([[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1.0]])
    centred = np.array([[1, 0, 0.5 - flat.shape[1] / 2], [0, 1, 0.5 - flat.shape[0] / 2], [0, 0, 1.0]])
    place = np.column_stack([turn[:, 0], turn[:, 1], [0, 0, 2.2 * max(size)]])
    camera = np.array([[900.0, 0, 319.5], [0, 900.0, 239.5], [0, 0, 1]])
    homography = camera @ place @ centred
    image = cv2.warpPerspective(flat, homography, (640, 480), flags=cv2.INTER_AREA, borderValue=100)
    noisy = cv2.GaussianBlur(image, (0, 0), 0.7) + rng.normal(0, 2, image.shape)
    down = np.stack(np.meshgrid(np.arange(1, board.rows), np.arange(1, board.columns), indexing="ij"), axis=-1)
    corners = (down.reshape(-1, 2)[:, ::-1] + 1.0) * cell - 0.5
    return np.clip(noisy, 0, 255).astype(np.uint8), cv2.perspectiveTransform(corners[None], homography)[0]


@pytest.mark.parametrize("name", list(BOARDS))
def test_corners_keep_their_numbers_at_all_tilts_and_rolls(name):
    """24 views to all sides, tilts up to 55 deg, all rolls: the right numbers or none, and hardly ever none."""
    rng = np.random.default_rng(3)
    read = 0
    for k in range(24):
        lean, roll = rng.uniform(0, 2 * np.pi, 2)
        image, true = warped(BOARDS[name], np.deg2rad(55) * k / 23, lean, roll, rng)
        found = find_board(image, BOARDS[name])
        if len(found):
            off = found.xy_px - true[found.corner]
            assert np.abs(off).max() < 0.3
            read += 1
    assert read >= 22


@pytest.mark.parametrize("dictionary", sorted(DICTIONARIES))
def test_all_dictionaries_are_read(dictionary):
    board = Board(6, 5, 0.04, 0.04, 0.028, dictionary)
    image, true = warped(board, 0.4, 1.0, 0.5, np.random.default_rng(1))
    found = find_board(image, board)
    assert len(found) >= 16
    assert np.abs(found.xy_px - true[found.corner]).max() < 0.4


@pytest.mark.parametrize(("columns", "rows"), [(9, 4), (7, 6), (8, 5), (6, 5), (5, 6), (5, 4)])
def test_a_part_of_a_larger_board_is_no_board(columns, rows):
    """OpenCV alone finds parts of a board, and another part in each image."""
    for tilt, roll in ((0.0, 0.1), (0.5, 1.0), (0.7, 4.0)):
        image, _ = warped(CHECKERS, tilt, 1.0, roll, np.random.default_rng(1))
        assert len(find_board(image, CHECKERS)) == 40
        found = find_board(image, Board(columns, rows, 0.04, 0.04))
        assert len(found) == 0
        assert found.refused


def test_a_narrow_margin_is_enough():
    image, true = warped(CHECKERS, 0.3, 1.0, 0.4, np.random.default_rng(1))
    for grey in (20, 100, 240):  # what is behind the board
        cut = image.copy()
        outline = cv2.convexHull(true.astype(np.float32)).reshape(-1, 2)
        middle = outline.mean(axis=0)
        mask = np.zeros(image.shape, np.uint8)
        cv2.fillConvexPoly(mask, np.rint(middle + 1.45 * (outline - middle)).astype(np.int32), 1)
        cut[mask == 0] = grey
        assert len(find_board(cut, CHECKERS)) == 40


@pytest.mark.parametrize("name", list(BOARDS))
def test_half_a_board_is_refused_and_says_why(name):
    image, true = rendered(name)[0]
    middle = true.mean(axis=0)
    hidden = image.copy()
    hidden[:, int(middle[0]) - 30 :] = 20
    found = find_board(hidden, BOARDS[name])
    assert len(found) == 0
    assert "seen" in found.refused


@pytest.mark.parametrize("name", ["charuco", "apriltags"])
def test_most_of_a_marked_board_is_enough(name):
    image, true = rendered(name)[0]
    hidden = image.copy()
    edge = int(np.quantile(true[:, 0], 0.75))
    hidden[:, edge:] = 20
    found = find_board(hidden, BOARDS[name])
    assert 20 <= len(found) < 40
    off = np.abs(found.xy_px - true[found.corner]).max(axis=1)
    assert off.max() < 0.15


def test_a_covered_checkerboard_is_refused():
    image, true = rendered("checkerboard")[0]
    x, y = true[9].astype(int)
    hidden = image.copy()
    hidden[y - 30 : y + 30, x - 30 : x + 30] = 90
    assert len(find_board(hidden, CHECKERS)) == 0


def test_another_board_is_not_found():
    image, _ = rendered("charuco")[0]
    assert len(find_board(image, Board(9, 6, 0.04, 0.04, 0.028, "DICT_6X6_250"))) == 0
    assert len(find_board(rendered("checkerboard")[0][0], Board(8, 5, 0.04, 0.04))) == 0
    assert len(find_board(np.zeros((100, 120), np.uint8), CHECKERS)) == 0


def test_colour_images_are_refused():
    with pytest.raises(InputError, match="camera 'eye'"):
        find_board(np.zeros((4, 4, 3), np.uint8), CHECKERS, "eye")
