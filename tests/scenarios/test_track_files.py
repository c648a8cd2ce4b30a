"""``mosca tracks``: files of tracks looked into and converted."""

from pathlib import Path

import ezc3d
import numpy as np
import pytest
from command_line import mosca, refusal
from rigs import ring

from mosca.data.files.rig_file import write_rig
from mosca.data.tracks import Tracks
from mosca.formats.tracks.tracks_file import SUFFIXES, read_tracks, write_tracks


@pytest.fixture
def take(tmp_path: Path) -> Path:
    """Two markers at 50 Hz for 20 frames; B is missing in frames 5 to 8 and 12."""
    frames = np.repeat(np.arange(20), 2)
    track = np.tile([0, 1], 20)
    kept = ~((track == 1) & np.isin(frames, [5, 6, 7, 8, 12]))
    xyz = np.column_stack([track + 0.01 * frames, 0.5 * frames, 1.0 + 0 * track])
    n = int(kept.sum())
    tracks = Tracks(
        frame=frames[kept], time_ns=frames[kept] * 20_000_000, track=track[kept], xyz=xyz[kept],
        label=np.array(["A", "B"])[track[kept]], covariance=np.tile(4e-8 * np.eye(3), (n, 1, 1)),
        n_cameras=np.full(n, 4), residual_px=np.full(n, 0.05), status=np.full(n, "measured"),
    )  # fmt: skip
    write_tracks(tracks, tmp_path / "take.npz", 50.0)
    return tmp_path / "take.npz"


def test_a_file_is_described(take):
    shown = mosca("tracks", "info", take.name, cwd=take.parent)
    assert shown.returncode == 0, shown.stderr
    assert "2 tracks, 35 samples in 20 frames, 0.380 s at 50 Hz" in shown.stdout
    assert "positions within 1.19 x 9.5 x 0 m" in shown.stdout
    rows = {line.split()[0]: line.split() for line in shown.stdout.splitlines() if line.split()[:1] in (["A"], ["B"])}
    assert rows["A"] == ["A", "20", "100.0", "0", "0.00"]
    assert rows["B"] == ["B", "15", "75.0", "2", "0.08"]


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_tracks_come_through_each_format(take, suffix):
    done = mosca("tracks", "convert", take.name, f"out{suffix}", cwd=take.parent)
    assert done.returncode == 0, done.stderr
    again, before = read_tracks(take.parent / f"out{suffix}"), read_tracks(take)
    assert len(again) == 35
    order = [np.lexsort((one.label, one.frame)) for one in (again, before)]
    np.testing.assert_allclose(again.xyz[order[0]], before.xyz[order[1]], atol=1e-5)
    assert again.label[order[0]].tolist() == before.label[order[1]].tolist()


def test_the_rate_and_the_markers_can_be_chosen(take):
    assert (
        mosca("tracks", "convert", take.name, "a.c3d", "--only", "B", "--fps", "60", cwd=take.parent).returncode == 0
    )
    outside = ezc3d.c3d(str(take.parent / "a.c3d"))["parameters"]["POINT"]
    assert outside["LABELS"]["value"] == ["B"]
    assert outside["RATE"]["value"][0] == 60.0


def test_tracks_are_seen_on_a_page(take):
    folder = take.parent
    write_rig(ring(3), folder / "rig.toml")
    done = mosca("tracks", "page", "take.npz", "seen.html", "--rig", "rig.toml", cwd=folder)
    assert done.returncode == 0, done.stderr
    page = (folder / "seen.html").read_text(encoding="utf-8")
    assert all(f">{name}<" in page for name in ("A (track 0)", "B (track 1)"))
    assert 'data-layer="cameras"' in page
    assert "2 tracks with 35 samples" in page
    # another program's file has neither cameras nor residuals
    assert mosca("tracks", "convert", "take.npz", "other.trc", cwd=folder).returncode == 0
    assert mosca("tracks", "page", "other.trc", "other.html", cwd=folder).returncode == 0
    page = (folder / "other.html").read_text(encoding="utf-8")
    assert ">A (track 0)<" in page
    assert 'data-layer="cameras"' not in page
    write_tracks(read_tracks(take).select(np.array([], int)), folder / "none.npz", 50.0)
    assert "none.npz: no tracks: there is nothing to see" in refusal(
        "tracks", "page", "none.npz", "x.html", cwd=folder
    )


def test_mistakes_are_told_in_one_line(take):
    folder = take.parent
    assert "has no marker of that name; names there: A, B" in refusal(
        "tracks", "convert", "take.npz", "x.csv", "--only", "C", cwd=folder
    )
    assert ".npz, .csv, .parquet, .c3d, .trc are allowed" in refusal(
        "tracks", "convert", "take.npz", "x.mat", cwd=folder
    )
    assert "take.xls" in refusal("tracks", "info", "take.xls", cwd=folder)
    assert not (folder / "x.csv").exists()
