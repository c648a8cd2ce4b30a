"""The channel /clock of a capture: each pulse with its times, and how its frames were numbered."""

import time
from dataclasses import replace

import numpy as np
import pytest
from capture_rig import EXPOSURE_NS, Camera, Line, write_rig

from hardware.driver import Capabilities
from hardware.triggers.software import SoftwareTrigger
from mosca.data.frames import CameraInfo
from mosca.errors import InputError
from mosca.recording import RecordingWriter, open_recording
from scenarios.lab.capture import CaptureRequest, capture

SIZE = (64, 48)
NAMES = ("a", "b")
PERIOD_NS = 10_000_000
IMAGE = [np.zeros((SIZE[1], SIZE[0]), np.uint8)]


class Commanded(Camera):
    """Exposes on command and has no time stamps."""

    capabilities = Capabilities(software_trigger=True)

    def clock(self):
        return None

    def software_trigger(self):
        at_ns = time.monotonic_ns()
        self.commanded = [*getattr(self, "commanded", []), at_ns]
        self.frames.put((self.block, None, self.images[0]))
        self.block += 1
        return at_ns


class Stampless(Camera):
    """On the line, without time stamps; frames are here ``late_ns`` after their exposures."""

    late_ns = 0

    def clock(self):
        return None

    def grab(self, timeout_s):
        buffer = super().grab(timeout_s)
        if buffer is None:
            return None
        # blocks are pulses here
        host_ns = self.line.due_ns(buffer.block_id) + EXPOSURE_NS + self.late_ns
        return replace(buffer, device_ns=None, host_ns=host_ns)


class Slow(Stampless):
    """Slower than the others by more than half a period."""

    late_ns = 7_000_000


def taken(tmp_path, kinds, trigger=None, frames=60, told=""):
    """Capture with cameras of ``kinds`` (name -> class); return line, outcome and the recording's pulses.

    ``told``: a line of the rig file's ``[hardware]``.
    """
    rig, line = write_rig(tmp_path / "rig.toml", kinds, SIZE), Line()
    rig.write_text(rig.read_text().replace("[hardware]\n", f"[hardware]\n{told}\n", 1))
    outcome = capture(
        CaptureRequest(rig, tmp_path / "take", frames=frames),
        None,
        lambda name, settings: kinds[name](name, line, IMAGE, SIZE),
        trigger or (lambda rig, drivers: line),
    )
    with open_recording(tmp_path / "take") as recording:
        return line, outcome, recording.pulses(), list(recording), [d for _, d in recording.channel("account")]


def test_pulses_that_this_machine_sent_have_its_times(tmp_path):
    line, outcome, pulses, frames, account = taken(
        tmp_path, dict.fromkeys(NAMES, Commanded), lambda rig, drivers: SoftwareTrigger(drivers, 100.0)
    )
    times = {(f.camera, round(f.time_ns / PERIOD_NS)): f.time_ns for f in frames}
    begun = set()
    for one in pulses:
        assert one.nominal_ns == one.number * PERIOD_NS
        for name, how in one.found.items():
            (at_ns,) = [c for c in line.drivers[name].commanded if one.sent_ns <= c <= one.acknowledged_ns]
            late_ns = times[name, one.number] - one.nominal_ns
            assert (how, late_ns >= 0) == ("trigger", True)
            if late_ns < 0.44 * PERIOD_NS:  # a stamp is no later, whenever the command was carried out
                begun.add(at_ns - one.nominal_ns - late_ns)
    assert len(begun) == 1  # frames are stamped by their commands, from pulse 0 on
    there = {one.number for one in pulses if one.number < 60}
    assert set(times) == {(name, one.number) for one in pulses for name in one.found}
    assert outcome.skipped == account[-1]["skipped_pulses"] <= 60 - len(there)
    assert outcome.whole == (len(frames) == 120)


def test_pulses_from_elsewhere_have_the_numbers_alone(tmp_path):
    _, outcome, pulses, _, _ = taken(tmp_path, dict.fromkeys(NAMES, Camera))
    assert outcome.whole
    assert [one.number for one in pulses] == list(range(60))
    assert all((one.sent_ns, one.acknowledged_ns) == (None, None) for one in pulses)
    assert [one.nominal_ns for one in pulses] == [k * PERIOD_NS for k in range(60)]
    assert all(one.found == dict.fromkeys(NAMES, "clock") for one in pulses)


def test_how_each_camera_was_numbered_is_there_and_a_take_that_is_not_certain_is_not_whole(tmp_path):
    _, outcome, pulses, _, account = taken(tmp_path, {"a": Camera, "b": Stampless, "c": Slow})
    assert {how for one in pulses for name, how in one.found.items() if name == "b"} == {"count"}
    assert {how for one in pulses for name, how in one.found.items() if name == "c"} == {"arrival"}
    assert not outcome.whole
    assert outcome.cameras["a"].unproven == outcome.cameras["b"].unproven == 0
    assert outcome.cameras["c"].unproven > 50
    assert account[-1]["cameras"]["c"]["unproven"] == outcome.cameras["c"].unproven
    assert any(note.startswith("camera c: has no time stamps") for note in outcome.notes)


def test_a_take_whose_rig_accepts_what_is_not_certain_is_whole(tmp_path):
    _, outcome, _, _, _ = taken(tmp_path, {"a": Camera, "c": Slow}, told="accept_unproven = true")
    assert outcome.cameras["c"].unproven > 50
    assert outcome.whole == all(c.failed == c.dropped == 0 for c in outcome.cameras.values())


class NeverFires(Line):
    """Pulses from outside that nobody began."""

    def start(self):
        return None


def test_a_capture_whose_pulses_never_come_ends_and_is_not_whole(tmp_path):
    rig, line = write_rig(tmp_path / "rig.toml", NAMES, SIZE), NeverFires()
    rig.write_text(rig.read_text().replace("[hardware]\n", "[hardware]\nwait_s = 0.5\n", 1))
    opener = lambda name, settings: Camera(name, line, IMAGE, SIZE)  # noqa: E731
    request = CaptureRequest(rig, tmp_path / "take", frames=20)
    outcome = capture(request, None, opener, lambda rig, drivers: line)
    assert not outcome.whole
    assert {name: row.dropped for name, row in outcome.cameras.items()} == dict.fromkeys(NAMES, 20)
    assert any("no pulse came in 0.5 s" in note for note in outcome.notes)


def written(path, *messages):
    with RecordingWriter(path, [CameraInfo("a", *SIZE, 8, 100.0)]) as writer:
        for message in messages:
            writer.write_channel("clock", 0, message)
    return open_recording(path)


def test_recordings_from_before_open_and_have_no_pulses(tmp_path):
    with written(tmp_path / "none") as recording:
        assert recording.pulses() == ()
    older = {"host_ns": 5, "utc_ns": 6, "session_ns": 7, "cameras": {"a": {"index": [0], "host_ns": [3]}}}
    with written(tmp_path / "older", older, older) as recording:
        assert recording.pulses() == ()


@pytest.mark.parametrize(
    "message",
    [
        {"cameras": {"a": {"pulse": [1, 2], "found": ["clock"]}}},
        {"cameras": {}, "pulses": {"number": [1]}},
        {"cameras": {}, "pulses": {"number": ["x"], "nominal_ns": [1], "sent_ns": [1], "acknowledged_ns": [1]}},
        {"pulses": {}},
        {"cameras": {"a": [1]}},
    ],
)
def test_a_message_that_no_capture_writes_is_one_line(tmp_path, message):
    with written(tmp_path / "take", message) as recording, pytest.raises(InputError, match="channel /clock") as error:
        recording.pulses()
    assert "recording.mcap" in str(error.value)
    assert "\n" not in str(error.value)
