"""``mosca live``, and tracks that are finished and stitched by verbs: on a small scenario and its recording."""

import json
import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from tiny_scenario import write_tiny

from mosca.data.files.rig_file import write_rig
from mosca.data.frames import CameraInfo, Frame
from mosca.data.tracks import Samples
from mosca.errors import InputError
from mosca.formats.bodies.model_file import read_model
from mosca.formats.tracks.tracks_csv import read_tracks_csv
from mosca.formats.tracks.tracks_file import TracksLog, read_tracks
from reports.record import read_record
from scenarios.build.cameras import calibrated, true_rig, virtual_cameras
from scenarios.cli.main import cli
from scenarios.commands.live import run_live_command
from scenarios.commands.live_sources import LiveOptions, PacedFrames, opened_live
from scenarios.run.scenario import run_scenario
from scenarios.spec.scenario import load_scenario
from scenarios.types import RunOptions


@pytest.fixture(scope="module")
def lab(tmp_path_factory) -> Path:
    """A folder with a scenario, its recording and its rig."""
    folder = tmp_path_factory.mktemp("lab")
    spec = load_scenario(write_tiny(folder, duration_s=0.4))
    run_scenario(spec, "tiny", folder, RunOptions(record_to=folder / "take"))
    write_rig(calibrated(spec, virtual_cameras(spec, true_rig(spec, folder))).rig, folder / "rig.toml")
    return folder


def done(*words: object) -> list[str]:
    """Run the command line; it must succeed. Its lines."""
    result = CliRunner().invoke(cli, [str(word) for word in words], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.output.splitlines()


def test_a_scenario_is_played_live_and_recorded(lab, tmp_path):
    told = []
    lines = run_live_command(
        LiveOptions(
            str(lab / "tiny.toml"), out=tmp_path / "a.csv", record=tmp_path / "a.json", queued=100, rate=20.0
        ),
        told.append,
    )
    # 40 sets at 20 a second are two seconds, and a line for each that is over
    assert len(told) >= 1
    assert "sets/s, latency" in told[0]
    assert any("0 sets dropped, 8.0 points, 8 tracks" in line for line in told)
    assert lines[0].startswith("40 frame sets in ")
    assert "0 dropped whole" in lines[0]
    tracks = read_tracks_csv(tmp_path / "a.csv")
    assert len(np.unique(tracks.track)) == 8
    assert (np.diff(tracks.frame * 1000 + tracks.track) > 0).all()
    assert [p.name for p in tmp_path.iterdir() if "part" in p.name] == []
    record = read_record(tmp_path / "a.json")
    assert record.counts["tracked_sets"] == 40
    assert record.counts["samples"] == len(tracks)
    for stage in ("detect", "match", "track", "wait", "latency"):
        assert 0 <= record.timings[f"{stage}_mean"] <= record.timings[f"{stage}_max"]
        assert record.timings[f"{stage}_p99"] <= record.timings[f"{stage}_max"]
    assert set(record.cameras) == {"cam1", "cam2", "cam3", "cam4"}


def test_a_recording_played_too_fast_drops_whole_sets_and_says_so(lab, tmp_path):
    out = tmp_path / "b.npz"
    lines = done(
        "live", f"recording:{lab / 'take'}", "--rig", lab / "rig.toml", "--rate", 1e6, "--queued", 1, "--out", out,
        "--record", tmp_path / "b.json",
    )  # fmt: skip
    counts = json.loads((tmp_path / "b.json").read_text())["counts"]
    assert counts["skipped_sets"] > 0
    assert counts["tracked_sets"] + counts["skipped_sets"] == counts["frame_sets"] == 40
    assert any(f"{counts['skipped_sets']} dropped whole" in line for line in lines)
    assert any("left out whole" in line for line in lines)
    assert len(np.unique(read_tracks(out).frame)) <= counts["tracked_sets"]


def test_live_measures_what_a_patient_run_does(lab, tmp_path):
    rig = ("--rig", lab / "rig.toml")
    done("reconstruct", lab / "take", *rig, "--set", "lookahead=0", "--out", tmp_path / "patient.csv")
    done(
        "live", f"recording:{lab / 'take'}", "--rig", lab / "rig.toml", "--queued", 100, "--out",
        tmp_path / "live.csv",
    )  # fmt: skip
    assert (tmp_path / "live.csv").read_bytes() == (tmp_path / "patient.csv").read_bytes()


def test_a_lag_smooths_live_as_it_does_afterwards(lab, tmp_path):
    rig = ("--rig", lab / "rig.toml", "--lag", 4)
    lines = done("reconstruct", lab / "take", *rig, "--set", "lookahead=0", "--out", tmp_path / "patient.csv")
    assert "positions are smoothed with a lag of 4 frames" in lines
    done("live", f"recording:{lab / 'take'}", *rig, "--queued", 100, "--out", tmp_path / "live.csv")
    assert (tmp_path / "live.csv").read_bytes() == (tmp_path / "patient.csv").read_bytes()


def test_labels_are_learned_from_a_take_and_given_to_the_next(lab, tmp_path):
    take, model = tmp_path / "take.csv", tmp_path / "model.toml"
    done("reconstruct", lab / "take", "--rig", lab / "rig.toml", "--out", take)
    names = [word for k in range(4) for word in ("--name", f"{k}=M{k}")]
    limb = ("--limb", "all=M0,M1,M2,M3")
    (line,) = done("labels", "learn", take, *names, *limb, "--frames", "0:30", "--out", model)
    assert line.startswith("4 markers, ")
    assert dict(read_model(model).limbs) == {"all": ("M0", "M1", "M2", "M3")}
    lines = done("labels", "apply", take, "--model", model, "--out", tmp_path / "named.csv")
    named = read_tracks_csv(tmp_path / "named.csv")
    for k in range(4):
        assert set(named.label[named.track == k]) <= {"", f"M{k}"}
    assert f"{len(set(named.label.tolist()) - {''})} of 4 markers found" in lines[0]
    done(
        "reconstruct", lab / "take", "--rig", lab / "rig.toml", "--labels", model, "--fill", 0.1, "--out",
        tmp_path / "again.csv",
    )  # fmt: skip
    again = read_tracks_csv(tmp_path / "again.csv")
    assert again.label.tolist() == named.label.tolist()


def test_zones_are_stitched_by_a_verb(lab, tmp_path):
    done("reconstruct", lab / "take", "--rig", lab / "rig.toml", "--out", tmp_path / "all.csv")
    whole = read_tracks_csv(tmp_path / "all.csv")
    from mosca.formats.tracks.tracks_csv import write_tracks_csv

    write_tracks_csv(whole.select(whole.frame < 30), tmp_path / "early.csv")
    write_tracks_csv(whole.select(whole.frame > 10), tmp_path / "late.csv")
    lines = done("zones", tmp_path / "early.csv", tmp_path / "late.csv", "--out", tmp_path / "hall.csv")
    hall = read_tracks_csv(tmp_path / "hall.csv")
    assert lines[0] == f"8 tracks with {len(whole)} samples in {tmp_path / 'hall.csv'}"
    assert lines[1].startswith("8 targets handed over between zones, 152 samples merged")
    np.testing.assert_allclose(hall.xyz, whole.xyz, atol=1e-12)


def test_frames_come_when_they_are_due_and_stop_at_once():
    info = CameraInfo("a", 4, 3, 8, 100.0)
    image = np.zeros((3, 4), np.uint8)
    frames = [Frame("a", k, k * 50_000_000, 1_000_000, image) for k in range(5)]
    start = time.perf_counter()
    at = [time.perf_counter() - start for _ in PacedFrames((info,), frames, speed=2.0)]
    assert all(t >= 0.025 * k - 1e-3 for k, t in enumerate(at))
    paced = PacedFrames((info,), [frames[0], Frame("a", 1, 3600 * 10**9, 1_000_000, image)])
    stream = iter(paced)
    next(stream)
    paced.stop()
    assert list(stream) == []


def test_a_long_scenario_is_cut_to_what_fits_in_memory(lab, monkeypatch):
    monkeypatch.setattr("scenarios.commands.live_sources.MEMORY_BYTES", 4 * 320 * 240 * 6)
    with ExitStack() as stack:
        source = opened_live(LiveOptions(str(lab / "tiny.toml"), workers=1), stack)
        assert source.notes == ("0.06 s of 0.4 s fit in memory and are played",)
        assert len(list(source.frames)) == 4 * 6


def test_what_was_measured_is_on_the_disk_whatever_happens(tmp_path):
    n = np.arange(3)
    some = Samples(n, n * 10, n, np.zeros((3, 3)), np.zeros((3, 3, 3)), n, np.zeros(3), np.zeros(3, np.int8))
    with TracksLog(tmp_path / "t.c3d") as log:
        log.write(some)
        log.flush()
        assert len(read_tracks_csv(tmp_path / "t.c3d.part.csv")) == 3
    assert len(read_tracks_csv(tmp_path / "t.c3d.part.csv")) == 3
    with pytest.raises(InputError, match="left by a run that was cut short"):
        TracksLog(tmp_path / "t.c3d")
