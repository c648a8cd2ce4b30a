"""What Python alone takes for a number is none in a file: one damaged byte would make 15 of 1.5."""

import numpy as np
import pytest
import tomli_w

from mosca.data.files.decimals import integers, real, reals
from mosca.data.files.rig_file import read_rig
from mosca.data.files.target_file import read_target_file
from mosca.data.motion.bvh import read_bvh
from mosca.data.motion.joint_csv import read_points_csv
from mosca.errors import InputError
from mosca.formats.rigs.rig_formats import RigFileOptions, read_any_rig
from mosca.formats.tracks.tracks_csv import COLUMNS, read_tracks_csv
from mosca.formats.tracks.trc import read_trc
from mosca.recording.stamps import read_stamps
from twin.scenes.user_markers import read_marker_table

TRC = "PathFileType\t4\t(X/Y/Z)\ta\nDataRate\tNumFrames\tNumMarkers\tUnits\n50\t2\t1\tmm\nFrame#\tTime\tA\n\n"
BVH = (
    "HIERARCHY\nROOT a\n{\nOFFSET 0 0 0\nCHANNELS 3 Zrotation Xrotation Yrotation\n}\n"
    "MOTION\nFrames: 1\nFrame Time: 0.01\n1 2 3\n"
)
ORI = "0 0 9\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n0 0\n70\n"


@pytest.mark.parametrize("text", ["1_5", "١", "１.5", "1.5_", "+_1", ""])
def test_what_is_no_number(text):
    for read in (real, lambda one: reals(["1", one]), lambda one: integers(["1", one])):
        with pytest.raises(ValueError, match=r"."):
            read(text)


def test_what_is_one():
    assert reals(["1.5", "-2e3", " 7 ", "inf"]) == [1.5, -2000.0, 7.0, np.inf]
    assert np.isnan(real("nan"))
    assert integers(["12", "-3"]) == [12, -3]


@pytest.mark.parametrize("number", ["1_5", "١"])
@pytest.mark.parametrize(
    ("name", "text", "read"),
    [
        ("t.csv", ",".join(COLUMNS) + "\n0,0,0,a,NUMBER,0,0" + "," * 7 + "2,,measured\n", read_tracks_csv),
        ("t.csv", ",".join(COLUMNS) + "\nNUMBER,0,0,a,1,0,0" + "," * 7 + "2,,measured\n", read_tracks_csv),
        ("t.trc", TRC + "1\t0\tNUMBER\t2\t3\n2\t0.02\t1\t2\t3\n", read_trc),
        ("p.csv", "time,a.x,a.y,a.z\n0,1,2,3\n1,NUMBER,2,3\n", read_points_csv),
        ("a.bvh", BVH.replace("1 2 3", "NUMBER 2 3"), read_bvh),
        ("m.csv", "name,body,x,y,z\na,b,NUMBER,2,3\n", read_marker_table),
        ("frames.csv", "frame,camera,time_ns\n0,a,0\n1,a,NUMBER\n", lambda path: read_stamps(path, {"a": "a"}, 1.0)),
        (
            "c.ori",
            ORI.replace("9", "NUMBER"),
            lambda path: read_any_rig(path, options=RigFileOptions(size_px=(640, 480), pixel_mm=(0.01, 0.01))),
        ),
    ],
)
def test_every_reader_refuses_it(tmp_path, name, text, read, number):
    path = tmp_path / name
    (tmp_path / "c.addpar").write_text("0 0 0 0 0 1 0\n")
    path.write_text(text.replace("NUMBER", "7"), encoding="utf-8")
    read(path)
    path.write_text(text.replace("NUMBER", number), encoding="utf-8")
    with pytest.raises(InputError, match=rf"{name}.*( wanted|holds what is no digit)"):
        read(path)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("square_m = 0.04", "square_m = true", "key 'square_m': true given; a number is wanted"),
        ("sigma_m = 0.0", "sigma_m = false", "key 'sigma_m': false given; a number is wanted"),
    ],
)
def test_true_is_no_number_in_toml(tmp_path, old, new, said):
    path = tmp_path / "b.toml"
    text = 'kind = "board"\ncolumns = 9\nrows = 6\nsquare_m = 0.04\nsigma_m = 0.0\n'
    path.write_text(text)
    read_target_file(path)
    path.write_text(text.replace(old, new))
    with pytest.raises(InputError) as error:
        read_target_file(path)
    assert said in str(error.value)


def test_true_is_no_number_inside_a_rig(tmp_path):
    pose = {"position_m": [0.0, 1.0, 2.0], "rotation_wxyz": [1.0, 0.0, 0.0, 0.0]}
    lens = {"model": "opencv", "fx_px": 900.0, "fy_px": 900.0, "cx_px": 320.0, "cy_px": 240.0}
    path = tmp_path / "rig.toml"
    for k in range(2):
        if k:
            pose["position_m"] = [0.0, 1.0, True]
        cameras = [{"name": "a", "size": [640, 480], "lens": lens, "pose": pose}]
        path.write_text(tomli_w.dumps({"camera": cameras}))
        if not k:
            read_rig(path)
    with pytest.raises(InputError, match=r"rig\.toml: key 'camera\[0\]\.pose\.position_m\[2\]': true given"):
        read_rig(path)


def test_a_trc_that_lacks_frames_is_told(tmp_path):
    path = tmp_path / "t.trc"
    path.write_text(TRC + "1\t0\t1\t2\t3\n")
    with pytest.raises(InputError, match="NumFrames = '2', and 1 frames follow; the file is cut short"):
        read_trc(path)


def test_names_in_a_points_table_are_utf_8(tmp_path):
    path = tmp_path / "p.csv"
    path.write_text("time,Füße.x,Füße.y,Füße.z\n0,1,2,3\n", encoding="utf-8-sig")
    assert read_points_csv(path).names == ("Füße",)
    path.write_text("time,Füße.x,Füße.y,Füße.z\n0,1,2,3\n", encoding="latin-1")
    with pytest.raises(InputError, match=r"p\.csv: cannot be read: no utf-8-sig text .*a CSV table is wanted"):
        read_points_csv(path)


MATRIX = """%YAML:1.0
---
image_width: 640
image_height: 480
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 900.5, 0., 320., 0., 900.5, 240., 0., 0., 1. ]
"""


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("rows: 3", "rows: 4", "rows times cols = 12 holds 9 of dt = 'd'; as many are wanted"),
        ("rows: 3", "", "rows times cols = 0 holds 9 of"),
        ("dt: d", "dt: u", "of dt = 'u'; as many are wanted, of dt d"),
        ("dt: d", "dt: i", "is of whole numbers"),
        ("0., 0., 1.", "0., 0., 2.", "camera matrix"),
    ],
)
def test_a_matrix_of_opencv_is_as_it_says(tmp_path, old, new, said):
    path = tmp_path / "c.yml"
    path.write_text(MATRIX)
    assert read_any_rig(path)[0].cameras[0].lens.fx_px == 900.5
    path.write_text(MATRIX.replace(old, new))
    with pytest.raises(InputError, match=said):
        read_any_rig(path)


@pytest.mark.parametrize(
    "rows", ["[1.0, 900, 240], [0, 0, 1]", "[0, 900, 240], [0, 0, 2]", "[0, 900, 240], [0, 1, 1]"]
)
def test_a_camera_matrix_of_aniposelib_is_whole(tmp_path, rows):
    path = tmp_path / "c.toml"
    text = "[cam_0]\nsize = [640, 480]\nmatrix = [[900.0, 0, 320], ROWS]\ndistortions = [0.0, 0, 0, 0, 0]\n"
    text += "rotation = [0.0, 0, 0]\ntranslation = [0.0, 0, 1]\n"
    path.write_text(text.replace("ROWS", "[0, 900, 240], [0, 0, 1]"))
    read_rig(path)
    path.write_text(text.replace("ROWS", rows))
    with pytest.raises(InputError, match="and below them"):
        read_rig(path)


@pytest.mark.parametrize("size", ["640.5\n480", "640\n1e-3", "0\n480"])
def test_sizes_of_images_are_whole(tmp_path, size):
    (tmp_path / "c.addpar").write_text("0 0 0 0 0 1 0\n")
    (tmp_path / "c.ori").write_text(ORI)
    par = "1\na\nb\n1\n0\n1\nSIZE\n0.01\n0.01\n0\n1\n1\n1\n0\n"
    (tmp_path / "ptv.par").write_text(par.replace("SIZE", "640\n480"))
    rig, _ = read_any_rig(tmp_path)
    assert (rig.cameras[0].width, rig.cameras[0].height) == (640, 480)
    (tmp_path / "ptv.par").write_text(par.replace("SIZE", size))
    with pytest.raises(InputError, match=r"ptv\.par: image .*whole numbers of px"):
        read_any_rig(tmp_path)
