"""``mosca calibrate`` with a transparent, inverted board that OpenCV has drawn: cameras on both of its sides."""

import cv2
import numpy as np
import pytest
from command_line import mosca, refusal
from opencv_boards import charuco, imaged

from mosca.data.files.rig_file import read_rig
from mosca.data.rotations import rotation_from_vector

SIZE = (640, 480)
MATRIX = np.array([[600.0, 0.0, 322.0], [0.0, 600.0, 236.0], [0.0, 0.0, 1.0]])
BEND = np.array([-0.2, 0.05, 0.0, 0.0, 0.0])
FRAMES = 11
TARGET = """kind = "board"
columns = 7
rows = 5
square_m = 0.05
marker_m = 0.0375
dictionary = "DICT_4X4_50"
"""
AZIMUTHS = {"left": -0.4, "right": 0.35, "behind": np.pi + 0.2}  # [rad], about the vertical


def camera_from_world(name):
    """Cameras 0.75 m from the middle of the board, looking at it; OpenCV's axes, y down."""
    turn = rotation_from_vector(np.array([0.0, -AZIMUTHS[name], 0.0]))
    return turn, np.array([0.0, 0.0, 0.75])


@pytest.fixture(scope="module")
def take(tmp_path_factory):
    """JPEG sequences in folders; camera "late" sees the board twice only."""
    folder = tmp_path_factory.mktemp("boards")
    theirs = charuco(7, 5, 0.05, 0.0375, "DICT_4X4_50")
    middle = np.array([3.5, 2.5, 0.0]) * 0.05
    rng = np.random.default_rng(4)
    blank = np.full((SIZE[1], SIZE[0]), 90, np.uint8)
    for frame in range(FRAMES):
        turn = rotation_from_vector(rng.uniform(-0.5, 0.5, 3))
        shift = rng.uniform(-0.08, 0.08, 3)
        for name in (*AZIMUTHS, "late"):
            rotation, translation = camera_from_world("left" if name == "late" else name)
            pose = cv2.Rodrigues(rotation @ turn)[0][:, 0], rotation @ (shift - turn @ middle) + translation
            image = blank
            if name != "late" or frame in (3, 8):
                image, _ = imaged(theirs, *pose, MATRIX, BEND, SIZE, inverted=True)
            noisy = np.clip(image + rng.normal(0, 1.0, image.shape), 0, 255).astype(np.uint8)
            (folder / "take" / name).mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(folder / "take" / name / f"{frame}.jpg"), noisy, [cv2.IMWRITE_JPEG_QUALITY, 95])
    (folder / "front.toml").write_text(TARGET + "inverted = true\n")
    (folder / "both.toml").write_text(TARGET + "inverted = true\nfrom_behind = true\n")
    (folder / "plain.toml").write_text(TARGET)
    return folder


@pytest.mark.slow
def test_a_camera_that_saw_too_little_is_named_and_left_out_on_request(take):
    line = refusal("calibrate", "take", "--target", "both.toml", "--out", "rig.toml", cwd=take)
    assert "few-views: camera 'late': 2 views of the flat target" in line
    assert "at least 3 are wanted" in line
    assert line.endswith("or calibrate without late: --leave-out-unseen")
    assert not (take / "rig.toml").exists()
    done = mosca(
        "calibrate", "take", "--target", "both.toml", "--out", "rig.toml", "--leave-out-unseen", "--lens", "opencv",
        "--free", "fx_px,fy_px,cx_px,cy_px,k1,k2", cwd=take,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "WARNING left-out: camera 'late' is left out: few-views: camera 'late': 2 views" in done.stdout
    rig = read_rig(take / "rig.toml")
    assert rig.names == ("behind", "left", "right")
    # where the cameras are to each other, on both sides of the board
    for one, other in (("left", "right"), ("left", "behind")):
        poses = [rig.camera(name).world_from_camera for name in (one, other)]
        turn = poses[1].rotation.T @ poses[0].rotation
        (first, at_first), (second, at_second) = camera_from_world(one), camera_from_world(other)
        np.testing.assert_allclose(turn, second @ first.T, atol=2e-3)
        apart = poses[0].translation - poses[1].translation
        true = first.T @ -at_first - second.T @ -at_second
        assert np.linalg.norm(apart) == pytest.approx(np.linalg.norm(true), abs=2e-3)
    for camera in rig.cameras:
        assert camera.lens.fx_px == pytest.approx(600, abs=2)


def test_a_refusal_says_how_the_board_is_seen(take):
    line = refusal("calibrate", "take", "--target", "plain.toml", "--out", "no.toml", cwd=take)
    assert "left, right, late would see the board with inverted = true in the target file" in line
    assert "behind would see the board with inverted = true, from_behind = true in the target file" in line
    line = refusal("calibrate", "take", "--target", "front.toml", "--out", "no.toml", cwd=take)
    assert "few-views: camera 'behind': 0 views" in line
    assert "behind would see the board with from_behind = true in the target file" in line
