"""The tail of a recording: frames that waited when their writer was killed are read, moved, and never read twice."""

import os
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest

from mosca.data.frames import CameraInfo, Frame
from mosca.recording import RecordingWriter, open_recording
from mosca.recording.crash_buffer import TAIL_NAME, Tail, read_tail, rescued

CAMERAS = (CameraInfo("a", 16, 12, 8, 100.0), CameraInfo("b", 10, 9, 12, 100.0))

pytestmark = pytest.mark.skipif(not Path("/dev/shm").is_dir(), reason="this system has no /dev/shm")


def frame(camera, index, note=""):
    info = next(one for one in CAMERAS if one.name == camera)
    dtype = np.uint8 if info.bit_depth == 8 else np.uint16
    image = np.random.default_rng([ord(camera), index]).integers(0, 200, (info.height, info.width)).astype(dtype)
    if note:
        return Frame(camera, index, index * 10, 5, None, "corrupt", note=note)
    return Frame(camera, index, index * 10, 5, image)


def same(one, other):
    for name in ("camera", "index", "time_ns", "status", "note"):
        assert getattr(one, name) == getattr(other, name)
    assert getattr(one.image, "dtype", None) == getattr(other.image, "dtype", None)
    np.testing.assert_array_equal(one.image, other.image)


def test_frames_come_back_as_they_were_in_order_of_time(tmp_path):
    tail = Tail(CAMERAS, 1 << 20, tmp_path)
    put = [frame("b", 3), frame("a", 1), frame("a", 2, "spoilt, packets missing " * 20)]
    for number, one in enumerate(put):
        assert tail.put(one, 100 + number) == number
    kept = read_tail(tail.path, CAMERAS)
    assert [k.host_ns for k in kept] == [101, 102, 100]
    same(kept[0].frame, put[1])
    same(kept[2].frame, put[0])
    assert kept[1].frame.note == put[2].note[:248]
    tail.close()
    tail.close()
    assert list(tmp_path.iterdir()) == []
    assert tail.put(put[0], 1) is None


def test_a_slot_is_used_anew_and_a_full_tail_takes_no_more(tmp_path):
    tail = Tail(CAMERAS, 2 * 4096, tmp_path)
    assert [tail.put(frame("a", k), None) for k in range(3)] == [0, 1, None]
    tail.free(0)
    slot = tail.reserve(frame("a", 7).image)
    assert slot == 0
    assert [k.frame.index for k in read_tail(tail.path, CAMERAS)] == [1]  # not known yet whose image it is
    assert tail.put(frame("a", 7), 5, slot) == 0
    kept = read_tail(tail.path, CAMERAS)
    assert [(k.frame.index, k.host_ns) for k in kept] == [(1, None), (7, 5)]
    same(kept[1].frame, frame("a", 7))
    tail.close()


def test_a_tail_whose_writer_lives_is_left_alone(tmp_path, monkeypatch):
    tail = Tail(CAMERAS, 1 << 20, tmp_path)
    tail.put(frame("a", 1), 1)
    monkeypatch.setattr("mosca.recording.crash_buffer.MEMORY", tmp_path)
    assert rescued(tmp_path / "recording.mcap.part", tail.path, tail.token) is None
    assert tail.path.exists()
    tail.close()
    assert rescued(tmp_path / "recording.mcap.part", tail.path, tail.token) is None


KILLED = """
import os, signal, sys
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from test_recording_tail import CAMERAS, frame
from mosca.recording import RecordingWriter
writer = RecordingWriter(Path(sys.argv[1]), CAMERAS, tail_bytes=1 << 20)
for k in range(4):
    writer.write(frame("a", k)); writer.write(frame("b", k))
writer.keep(frame("a", 3), 3); writer.keep(frame("b", 4), 40); writer.keep(frame("a", 4), 41)
writer.flush()
writer.write(frame("a", 5))      # stays in the process
os.kill(os.getpid(), signal.SIGKILL)
"""


def killed(out):
    folder = str(Path(__file__).parent)
    subprocess.run([sys.executable, "-c", KILLED, str(out), folder], check=False, timeout=600)


@pytest.mark.parametrize("locked", [False, True])
def test_after_a_kill_what_waited_is_read_once_and_kept_beside_the_recording(tmp_path, locked, monkeypatch):
    out = tmp_path / "take"
    killed(out)
    if locked:  # the folder takes no file any more: it is read where it is

        def refuse(*_args, **_kwargs):
            raise OSError(28, "No space left on device")

        monkeypatch.setattr("mosca.recording.crash_buffer.whole_file", refuse)
    with open_recording(out) as recording:
        frames = list(recording)
        left = recording.waiting()
    assert [(f.camera, f.index) for f in frames] == [(c, k) for k in range(4) for c in "ab"] + [("b", 4), ("a", 4)]
    for one in frames:
        same(one, frame(one.camera, one.index))
    assert {k.host_ns for k in left} == {3, 40, 41}
    assert (out / TAIL_NAME).exists() != locked
    monkeypatch.undo()
    with open_recording(out) as recording:
        assert len(list(recording)) == 10
    assert (out / TAIL_NAME).exists()


def test_a_recording_that_ends_in_order_leaves_no_tail(tmp_path):
    before = set(Path("/dev/shm").glob("mosca-*"))
    with RecordingWriter(tmp_path / "take", CAMERAS, tail_bytes=1 << 20) as writer:
        writer.keep(frame("a", 0), 1)
        writer.write(frame("a", 0))
    assert sorted(os.listdir(tmp_path / "take")) == ["recording.mcap", "recording.toml"]
    with suppress(RuntimeError), RecordingWriter(tmp_path / "other", CAMERAS, tail_bytes=1 << 20) as writer:
        writer.keep(frame("a", 0), 1)
        writer.write(frame("a", 0))
        raise RuntimeError("body")
    assert os.listdir(tmp_path / "other") == ["recording.mcap.part"]
    assert set(Path("/dev/shm").glob("mosca-*")) <= before


@pytest.mark.parametrize("damage", [b"", b"mosca", b"\xff" * 9000, b"mosca\0t1" + b"\xff" * 9000])
def test_a_damaged_tail_gives_nothing(tmp_path, damage):
    path = tmp_path / "recording.tail"
    path.write_bytes(damage)
    assert read_tail(path, CAMERAS) == []


def test_damaged_slots_are_left_out(tmp_path):
    tail = Tail(CAMERAS, 1 << 20, tmp_path)
    for k in range(3):
        tail.put(frame("a", k), k)
    good = bytearray(tail.path.read_bytes())
    rng = np.random.default_rng(1)
    for _ in range(200):
        bad = bytearray(good)
        for at in rng.integers(0, 3 * 4096, 12):
            bad[int(at)] = int(rng.integers(0, 256))
        (tmp_path / "bad").write_bytes(bad)
        assert len(read_tail(tmp_path / "bad", CAMERAS)) <= 3
    tail.close()


def moved(folder):
    """Return the bytes of a tail of four frames as it is moved to the disk."""
    tail = Tail(CAMERAS, 1 << 20, folder)
    for k in range(4):
        tail.put(frame("a", k), k)
    tail.reserve(frame("a", 9).image)  # the writer died before it knew whose it was
    in_memory = folder / "mosca-memory.tail"
    in_memory.write_bytes(tail.path.read_bytes())
    tail.close()
    with patch("mosca.recording.crash_buffer.MEMORY", folder):
        beside = rescued(folder / "recording.mcap.part", in_memory, tail.token)
    return beside, bytearray(beside.read_bytes())


@pytest.mark.parametrize("kept", [0, 1, 3])
def test_frames_behind_the_cut_of_a_tail_are_told(tmp_path, kept):
    """Before, they were missing without a word."""
    path, good = moved(tmp_path)
    slot = (len(good) - 4096) // 4
    path.write_bytes(good[: 4096 + kept * slot + slot // 2])
    notes = []
    assert len(read_tail(path, CAMERAS, notes.append)) == kept
    assert f"cut short: {kept} of the 4 frames" in notes[0]


def test_no_changed_byte_of_a_tail_on_the_disk_is_read(tmp_path):
    path, good = moved(tmp_path)
    notes = []
    assert [one.frame.index for one in read_tail(path, CAMERAS, notes.append)] == [0, 1, 2, 3]
    assert notes == []
    size = (len(good) - 4096) // 4
    for at in (8, 16, 20, *(4096 + size + k for k in (0, 8, 12, 15, 20, 28, 40, 48, 320, 400))):
        bad = bytearray(good)
        bad[at] ^= 4
        path.write_bytes(bad)
        kept = read_tail(path, CAMERAS, notes.append)
        for one in kept:
            same(one.frame, frame("a", one.frame.index))
        assert len(kept) < 4, at
        assert len(notes) == 1, at
        assert "damaged" in notes.pop()


def test_a_tail_in_memory_has_checksums_of_what_is_known_of_a_frame(tmp_path):
    tail = Tail(CAMERAS, 1 << 20, tmp_path)
    tail.put(frame("a", 1), 1)
    data = bytearray(tail.path.read_bytes())
    tail.close()
    assert len(read_tail(written(tmp_path, data), CAMERAS)) == 1
    data[4096 + 48] ^= 1  # its time
    assert read_tail(written(tmp_path, data), CAMERAS) == []


def test_a_tail_of_an_older_version_is_read(tmp_path):
    path, data = moved(tmp_path)
    data[:8], data[24:44] = b"mosca\0t1", bytes(20)
    for k in range(4):
        begin = 4096 + k * (len(data) - 4096) // 4
        data[begin + 15], data[begin + 28 : begin + 32] = 0, bytes(4)
    path.write_bytes(data)
    assert [one.frame.index for one in read_tail(path, CAMERAS)] == [0, 1, 2, 3]


def written(folder, data):
    path = folder / "bent"
    path.write_bytes(data)
    return path


def test_a_recording_can_be_opened_before_its_first_frame(tmp_path):
    writer = RecordingWriter(tmp_path / "take", CAMERAS, "rig text", tail_bytes=1 << 20)
    with open_recording(tmp_path / "take") as recording:
        assert list(recording) == []
        assert [info.name for info in recording.cameras] == [info.name for info in CAMERAS]
        assert recording.rig_toml_text == "rig text"
        assert "its writer did not finish" in recording.notes[0]
    writer.close()


@pytest.mark.parametrize("made_before", [False, True])
def test_a_recording_that_never_began_leaves_nothing(tmp_path, made_before):
    if made_before:
        (tmp_path / "take").mkdir()
    with pytest.raises(RuntimeError), RecordingWriter(tmp_path / "take", CAMERAS, tail_bytes=1 << 20):
        raise RuntimeError("body")
    assert os.listdir(tmp_path) == (["take"] if made_before else [])
    with suppress(RuntimeError), RecordingWriter(tmp_path / "take", CAMERAS) as writer:
        writer.write_channel("notes", 0, {"a": 1})
        raise RuntimeError("body")
    assert os.listdir(tmp_path / "take") == ["recording.mcap.part"]
