"""mosca edit: takes edited and undone through the command line, and the page's own example."""

import os
import re
from pathlib import Path

import numpy as np
import pytest
from command_line import mosca, refusal
from track_tables import measured_tracks

from mosca.data.motion.bvh import read_bvh
from mosca.data.motion.motion import Motion, Skeleton
from mosca.data.tracks import Tracks
from mosca.formats.bodies.bvh_writer import write_bvh
from mosca.formats.tracks.tracks_file import read_tracks, write_tracks

DATA = Path(os.environ.get("MOSCA_DATA", Path(__file__).parents[3] / "shared" / "data"))
PAGE = Path(__file__).parents[2] / "docs/editing.md"
EDITS = """[[edit]]
delete = { labels = ["A"], frames = [10, 12] }
[[edit]]
offset = { labels = ["B"], keyframes = [{ frame = 5, xyz_m = [0, 0, 0.1] }], blend = "linear" }
"""


def take(folder):
    n = 30
    frame = np.repeat(np.arange(n), 2)
    xyz = np.random.default_rng(0).normal(size=(2 * n, 3))
    write_tracks(
        measured_tracks(frame, np.tile([0, 1], n), xyz, label=np.tile(["A", "B"], n)), folder / "a.npz", 100.0
    )
    (folder / "e.toml").write_text(EDITS)


def same(one, other):
    return all(
        getattr(one, n).dtype == getattr(other, n).dtype and getattr(one, n).tobytes() == getattr(other, n).tobytes()
        for n in Tracks.__dataclass_fields__
    )


def test_edits_are_done_kept_and_undone(tmp_path):
    take(tmp_path)
    start = read_tracks(tmp_path / "a.npz")
    done = mosca("edit", "a.npz", "e.toml", "--out", "b.npz", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.splitlines() == [
        "edit[0] delete: 3 rows changed or removed",
        "edit[1] offset: 30 rows changed or removed",
        "57 samples in b.npz; what was changed is kept beside it, in b.npz.edits.npz",
    ]
    edited = read_tracks(tmp_path / "b.npz")
    assert (edited.status[edited.label == "B"] == "edited").all()
    (tmp_path / "a.npz").unlink()
    assert "1 of 2 edits undone" in mosca("edit", "b.npz", "--undo", "1", "--out", "c.npz", cwd=tmp_path).stdout
    once = read_tracks(tmp_path / "c.npz")
    assert same(once, start.select(~((start.label == "A") & (start.frame >= 10) & (start.frame <= 12))))
    assert "2 of 2 edits undone" in mosca("edit", "b.npz", "--out", "d.npz", "--undo", cwd=tmp_path).stdout
    assert same(read_tracks(tmp_path / "d.npz"), start)
    assert not (tmp_path / "d.npz.edits.toml").exists()
    assert "1 of 1 edits undone" in mosca("edit", "c.npz", "--out", "c.npz", "--undo", cwd=tmp_path).stdout
    assert same(read_tracks(tmp_path / "c.npz"), start)
    assert sorted(one.name for one in tmp_path.glob("c.*")) == ["c.npz"]


def test_a_format_that_holds_less_is_told_and_undone_all_the_same(tmp_path):
    take(tmp_path)
    start = read_tracks(tmp_path / "a.npz")
    done = mosca("edit", "a.npz", "e.toml", "--out", "b.c3d", cwd=tmp_path)
    assert "57 samples in b.c3d, as far as .c3d holds numbers (a .npz file holds all of tracks)" in done.stdout
    mosca("edit", "b.c3d", "--out", "d.npz", "--undo", cwd=tmp_path)
    assert same(read_tracks(tmp_path / "d.npz"), start)


def test_a_changed_file_and_too_many_undone_edits_are_one_line(tmp_path):
    take(tmp_path)
    mosca("edit", "a.npz", "e.toml", "--out", "b.csv", cwd=tmp_path)
    line = refusal("edit", "b.csv", "--undo", "3", "--out", "c.csv", cwd=tmp_path)
    assert "--undo 3: b.csv has 2 edits; 1 to 2, or all, can be undone" in line
    text = (tmp_path / "b.csv").read_text()
    (tmp_path / "b.csv").write_text(text.replace("measured", "filled", 1))
    before = sorted(tmp_path.iterdir())
    for words in (("e.toml",), ("--undo",)):
        line = refusal("edit", "b.csv", "--out", "c.csv", *words, cwd=tmp_path)
        assert "b.csv: is not as 'mosca edit' wrote it" in line
    assert sorted(tmp_path.iterdir()) == before


def test_a_motion_is_edited_and_undone(tmp_path):
    skeleton = Skeleton(("hip", "knee"), np.array([-1, 0]), np.array([[0, 0, 0], [0, 0, -0.4]]), ("ZXY", "ZXY"))
    rotations = np.tile([1.0, 0.0, 0.0, 0.0], (20, 2, 1))
    write_bvh(Motion(skeleton, 50.0, np.zeros((20, 3)), rotations), tmp_path / "a.bvh")
    (tmp_path / "e.toml").write_text("[[edit]]\ntrim = { frames = [5, 9] }\n")
    assert "5 frames in b.bvh" in mosca("edit", "a.bvh", "e.toml", "--out", "b.bvh", cwd=tmp_path).stdout
    line = refusal("edit", "b.bvh", "--undo", "--metres-per-unit", "0.1", "--out", "c.bvh", cwd=tmp_path)
    assert "b.bvh.edits.npz: holds no recorded edits" in line
    assert "1 of 1 edits undone" in mosca("edit", "b.bvh", "--out", "c.bvh", "--undo", cwd=tmp_path).stdout
    a, c = (read_bvh(tmp_path / f"{name}.bvh") for name in "ac")
    np.testing.assert_array_equal(a.rotations, c.rotations)
    np.testing.assert_array_equal(a.root_xyz, c.root_xyz)


@pytest.mark.data
def test_the_example_of_the_page_runs(tmp_path):
    source = DATA / "people/cmu_02_01.c3d"
    if not source.is_file():
        pytest.skip(f"no {source}")
    blocks = re.findall(r"```toml\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    (tmp_path / "take.c3d").write_bytes(source.read_bytes())
    (tmp_path / "edits.toml").write_text(blocks[0])
    done = mosca("edit", "take.c3d", "edits.toml", "--out", "edited.npz", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert len(done.stdout.splitlines()) == blocks[0].count("[[edit]]") + 1
    mosca("edit", "edited.npz", "--out", "start.npz", "--undo", cwd=tmp_path)
    assert same(read_tracks(tmp_path / "start.npz"), read_tracks(source))
    walk = DATA / "cmu_mocap/bvh/02/02_01.bvh"
    other = DATA / "cmu_mocap/bvh/07/07_01.bvh"
    if not (walk.is_file() and other.is_file()):
        pytest.skip(f"no {walk}")
    (tmp_path / "walk.bvh").write_bytes(walk.read_bytes())
    (tmp_path / "other.bvh").write_bytes(other.read_bytes())
    (tmp_path / "motion.toml").write_text(blocks[1])
    done = mosca("edit", "walk.bvh", "motion.toml", "--out", "edited.bvh", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
