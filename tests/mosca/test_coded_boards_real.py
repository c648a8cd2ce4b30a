"""Boards in real images: Caliscope's webcams (BSD-2), a checkerboard held by hand and a framed ChArUco board."""

import csv
import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from mosca.coded_targets.boards import find_board
from mosca.data.boards import Board

DATA = Path(os.environ.get("MOSCA_DATA", Path(__file__).parents[3] / "shared" / "data"))
SESSIONS = DATA / "caliscope_4cam" / "sessions"
IMAGES = SESSIONS / "chessboard_intrinsic"
VIDEOS = SESSIONS / "4_cam_recording" / "calibration" / "extrinsic"
pytestmark = [
    pytest.mark.data,
    pytest.mark.skipif(not IMAGES.is_dir(), reason=f"no Caliscope session in {DATA} (set MOSCA_DATA)"),
]
CHECKERS = Board(10, 7, 0.03, 0.03)
CHARUCO = Board(4, 5, 0.054, 0.02, 0.75 * 0.054, "DICT_4X4_1000")


@pytest.mark.parametrize(
    "name", ["cam_0_frame_100", "cam_0_frame_1070", "cam_0_frame_200", "cam_0_frame_300", "cam_1_frame_1070",
             "cam_2_frame_1070"]
)  # fmt: skip
def test_a_checkerboard_held_by_hand_is_found(name):
    """All 54 corners on a plane but for the lens and the paper, where OpenCV's finder has them."""
    image = cv2.imread(str(IMAGES / f"{name}.jpg"), cv2.IMREAD_GRAYSCALE)
    found = find_board(image, CHECKERS)
    assert found.corner.tolist() == list(range(54))
    homography, _ = cv2.findHomography(CHECKERS.corners()[:, :2], found.xy_px)
    assert np.linalg.det(homography) < 0  # from the front: y up on the board, down in the image
    there = cv2.perspectiveTransform(CHECKERS.corners()[None, :, :2], homography)[0]
    assert np.sqrt(np.mean((there - found.xy_px) ** 2)) < 0.6
    _, theirs = cv2.findChessboardCornersSB(image, (9, 6))
    apart = np.linalg.norm(found.xy_px[:, None] - theirs.reshape(-1, 2), axis=2).min(axis=1)
    assert apart.max() < 1.5
    assert np.median(apart) < 0.3
    for columns, rows in ((9, 6), (8, 7), (7, 6), (6, 5), (9, 4)):  # wrong size given: refused
        assert len(find_board(image, Board(columns, rows, 0.03, 0.03))) == 0


@pytest.mark.parametrize(
    ("name", "why"), [("cam_0_frame_000", "seen as a whole"), ("cam_3_frame_1070", "from where the board would")]
)
def test_what_is_not_whole_or_not_flat_is_refused(name, why):
    """In one a hand hides the border, in the other the paper is bent."""
    image = cv2.imread(str(IMAGES / f"{name}.jpg"), cv2.IMREAD_GRAYSCALE)
    found = find_board(image, CHECKERS)
    assert len(found) == 0
    assert why in found.refused


def test_a_charuco_board_is_found_where_caliscope_found_it():
    """Corners by number; black and white are the other way round on this board."""
    with (VIDEOS / "xy.csv").open(newline="") as file:
        every = list(csv.DictReader(file))
    syncs = sorted({int(row["sync_index"]) for row in every})  # a frame of the video for each
    rows = [row for row in every if row["cam_id"] == "0"]
    theirs = {
        (int(row["sync_index"]), int(row["keypoint_id"])): (float(row["img_loc_x"]), float(row["img_loc_y"]))
        for row in rows
    }
    video = cv2.VideoCapture(str(VIDEOS / "cam_0.mp4"))
    off = []
    for k in range(12):
        read, image = video.read()
        assert read
        found = find_board(255 - cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), CHARUCO)
        for corner, xy in zip(found.corner.tolist(), found.xy_px, strict=True):
            if (syncs[k], corner) in theirs:
                off.append(np.linalg.norm(xy - theirs[syncs[k], corner]))
    assert len(off) > 80
    assert np.median(off) < 0.35
    assert np.max(off) < 1.5


def test_a_board_seen_from_behind_is_refused():
    """Camera 1 sees the other side through the frame, printed as its mirror image."""
    read, image = cv2.VideoCapture(str(VIDEOS / "cam_1.mp4")).read()
    assert read
    grey = 255 - cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    assert len(find_board(grey, CHARUCO)) == 0
    assert len(find_board(np.ascontiguousarray(grey[:, ::-1]), CHARUCO)) == 12
