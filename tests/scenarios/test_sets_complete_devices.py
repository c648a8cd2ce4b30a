"""What did not arrive does not pass: rigs and cameras that die, and pulses that reach no camera."""

import json
from dataclasses import replace

import pytest
from capture_rig import EXPOSURE_NS, Camera, Line, openers, write_rig
from tiny_scenario import write_tiny

from hardware.settings import read_hardware
from hardware.source import HardwareSource
from mosca.recording import open_recording
from reports.record import write_record
from scenarios.run import scenario as work
from scenarios.run.folder import write_run
from scenarios.spec.scenario import load_scenario
from scenarios.types import RunOptions

PULSES = 40
SIZE = (320, 240)
# judged without a truth, and met by any machine
MET = "frame_rate = 0.001"


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    """Camera -> images of the twin, pulse by pulse."""
    folder = tmp_path_factory.mktemp("filmed")
    spec = load_scenario(write_tiny(folder, duration_s=PULSES / 100))
    work.run_scenario(spec, "tiny", folder, RunOptions(record_to=folder / "take"))
    images = {}
    with open_recording(folder / "take") as source:
        for frame in source:
            images.setdefault(frame.camera, []).append(frame.image)
    return images


def judged(folder, monkeypatch, filmed, line, limits=MET, hardware="", kinds=None):
    """Return the record, as its file has it, and the result of a run of simulated devices.

    ``hardware``: a key of [hardware].
    """
    path = write_rig(folder / "rig.toml", tuple(filmed), SIZE)
    path.write_text(path.read_text().replace("[hardware]\n", f"[hardware]\n{hardware}\n", 1))
    rig = read_hardware(path)
    opener, trigger = openers(line, filmed, SIZE)

    def opened(name, settings):
        kind = (kinds or {}).get(name)
        return opener(name, settings) if kind is None else kind(name, line, filmed[name], SIZE)

    fakes = opened, trigger
    monkeypatch.setattr(work, "check_named_source", lambda _: None)
    monkeypatch.setattr(work, "opened_source", lambda *given: HardwareSource(rig, PULSES, *fakes))
    spec = load_scenario(write_tiny(folder, duration_s=PULSES / 100, limits=limits))
    result = work.run_scenario(spec, "tiny", folder, RunOptions(source="hardware:rig.toml"))
    write_record(result.record, folder / "record.json")
    return json.loads((folder / "record.json").read_text()), result


def page_of(result, folder):
    """Return the page of a run, and write its folder."""
    write_run(result, folder / "out")
    return (folder / "out" / "report.html").read_text()


def test_a_rig_that_delivers_everything_passes(tmp_path, monkeypatch, filmed):
    record, _ = judged(tmp_path, monkeypatch, filmed, Line())
    assert record["passed"]
    assert record["verdict"].startswith("every limit is met")
    assert record["counts"]["complete_sets"] == record["counts"]["expected_sets"] == PULSES
    assert all(one["whole"] >= PULSES for one in record["source_account"]["cameras"].values())


def test_a_killed_rig_has_not_passed(tmp_path, monkeypatch, filmed):
    record, result = judged(tmp_path, monkeypatch, filmed, Line(gone_at=19))
    assert not record["passed"]
    assert record["verdict"].startswith("broken: sets_complete; 20 of 40 pulses gave a complete set; frames ended")
    assert "camera cam1: 20 frames missing, the last at 0.19 s" in record["verdict"]
    assert "20 of 40 pulses gave a complete set" in page_of(result, tmp_path)


def test_a_killed_camera_has_not_passed(tmp_path, monkeypatch, filmed):
    line = Line(misses={"cam2": range(25, 1000)})
    record, _ = judged(tmp_path, monkeypatch, filmed, line)
    assert not record["passed"]
    words = "25 of 40 pulses gave a complete set; camera cam2: 15 frames missing, the last at 0.24 s"
    assert record["verdict"].startswith(f"broken: sets_complete; {words}")


class NeverFires(Line):
    """Pulses from outside that nobody began."""

    def start(self):
        return None


def test_a_rig_whose_pulses_never_come_has_not_passed(tmp_path, monkeypatch, filmed):
    record, result = judged(tmp_path, monkeypatch, filmed, NeverFires(), hardware="wait_s = 0.5")
    assert not record["passed"]
    assert record["verdict"].startswith("broken: sets_complete")
    assert "0 of 40 pulses gave a complete set; frames ended after 0 pulses" in record["verdict"]
    assert any("no pulse came in 0.5 s" in note for note in record["counts"]["notes"].values())
    assert "0 of 40 pulses gave a complete set" in page_of(result, tmp_path)


class Stampless(Camera):
    """Without time stamps, and slower than the others by 0.7 of a period: its pulses are not certain."""

    def clock(self):
        return None

    def grab(self, timeout_s):
        buffer = super().grab(timeout_s)
        if buffer is None:
            return None
        # blocks are pulses here
        return replace(buffer, device_ns=None, host_ns=self.line.due_ns(buffer.block_id) + EXPOSURE_NS + 7_000_000)


def test_frames_of_uncertain_pulses_have_not_passed_unless_the_rig_accepts_them(tmp_path, monkeypatch, filmed):
    kinds = {"cam4": Stampless}
    record, _ = judged(tmp_path, monkeypatch, filmed, Line(), kinds=kinds)
    assert not record["passed"]
    assert "0 of 40 pulses gave a complete set" in record["verdict"]
    # by its arrivals its first frame is of pulse 1
    assert "camera cam4: 39 frames whose pulses or times are not certain" in record["verdict"]
    assert record["cameras"]["cam4"]["delivered"] == record["cameras"]["cam4"]["unproven"] == PULSES - 1
    limits = f"{MET}\nsets_complete = 0.9"
    accepts = "accept_unproven = true"
    record, _ = judged(tmp_path, monkeypatch, filmed, Line(), limits, hardware=accepts, kinds=kinds)
    assert record["passed"], record["verdict"]
    assert record["source_account"]["cameras"]["cam4"]["unproven"] >= PULSES - 1
    assert "of camera 'cam4'" in record["counts"]["notes"]["unproven"]


def test_withheld_pulses_have_not_passed_unless_the_scenario_says_so(tmp_path, monkeypatch, filmed):
    misses = {name: {17, 18, 30} for name in filmed}
    record, _ = judged(tmp_path, monkeypatch, filmed, Line(misses=misses))
    assert not record["passed"]
    assert "37 of 40 pulses gave a complete set" in record["verdict"]
    record, _ = judged(tmp_path, monkeypatch, filmed, Line(misses=misses), f"{MET}\nsets_complete = 0.9")
    assert record["passed"]
