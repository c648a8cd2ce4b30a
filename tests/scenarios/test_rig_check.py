"""``mosca rig check`` on rigs that cannot be right."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import mosca
from scipy.spatial.transform import Rotation

from mosca.data.files.rig_file import read_rig, write_rig
from mosca.data.rig import Camera, OpenCVLens, Pose, Rig

DATA = Path(os.environ.get("MOSCA_DATA", Path(__file__).parents[3] / "shared" / "data"))
LENS = OpenCVLens(800.0, 800.0, 319.5, 239.5)


def looking(name, at, toward):
    """A camera at ``at`` that looks towards a point, y down."""
    z = np.subtract(toward, at) / np.linalg.norm(np.subtract(toward, at))
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    return Camera(name, 640, 480, LENS, Pose(np.column_stack([x, np.cross(z, x), z]), np.array(at, float)))


GOOD = (looking("a", (2, 0, 1), (0, 0, 0)), looking("b", (0, 2, 1), (0, 0, 0)), looking("c", (-2, 0, 1), (0, 0, 0)))


def warnings(tmp_path, cameras):
    write_rig(Rig(tuple(cameras)), tmp_path / "rig.toml")
    done = mosca("rig", "check", "rig.toml", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    return [line for line in done.stdout.splitlines() if line.startswith("WARNING")]


def moved(camera, shift=(0.0, 0.0, 0.0), turn=(0.0, 0.0, 0.0), scale=1.0):
    pose = camera.world_from_camera
    rotation = Rotation.from_euler("xyz", turn, degrees=True).as_matrix() @ pose.rotation
    return replace(camera, world_from_camera=Pose(rotation, scale * pose.translation + shift))


def test_a_good_rig_has_no_warnings(tmp_path):
    assert warnings(tmp_path, GOOD) == []
    # cameras of one lens, and two bodies side by side, are no fault
    assert warnings(tmp_path, (*GOOD, moved(replace(GOOD[0], name="d"), shift=(0.0, 0.05, 0.0)))) == []


def test_cameras_at_one_place_are_told(tmp_path):
    (line,) = warnings(tmp_path, (*GOOD, replace(GOOD[0], name="d")))
    assert "cameras 'a' and 'd' have the same pose and the same lens" in line
    (line,) = warnings(tmp_path, (*GOOD, moved(replace(GOOD[0], name="d"), turn=(0, 0, 3))))
    assert "cameras 'a' and 'd' have the same position and the same lens" in line
    other = replace(GOOD[0], name="d", lens=replace(LENS, fx_px=801.0))
    (line,) = warnings(tmp_path, (*GOOD, other))
    assert "cameras 'a' and 'd' have the same pose, so that" in line


def test_positions_in_millimetres_are_told(tmp_path):
    (line,) = warnings(tmp_path, [moved(camera, scale=100.0) for camera in GOOD])
    assert "half of the cameras are more than 283 m apart; if these are millimetres" in line
    assert warnings(tmp_path, [moved(camera, scale=10.0) for camera in GOOD]) == []  # a hall of 40 m


def test_cameras_that_see_nothing_in_common_are_told(tmp_path):
    away = looking("away", (0.0, -2.0, 1.0), (0.0, -9.0, 3.0))
    (line,) = warnings(tmp_path, (*GOOD, away))
    assert "the fields of view of a, b, c | away have nothing in common" in line
    # two pairs that look away from each other
    pair = (looking("d", (10, 8, 1), (20, 20, 1)), looking("e", (8, 10, 1), (20, 20, 1)))
    (line,) = warnings(tmp_path, (*GOOD[:2], *pair))
    assert "of a, b | d, e have nothing in common" in line


@pytest.mark.data
@pytest.mark.skipif(not (DATA / "sleap_anipose").is_dir(), reason="needs sleap_anipose of MOSCA_DATA")
def test_the_rig_that_sleap_anipose_ships(tmp_path):
    """In millimetres, and its cameras "side" and "top" are one; as metres the second remains."""
    shipped = DATA / "sleap_anipose" / "calibration.toml"
    done = mosca("rig", "check", shipped, cwd=tmp_path)
    assert "cameras 'side' and 'top' have the same pose and the same lens" in done.stdout
    assert "if these are millimetres" in done.stdout
    assert mosca("rig", "convert", "--unit", "mm", shipped, "rig.toml", cwd=tmp_path).returncode == 0
    at = read_rig(tmp_path / "rig.toml").camera("back").world_from_camera.translation
    np.testing.assert_allclose(1000 * at, read_rig(shipped).camera("back").world_from_camera.translation)
    done = mosca("rig", "check", "rig.toml", cwd=tmp_path)
    assert done.stdout.count("WARNING") == 1
    assert "nan" not in done.stdout
