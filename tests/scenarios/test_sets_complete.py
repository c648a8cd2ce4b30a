"""A run that measured less than it claims has not passed: frames that end, cameras that die, pulses withheld."""

import json
import shutil
from dataclasses import replace

import pytest
from command_line import mosca
from tiny_scenario import write_tiny

import scenarios.run.scenario as runner
from mosca.data.frames import WrappedSource
from mosca.recording import open_recording
from scenarios.score.delivery import expected_share
from scenarios.spec.scenario import load_scenario
from scenarios.types import RunOptions
from twin.cameras.delivery import Delivery

PULSES = 30


class Lossy(WrappedSource):
    """A recording of which only the frames come that ``arrives`` lets pass."""

    def __init__(self, source, arrives):
        super().__init__(source)
        self._arrives = arrives

    def __iter__(self):
        return (frame for frame in self._source if self._arrives(frame))

    def account(self):
        return {"notes": ["the source's own words"]}


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tiny")
    path = write_tiny(folder, limits="position_rms = 0.01\nreprojection_rms = 1.0")
    assert mosca("run", path.name, "--record", "take", "--out", "twin", cwd=folder).returncode == 0
    return path


def record_of(path, arrives, monkeypatch, **limits):
    take = path.parent / "take"
    monkeypatch.setattr(runner, "check_named_source", lambda _: None)
    monkeypatch.setattr(runner, "opened_source", lambda *_: Lossy(open_recording(take), arrives))
    spec = load_scenario(path)
    spec = spec.model_copy(update={"limits": spec.limits | limits})
    options = RunOptions(source="recording:take", truth=take / "truth.npz")
    return runner.run_scenario(spec, "tiny", path.parent, options).record


def test_all_of_it_passes(tiny, monkeypatch):
    record = record_of(tiny, lambda _: True, monkeypatch)
    assert record.passed, record.verdict
    assert (record.metric("sets_complete").value, record.metric("sets_complete").limit) == (1.0, 1.0)
    assert (record.counts["expected_sets"], record.counts["complete_sets"]) == (PULSES, PULSES)


CUTS = {
    "killed rig": (lambda f: f.index < 12, 12, "12 of 30 pulses gave a complete set; frames ended after 12 pulses"),
    "killed camera": (lambda f: f.camera != "cam2" or f.index < 20, 20, "camera cam2: 10 frames missing"),
    "dead from the start": (lambda f: f.camera != "cam3", 0, "camera cam3: 30 frames missing, none came"),
    "withheld pulse": (lambda f: f.index != 7, 29, "camera cam1: 1 frames missing, the last at 0.29 s"),
    "one frame": (lambda f: (f.camera, f.index) != ("cam4", 15), 29, "camera cam4: 1 frames missing"),
}


@pytest.mark.parametrize("cut", CUTS)
def test_less_than_claimed_fails_and_says_what_lacks(tiny, monkeypatch, cut):
    arrives, complete, words = CUTS[cut]
    record = record_of(tiny, arrives, monkeypatch)
    assert not record.passed
    assert "sets_complete" in record.verdict
    assert words in record.verdict
    assert record.metric("sets_complete").value == pytest.approx(complete / PULSES)
    assert record.source_account["notes"] == ["the source's own words"]
    for name, camera in record.cameras.items():
        assert camera["delivered"] == PULSES - sum(
            not arrives(f) for f in open_recording(tiny.parent / "take") if f.camera == name
        )


def test_a_loss_that_the_scenario_allows_passes(tiny, monkeypatch):
    assert record_of(tiny, CUTS["one frame"][0], monkeypatch, sets_complete=0.9).passed


def test_a_recording_shorter_than_the_scenario_fails(tiny):
    words = ("run", tiny.name, "--source", "recording:take", "--truth", "take/truth.npz", "--out", "short")
    done = mosca(*words, "--set", "capture.duration_s=0.6", cwd=tiny.parent)
    assert done.returncode == 1
    assert "frames ended after 30 pulses" in done.stdout


def test_losses_that_a_scenario_states_are_not_expected():
    none, dead = Delivery(), Delivery(dies_s=3.0)
    assert expected_share({"a": none, "b": none}, 1000, 10.0) == 1.0
    assert expected_share({"a": none, "b": dead}, 1000, 10.0) == pytest.approx(0.3, abs=0.003)
    assert expected_share({"a": replace(dead, returns_s=5.0)}, 1000, 10.0) == pytest.approx(0.8, abs=0.003)
    # two cameras that lose a tenth of their frames: 0.81, less four standard deviations of a binomial share
    lossy = Delivery(dropped_share=0.1)
    assert expected_share({"a": lossy, "b": lossy}, 10_000, 100.0) == pytest.approx(0.81 - 4 * 0.00392, abs=1e-4)
    # bursts of 25 are 25 times fewer events
    burst = Delivery(burst_share=0.1, burst_frames=25)
    assert expected_share({"a": burst}, 10_000, 100.0) == pytest.approx(0.9 - 4 * 0.015, abs=1e-4)


def test_a_recording_longer_than_the_scenario_is_held_to_its_own_length(tiny, monkeypatch):
    take = tiny.parent / "take"
    options = RunOptions(source="recording:take", truth=take / "truth.npz")
    spec = load_scenario(tiny, ("capture.duration_s=0.2",))
    verdicts = []
    for arrives in (lambda _: True, lambda f: f.camera != "cam2" or f.index < 25):
        source = Lossy(open_recording(take), arrives)
        monkeypatch.setattr(runner, "check_named_source", lambda _: None)
        monkeypatch.setattr(runner, "opened_source", lambda *_, source=source: source)
        record = runner.run_scenario(spec, "tiny", tiny.parent, options).record
        assert record.counts["expected_sets"] == PULSES
        verdicts.append((record.passed, record.verdict))
    assert verdicts[0][0]
    assert not verdicts[1][0]
    assert "25 of 30 pulses gave a complete set" in verdicts[1][1]


def test_a_recording_is_held_to_the_pulses_that_its_capture_triggered(tiny, tmp_path):
    whole = shutil.copytree(tiny.parent / "take", tmp_path / "take")
    shutil.copy(tiny, tmp_path)
    words = ("run", tiny.name, "--source", "recording:take", "--truth", "take/truth.npz")
    told = whole / "recording.toml"
    text = told.read_text()
    for pulses, code in ((PULSES, 0), (PULSES + 2, 1)):
        told.write_text(f"{text}\n[capture]\npulses = {pulses}\n")
        done = mosca(*words, "--out", f"of{pulses}", cwd=tmp_path)
        assert done.returncode == code, done.stdout
    assert "30 of 32 pulses gave a complete set; frames ended after 30 pulses" in done.stdout
    record = json.loads((tmp_path / "of32" / "record.json").read_text())
    assert record["source_account"]["pulses"] == PULSES + 2
    assert record["source_account"]["frames"] == {f"cam{k}": PULSES for k in (1, 2, 3, 4)}
    told.write_text(f"{text}\n[capture]\npulses = true\n")
    done = mosca(*words, "--out", "bad", cwd=tmp_path)
    assert done.returncode == 2
    assert "recording.toml: capture.pulses = True: a count from 0 is wanted" in done.stderr
    assert not (tmp_path / "bad").exists()
