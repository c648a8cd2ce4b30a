"""An unfinished recording from elsewhere may name any file as its tail: only its own is read, moved or removed."""

import os
import subprocess
import sys
import tempfile
import zlib
from pathlib import Path

import pytest
from mcap.writer import CompressionType, Writer

from mosca.data.frames import CameraInfo, Frame
from mosca.errors import InputError
from mosca.recording import mcap_format as layout
from mosca.recording import open_recording
from mosca.recording.crash_buffer import LARGEST_TAIL, MEMORY, TAIL_NAME, Tail, read_tail

CAMERA = CameraInfo("a", 4, 3, 8, 100.0)
TOKEN = bytes(range(16))

pytestmark = pytest.mark.skipif(not MEMORY.is_dir(), reason="this system has no /dev/shm")


def unfinished(folder, tail, token=TOKEN):
    """Write a recording without frames that names ``tail``."""
    folder.mkdir()
    with (folder / "recording.mcap.part").open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE)
        writer.start(profile=layout.PROFILE, library="mosca")
        told = {"version": layout.VERSION, "tail": str(tail)} | ({"tail_token": token.hex()} if token else {})
        writer.add_metadata(layout.PROFILE, told)
        fields = {"width": "4", "height": "3", "bit_depth": "8", "frame_rate_hz": "100", "clock": "device"}
        writer.add_metadata("camera/a", fields | {"stamp_event": "exposure_start"})
        writer.finish()
    return folder


def tail_bytes(token=TOKEN, size=4096, used=1, magic=b"mosca\0t1"):
    head = magic + size.to_bytes(8, "little") + used.to_bytes(8, "little") + token
    return head.ljust(4096, b"\0") + bytes(4096)


@pytest.fixture
def in_memory():
    """Yield a path of a tail's name in /dev/shm; nothing is there afterwards."""
    file, name = tempfile.mkstemp(prefix="mosca-", suffix=".tail", dir=MEMORY)
    os.close(file)
    yield Path(name)
    Path(name).unlink(missing_ok=True)


def left_alone(folder, named, content):
    with open_recording(folder) as recording:
        assert list(recording) == []
    assert named.read_bytes() == content
    assert not os.path.lexists(folder / TAIL_NAME)


@pytest.mark.parametrize("content", [b"my thesis", tail_bytes()], ids=["document", "tail"])
def test_a_file_of_the_users_that_a_recording_names_is_left_alone(tmp_path, content):
    mine = tmp_path / "mosca-thesis.tail"
    mine.write_bytes(content)
    left_alone(unfinished(tmp_path / "take", mine), mine, content)
    detour = MEMORY / os.path.relpath(mine, MEMORY)
    left_alone(unfinished(tmp_path / "other", detour), mine, content)


@pytest.mark.parametrize(
    ("content", "token"),
    [
        (b"", TOKEN),
        (b"no tail", TOKEN),
        (tail_bytes(magic=b"mosca\0t0"), TOKEN),
        (tail_bytes(), TOKEN[::-1]),
        (tail_bytes(), None),
        (tail_bytes(), b"xyz"),
        (tail_bytes(size=1 << 60), TOKEN),
    ],
    ids=["empty", "short", "magic", "other recording", "no token", "short token", "slot of 2^60"],
)
def test_what_is_no_tail_of_this_recording_stays_in_memory(tmp_path, in_memory, content, token):
    in_memory.write_bytes(content)
    left_alone(unfinished(tmp_path / "take", in_memory, token), in_memory, content)


def test_a_link_in_memory_is_not_followed(tmp_path, in_memory):
    mine = tmp_path / "mine"
    mine.write_bytes(tail_bytes())
    in_memory.unlink()
    in_memory.symlink_to(mine)
    left_alone(unfinished(tmp_path / "take", in_memory), mine, tail_bytes())
    assert in_memory.is_symlink()


OPENED = """
import sys
from pathlib import Path
from mosca.errors import InputError
from mosca.recording import open_recording
try:
    with open_recording(Path(sys.argv[1])) as recording:
        print(len(list(recording)))
except InputError as error:
    print(error)
"""


def opened(folder):
    done = subprocess.run(
        [sys.executable, "-c", OPENED, str(folder)], capture_output=True, text=True, timeout=300, check=True
    )
    return done.stdout.strip()


def test_a_pipe_in_memory_does_not_hold_up(tmp_path, in_memory):
    in_memory.unlink()
    os.mkfifo(in_memory)
    assert opened(unfinished(tmp_path / "take", in_memory)) == "0"
    assert in_memory.is_fifo()


@pytest.mark.parametrize("kind", ["pipe", "link", "dangling link", "folder", "huge"])
def test_a_tail_beside_the_recording_that_is_no_regular_file_is_refused(tmp_path, kind):
    folder = unfinished(tmp_path / "take", MEMORY / "mosca-none.tail")
    tail, mine = folder / TAIL_NAME, tmp_path / "mine"
    mine.write_bytes(tail_bytes())
    match kind:
        case "pipe":
            os.mkfifo(tail)
        case "link":
            tail.symlink_to(mine)
        case "dangling link":
            tail.symlink_to(tmp_path / "none")
        case "folder":
            tail.mkdir()
        case "huge":
            with tail.open("wb") as file:
                file.truncate(1 << 40)
    if kind == "pipe":
        said = opened(folder)
    else:
        with pytest.raises(InputError) as caught, open_recording(folder) as recording:
            list(recording)
        said = str(caught.value)
    assert said.startswith(f"{tail}: the frames that waited cannot be read: ")
    assert "\n" not in said
    assert mine.read_bytes() == tail_bytes()
    assert os.path.lexists(tail)


def test_slots_are_counted_by_the_files_size_not_by_what_it_says(tmp_path, in_memory):
    tail = Tail((CAMERA,), 1 << 20, tmp_path)
    tail.put(Frame("a", 7, 70, 5, None, "corrupt", note="spoilt"), 1)
    content = bytearray(tail.path.read_bytes()[: 3 * 4096])
    token = tail.token
    tail.close()
    content[16:24] = (1 << 60).to_bytes(8, "little")
    content[40:44] = zlib.crc32(content[:40]).to_bytes(4, "little")
    (tmp_path / "tail").write_bytes(content)
    assert [kept.frame.index for kept in read_tail(tmp_path / "tail", (CAMERA,))] == [7]
    in_memory.write_bytes(content)
    folder = unfinished(tmp_path / "take", in_memory, token)
    with open_recording(folder) as recording:
        assert [frame.index for frame in recording] == [7]
    assert [kept.frame.index for kept in read_tail(folder / TAIL_NAME, (CAMERA,))] == [7]
    assert not in_memory.exists()


def test_a_tail_is_removed_only_when_its_copy_reads_back_as_it_was(tmp_path, in_memory, monkeypatch):
    in_memory.write_bytes(tail_bytes())
    folder = unfinished(tmp_path / "take", in_memory)
    synced = []
    monkeypatch.setattr(
        "mosca.recording.crash_buffer.hashlib.file_digest", lambda *_: type("", (), {"digest": bytes})
    )
    left_alone(folder, in_memory, tail_bytes())
    monkeypatch.undo()
    fsync = os.fsync
    monkeypatch.setattr(os, "fsync", lambda file: (synced.append(in_memory.exists()), fsync(file)))
    with open_recording(folder) as recording:
        assert list(recording) == []
    assert synced == [True, True]  # the file, then its name
    assert (folder / TAIL_NAME).read_bytes() == tail_bytes()
    assert not in_memory.exists()


def test_a_tail_is_never_larger_than_one_that_is_read(tmp_path):
    tail = Tail((CAMERA,), LARGEST_TAIL * 4, tmp_path)
    assert tail.path.stat().st_size <= LARGEST_TAIL + 4096
    tail.close()


def test_a_file_that_may_not_be_read_is_reported(tmp_path):
    with pytest.raises(InputError, match="the frames that waited cannot be read: No such file"):
        read_tail(tmp_path / "none", (CAMERA,))
