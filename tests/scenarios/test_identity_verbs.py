"""Blink codes, coded targets, printed sheets and motion files through the command line."""

from itertools import islice

import cv2
import numpy as np
import pytest
from command_line import mosca, refusal
from track_tables import measured_tracks

from mosca.data.files.rig_file import write_rig
from mosca.data.lamp_codes import lamp_bits
from mosca.data.motion.bvh import read_bvh
from mosca.data.target_codes import SECTORS, code_bits
from mosca.data.targets import CodedTarget
from mosca.formats.sheets.target_sheet import PAGES_MM, lay_out_sheets
from mosca.formats.tracks.tracks_file import read_tracks, write_tracks
from mosca.recording import RecordingWriter
from scenarios.build.cameras import true_rig, twin_source, virtual_cameras
from scenarios.build.scene import build_scene
from scenarios.spec.catalog import find
from scenarios.spec.scenario import load_scenario

DOT_M, DPI = 0.004, 254
NUMBERS = (3, 17, 99, 256, 301, 402, 406, 7, 12, 45, 80, 111)
BOARD = 'kind = "board"\ncolumns = 5\nrows = 4\nsquare_m = 0.03\nmargin_m = 0.015\n'
FIELD = "kind = 'field'\ndot_radius_m = 0.004\n" + "".join(
    f"[[target]]\nnumber = {number}\nposition_m = [{k}.0, 0.0, 0.0]\n" for k, number in enumerate(NUMBERS)
)


def test_lamps_are_named_by_their_blinks(tmp_path):
    numbers = {4: 12, 9: 30, 11: 5, 12: 44, 15: 61, 20: 70}
    lit = sorted((f, track) for track, number in numbers.items() for f in range(64) if lamp_bits(number)[f % 16])
    frame, track = np.array(lit).T
    write_tracks(measured_tracks(frame, track, np.zeros((len(lit), 3))), tmp_path / "take.csv", 100.0)
    done = mosca(
        "labels", "blink", "take.csv", "--name", "12=LWRI", "--name", "13=RWRI", "--out", "named.csv", cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    assert "1 of 6 tracks have a label" in done.stdout
    assert "not found: RWRI" in done.stdout
    named = read_tracks(tmp_path / "named.csv")
    assert set(named.label[named.track == 4]) == {"LWRI"}
    assert set(named.label[named.track == 9]) == {""}


def test_coded_targets_are_tracked_by_their_numbers(tmp_path):
    path = find("targets/test_field")
    spec = load_scenario(path, ("capture.duration_s=0.03",))
    rig = true_rig(spec, path.parent)
    scene, cameras = build_scene(spec, path.parent), virtual_cameras(spec, rig)
    with twin_source(spec, scene, cameras, 1) as source, RecordingWriter(tmp_path / "take", source.cameras) as writer:
        for frame in islice(source, 3 * len(cameras)):
            writer.write(frame)
    write_rig(rig, tmp_path / "rig.toml")
    done = mosca("labels", "coded", "take", "--rig", "rig.toml", "--out", "coded.csv", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    tracks = read_tracks(tmp_path / "coded.csv")
    true = dict(zip(scene.marker_names, scene.sampler().at(0.0).marker_xyz, strict=True))
    first = tracks.select(tracks.frame == 0)
    assert len(first) >= 10
    away = [np.linalg.norm(xyz - true[str(label)]) for label, xyz in zip(first.label, first.xyz, strict=True)]
    assert max(away) < 0.01


@pytest.mark.parametrize(("text", "line"), [(BOARD, "square_m = 0.0297"), (FIELD, "dot_radius_m = 0.00396")])
def test_a_ruler_gives_the_printed_lengths(tmp_path, text, line):
    (tmp_path / "sheet.toml").write_text(text)
    done = mosca("target", "scale", "sheet.toml", "--ruler", "148.5", "150", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "printed at 99.00 % of its size" in done.stdout
    assert line in done.stdout


def scan(numbers, scale):
    """Return a scan of a sheet that was printed at ``scale``."""
    width, height = PAGES_MM["A4"]
    (places,) = lay_out_sheets([CodedTarget.of_dot(number, DOT_M) for number in numbers])
    image = np.full((round(height * DPI / 25.4), round(width * DPI / 25.4)), 255, np.uint8)
    row, column = np.indices(image.shape)
    x, y = column * 25.4 / DPI / scale, height - row * 25.4 / DPI / scale
    for place in places:
        target, right, up = place.target, x - place.x_mm, y - place.y_mm
        radius = np.hypot(right, up) / 1000
        sector = (np.degrees(np.arctan2(up, right)) % 360 / (360 / SECTORS)).astype(int) % SECTORS
        ring = (radius > target.ring_inner_m) & (radius < target.ring_outer_m)
        white = (radius < target.dot_radius_m) | (ring & np.array(code_bits(target.number))[sector])
        plate = np.maximum(np.abs(right), np.abs(up)) < 500 * target.plate_m
        image[plate] = np.where(white[plate], 230, 20)
    return cv2.GaussianBlur(image, (0, 0), 1.0)


def test_a_scan_gives_the_printed_lengths(tmp_path):
    (tmp_path / "field.toml").write_text(FIELD)
    cv2.imwrite(str(tmp_path / "scan.png"), scan(NUMBERS, 0.98))
    done = mosca("target", "scale", "field.toml", "--scan", "scan.png", DPI, "--page", "A4", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    (length,) = [line for line in done.stdout.splitlines() if line.startswith("dot_radius_m")]
    assert float(length.split("=")[1]) == pytest.approx(0.98 * DOT_M, rel=2e-3)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("labels", "blink", "take.csv", "--name", "75=A", "--out", "a.csv"), "--name 75=A: NUMBER=LABEL"),
        (("labels", "blink", "take.csv", "--name", "1=A", "--name", "1=B", "--out", "a.csv"), "given twice"),
        (("target", "scale", "field.toml"), "give --ruler MEASURED PRINTED or --scan IMAGE DPI"),
        (("target", "scale", "field.toml", "--ruler", "5.9", "150"), "ruler measured as 5.9 mm"),
        (("target", "scale", "wand.toml", "--ruler", "150", "150"), "describes Wand, which has no printed sheet"),
        (("target", "scale", "board.toml", "--scan", "field.toml", "600"), "no coded targets that a scan shows"),
        (("target", "scale", "field.toml", "--scan", "no.png", "600"), "no.png: no such file"),
        (("target", "scale", "field.toml", "--scan", "board.toml", "600"), "neither PNG, TIFF, BMP nor JPEG"),
        (("target", "scale", "field.toml", "--scan", ".", "600"), ".: is a folder; name a file"),
    ],
)
def test_wrong_words_are_named(tmp_path, words, message):
    (tmp_path / "field.toml").write_text(FIELD)
    (tmp_path / "board.toml").write_text(BOARD)
    (tmp_path / "wand.toml").write_text('kind = "wand"\nalong_m = [0.0, 0.1, 0.3]\ndiameter_m = 0.02\n')
    assert message in refusal(*words, cwd=tmp_path)


BVH = """HIERARCHY
ROOT hip
{
  OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  End Site
  {
    OFFSET 0 50 0
  }
}
MOTION
Frames: 2
Frame Time: 0.02
0 90 0 0 0 0
1 90 0 10 0 0
"""


def test_motions_are_converted(tmp_path):
    (tmp_path / "a.bvh").write_text(BVH)
    done = mosca("motion", "convert", "a.bvh", "b.bvh", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    one, two = (read_bvh(tmp_path / name) for name in ("a.bvh", "b.bvh"))
    np.testing.assert_allclose(two.root_xyz, one.root_xyz, atol=1e-9)
    np.testing.assert_allclose(two.rotations, one.rotations, atol=1e-9)
    for words in (("a.bvh", "b.csv"), ("a.amc", "b.bvh"), ("a.bvh", "b.bvh", "--skeleton", "a.asf")):
        refusal("motion", "convert", *words, cwd=tmp_path)
