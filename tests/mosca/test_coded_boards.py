"""Boards rendered by the twin: corners where they truly are, in the right order, and none of half a board."""

from functools import cache

import numpy as np
import pytest

from mosca.boards import corner_covariance, find_board
from mosca.camera import project
from mosca.data.arrays import Array
from mosca.data.boards import Board
from mosca.data.rig import Camera, OpenCVLens, Pose
from mosca.errors import InputError
from twin.cameras.camera import VirtualCamera
from twin.cameras.mount import Mount
from twin.cameras.optics import Optics
from twin.cameras.sensor import Sensor
from twin.cameras.shutter import Timing
from twin.scenes.target_boards import build_board, corners_at
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
    sampler = scene.sampler()
    views = []
    for frame in source:
        assert frame.image is not None
        true = project(eye, corners_at(sampler, board, frame.time_ns * 1e-9 + 0.5e-3))
        views.append((frame.image, true))
    return tuple(views)


@pytest.mark.parametrize(
    ("name", "limit_px"), [("checkerboard", 0.02), ("charuco", 0.03), ("apriltags", 0.03)]
)
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


def test_the_covariance_of_a_corner_by_many_draws():
    """One ideal corner with white noise, refined by OpenCV 400 times."""
    import cv2

    rng = np.random.default_rng(1)
    y, x = np.mgrid[:41, :41] - 20.0
    from scipy.special import erf

    clean = 100 + 80 * erf((x - 0.3) / 1.2) * erf((y + 0.2) / 1.2)
    places = []
    for _ in range(400):
        soft = cv2.GaussianBlur((clean + rng.normal(0, 3, clean.shape)).astype(np.float32), (9, 9), 1.0)
        at = cv2.cornerSubPix(soft, np.array([[[20.0, 20.0]]], np.float32), (6, 6), (-1, -1), (3, 60, 1e-5))
        places.append(at.ravel())
    soft = cv2.GaussianBlur(clean.astype(np.float32), (9, 9), 1.0)
    told = corner_covariance(soft, np.array([20.3, 19.8]), 6, 3.0)
    np.testing.assert_allclose(np.diag(told), np.var(places, axis=0), rtol=0.25)
    assert np.isinf(corner_covariance(np.full((41, 41), 9.0), np.array([20.0, 20.0]), 6, 3.0)).all()


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
