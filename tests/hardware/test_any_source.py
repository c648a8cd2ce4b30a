"""One scenario, four sources: the twin, a recording of it, and devices that are fed with its frames."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
import tomli_w
from needs import needs_aravis, needs_module

from mosca.data.tracks import read_npz, write_npz
from mosca.formats.tracks.tracks_csv import write_tracks_csv
from mosca.recording import open_recording
from reports.record import write_record
from scenarios.run.folder import write_run
from scenarios.run.scenario import run_scenario
from scenarios.spec.catalog import find
from scenarios.spec.scenario import load_scenario
from scenarios.types import RunOptions

# before pylon's first enumeration
os.environ.setdefault("PYLON_CAMEMU", "4")

SCENARIO = "rigs/any_source"
PULSES = 30
RATE_HZ = 10.0
SLOWER = (f"capture.frame_rate_hz={RATE_HZ}", f"capture.duration_s={PULSES / RATE_HZ}", "scene.speed_mps=0.08")
"""The scenario at a fifth of its pace: software triggers skip a pulse where the last one's frames are not there."""
ATTEMPTS = 5
"""A machine that is too busy for that skips pulses too; the next attempt may have them all."""
ONLY_SOURCE_AND_TIMING = ("source", "source_account", "timings")


@pytest.fixture(scope="module")
def take(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The twin's run folder and the recording of its frames."""
    folder = tmp_path_factory.mktemp("any_source")
    return run(folder / "twin", RunOptions(workers=2, record_to=folder / "take", page=False)), folder / "take"


def run(out: Path, options: RunOptions) -> Path:
    path = find(SCENARIO)
    result = run_scenario(load_scenario(path, SLOWER), SCENARIO, path.parent, options)
    if options.page:
        write_run(result, out)
        return out
    # the files that are compared: pages take longer than the runs
    out.mkdir()
    write_record(result.record, out / "record.json")
    write_npz(result.tracks, out / "tracks.npz")
    write_tracks_csv(result.tracks, out / "tracks.csv")
    return out


def rig_file(path: Path, cameras: dict[str, dict[str, object]], hardware: dict[str, object]) -> Path:
    tables = [
        {"name": name, "size": [656, 491], "hardware": {"exposure_us": 1000.0, **settings}}
        for name, settings in cameras.items()
    ]
    path.write_text(tomli_w.dumps({"hardware": hardware, "camera": tables}))
    return path


def same(a: Path, b: Path) -> None:
    assert (a / "tracks.npz").read_bytes() == (b / "tracks.npz").read_bytes()
    assert (a / "tracks.csv").read_bytes() == (b / "tracks.csv").read_bytes()
    mine, theirs = (json.loads((run / "record.json").read_text()) for run in (a, b))
    assert mine["passed"]
    for camera in (*mine["cameras"].values(), *theirs["cameras"].values()):
        camera["sensor"].pop("stated", None)  # of the twin's sensor alone
    # what disturbs its cameras the twin alone knows
    mine["premises"], theirs["premises"] = (
        {key: value for key, value in one["premises"].items() if key in theirs["premises"]} for one in (mine, theirs)
    )
    differ = {key for key in mine if mine[key] != theirs[key]}
    assert differ <= {*ONLY_SOURCE_AND_TIMING, "provenance"}
    assert len(read_npz(a / "tracks.npz")) > 20 * PULSES


def test_the_recording(take: tuple[Path, Path], tmp_path: Path) -> None:
    twin, recording = take
    same(twin, run(tmp_path / "run", RunOptions(source=f"recording:{recording}", page=False)))


def test_gige_vision_devices(take: tuple[Path, Path], tmp_path: Path) -> None:
    """As a user does it: one process serves, another runs. Each pulse waits for its frames, so that none is lost."""
    needs_aravis()
    twin, recording = take
    for attempt in range(ATTEMPTS):
        with served(recording, tmp_path / f"rig{attempt}.toml", "Software") as rig:
            if same_or_skipped(twin, tmp_path / f"run{attempt}", rig, recording, page=True):
                return
    pytest.skip(f"this machine was late at {RATE_HZ:g} Hz in all {ATTEMPTS} attempts, and each record states it")


def same_or_skipped(twin: Path, out: Path, rig: Path, recording: Path, page: bool = False) -> bool:
    """Run the devices; they give the twin's record, unless a busy machine was late, which the record states.

    Late: it skipped pulses, or cannot tell their times to a millisecond.
    """
    run(out, RunOptions(source=f"hardware:{rig}", truth=recording / "truth.npz", page=page))
    counts = json.loads((out / "record.json").read_text())["counts"]
    notes = counts["notes"]
    if not {"skipped pulses", "untimed"} & set(notes):
        same(twin, out)
        return True
    if "skipped pulses" in notes:
        assert "they could not be sent in their periods" in " ".join(notes.values())
    assert counts["complete_sets"] < PULSES
    return False


@pytest.mark.slow
def test_gige_vision_devices_on_a_pulse_generator(take: tuple[Path, Path], tmp_path: Path) -> None:
    """Its pulses do not wait: losses of a busy machine are counted."""
    needs_aravis()
    needs_module("serial", "serial")
    twin, recording = take
    with served(recording, tmp_path / "rig.toml", "serial") as rig:
        out = run(tmp_path / "run", RunOptions(source=f"hardware:{rig}", truth=recording / "truth.npz"))
    counts = json.loads((out / "record.json").read_text())["counts"]
    if counts["complete_sets"] == PULSES:
        same(twin, out)
    assert counts["complete_sets"] <= counts["frame_sets"] <= PULSES
    missing = counts["dropped"] + counts["corrupt"] + counts["late"]
    assert missing >= counts["frame_sets"] - counts["complete_sets"]


@contextmanager
def served(recording: Path, rig: Path, trigger: str) -> Iterator[Path]:
    """Serve the recording as GigE Vision cameras that ``trigger`` triggers."""
    command = [sys.executable, "-m", "scenarios.cli.main", "twin", "serve", str(recording), "--rig-out", str(rig)]
    command += ["--trigger", trigger, "--address", "127.0.0.40", "--seconds", "3600"]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as server:
        try:
            deadline = time.monotonic() + 600
            while not rig.exists():
                assert server.poll() is None
                assert time.monotonic() < deadline
                time.sleep(0.1)
            yield rig
        finally:
            server.terminate()


def test_a_vendor_s_own_software(take: tuple[Path, Path], tmp_path: Path) -> None:
    needs_module("pypylon.pylon", "pylon")
    twin, recording = take
    with open_recording(recording) as source:
        names = [info.name for info in source.cameras]
        for frame in source:
            assert frame.image is not None
            folder = tmp_path / frame.camera
            folder.mkdir(exist_ok=True)
            assert cv2.imwrite(
                str(folder / f"{round(frame.time_ns * RATE_HZ * 1e-9):04d}.tiff"), np.array(frame.image)
            )
    cameras: dict[str, dict[str, object]] = {
        name: {
            "driver": "pylon",
            "serial": f"0815-000{k}",
            "trigger": "Software",
            "window": [0, 0, 656, 491],
            "features": {"TestImageSelector": "Off", "ImageFileMode": "On", "ImageFilename": str(tmp_path / name)},
        }
        for k, name in enumerate(names)
    }
    trigger = {"source": "software"}
    rig = rig_file(tmp_path / "rig.toml", cameras, {"rate_hz": RATE_HZ, "trigger": trigger})
    for attempt in range(ATTEMPTS):
        if same_or_skipped(twin, tmp_path / f"run{attempt}", rig, recording):
            return
    pytest.skip(f"this machine was late at {RATE_HZ:g} Hz in all {ATTEMPTS} attempts, and each record states it")


def test_a_frame_of_another_pulse_makes_another_record(take: tuple[Path, Path], tmp_path: Path) -> None:
    """The control: a run with one frame replaced by its neighbour is not the same."""
    twin, recording = take
    with open_recording(recording) as source:
        names = [info.name for info in source.cameras]
        for frame in source:
            number = round(frame.time_ns * RATE_HZ * 1e-9)
            number = {20: 21, 21: 20}.get(number, number) if frame.camera == names[0] else number
            folder = tmp_path / "swapped" / frame.camera
            folder.mkdir(parents=True, exist_ok=True)
            assert frame.image is not None
            assert cv2.imwrite(str(folder / f"{number:04d}.png"), np.array(frame.image))
    lines = ["frame,camera,time_ns,exposure_ns,status"]
    lines += [f"{k},{name},{round(k * 1e9 / RATE_HZ)},1000000,ok" for k in range(PULSES) for name in names]
    (tmp_path / "swapped" / "frames.csv").write_text("\n".join(lines) + "\n")
    options = RunOptions(source=f"recording:{tmp_path / 'swapped'}", truth=recording / "truth.npz", page=False)
    other = run(tmp_path / "run", options)
    assert (other / "tracks.npz").read_bytes() != (twin / "tracks.npz").read_bytes()
