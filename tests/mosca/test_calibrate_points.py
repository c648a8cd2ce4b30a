"""Target files and the calibration from measured points: reading, and error messages."""

import contextlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mosca.calibration.single_camera.adjust import AdjustmentSettings
from mosca.calibration.single_camera.from_points import calibrate_from_points, summary
from mosca.data.files.target_file import MeasuredPoints, read_measured_points, read_target_file
from mosca.errors import CalibrationError, InputError

TARGET = """
kind = "points"
unit = "mm"
lens = "opencv"
size_px = [1280, 1024]

[[camera]]
name = "left"
file = "points/left.txt"

[[camera]]
name = "right"
file = "points/right.txt"
lens = "mosca"
pixel_pitch_mm = 0.005
"""
K = np.array([[2000.0, 0.0, 650.0], [0.0, 2010.0, 520.0], [0.0, 0.0, 1.0]])


def write_recording(folder: Path, noise_px: float = 0.1) -> dict[str, np.ndarray]:
    """Two cameras 2 m before a stepped target, one at each side; returns their positions [m]."""
    axis = np.linspace(-300.0, 300.0, 7)
    x, y = np.meshgrid(axis, axis)
    points = np.column_stack([x.ravel(), y.ravel(), 60.0 * (np.arange(x.size) % 4)])
    rng = np.random.default_rng(3)
    (folder / "points").mkdir(exist_ok=True)
    places = {}
    for name, angle in (("left", 0.3), ("right", -0.3)):
        turn = np.array([np.pi, 0.0, 0.0])
        rotation = cv2.Rodrigues(np.array([0.0, angle, 0.0]))[0] @ cv2.Rodrigues(turn)[0]
        place = rotation.T @ np.array([0.0, 0.0, -2000.0])
        xy = cv2.projectPoints(points, cv2.Rodrigues(rotation)[0], -rotation @ place, K, None)[0].reshape(-1, 2)
        xy += rng.normal(0, noise_px, xy.shape)
        rows = [" ".join(f"{v:.6f}" for v in row) for row in np.column_stack([xy, points])]
        (folder / "points" / f"{name}.txt").write_text("# u v X Y Z\n" + "\n".join(rows) + "\n")
        places[name] = place / 1000
    return places


def target_of(folder: Path, text: str = TARGET):
    (folder / "target.toml").write_text(text)
    return read_target_file(folder / "target.toml")


def test_two_cameras_from_files(tmp_path):
    places = write_recording(tmp_path)
    rig, adjustments = calibrate_from_points(tmp_path, target_of(tmp_path))
    assert rig.names == ("left", "right")
    assert [c.lens.model for c in rig.cameras] == ["opencv", "mosca"]
    assert rig.camera("right").lens.mx_mm_per_px == 0.005
    for adjustment in adjustments:
        error = adjustment.camera.world_from_camera.translation - places[adjustment.camera.name]
        sigma = np.sqrt(np.diag(adjustment.covariance)[3:6])
        assert np.all(np.abs(error) < 4 * sigma)
        assert adjustment.sigma0_px == pytest.approx(0.1, rel=0.25)
        # 2 m / 2000 px: 0.1 px is 0.1 mm on the target
        assert adjustment.sigma_x_m == pytest.approx(1e-4, rel=0.35)
    text = summary(adjustments)
    assert "left: opencv lens, 1280 x 1024 px, 49 of 49 points used" in text
    assert "mx_mm_per_px" in text
    assert "held" in text
    assert f"sigma0 {adjustments[0].sigma0_px:.3f} px" in text


def test_the_summary_names_a_blunder_by_its_place_in_the_file(tmp_path):
    write_recording(tmp_path)
    path = tmp_path / "points" / "left.txt"
    lines = path.read_text().splitlines()
    row = [float(v) for v in lines[17].split()]
    row[0] += 12.0
    lines[17] = " ".join(map(str, row))
    path.write_text("\n".join(lines))
    _, adjustments = calibrate_from_points(tmp_path, target_of(tmp_path))
    # line 18 of the file is its 17th point
    assert list(adjustments[0].rejected) == [16]
    assert "rejected as blunders, counted from 1: 17 (12." in summary(adjustments)


def test_columns_units_and_pixel_origin(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("7; 10.5; -3, 250\t20.5 1e2\n\n1 2 3 4 5 6 # a remark\n")
    target = target_of(
        tmp_path, TARGET.replace('"mm"', '"mm"\ncolumns = ["-", "X", "Y", "Z", "u", "v"]\npixel_origin = "corner"')
    )
    points = read_measured_points(path, target)
    np.testing.assert_allclose(points.xy_px, [[20.0, 99.5], [4.5, 5.5]])
    np.testing.assert_allclose(points.xyz, [[0.0105, -0.003, 0.25], [0.002, 0.003, 0.004]])
    one = target.model_copy(update={"pixel_origin": "one", "unit": "m"})
    np.testing.assert_allclose(read_measured_points(path, one).xy_px[1], [4, 5])
    np.testing.assert_allclose(read_measured_points(path, one).xyz[1], [2, 3, 4])
    assert not points.xyz.flags.writeable


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('kind = "points"', 'kind = "dots"', "kind = 'dots' given; allowed: 'points'"),
        ('kind = "points"', "", "no 'kind' given"),
        ('unit = "mm"', 'unit = "inch"', "key 'unit': 'inch' given"),
        ('unit = "mm"', "", "key 'unit' is missing"),
        ('unit = "mm"', 'unit = "mm"\ncolumns = ["u", "v", "X", "Y"]', "each of u, v, X, Y, Z must stand in it once"),
        ('lens = "opencv"', 'lense = "opencv"', "unknown key 'lense'; did you mean 'lens'?"),
        ("size_px = [1280, 1024]", "", "camera 'left' has no 'size_px'"),
        ("size_px = [1280, 1024]", "size_px = [1280, 0]", "size_px[1]"),
        ('name = "right"', 'name = "left"', "camera name 'left' stands twice"),
    ],
)
def test_a_wrong_target_file_is_explained(tmp_path, old, new, said):
    with pytest.raises(InputError) as error:
        target_of(tmp_path, TARGET.replace(old, new, 1))
    assert str(tmp_path / "target.toml") in str(error.value)
    assert said in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("1 2 3 4\n", "line 1: 4 values given, 5 wanted (u v X Y Z)"),
        ("1 2 3 4 5\n# x\n1 2 three 4 5\n", "line 3: X = 'three' given; a finite number is wanted"),
        ("1 2 3 4 nan\n", "line 1: Z = 'nan' given"),
        ("# nothing\n", "no measured points"),
    ],
)
def test_a_wrong_line_is_named(tmp_path, content, said):
    (tmp_path / "p.txt").write_text(content)
    with pytest.raises(InputError) as error:
        read_measured_points(tmp_path / "p.txt", target_of(tmp_path))
    assert said in str(error.value)
    assert "p.txt" in str(error.value)


def test_the_lens_that_is_asked_for_goes_before_the_file_s(tmp_path):
    write_recording(tmp_path)
    free = AdjustmentSettings(parameters=("fx_px", "fy_px"))
    rig, adjustments = calibrate_from_points(tmp_path, target_of(tmp_path), free, "opencv")
    assert [c.lens.model for c in rig.cameras] == ["opencv", "opencv"]
    assert all(one.parameters[6:] == ("fx_px", "fy_px") for one in adjustments)
    with pytest.raises(InputError, match="lens parameter 'fx_px' cannot be estimated; allowed: c_mm"):
        calibrate_from_points(tmp_path, target_of(tmp_path), free)


def test_what_a_recording_lacks_is_named(tmp_path):
    target = target_of(tmp_path)
    with pytest.raises(InputError, match=r"left\.txt: no such file"):
        calibrate_from_points(tmp_path, target)
    with pytest.raises(InputError, match="no such folder"):
        calibrate_from_points(tmp_path / "none", target)
    write_recording(tmp_path)
    small = target.model_copy(update={"size_px": (640, 512)})
    with pytest.raises(InputError, match=r"points lie outside the image of 640 x 512 px"):
        calibrate_from_points(tmp_path, small)
    swapped = target.model_copy(update={"columns": ("v", "u", "X", "Y", "Z"), "size_px": (1280, 1280)})
    with pytest.raises(CalibrationError, match="mirrored"):
        calibrate_from_points(tmp_path, swapped)


@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)
@given(content=st.binary(max_size=200) | st.text("0123456789.- e\n,;#\t", max_size=200).map(str.encode))
def test_any_bytes_are_read_or_refused(tmp_path, content):
    target = target_of(tmp_path)
    (tmp_path / "any").write_bytes(content)
    with contextlib.suppress(InputError):
        assert isinstance(read_measured_points(tmp_path / "any", target), MeasuredPoints)
    (tmp_path / "any.toml").write_bytes(content)
    with pytest.raises(InputError):
        read_target_file(tmp_path / "any.toml")
