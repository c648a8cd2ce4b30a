"""The live view of a capture: into a file, through the viewer's pipe, and never at the capture's expense."""

import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from capture_rig import Line, ctrl_c, openers, write_rig
from command_line import refusal
from test_capture_detections import NAMES, RATE, SIZE, picture, rig_file

from mosca.data.files.rig_file import read_rig
from mosca.data.frames import CameraInfo, Frame
from mosca.data.tracks import Samples
from mosca.errors import InputError
from mosca.pipeline import PipelineSettings
from reports import viewer_process, viewer_program
from reports.viewer import RerunLog
from reports.viewer_process import log_in_viewer
from scenarios.commands.live_skeleton import LiveShow
from scenarios.commands.live_sources import LiveOptions
from scenarios.lab.capture import CaptureRequest, capture
from scenarios.lab.live_view import LiveView, uncalibrated

pytest.importorskip("rerun", reason="rerun is not installed: pip install rerun-sdk")
RERUN = str(Path(sys.executable).parent / "rerun")


def statistics(path):
    """Return entity -> chunks of an .rrd file, as rerun's own program counts them."""
    done = subprocess.run([RERUN, "rrd", "stats", str(path)], capture_output=True, text=True, check=True)
    lines = done.stdout.split("Num chunks per entity")[1].split("Num chunks per index")[0].splitlines()
    return {name: int(n) for name, _, n in (line.rpartition(": ") for line in lines) if n.isdigit()}


def captured(tmp_path, calibrated, progress=None, frames=60):
    path = rig_file(tmp_path, calibrated)
    rig = read_rig(rig_file(tmp_path)) if calibrated else None
    if rig is None:
        images = {name: [np.full((SIZE[1], SIZE[0]), 5, np.uint8)] for name in NAMES}
    else:
        images = {camera.name: [picture(camera, pulse) for pulse in range(20)] for camera in rig.cameras}
    request = CaptureRequest(path, tmp_path / "take", frames=frames, view_log=tmp_path / "view.rrd")
    return capture(request, progress, *openers(Line(RATE), images, SIZE))


@pytest.fixture
def until_shown(monkeypatch):
    """Return a progress callback that ends the capture once three frame sets were shown, however long it takes."""
    shown, log_step = [], RerunLog.log_step

    def counted(self, frame, *rest):
        log_step(self, frame, *rest)
        shown.append(frame)

    monkeypatch.setattr(RerunLog, "log_step", counted)
    return ctrl_c(lambda: len(shown) >= 3)


def test_cameras_detections_and_points_are_shown(tmp_path, until_shown):
    start = time.monotonic()
    outcome = captured(tmp_path, True, until_shown, frames=None)
    assert outcome.whole
    assert 3 <= outcome.shown <= 2 + 10 * (time.monotonic() - start)
    shown = statistics(tmp_path / "view.rrd")
    assert shown["/world/points"] >= 1
    for name in NAMES:
        assert shown[f"/world/cameras/{name}/image"] >= 1
        assert shown[f"/world/cameras/{name}/image/detections"] >= 1


def test_a_rig_without_calibration_shows_images_alone(tmp_path, until_shown):
    outcome = captured(tmp_path, False, until_shown, frames=None)
    assert outcome.whole
    assert outcome.shown >= 3
    shown = statistics(tmp_path / "view.rrd")
    assert "/world/points" not in shown
    assert shown["/world/cameras/top/image"] >= 1


def test_the_viewer_reads_the_log_from_a_pipe_while_it_grows(tmp_path):
    if shutil.which(RERUN) is None:
        pytest.skip("the program 'rerun' is not beside this Python")
    saved = tmp_path / "seen.rrd"
    rig = uncalibrated([CameraInfo(name, *SIZE, 8, RATE) for name in NAMES])
    with log_in_viewer(rig, ("--port", "auto", "--bind", "127.0.0.1", "--save", str(saved))) as log:
        for frame in range(3):
            log.log_step(frame, frame * 10_000_000, {n: np.zeros((SIZE[1], SIZE[0]), np.uint8) for n in NAMES})
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline:  # the viewer ends a moment after the log, then the file is whole
        time.sleep(0.2)
        try:
            shown = statistics(saved)
        except (subprocess.CalledProcessError, IndexError):
            continue
        if len([name for name in shown if name.endswith("/image")]) == len(NAMES):
            return
    raise AssertionError("the viewer did not get the images")


def test_a_viewer_that_cannot_start_is_one_line(monkeypatch):
    rig = uncalibrated([CameraInfo("a", *SIZE, 8, RATE)])
    # the time that a viewer is given to end: until it has, on however slow a machine
    monkeypatch.setattr(viewer_process, "VIEWER_STARTS_S", 120.0)
    with pytest.raises(InputError, match="ended at once; is there a display"):
        log_in_viewer(rig, ("--no-such-option",))
    monkeypatch.setattr(viewer_program.sys, "executable", "/nowhere/python")
    monkeypatch.setattr(viewer_program.shutil, "which", lambda name: None)
    with pytest.raises(InputError, match="pip install rerun-sdk"):
        log_in_viewer(rig)


@pytest.mark.parametrize("verb", ["live any_source --view", "capture --rig rig.toml --out take --view"])
def test_without_a_display_there_is_no_view(tmp_path, monkeypatch, verb):
    """The viewer takes longer to find out than it is waited for; without it the run would go on unseen."""
    if not Path(RERUN).is_file():
        pytest.skip("the program 'rerun' is not beside this Python")
    write_rig(tmp_path / "rig.toml", ("only",), SIZE, RATE)
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(viewer_program.sys, "platform", "linux")
    assert "--view: there is no display for a window; " in refusal(*verb.split(), cwd=tmp_path)


def test_a_viewer_that_is_closed_is_told_and_the_run_goes_on(tmp_path, monkeypatch):
    program = tmp_path / "viewer"
    program.write_text("#!/bin/sh\nexec cat > /dev/null\n")
    program.chmod(0o755)
    monkeypatch.setattr(viewer_process, "viewer_program", lambda wanted_by: str(program))
    monkeypatch.setattr("scenarios.commands.live_skeleton.SHOWN_HZ", 1e9)
    rig = uncalibrated([CameraInfo("a", *SIZE, 8, RATE)])
    with ExitStack() as stack:
        show = LiveShow(LiveOptions("", view=True), rig, stack)
        show.show(0, 0, Samples.none(), [])
        assert show.finish() == []
        (log,) = show.logs
        os.kill(log.viewer, signal.SIGTERM)
        while not log.ended:
            time.sleep(0.01)
        for frame in (1, 2):
            show.show(frame, frame, Samples.none(), [])
        (told,) = show.finish()
    # closing has not waited for a viewer that is gone
    assert told == "view: ended early at frame set 1 (the viewer was closed, or could not open its window)"


class SlowLog:
    """A log that takes its time, or breaks."""

    def __init__(self, seconds=0.0, error=None):
        self.seconds, self.error, self.steps = seconds, error, []

    def log_step(self, frame, *rest):
        self.steps.append(frame)
        time.sleep(self.seconds)
        if self.error is not None:
            raise self.error

    def __enter__(self):
        return self

    def __exit__(self, *exc):
        pass


@pytest.mark.parametrize("log", [SlowLog(0.4), SlowLog(0.0, RuntimeError("no space"))])
def test_a_slow_or_broken_view_costs_the_capture_nothing(tmp_path, monkeypatch, log):
    monkeypatch.setattr("reports.viewer.RerunLog", lambda path, rig: log)
    start = time.monotonic()
    outcome = captured(tmp_path, False)
    assert outcome.whole
    # it rests as long as it worked
    assert 1 <= len(log.steps) <= 2 + (time.monotonic() - start) / 0.8
    assert sum("view: ended early (no space)" in note for note in outcome.notes) == (log.error is not None)


def test_nothing_is_shown_while_the_recording_is_behind():
    cameras = [CameraInfo("a", 4, 4, 8, RATE)]
    behind = [0.5]
    log = SlowLog()
    view = LiveView(log, cameras, None, PipelineSettings(), lambda: behind[0])
    frame = partial(Frame, "a", exposure_ns=0, image=np.zeros((4, 4), np.uint8))
    for pulse in range(5):
        view.offer(frame(index=pulse, time_ns=pulse * 20_000_000))
    time.sleep(0.1)
    assert log.steps == []
    behind[0] = 0.0
    view.offer(frame(index=5, time_ns=100_000_000))
    deadline = time.monotonic() + 60
    while not log.steps and time.monotonic() < deadline:
        time.sleep(0.01)
    view.close()
    view.close()
    assert log.steps == [5]


def test_a_rig_file_of_names_alone_is_enough_to_look(tmp_path):
    path = write_rig(tmp_path / "rig.toml", ("only",), SIZE, RATE)
    images = {"only": [np.zeros((SIZE[1], SIZE[0]), np.uint8)]}
    request = CaptureRequest(path, tmp_path / "take", frames=10, view_log=tmp_path / "view.rrd")
    assert capture(request, None, *openers(Line(RATE), images, SIZE)).whole
