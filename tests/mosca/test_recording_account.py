"""What a recording states of itself: pulses that were triggered, frames that were written."""

import numpy as np
import pytest

from mosca.data.frames import CameraInfo, Frame
from mosca.errors import InputError
from mosca.recording import RecordingWriter, open_recording
from mosca.recording.account import recorded_account

CAMERAS = tuple(CameraInfo(name, 8, 6, 8, 100.0, "session", "exposure_start") for name in ("a", "b"))


def written(folder, *, finished, captured=None, clock=()):
    writer = RecordingWriter(folder, CAMERAS)
    for index in range(5):
        for info in CAMERAS[: 1 if index == 4 else 2]:
            writer.write(Frame(info.name, index, index * 10_000_000, 1000, np.zeros((6, 8), np.uint8)))
    for number in clock:
        stamps = {"a": {"pulse": [number], "found": ["trigger"]}}
        writer.write_channel("clock", number * 10_000_000, {"cameras": stamps})
    if captured is not None:
        writer.about["capture"] = {"pulses": captured}
    writer.flush()
    writer.close() if finished else writer.abandon()
    with open_recording(folder) as recording:
        return recording.account()


def test_a_capture_states_its_pulses_and_frames(tmp_path):
    account = written(tmp_path / "take", finished=True, captured=7, clock=(0, 1, 2))
    assert account == {"pulses": 7, "frames": {"a": 5, "b": 4}, "notes": []}


def test_a_recording_without_pulses_states_its_frames(tmp_path):
    assert written(tmp_path / "take", finished=True) == {"frames": {"a": 5, "b": 4}, "notes": []}


def test_the_pulses_of_a_killed_capture_are_those_of_its_clock(tmp_path):
    account = written(tmp_path / "take", finished=False, clock=(0, 1, 5))
    assert account["pulses"] == 6
    assert "frames" not in account


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("capture = 3", "capture = 3: a table is wanted"),
        ("[capture]\npulses = -1", "capture.pulses = -1: a count from 0 is wanted"),
        ("[capture]\npulses = 2.5", "capture.pulses = 2.5: a count from 0 is wanted"),
        ("camera = 3", "camera = 3: a table [[camera]] for each camera is wanted"),
        ('[[camera]]\nname = "a"\nframes = {ok = "x"}', "camera.frames.ok = 'x': a count from 0 is wanted"),
    ],
)
def test_what_is_no_count_is_refused(tmp_path, text, says):
    path = tmp_path / "recording.toml"
    path.write_text(text)
    with pytest.raises(InputError) as refused:
        recorded_account(path, ())
    assert says in str(refused.value)
    assert str(path) in str(refused.value)
