"""One changed byte of a recording: refused, or noted and never read as something else."""

from pathlib import Path

import numpy as np
import pytest

from mosca.data.frames import CameraInfo, Frame
from mosca.errors import InputError
from mosca.recording import McapRecording, RecordingWriter, mcap_format, open_recording

CAMERAS = (CameraInfo("left", 32, 24, 8, 100.0), CameraInfo("right", 32, 24, 8, 100.0))
RIG = "[[camera]]\nname = 'left'\n"


def picture(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (24, 32)).astype(np.uint8)


def recorded(folder: Path) -> bytearray:
    """Write frames k of both cameras, alike but for the pixels, and a command each; return the file's bytes."""
    with RecordingWriter(folder, CAMERAS, RIG) as writer:
        for k in range(5):
            for seed, camera in enumerate(CAMERAS):
                writer.write(Frame(camera.name, k, 10_000_000 * k, 0, picture(10 * seed + k)))
            writer.write_channel("commands", 10_000_000 * k, {"speed": 40 + k})
    return bytearray((folder / "recording.mcap").read_bytes())


def reopened(folder: Path, data: bytes) -> McapRecording:
    (folder / "recording.mcap").write_bytes(data)
    recording = open_recording(folder)
    assert isinstance(recording, McapRecording)
    return recording


def test_nothing_is_noted_where_nothing_is_wrong(tmp_path):
    with reopened(tmp_path, recorded(tmp_path)) as recording:
        assert len(list(recording)) == 10
        assert [told["speed"] for _, told in recording.channel("commands")] == [40, 41, 42, 43, 44]
        assert recording.rig_toml_text == RIG
        assert recording.notes == ()


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"100.0", b"500.0"),
        (b"camera/left", b"camera/lefx"),
        (b"camera/right", b"camerb/right"),
        (b"holds", b"folds"),
    ],
)
def test_what_it_says_of_itself_is_refused(tmp_path, old, new):
    data = recorded(tmp_path)
    at = data.index(old)
    data[at : at + len(old)] = new
    with pytest.raises(
        InputError, match=r"recording\.mcap: (what it says of .* checksum is wrong|describes 1 of its 2)"
    ):
        reopened(tmp_path, data)


def test_a_damaged_rig_file_is_left_out_and_noted(tmp_path):
    data = recorded(tmp_path)
    data[data.index(b"name = 'left'") + 8] = ord("L")
    with reopened(tmp_path, data) as recording:
        assert recording.rig_toml_text is None
        assert any("rig file inside is damaged" in note for note in recording.notes)


def test_a_command_with_another_digit_is_lost_and_noted(tmp_path):
    data = recorded(tmp_path)
    data[data.index(b'{"speed": 42}') + 10] = ord("9")
    with reopened(tmp_path, data) as recording:
        assert 92 not in [told["speed"] for _, told in recording.channel("commands")]
        assert any("what has no checksum of its own is lost" in note for note in recording.notes)


def test_a_frame_is_never_read_as_another_camera_s(tmp_path):
    """The checksum of a frame does not cover its channel, which stands before it."""
    data = recorded(tmp_path)
    changed = 0
    for at in range(len(data) - 2):
        # a message: opcode 5, length, channel, sequence
        if data[at] == 5 and data[at + 9 : at + 11] in (b"\1\0", b"\2\0") and data[at + 3 : at + 9] == bytes(6):
            bent = bytearray(data)
            bent[at + 9] = 3 - bent[at + 9]
            changed += 1
            with reopened(tmp_path, bent) as recording:
                for frame in recording:
                    seed = 10 * (frame.camera == "right") + frame.index
                    np.testing.assert_array_equal(frame.image, picture(seed))
                assert recording.notes
    assert changed >= 10


def test_messages_of_a_channel_that_is_not_described_are_noted(tmp_path):
    data = recorded(tmp_path)
    at = data.index(b"/camera/left/frame")
    data[at : at + 18] = b"/camera/lefx/frame"
    with reopened(tmp_path, data) as recording:
        assert {frame.camera for frame in recording} == {"right"}
        assert any("5 of the 10 messages of its cameras" in note for note in recording.notes)


def test_older_recordings_without_checksums_of_metadata_open(tmp_path, monkeypatch):
    def as_before(name: str, entries: dict[str, str]) -> dict[str, str]:
        return {key: one for key, one in entries.items() if key not in ("cameras", "rig_crc32")}

    monkeypatch.setattr(mcap_format, "sealed", as_before)
    with reopened(tmp_path, recorded(tmp_path)) as recording:
        assert len(list(recording)) == 10
        assert recording.notes == ()
        assert recording.rig_toml_text == RIG
