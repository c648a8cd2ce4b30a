"""The rig file, and the calibrations of aniposelib, Caliscope and Pose2Sim."""

import os
import tomllib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mosca.camera.projection import project
from mosca.data.files.rig_file import read_rig, read_rig_file, rig_schema, write_rig
from mosca.data.rig import Camera, FisheyeLens, MoscaLens, OpenCVLens, Pose, Rig
from mosca.data.rotations import (
    nearest_rotation,
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_from_vector,
)
from mosca.errors import InputError

DATA = Path(os.environ.get("MOSCA_DATA", Path(__file__).parents[3] / "shared" / "data"))

GOOD = """
[[camera]]
name = "left"
size = [1280, 1024]
[camera.lens]
model = "opencv"
fx_px = 1400.0
fy_px = 1401.0
cx_px = 640.0
cy_px = 511.5
k1 = -0.1
[camera.pose]
position_m = [2.0, -1.5, 2.2]
rotation_wxyz = [0.5, -0.5, 0.5, -0.5]
[camera.hardware]
driver = "emulated"
serial = "0815"

[[camera]]
name = "right"
size = [1280, 1024]
[camera.lens]
model = "mosca"
c_mm = 8.0
xp_px = 640.0
yp_px = 511.5
mx_mm_per_px = 0.005
my_mm_per_px = 0.005
K1_per_mm2 = 1e-4
[camera.pose]
position_m = [-2, 1, 2]
rotation_wxyz = [1.0, 0.0, 0.0, 0.0]
"""
UNIT = st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 0.1)
FINITE = st.floats(-1e3, 1e3)


def rig_of(tmp_path: Path, text: str) -> Rig:
    path = tmp_path / "rig.toml"
    path.write_text(text, encoding="utf-8")
    return read_rig(path)


def what_it_says(path: Path) -> str:
    """Read a rig; return the error's text, or nothing. Any other exception goes through."""
    try:
        read_rig(path)
    except InputError as error:
        return str(error)
    return ""


def test_reading_by_hand(tmp_path: Path) -> None:
    rig = rig_of(tmp_path, GOOD)
    left, right = rig.cameras
    assert rig.names == ("left", "right")
    assert (left.width, left.height) == (1280, 1024)
    assert left.lens == OpenCVLens(1400.0, 1401.0, 640.0, 511.5, k1=-0.1)
    assert right.lens == MoscaLens(8.0, 640.0, 511.5, 0.005, 0.005, K1_per_mm2=1e-4)
    # (0.5, -0.5, 0.5, -0.5) is the camera with its axis along the world's +x, its x to -y, its y down.
    np.testing.assert_allclose(left.world_from_camera.rotation, [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], atol=1e-15)
    np.testing.assert_array_equal(left.world_from_camera.translation, [2.0, -1.5, 2.2])
    np.testing.assert_array_equal(right.world_from_camera.rotation, np.eye(3))


def test_errors_of_the_cameras_read_back(tmp_path: Path) -> None:
    path = tmp_path / "again.toml"
    path.write_text(GOOD)
    rig = read_rig(path)
    stated = Rig((replace(rig.cameras[0], residual_px=0.02, shake_px=0.03), rig.cameras[1]))
    write_rig(stated, path)
    first, second = tomllib.loads(path.read_text())["camera"]
    assert (first["residual_px"], first["shake_px"]) == (0.02, 0.03)
    assert not {"residual_px", "shake_px"} & set(second)
    assert [(one.residual_px, one.shake_px) for one in read_rig(path).cameras] == [(0.02, 0.03), (0.0, 0.0)]


def test_hardware_tables_and_uncalibrated_cameras(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(GOOD + '\n[hardware]\ntrigger = "box"\n', encoding="utf-8")
    document = read_rig_file(path)
    assert document.camera[0].hardware == {"driver": "emulated", "serial": "0815"}
    assert document.camera[1].hardware == {}
    assert document.hardware == {"trigger": "box"}
    path.write_text('[[camera]]\nname = "a"\nsize = [64, 48]\n', encoding="utf-8")
    assert read_rig_file(path).camera[0].lens is None
    with pytest.raises(InputError, match=r"camera 'a' has no \[camera.lens\]; calibrate it"):
        read_rig(path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[2.0, -1.5, 2.2]", "[2000.0, -1500.0, 2200.0]", "position_m.*metres are wanted.*divide by 1000"),
        ("[0.5, -0.5, 0.5, -0.5]", "[0.5, -0.5, 0.5, -0.6]", "rotation_wxyz.*unit quaternion.*norm is 1.05"),
        ("cx_px = 640.0", "cx_px = 3.2", None),
        ("cx_px = 640.0", "cx_px = 6400.0", "camera 'left': lens.cx_px = 6400 is far outside.*1280x1024"),
        ("yp_px = 511.5", "yp_px = -5115.0", "camera 'right': lens.yp_px = -5115 is far outside"),
        ("fx_px = 1400.0", "fx_px = -1400.0", "fx_px.*-1400.0 given.*greater than 0"),
        ("fx_px = 1400.0", "fx_px = nan", "fx_px.*finite"),
        ("fx_px = 1400.0", "fxpx = 1400.0", "fx"),
        ('"opencv"', '"opencw"', "opencw.*'mosca', 'opencv', 'fisheye'"),
        ("size = [1280, 1024]", "size = [1280]", "size"),
        ("size = [1280, 1024]", "size = [0, 1024]", "greater than 0"),
        ('name = "right"', 'name = "left"', "'left' stands twice"),
        ('name = "right"', 'name = "a/b"', "name"),
        ('[[camera]]\nname = "right"', '[camera]\nname = "right"', "not valid TOML"),
        ("k1 = -0.1", "k9 = -0.1", "unknown key.*k9.* Allowed here: .*k1, k2"),
        ("k1 = -0.1", "s4 = nan", "s4.*finite"),
        ("k1 = -0.1", "tauX = -1.6", "tauX.*-1.6 given.*-1.5"),
        ("k1 = -0.1", "taux = 0.1", "unknown key.*taux.*tauX"),
    ],
)
def test_faults_are_said_in_one_line(tmp_path: Path, old: str, new: str, message: str | None) -> None:
    text = GOOD.replace(old, new)
    assert text != GOOD
    if message is None:
        rig_of(tmp_path, text)
        return
    with pytest.raises(InputError, match=message) as caught:
        rig_of(tmp_path, text)
    assert "rig.toml" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_and_empty_files(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        read_rig(tmp_path / "none.toml")
    with pytest.raises(InputError, match="key 'camera' is missing"):
        rig_of(tmp_path, "")


@settings(max_examples=60, deadline=None)
@given(q=UNIT, position=st.tuples(FINITE, FINITE, FINITE), k=st.floats(-1, 1), kind=st.sampled_from("mof"))
def test_written_rigs_read_back_lens_and_position_to_the_last_bit(
    tmp_path_factory: pytest.TempPathFactory, q: list[float], position: tuple, k: float, kind: str
) -> None:
    lens = {
        "m": MoscaLens(8.0 + k, 300.0 + k, 200.0 - k, 0.0074, 0.0074 * (1 + k / 100), k, k, k, k, k, k),
        "o": OpenCVLens(900.0 + k, 901.0, 300.0, 200.0, *(k / j for j in range(1, 15))),
        "f": FisheyeLens(900.0 + k, 901.0, 300.0, 200.0, k, k, k, k),
    }[kind]
    rig = Rig((Camera("c 1", 640, 480, lens, Pose(rotation_from_quaternion(q), np.array(position))),))
    path = tmp_path_factory.mktemp("rig") / "rig.toml"
    write_rig(rig, path, hardware={"c 1": {"serial": "1"}})
    again = read_rig(path).cameras[0]
    assert again.lens == lens
    np.testing.assert_array_equal(again.world_from_camera.translation, position)
    # the file holds a quaternion: an element is four products of its normalised parts, each right to 2 epsilon
    np.testing.assert_allclose(
        again.world_from_camera.rotation,
        rig.cameras[0].world_from_camera.rotation,
        rtol=0,
        atol=8 * np.finfo(float).eps,
    )
    assert read_rig_file(path).camera[0].hardware == {"serial": "1"}
    assert [p.name for p in path.parent.iterdir()] == ["rig.toml"]


@settings(max_examples=100, deadline=None)
@given(q=UNIT)
def test_rotations_agree_with_scipy_and_opencv(q: list[float]) -> None:
    expected = Rotation.from_quat(np.array(q), scalar_first=True)
    matrix = rotation_from_quaternion(q)
    np.testing.assert_allclose(matrix, expected.as_matrix(), atol=1e-14)
    back = quaternion_from_rotation(matrix)
    np.testing.assert_allclose(Rotation.from_quat(back, scalar_first=True).as_matrix(), matrix, atol=1e-14)
    assert back[0] >= 0
    vector = expected.as_rotvec()
    np.testing.assert_allclose(rotation_from_vector(vector), cv2.Rodrigues(vector)[0], atol=1e-13)
    np.testing.assert_allclose(nearest_rotation(1.01 * matrix)[0], matrix, atol=1e-13)


def test_rotation_by_nothing() -> None:
    np.testing.assert_array_equal(rotation_from_vector([0.0, 0.0, 0.0]), np.eye(3))


@settings(max_examples=150, deadline=None)
@given(data=st.binary(max_size=400))
def test_any_bytes_give_a_rig_or_an_input_error(tmp_path_factory: pytest.TempPathFactory, data: bytes) -> None:
    path = tmp_path_factory.mktemp("rig") / "rig.toml"
    path.write_bytes(data)
    with pytest.raises(InputError):
        read_rig(path)


@settings(max_examples=100, deadline=None)
@given(
    name=st.sampled_from(["s1", "s2", "s3", "s4", "tauX", "tauY"]),
    value=st.one_of(st.floats(), st.integers(), st.booleans(), st.text(max_size=4).map(repr), st.just("[0.1]")),
)
def test_any_prism_or_tilt_gives_a_rig_or_an_input_error(
    tmp_path_factory: pytest.TempPathFactory, name: str, value: object
) -> None:
    path = tmp_path_factory.mktemp("rig") / "rig.toml"
    said = str(value).lower() if isinstance(value, bool) else str(value)
    path.write_text(GOOD.replace("k1 = -0.1", f"{name} = {said}"), encoding="utf-8", newline="")
    error = what_it_says(path)
    assert "\n" not in error
    if not error:
        lens = read_rig(path).cameras[0].lens
        assert np.isfinite(getattr(lens, name))
        assert name.startswith("s") or abs(getattr(lens, name)) <= 1.5


def test_schema_is_one_that_editors_take() -> None:
    schema = rig_schema()
    assert schema["required"] == ["camera"]
    assert set(schema["$defs"]) >= {"CameraTable", "MoscaLensTable", "OpenCVLensTable", "FisheyeLensTable"}
    assert (
        schema["$defs"]["CameraTable"]["properties"]["lens"]["anyOf"][0]["discriminator"]["propertyName"] == "model"
    )


ANIPOSE = """
[cam_0]
name = "A"
size = [640, 480]
matrix = [[500.0, 0.0, 320.0], [0.0, 510.0, 240.0], [0.0, 0.0, 1.0]]
distortions = [-0.2, 0.1, 0.001, -0.002, 0.03]
rotation = [0.3, -0.2, 1.1]
translation = [0.1, 0.2, 3.0]

[cam_1]
name = "B"
size = [640, 480]
fisheye = true
matrix = [[300.0, 0.0, 320.0], [0.0, 300.0, 240.0], [0.0, 0.0, 1.0]]
distortions = [0.01, 0.02, 0.0, 0.0]
rotation = [0.0, 0.0, 0.0]
translation = [0.0, 0.0, 1.0]

[metadata]
adjusted = false
error = 0.0
"""


@pytest.mark.parametrize("count", [5, 12, 14])
def test_aniposelib_projects_as_opencv_says(tmp_path: Path, count: int) -> None:
    given = [-0.2, 0.1, 0.001, -0.002, 0.03, 0.02, 0.01, 0.003, 0.004, -0.003, 0.002, 0.001, 0.02, -0.03]
    rig = rig_of(tmp_path, ANIPOSE.replace(str(given[:5]), str(given[:count])))
    points = np.random.default_rng(1).uniform(-0.5, 0.5, (20, 3))
    expected, _ = cv2.projectPoints(
        points, np.array([0.3, -0.2, 1.1]), np.array([0.1, 0.2, 3.0]),
        np.array([[500.0, 0, 320], [0, 510, 240], [0, 0, 1]]), np.array(given[:count]),
    )  # fmt: skip
    np.testing.assert_allclose(project(rig.cameras[0], points), expected[:, 0], atol=1e-9)
    assert rig.names == ("A", "B")
    assert rig.cameras[1].lens == FisheyeLens(300.0, 300.0, 320.0, 240.0, 0.01, 0.02)
    np.testing.assert_allclose(rig.cameras[1].world_from_camera.translation, [0, 0, -1], atol=1e-15)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[0.1, 0.2, 3.0]", "[100.0, 200.0, 3000.0]", r"\[cam_0\].*metres are wanted.*divide by 1000"),
        ("[-0.2, 0.1, 0.001, -0.002, 0.03]", "[1.0]", "1 distortions given; 4, 5, 8, 12 or 14"),
        (
            "[-0.2, 0.1, 0.001, -0.002, 0.03]",
            str([0.0] * 12 + [0.1, 2.0]),
            "tauX, tauY = 0.1, 2 given.*rad, at most 1.5",
        ),
        ("distortions = [0.01, 0.02, 0.0, 0.0]", "distortions = [0.0]", "a fisheye has 4"),
        ("[[500.0, 0.0, 320.0]", "[[500.0, 3.0, 320.0]", "skew 3"),
        ("size = [640, 480]\nmatrix", "matrix", r"\[cam_0\]: key 'size' is missing"),
        ("rotation = [0.3, -0.2, 1.1]", "rotation = [[1.0,0.0,0.0],[0.0,2.0,0.0],[0.0,0.0,1.0]]", "rotation is"),
        ("320.0], [0.0, 510", "-3200.0], [0.0, 510", "cx_px = -3200 is far outside"),
    ],
)
def test_faults_of_foreign_calibrations(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in ANIPOSE
    with pytest.raises(InputError, match=message) as caught:
        rig_of(tmp_path, ANIPOSE.replace(old, new, 1))
    assert "\n" not in str(caught.value)


@settings(max_examples=250, deadline=None)
@given(
    original=st.sampled_from([GOOD, ANIPOSE]),
    at=st.floats(0, 0.999),
    length=st.integers(0, 12),
    text=st.text(max_size=6),
)
def test_any_edit_gives_a_rig_or_an_input_error(
    tmp_path_factory: pytest.TempPathFactory, original: str, at: float, length: int, text: str
) -> None:
    path, place = tmp_path_factory.mktemp("rig") / "rig.toml", int(at * len(original))
    path.write_text(original[:place] + text + original[place + length :], encoding="utf-8", newline="")
    assert "\n" not in what_it_says(path)


@pytest.mark.data
@pytest.mark.skipif(not (DATA / "caliscope_4cam").is_dir(), reason="needs caliscope_4cam of MOSCA_DATA")
def test_real_caliscope_files() -> None:
    files = sorted((DATA / "caliscope_4cam").rglob("camera_array.toml"))
    assert len(files) >= 5
    for path in files:
        tables = {
            f"cam_{t['cam_id']}": t
            for t in tomllib.loads(path.read_text(encoding="utf-8"))["cameras"].values()
            if not t.get("ignore")
        }
        rig = read_rig(path)
        assert set(rig.names) == set(tables)
        for camera in rig.cameras:
            table = tables[camera.name]
            given = np.array(table["rotation"])
            rotation = given if given.ndim == 2 else cv2.Rodrigues(given)[0]
            # The camera's centre in the world is where R x + t = 0.
            centre = np.linalg.solve(rotation, -np.array(table["translation"]))
            np.testing.assert_allclose(camera.world_from_camera.translation, centre, atol=1e-6)
            np.testing.assert_allclose(camera.world_from_camera.rotation, rotation.T, atol=1e-6)
            assert isinstance(camera.lens, OpenCVLens)
            lens = camera.lens
            assert [lens.k1, lens.k2, lens.p1, lens.p2, lens.k3] == table["distortions"]
            assert [camera.width, camera.height] == table["size"]
