"""Boards before wide-angle lenses, drawn by OpenCV: found where they are, and wrong corners not."""

import cv2
import numpy as np
import pytest
from opencv_boards import charuco, imaged

from mosca.coded_targets.board_view import BoardView, fitted_view
from mosca.coded_targets.boards import FARTHEST_SHARE, find_board
from mosca.data.boards import Board

SIZE = (960, 720)
MATRIX = np.array([[560.0, 0.0, 489.0], [0.0, 560.0, 352.0], [0.0, 0.0, 1.0]])
BOARD = Board(11, 8, 0.03, 0.03, 0.021, "DICT_5X5_100")
THEIRS = charuco(11, 8, 0.03, 0.021, "DICT_5X5_100")
LENSES = {
    "wide": (MATRIX, np.array([-0.36, 0.16, 0.002, -0.001, -0.03]), False, 1.0),
    "fisheye": (np.array([[330.0, 0.0, 489.0], [0.0, 330.0, 352.0], [0.0, 0.0, 1.0]]), np.zeros(4), True, 0.8),
}
POSES = {"near": ((0.1, -0.2, 0.05), (-0.17, -0.12, 0.22)), "leaning": ((0.3, 0.7, 0.2), (-0.13, -0.13, 0.27))}


@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize("lens", LENSES)
def test_a_board_is_found_where_the_lens_bends_its_lines(lens, pose):
    matrix, bend, fisheye, nearer = LENSES[lens]
    rotation, translation = POSES[pose]
    image, true = imaged(THEIRS, rotation, nearer * np.array(translation), matrix, bend, SIZE, fisheye=fisheye)
    found = find_board(image, BOARD)
    assert found.refused == ""
    assert len(found) >= 60  # of 70
    off = np.linalg.norm(found.xy_px - true[found.corner], axis=1)
    assert np.median(off) < 0.03  # squares of the fisheye are 20 px wide, gaps beside their markers 3 px
    assert off.max() < 1.0
    # a homography alone would not do: the control
    plane = BOARD.corners()[:, :2]
    straight = fitted_view(plane, true, SIZE, bent=False)
    off = np.linalg.norm(straight.image(plane) - true, axis=1) / (0.03 * straight.narrowest(plane))
    assert off.max() > FARTHEST_SHARE
    bent = fitted_view(plane, true, SIZE, bent=True)
    off = np.linalg.norm(bent.image(plane) - true, axis=1) / (0.03 * bent.narrowest(plane))
    assert off.max() < FARTHEST_SHARE


def test_a_checkerboard_is_found_too_and_a_part_of_it_is_none():
    """The squares beyond its border are looked for where the lens has them."""
    pattern = np.indices((7, 10)).sum(axis=0) % 2 * 255
    drawn = np.kron(pattern, np.ones((60, 60))).astype(np.uint8)
    drawn = cv2.copyMakeBorder(drawn, 60, 60, 60, 60, cv2.BORDER_CONSTANT, value=255)
    camera = np.array([[500.0, 0.0, 479.5], [0.0, 500.0, 359.5], [0.0, 0.0, 1.0]])
    bend = np.array([-0.36, 0.16, 0.0, 0.0, -0.03])
    x, y = np.meshgrid(np.arange(960.0), np.arange(720.0))
    rays = cv2.undistortPoints(np.stack([x, y], -1).reshape(-1, 1, 2), camera, bend).reshape(720, 960, 2)
    # squares of 0.15 at distance 1, the board's middle on the axis
    at = (rays / 0.15 * 60 + np.array([6.0, 4.5]) * 60 - 0.5).astype(np.float32)
    image = cv2.GaussianBlur(cv2.remap(drawn, at, None, cv2.INTER_LINEAR, borderValue=90), (0, 0), 0.7)
    found = find_board(image, Board(10, 7, 0.03, 0.03))
    assert found.refused == ""
    points = np.array([(0.15 * (c - 4), 0.15 * (r - 2.5), 1.0) for r in range(6) for c in range(9)])
    true = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera, bend)[0][:, 0]
    assert np.abs(found.xy_px - true).max() < 0.1
    assert len(find_board(image, Board(9, 6, 0.03, 0.03))) == 0


def test_single_wrong_corners_are_left_out_and_a_bent_board_is_refused():
    matrix, bend, _, _ = LENSES["wide"]
    image, true = imaged(THEIRS, *POSES["near"], matrix, bend, SIZE)
    at = np.round(true[24]).astype(int)
    covered = image.copy()  # a black speck beside a corner draws it away
    covered[at[1] - 9 : at[1] - 2, at[0] - 9 : at[0] + 1] = 45
    found = find_board(covered, BOARD)
    assert len(found) >= 60
    assert np.abs(found.xy_px - true[found.corner]).max() < 0.2
    # paper rolled to a radius of four of its lengths is no plane: its two halves rise by 1 / 32 of it
    rolled = BOARD.corners().copy()
    rolled[:, 2] = rolled[:, 0] ** 2 / (2 * 0.33)
    seen = cv2.projectPoints(
        rolled * [1, -1, -1], np.array([0.3, 0.7, 0.2]), np.array([0.05, 0.0, 0.3]), matrix, bend
    )[0]
    view = fitted_view(BOARD.corners()[:, :2], seen[:, 0], SIZE, bent=True)
    plane = BOARD.corners()[:, :2]
    off = np.linalg.norm(view.image(plane) - seen[:, 0], axis=1) / (0.03 * view.narrowest(plane))
    assert np.mean(off > FARTHEST_SHARE) > 0.1


def test_the_radial_terms_are_undone():
    """With one term the radius is the root of a quadratic equation."""
    term = -0.4
    view = BoardView((801, 601), np.diag([1.0, 1.0, 1.0]), (term, 0.0), 0.9)
    half = np.hypot(801, 601) / 2
    straight = np.array([[0.0, 0.0], [0.3, 0.0], [0.3, -0.4], [0.6, 0.5]])
    u = np.linalg.norm(straight, axis=1)
    # r = u (1 + term r^2)
    r = np.r_[0.0, (1 - np.sqrt(1 - 4 * term * u[1:] ** 2)) / (2 * term * u[1:])]
    expected = straight * np.divide(r, u, out=np.ones(4), where=u > 0)[:, None] * half + [400, 300]
    np.testing.assert_allclose(view.image(straight), expected, atol=2e-3)
    # what the terms fold is nowhere
    folded = BoardView((801, 601), np.eye(3), (3.0, 0.0), 0.5)
    assert np.isnan(folded.image(np.array([[5.0, 0.0]]))).all()
