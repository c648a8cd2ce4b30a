"""A rig from a table of a wand's image points, as EasyWand, DLTdv and Argus write it; the points are OpenCV's."""

import command_line
import cv2
import numpy as np
import pytest

from mosca.calibration.quality.compare_rigs import compare_rigs
from mosca.data.files.rig_file import read_rig
from mosca.data.files.target_file import read_wand_points_table
from mosca.data.rig import Camera, OpenCVLens, Pose, Rig
from mosca.formats.wand_points import read_wand_points

FRAMES, NOISE_PX, LENGTH_M = 100, 0.1, 0.4
VOLUME = ((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))
WAND = f'kind = "wand"\nalong_m = [0.0, {LENGTH_M}]\ndiameter_m = 1e-3\n'
LAYOUT = """[points]
y_axis = "up"
sigma_px = 0.1
size_px = [1280, 1024]
camera = [{ name = "left" }, { name = "right" }, { name = "above", size_px = [1000, 800] }]
"""
LENSES = (
    (1280, 1024, OpenCVLens(1500.0, 1500.0, 630.0, 520.0, -0.10)),
    (1280, 1024, OpenCVLens(1400.0, 1400.0, 650.0, 500.0, -0.05)),
    (1000, 800, OpenCVLens(1000.0, 1000.0, 510.0, 390.0, -0.12)),
)
PLACES = np.array([[3.0, 0.0, 1.0], [-1.5, 2.6, 1.4], [-1.2, -2.8, 0.8]])


def true_rig() -> Rig:
    """Three cameras that look at the origin."""
    cameras = []
    for name, (width, height, lens), place in zip(("left", "right", "above"), LENSES, PLACES, strict=True):
        z = -place / np.linalg.norm(place)
        x = np.cross(z, [0, 0, 1]) / np.linalg.norm(np.cross(z, [0, 0, 1]))
        cameras.append(Camera(name, width, height, lens, Pose(np.column_stack([x, np.cross(z, x), z]), place)))
    return Rig(tuple(cameras))


@pytest.fixture(scope="module")
def pixels():
    """Image points (frame, ball, camera, 2), pixel centres at whole numbers from the upper left, NaN where unseen."""
    rng = np.random.default_rng(11)
    middle, along = rng.uniform(-0.5, 0.5, (FRAMES, 3)), rng.normal(size=(FRAMES, 3))
    along *= LENGTH_M / 2 / np.linalg.norm(along, axis=1, keepdims=True)
    out = np.full((FRAMES, 2, 3, 2), np.nan)
    for ball, points in enumerate((middle - along, middle + along)):
        for k, camera in enumerate(true_rig().cameras):
            lens, rotation = camera.lens, camera.world_from_camera.rotation.T
            matrix = np.array([[lens.fx_px, 0, lens.cx_px], [0, lens.fy_px, lens.cy_px], [0, 0, 1]])
            seen, _ = cv2.projectPoints(
                points, cv2.Rodrigues(rotation)[0], -rotation @ PLACES[k], matrix, np.array([lens.k1, 0, 0, 0])
            )
            xy = seen[:, 0] + NOISE_PX * rng.normal(size=(FRAMES, 2))
            inside = ((xy > 0) & (xy < [camera.width - 1, camera.height - 1])).all(axis=1)
            there = inside & (rng.random(FRAMES) > 0.05)
            out[there, ball, k] = xy[there]
    return out


def table(pixels, y_axis="up") -> str:
    """Return the table, first pixel (1, 1), counted from the lower or the upper left."""
    xy = pixels + 1
    if y_axis == "up":
        xy = np.stack([xy[..., 0], np.array([1024, 1024, 800]) + 1 - xy[..., 1]], axis=-1)
    return "\n".join(",".join(f"{x:.4f}" for x in row) for row in xy.reshape(len(xy), -1)) + "\n"


def calibrated(folder, csv, toml):
    (folder / "wand.csv").write_text(csv)
    (folder / "wand.toml").write_text(toml)
    done = command_line.mosca(
        "calibrate", "wand.csv", "--target", "wand.toml", "--lens", "opencv", "--out", "rig.toml", cwd=folder
    )
    assert done.returncode == 0, done.stderr
    return read_rig(folder / "rig.toml"), done.stdout


def test_the_rig_that_made_the_table(pixels, tmp_path):
    found, said = calibrated(tmp_path, table(pixels), WAND + LAYOUT)
    compared = compare_rigs(true_rig(), found, VOLUME, align="rigid")
    # two rays of 0.1 px at 1,400 px and 3 m place a point to 0.3 mm; 550 such image points average
    assert compared.rms_m < 3e-4, compared.lines()
    assert "scale from the wand's length 0.4 m" in said
    # what it is for: the other direction of y fits as well, and is the mirror image of the rig
    mirrored, also = calibrated(tmp_path, table(pixels), WAND + LAYOUT.replace('"up"', '"down"'))
    sigma0 = [float(text.split("sigma0 ")[1].split(",")[0]) for text in (said, also)]
    assert sigma0[1] == pytest.approx(sigma0[0], abs=0.02)
    assert compare_rigs(true_rig(), mirrored, VOLUME, align="rigid").rms_m > 0.1


HEADER = ",".join(
    f"{point}_cam_{camera}_{axis}" for point in ("Track 1", "Track 2") for camera in "123" for axis in "xy"
)


@pytest.mark.parametrize("y_axis", ["up", "down"])
@pytest.mark.parametrize("header", ["", HEADER + "\n", HEADER.replace("Track ", "pt").replace("cam_", "cam") + "\n"])
def test_points_are_read_as_they_were_imaged(pixels, tmp_path, y_axis, header):
    (tmp_path / "a.csv").write_text(header + table(pixels, y_axis).replace("nan", "NaN", 50).replace("nan", "", 50))
    (tmp_path / "a.toml").write_text(WAND + LAYOUT.replace('"up"', f'"{y_axis}"'))
    seen = read_wand_points(tmp_path / "a.csv", read_wand_points_table(tmp_path / "a.toml"), 2)
    assert seen.cameras == ("left", "right", "above")
    assert seen.sizes.tolist() == [[1280, 1024], [1280, 1024], [1000, 800]]
    assert seen.frames == FRAMES
    assert len(seen) == np.isfinite(pixels).all(axis=3).sum()
    np.testing.assert_allclose(seen.xy_px, pixels[seen.frame, seen.mark, seen.camera], atol=6e-5)


GOOD = "1,2,3,4,5,6,7,8\n"


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        ("", "no image points"),
        (
            "pt1_cam1_X,pt1_cam1_Y,pt1_cam2_X,pt1_cam2_Y,pt2_cam1_X,pt2_cam1_Y,pt2_cam2_X,pt2_cam2_Y\n",
            "no image points",
        ),
        ("1,2,3,4,5,6\n", "6 columns given; a multiple of 4 is wanted: x and y of 2 balls are 4 a camera"),
        ("1,2,3,4\n", "4 columns given"),
        (GOOD + "1,2,3\n", "row 2: 3 values given, 8 wanted as in the first row"),
        (GOOD + "1,2,x,4,5,6,7,8\n", "row 2, column 3: 'x' given; a number, NaN or nothing is wanted"),
        (GOOD + "1,2,3,NaN,5,6,7,8\n", "row 2, columns 3 and 4: one of x and y is given"),
        (GOOD + "1,2,3,4,5,6,700,8\n", "row 2, columns 7 and 8: (700, 8) lies outside the image of 640 x 480 px"),
        (GOOD + "1,2,3,4,5,6,inf,8\n", "row 2, columns 7 and 8: (inf, 8) lies outside"),
        (
            "pt1_cam1_X,pt1_cam1_Y,pt2_cam1_X,pt2_cam1_Y,pt1_cam2_X,pt1_cam2_Y,pt2_cam2_X,pt2_cam2_Y\n" + GOOD,
            "row 1, column 3: 'pt2_cam1_X' given; 'pt1_cam2_X' is wanted",
        ),
    ],
)
def test_what_a_table_lacks_is_named(tmp_path, rows, said):
    (tmp_path / "a.csv").write_text(rows)
    (tmp_path / "a.toml").write_text(WAND + '[points]\ny_axis = "up"\nsize_px = [640, 480]\n')
    line = command_line.refusal("calibrate", "a.csv", "--target", "a.toml", "--out", "rig.toml", cwd=tmp_path)
    assert line.startswith("mosca: a.csv")
    assert said in line


@pytest.mark.parametrize(
    ("layout", "options", "said"),
    [
        ("", (), "no table [points]; for a table of image points it states size_px = [width, height] and y_axis"),
        ("[points]\nsize_px = [640, 480]\n", (), "points.y_axis"),
        ('[points]\ny_axis = "up"\n', (), "no 'size_px'"),
        ('[points]\ny_axis = "left"\nsize_px = [640, 480]\n', (), "'left'"),
        ('[points]\ny_axis = "up"\nsize_px = [640, 480]\n', ("--every", 2), "--every: not with a table"),
        (
            '[points]\ny_axis = "up"\nsize_px = [640, 480]\ncamera = [{name = "a"}, {name = "a"}]\n',
            (),
            "camera name 'a' stands twice",
        ),
        (
            '[points]\ny_axis = "up"\nsize_px = [640, 480]\ncamera = [{name = "a"}, {name = "b"}, {name = "c"}]\n',
            (),
            "8 columns given; of 3 cameras 12 are wanted",
        ),
    ],
)
def test_what_a_wand_s_file_must_say_of_a_table(tmp_path, layout, options, said):
    (tmp_path / "a.csv").write_text(GOOD)
    (tmp_path / "a.toml").write_text(WAND + layout)
    given = ("calibrate", "a.csv", "--target", "a.toml", "--out", "rig.toml", *options)
    assert said in command_line.refusal(*given, cwd=tmp_path)
    (tmp_path / "b.toml").write_text('kind = "board"\ncolumns = 9\nrows = 6\nsquare_m = 0.04\n')
    given = ("calibrate", "a.csv", "--target", "b.toml", "--out", "rig.toml")
    assert 'calibrates with kind = "wand"; b.toml describes a Board' in command_line.refusal(*given, cwd=tmp_path)
