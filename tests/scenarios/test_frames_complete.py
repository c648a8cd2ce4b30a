"""A continuous run of which a camera delivered less than it claims has not passed."""

from dataclasses import replace

import pytest
from command_line import mosca
from test_sets_complete import Lossy
from tiny_scenario import write_tiny

import scenarios.run.scenario as runner
from mosca.recording import open_recording
from reports.page import write_page
from scenarios.score.delivery import frames_of
from scenarios.spec.scenario import load_scenario
from scenarios.types import RunOptions
from twin.cameras.exposure.shutter import Timing

FREE = """[timing]
rate_hz = 100.0
[[camera]]
name = "cam2"
timing.offset_s = 0.0537
[[camera]]
name = "cam3"
timing.offset_s = 0.0013
timing.drift_ppm = -50.0
[continuous]
clocks = "common"
estimate = "known"
"""
LIMITS = "position_rms = 0.01\nreprojection_rms = 1.0"
# by hand: 0.4 s at 100 Hz; cam2 from 0.0537 s on, the last at 0.3937 s; cam3 at 99.995 Hz, the last at 0.39132 s
FRAMES = {"cam1": 40, "cam2": 35, "cam3": 40, "cam4": 40}


@pytest.fixture(scope="module")
def free(tmp_path_factory):
    folder = tmp_path_factory.mktemp("free")
    path = write_tiny(folder, duration_s=0.4, cameras=FREE, limits=LIMITS)
    assert mosca("run", path.name, "--record", "take", "--out", "twin", cwd=folder).returncode == 0
    return path


def result_of(path, monkeypatch, arrives=lambda _: True, change=lambda frame: frame, **limits):
    take = path.parent / "take"
    source = Lossy(open_recording(take), arrives)
    kept = type(source).__iter__
    monkeypatch.setattr(Lossy, "__iter__", lambda self: map(change, kept(self)))
    monkeypatch.setattr(runner, "check_named_source", lambda _: None)
    monkeypatch.setattr(runner, "opened_source", lambda *_: source)
    spec = load_scenario(path)
    spec = spec.model_copy(update={"limits": spec.limits | limits})
    return runner.run_scenario(
        spec, "tiny", path.parent, RunOptions(source="recording:take", truth=take / "truth.npz")
    )


def test_all_of_it_passes(free, monkeypatch):
    record = result_of(free, monkeypatch).record
    assert record.passed, record.verdict
    assert record.metric("sets_complete") is None
    assert {name: one["expected"] for name, one in record.cameras.items()} == FRAMES
    assert {name: one["arrived"] for name, one in record.cameras.items()} == FRAMES
    assert record.metric("frames_complete").value == 1.0
    assert record.counts["expected_frames"] == record.counts["frames"] == sum(FRAMES.values())


CUTS = {
    "dies": ("cam2", lambda f: f.index < 12, 12, 23, "0.11"),
    "dies early": ("cam4", lambda f: f.index < 12, 12, 28, "0.11"),
    "misses every third": ("cam3", lambda f: f.index % 3, 26, 14, "0.37"),
}


@pytest.mark.parametrize("cut", CUTS)
def test_a_camera_that_delivers_less_fails_and_is_named(free, monkeypatch, tmp_path, cut):
    camera, there, arrived, missing, last = CUTS[cut]
    result = result_of(free, monkeypatch, lambda f: f.camera != camera or there(f))
    record = result.record
    assert not record.passed
    words = f"camera {camera}: {missing} of {FRAMES[camera]} frames missing, the last {last} s after the first"
    assert record.verdict.startswith(f"broken: frames_complete; {words}")
    assert record.verdict.count("frames missing") == 1
    assert record.metric("frames_complete").value == pytest.approx(arrived / FRAMES[camera])
    assert record.cameras[camera]["complete"] == pytest.approx(arrived / FRAMES[camera])
    write_page(tmp_path / "report.html", record, result.evidence)
    page = (tmp_path / "report.html").read_text()
    assert words in page
    assert f"{arrived} of {FRAMES[camera]}" in page


def test_damaged_frames_have_not_arrived(free, monkeypatch):
    def damaged(frame):
        broken = frame.camera == "cam1" and frame.index in (20, 21)
        return replace(frame, image=None, status="corrupt") if broken else frame

    record = result_of(free, monkeypatch, change=damaged).record
    assert "camera cam1: 2 of 40 frames missing (2 corrupt)" in record.verdict
    assert not record.passed


def test_a_limit_of_the_scenario_counts_for_each_camera(free, monkeypatch):
    lost = lambda f: f.camera != "cam1" or f.index != 20  # noqa: E731
    assert not result_of(free, monkeypatch, lost, frames_complete=0.98).record.passed
    assert result_of(free, monkeypatch, lost, frames_complete=0.97).record.passed


def test_a_camera_that_runs_free_begins_when_it_likes(free, monkeypatch):
    # of a real one the scenario knows its rate, not its phase: one frame less is no loss, two are
    assert result_of(free, monkeypatch, lambda f: f.index > 0).record.passed
    assert not result_of(free, monkeypatch, lambda f: f.index > 1).record.passed


def test_losses_that_the_scenario_states_are_allowed_to_that_camera_alone(tmp_path):
    states = FREE.replace('"cam2"', '"cam2"\ndelivery.dies_s = 0.25\ndelivery.returns_s = 0.3')
    path = write_tiny(tmp_path, duration_s=0.4, cameras=states, limits=LIMITS)
    record = runner.run_scenario(load_scenario(path), "tiny", tmp_path).record
    assert record.passed, record.verdict
    metric = record.metric("frames_complete")
    # 5 of 35 frames lie in 50 ms; at the ends of the interval one each may be lost by rounding
    assert metric.value == pytest.approx(30 / 35)
    assert metric.limit == pytest.approx(1 - 0.05 / (0.4 - 0.0537) - 2 / 35)
    assert record.cameras["cam1"]["least"] == 1.0


def test_the_twin_takes_each_frame(tmp_path):
    states = FREE.replace('"cam3"', '"cam3"\ndelivery.dies_s = 0.2')
    path = write_tiny(tmp_path, duration_s=0.4, cameras=states, limits=f"{LIMITS}\nframes_complete = 0.9")
    record = runner.run_scenario(load_scenario(path), "tiny", tmp_path).record
    assert not record.passed
    assert "camera cam3: 20 of 40 frames missing" in record.verdict


def test_a_recording_longer_than_the_scenario_is_held_to_its_own_length(free, monkeypatch):
    spec = load_scenario(free, ("capture.duration_s=0.2",))
    for arrives, passed in ((lambda _: True, True), (lambda f: f.camera != "cam1" or f.index < 30, False)):
        take = Lossy(open_recording(free.parent / "take"), arrives)
        monkeypatch.setattr(runner, "check_named_source", lambda _: None)
        monkeypatch.setattr(runner, "opened_source", lambda *_, take=take: take)
        options = RunOptions(source="recording:take", truth=free.parent / "take/truth.npz")
        record = runner.run_scenario(spec, "tiny", free.parent, options).record
        assert record.passed == passed, record.verdict
    assert "camera cam1: 10 of 40 frames missing" in record.verdict


def test_frames_of_a_take_are_counted_as_by_hand():
    assert frames_of(Timing(), 40, 100.0) == 40
    assert frames_of(Timing(rate_hz=100.0), 40, 100.0) == 40
    assert frames_of(Timing(rate_hz=100.0, offset_s=0.0537), 40, 100.0) == 35
    assert frames_of(Timing(rate_hz=30.0, offset_s=-0.01), 100, 50.0) == 60  # the first at -0.01 s + 1/30 s
    assert frames_of(Timing(rate_hz=50.0, drift_ppm=50.0), 100, 50.0) == 101
