"""Files that are made to break a reader end in one line: no recursion, no crash, no waiting."""

import io
import os
import struct
import subprocess
import sys
import zipfile

import av
import numpy as np
import pytest
from rigs import ring

from mosca.data.files.bounded import MOST_TABLE_BYTES, parse_json
from mosca.data.files.rig_file import read_rig
from mosca.data.files.toml import read_toml
from mosca.data.motion.asf import read_asf_amc
from mosca.data.motion.joint_csv import read_points_csv
from mosca.data.rig import OpenCVLens
from mosca.data.tracks import read_npz
from mosca.errors import InputError
from mosca.formats.rigs.rig_formats import read_any_rig, write_any_rig
from mosca.recording.video import open_video
from scenarios.spec.scenario import apply_overrides

DEEP = {"lists": "[" * 100_000, "closed lists": "[" * 900 + "]" * 900, "deep but readable": "[" * 80 + "]" * 80}
LARGE = {"decimal": "1" * 5000, "hexadecimal": "0x" + "f" * 6000, "beyond 64 bits": str(1 << 63)}


@pytest.mark.parametrize("value", [*DEEP.values(), *LARGE.values()], ids=[*DEEP, *LARGE])
def test_toml_and_set_refuse_deep_and_large_values_in_one_line(tmp_path, value):
    path = tmp_path / "a.toml"
    path.write_text(f"a = {value}")
    with pytest.raises(InputError, match=r"a\.toml: not valid TOML: .*(flatten them|a smaller one)$") as caught:
        read_toml(path)
    assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match=r"^--set x\.y: .*(flatten them|a smaller one)$"):
        apply_overrides({}, (f"x.y={value}",))


@pytest.mark.parametrize("part", ["a", '"a"', "'a' "])
def test_toml_refuses_a_key_of_many_parts(tmp_path, part):
    path = tmp_path / "a.toml"
    path.write_text(".".join([part] * 100_000) + " = 1")
    with pytest.raises(InputError, match="a key has more than 64 parts"):
        read_toml(path)


def test_toml_reads_what_is_within_the_limits(tmp_path):
    path = tmp_path / "a.toml"
    path.write_bytes(b"a = [[1.5, 2.5]]\r\nb.c = 9223372036854775807\r\n# " + b"x" * 1_000_000)
    assert read_toml(path) == {"a": [[1.5, 2.5]], "b": {"c": (1 << 63) - 1}}


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no named pipes")
def test_toml_does_not_wait_for_a_pipe(tmp_path):
    path = tmp_path / "a.toml"
    os.mkfifo(path)
    code = "import sys, pathlib, mosca.data.files.toml as t; t.read_toml(pathlib.Path(sys.argv[1]))"
    done = subprocess.run([sys.executable, "-c", code, str(path)], capture_output=True, text=True, timeout=120)
    assert "a.toml: cannot be read: is a named pipe; name a regular file" in done.stderr


OPENCV_DEEP = {
    "json": '{"a": ' + "[" * 1_000_000,
    "xml": '<?xml version="1.0"?>\n<opencv_storage>' + "<a>" * 100_000,
    "yaml": "%YAML:1.0\n---\n" + "a:" * 100_000,
    "yml": "%YAML:1.0\n---\na:\n   " + "-" * 100_000,
}
"""By suffix: OpenCV 5.0 ends with a segmentation fault on the last three."""


@pytest.mark.parametrize("suffix", OPENCV_DEEP)
def test_deep_files_of_opencv_are_refused(tmp_path, suffix):
    path = tmp_path / f"a.{suffix}"
    path.write_text(OPENCV_DEEP[suffix])
    code = "import sys, mosca.formats.rigs.rig_formats as r; r.read_any_rig(sys.argv[1])"
    done = subprocess.run([sys.executable, "-c", code, str(path)], capture_output=True, text=True, timeout=120)
    assert done.returncode == 1, done.returncode
    assert "InputError" in done.stderr
    assert f"a.{suffix}: holds more than 4000 of the characters" in done.stderr


def npz(path, shape, content):
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(head, {"descr": "<f8", "fortran_order": False, "shape": shape})
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("frame.npy", head.getvalue() + content)


BOUNDED = """
import resource, sys
from pathlib import Path
from mosca.data.files import npz
from mosca.data.tracks import read_npz
assert npz.SMALL_BYTES < 1 << 29
npz.SMALL_BYTES = 1 << 20
resource.setrlimit(resource.RLIMIT_AS, (1 << 30, 1 << 30))
read_npz(Path(sys.argv[1]))
"""
"""With a smaller bound, so that a bomb is made at once."""


@pytest.mark.parametrize(
    ("shape", "n_bytes", "said"),
    [((1 << 29,), 8, "states the shape"), ((-1, 1 << 40), 8, "holds no tracks"), ((1 << 21,), 1 << 24, "so small a")],
    ids=["shape", "negative shape", "bomb"],
)
def test_arrays_larger_than_their_archive_can_hold_are_refused(tmp_path, shape, n_bytes, said):
    path = tmp_path / "tracks.npz"
    npz(path, shape, bytes(n_bytes))
    done = subprocess.run([sys.executable, "-c", BOUNDED, str(path)], capture_output=True, text=True, timeout=120)
    last = done.stderr.splitlines()[-1]
    assert "InputError" in last
    assert said in last


@pytest.mark.parametrize("rotation", ["[1e308, 1e308, 0.0]", "[[1e308, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]"])
def test_a_rotation_beyond_all_angles_is_refused(tmp_path, rotation):
    path = tmp_path / "calibration.toml"
    path.write_text(
        "[cam_0]\nname = 'a'\nsize = [640, 480]\n"
        "matrix = [[900.0, 0.0, 320.0], [0.0, 900.0, 240.0], [0.0, 0.0, 1.0]]\n"
        f"distortions = [0.0, 0.0, 0.0, 0.0, 0.0]\nrotation = {rotation}\ntranslation = [0.0, 0.0, 1.0]\n"
    )
    with pytest.raises(InputError, match=r"rotation holds 1e\+308"):
        read_rig(path)


def test_a_video_without_a_size_is_refused(tmp_path):
    path = tmp_path / "cam.avi"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("rawvideo", rate=25, width=64, height=48, pix_fmt="gray")
        for frame in (av.VideoFrame.from_ndarray(np.zeros((48, 64), np.uint8), "gray") for _ in range(3)):
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    open_video(path).close()
    data = bytearray(path.read_bytes())
    size = struct.pack("<ii", 64, 48)
    while (at := data.find(size)) >= 0:
        data[at : at + 8] = bytes(8)
    path.write_bytes(data)
    with pytest.raises(InputError, match="states no known coding, pixel format and size"):
        open_video(path)


@pytest.mark.parametrize("text", ["x=1\ny=2", "x=a\nb", "x\ny=1", "x=1\n[z]\ny=2"])
def test_set_takes_one_key(text):
    document = {}
    with pytest.raises(InputError, match=r"^--set x.*: holds several lines; give each KEY=VALUE") as caught:
        apply_overrides(document, (text,))
    assert "\n" not in str(caught.value)
    assert document == {}


def test_set_takes_a_list_of_several_lines():
    document = {}
    apply_overrides(document, ("x=[1,\n2]", "y='''a\nb'''", "z=word"))
    assert document == {"x": [1, 2], "y": "a\nb", "z": "word"}


def test_an_error_is_one_line_whatever_it_quotes():
    text = str(InputError("a.csv: 'x\ny\r\x0cz\x85\u2028' given; Füße wanted"))
    assert text == "a.csv: 'x\\ny\\r\\x0cz\\x85\\u2028' given; Füße wanted"
    assert len(text.splitlines()) == 1


def test_json_is_bounded():
    assert parse_json(b'{"a": [1, "[[["]}') == {"a": [1, "[[["]}
    for bad in ("[" * 100_000, "[" * 65 + "]" * 65, "1" * 5000, b"\xff", "{"):
        with pytest.raises(ValueError):  # noqa: PT011 (each parser's own text)
            parse_json(bad)


def test_a_text_of_too_many_bytes_is_not_read(tmp_path):
    path = tmp_path / "a.csv"
    with open(path, "wb") as file:
        file.truncate(MOST_TABLE_BYTES + 1)
    with pytest.raises(InputError, match=r"a\.csv: cannot be read: has 134217729 bytes, at most 134217728 are read"):
        read_points_csv(path)


ASF = """:root
order TX TY TZ RX RY RZ
:bonedata
begin
  name thigh
  direction 0 -1 0
  length 2
{more}end
:hierarchy
begin
  root thigh
end
"""


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (ASF.format(more="begin\n  name shin\n"), "'begin' stands in a bone that has not ended"),
        (ASF.format(more=":units\n"), "':units' stands in a bone that has not ended"),
        (ASF.format(more="").partition("end")[0], "its last bone has no 'end'"),
    ],
    ids=["begin", "section", "end of file"],
)
def test_a_bone_that_does_not_end_is_refused(tmp_path, text, said):
    """Before, the first of two bones was left out without a word."""
    asf, amc = tmp_path / "a.asf", tmp_path / "a.amc"
    amc.write_text("1\nroot 0 0 0 0 0 0\n")
    asf.write_text(ASF.format(more=""))
    assert read_asf_amc(asf, amc).skeleton.names == ("root", "thigh", "thigh_end")
    asf.write_text(text)
    with pytest.raises(InputError, match=said):
        read_asf_amc(asf, amc)


@pytest.mark.parametrize("cell", ["\u2028", "\x85", "\x1c"])
def test_only_blanks_and_tabs_are_an_empty_cell(tmp_path, cell):
    path = tmp_path / "a.csv"
    path.write_text("time,a.x,a.y,a.z\n0,1,2, \t\n", encoding="utf-8")
    assert np.isnan(read_points_csv(path).xyz[0, 0, 2])
    path.write_text(f"time,a.x,a.y,a.z\n0,1,2,{cell}\n", encoding="utf-8")
    with pytest.raises(InputError, match="a number wanted"):
        read_points_csv(path)


@pytest.mark.parametrize("c", ["1e308", "1e60", "inf"])
def test_a_principal_distance_beyond_all_lenses_is_refused(tmp_path, c):
    folder = tmp_path / "cal"
    write_any_rig(ring(1, (OpenCVLens(800.0, 800.0, 327.5, 245.0, k1=-0.1),)), folder, "openptv")
    (path,) = folder.glob("*.ori")
    words = path.read_text().split()
    read_any_rig(folder, "openptv")
    path.write_text(" ".join([*words[:17], c, *words[18:]]))
    with pytest.raises(InputError, match=r"c above 0 and up to 100000 mm|a finite number is wanted"):
        read_any_rig(folder, "openptv")


def test_an_encrypted_array_is_refused(tmp_path):
    path = tmp_path / "tracks.npz"
    npz(path, (1,), bytes(8))
    data = bytearray(path.read_bytes())
    data[data.index(b"PK\x01\x02") + 8] |= 1  # the flags in the archive's directory
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"tracks\.npz: holds no tracks: frame\.npy is encrypted"):
        read_npz(path)
