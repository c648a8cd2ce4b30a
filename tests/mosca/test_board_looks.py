"""Boards that are inverted, or seen from behind, drawn by OpenCV."""

import cv2
import numpy as np
import pytest
from opencv_boards import charuco, imaged

from mosca.calibration.targets.reader import BoardReader
from mosca.coded_targets.boards import find_board, other_looks
from mosca.data.boards import Board

SIZE = (640, 480)
MATRIX = np.array([[620.0, 0.0, 319.5], [0.0, 620.0, 239.5], [0.0, 0.0, 1.0]])
THEIRS = charuco(7, 5, 0.04, 0.03, "DICT_4X4_50")
FRONT = ((0.2, -0.3, 0.1), (-0.14, -0.1, 0.42))
BEHIND = ((0.1, 2.9, 0.2), (0.12, -0.1, 0.42))  # turned by half a turn about its vertical: its mirror image


def board(**looks):
    return Board(7, 5, 0.04, 0.04, 0.03, "DICT_4X4_50", **looks)


@pytest.mark.parametrize("inverted", [False, True])
@pytest.mark.parametrize("pose", [FRONT, BEHIND], ids=["front", "behind"])
def test_a_board_is_found_as_it_looks_and_refused_otherwise(pose, inverted):
    image, true = imaged(THEIRS, *pose, MATRIX, np.zeros(5), SIZE, inverted=inverted)
    behind = pose is BEHIND
    found = find_board(image, board(inverted=inverted, from_behind=True))
    assert found.refused == ""
    assert found.corner.tolist() == list(range(24))
    assert np.abs(found.xy_px - true).max() < 0.1
    handed = cv2.findHomography(board().corners()[:, :2], found.xy_px)[0]
    assert (np.linalg.det(handed) > 0) == behind
    # the controls: another key, another board
    assert len(find_board(image, board(inverted=not inverted, from_behind=True))) == 0
    assert (len(find_board(image, board(inverted=inverted))) == 0) == behind
    wanted = {key: True for key, value in (("inverted", inverted), ("from_behind", behind)) if value}
    if wanted:
        assert other_looks(image, board()) == wanted


def test_covariances_are_mirrored_too():
    """A corner that leans has its error ellipse leaning: the same image from the front has the mirror image's."""
    image, _ = imaged(THEIRS, *BEHIND, MATRIX, np.zeros(5), SIZE)
    noisy = np.clip(image + np.random.default_rng(1).normal(0, 3, image.shape), 0, 255).astype(np.uint8)
    behind = find_board(noisy, board(from_behind=True))
    front = find_board(np.ascontiguousarray(noisy[:, ::-1]), board())
    np.testing.assert_allclose(behind.xy_px, front.xy_px * [-1, 1] + [639, 0], atol=1e-9)
    np.testing.assert_allclose(behind.covariance_px2, front.covariance_px2 * [[1, -1], [-1, 1]], rtol=1e-9)
    assert np.abs(front.covariance_px2[:, 0, 1]).max() > 0


def test_the_reader_says_how_a_board_looks_that_it_does_not_find():
    reader = BoardReader(board())
    for name, pose, inverted in (("a", FRONT, True), ("b", BEHIND, True), ("c", FRONT, False)):
        image, _ = imaged(THEIRS, *pose, MATRIX, np.zeros(5), SIZE, inverted=inverted)
        reader.read(image, name, 8)
    reader.read(np.full((480, 640), 90, np.uint8), "d", 8)
    assert reader.advice() == (
        "; a would see the board with inverted = true in the target file; b would see the board with inverted = "
        "true, from_behind = true in the target file"
    )


def test_a_checkerboard_has_no_other_side():
    with pytest.raises(ValueError, match="from_behind = true: a checkerboard's two sides look alike"):
        Board(9, 6, 0.04, 0.04, from_behind=True)
