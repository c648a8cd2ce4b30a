"""``recording.mcap``: what is written is read, also after a kill, a cut or a flipped bit."""

import json
import os
import signal
import struct
import subprocess
import sys
import tomllib
import zlib
from pathlib import Path

import blosc2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from mosca.data.frames import CameraInfo, Frame
from mosca.data.rig import Camera, OpenCVLens, Pose, Rig
from mosca.errors import InputError
from mosca.recording import McapRecording, RecordingWriter, open_recording

QUIET = settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
CAMERAS = (CameraInfo("left", 32, 24, 8, 100.0, "device", "exposure_middle"), CameraInfo("right", 32, 24, 12, 100.0))


def picture(seed: int, deep: bool) -> np.ndarray:
    image = np.random.default_rng(seed).integers(0, 4096 if deep else 256, (24, 32))
    return image.astype(np.uint16 if deep else np.uint8)


def frames(n: int) -> list[Frame]:
    made = []
    for k in range(n):
        made.append(Frame("left", k, 10_000_000 * k - 3, 700, picture(k, False), "ok", "exposure_middle", 11))
        if k % 5 == 3:
            made.append(Frame("right", k, 10_000_000 * k, 0, None, "dropped", note="buffer full"))
        elif k % 5 == 4:
            made.append(Frame("right", k, 10_000_000 * k, 0, None, "corrupt", note="ümlaut"))
        else:
            doubt = "its time is known to 1.6 ms" if k % 5 == 2 else ""
            made.append(Frame("right", k, 10_000_000 * k, 500, picture(1000 + k, True), note=doubt))
    return made


def write(folder: Path, n: int, codec: str = "lz4") -> list[Frame]:
    made = frames(n)
    with RecordingWriter(folder, CAMERAS, "[[camera]]\n", codec) as writer:
        for k, frame in enumerate(made):
            writer.write(frame, host_time_ns=5_000_000_000 + k)
        writer.write_channel("commands", 20, {"thrust": [1.5, 2]})
        writer.write_channel("imu", 30, b"\x00\x01")
        writer.write_channel("commands", 40, {"thrust": []})
    return made


def check_equal(read: list[Frame], written: list[Frame]) -> None:
    assert len(read) == len(written)
    for a, b in zip(read, written, strict=True):
        for name in ("camera", "index", "time_ns", "exposure_ns", "status", "stamp_event", "row_time_ns", "note"):
            assert getattr(a, name) == getattr(b, name)
        assert getattr(a.image, "dtype", None) == getattr(b.image, "dtype", None)
        np.testing.assert_array_equal(a.image, b.image)


@pytest.mark.parametrize("codec", ["lz4", "zstd"])
def test_round_trip(tmp_path: Path, codec: str) -> None:
    written = write(tmp_path / "new" / "rec", 12, codec)
    with open_recording(tmp_path / "new" / "rec") as recording:
        assert isinstance(recording, McapRecording)
        assert recording.cameras == CAMERAS
        assert recording.n_frames == 24
        assert recording.rig_toml_text == "[[camera]]\n"
        check_equal(list(recording), written)
        assert list(recording.channel("commands")) == [(20, {"thrust": [1.5, 2]}), (40, {"thrust": []})]
        assert list(recording.channel("imu")) == [(30, b"\x00\x01")]
        assert recording.notes == ()
    assert sorted(p.name for p in (tmp_path / "new" / "rec").iterdir()) == ["recording.mcap", "recording.toml"]


def test_toml_for_people(tmp_path: Path) -> None:
    write(tmp_path, 10)
    text = (tmp_path / "recording.toml").read_text(encoding="utf-8")
    document = tomllib.loads(text)
    assert document["version"] == 1
    assert document["duration_s"] == pytest.approx(0.090000003)
    assert document["camera"][1]["frames"] == {"ok": 6, "dropped": 2, "corrupt": 2}
    assert document["channel"] == [{"name": "commands", "messages": 2}, {"name": "imu", "messages": 1}]
    assert "mosca.frame.v1" in text


def test_others_can_read_it_by_the_documented_layout(tmp_path: Path) -> None:
    """Read with the mcap package and the layout as documented, without the project's reader."""
    written = [f for f in write(tmp_path, 10) if f.camera == "right"]
    found = []
    with open(tmp_path / "recording.mcap", "rb") as file:
        reader = make_reader(file)
        assert reader.get_header().profile == "mosca-recording"
        assert {m.name for m in reader.iter_metadata()} == {"mosca-recording", "camera/left", "camera/right"}
        assert [a.name for a in reader.iter_attachments()] == ["rig.toml"]
        for schema, channel, message in reader.iter_messages(topics=["/camera/right/frame"], log_time_order=False):
            assert (schema.name, channel.message_encoding) == ("mosca.frame.v1", "mosca.frame.v1")
            found.append(message)
        commands = [json.loads(m.data) for _, _, m in reader.iter_messages(topics=["/commands"])]
    assert commands == [{"thrust": [1.5, 2]}, {"thrust": []}]
    assert len(found) == len(written)
    for k, (message, frame) in enumerate(zip(found, written, strict=True)):
        data = message.data
        header_sum, payload_sum, status, _, pixel, _, height, width = struct.unpack_from("<IIBBBBII", data)
        index, time_ns, exposure_ns, row_ns, n_note = struct.unpack_from("<qqqqI", data, 20)
        assert zlib.crc32(data[8 : 56 + n_note]) == header_sum
        payload = data[56 + n_note :]
        assert zlib.crc32(payload) == payload_sum
        assert (index, time_ns, exposure_ns, row_ns) == (frame.index, frame.time_ns, frame.exposure_ns, 0)
        assert (message.log_time, message.publish_time) == (frame.time_ns, 5_000_000_000 + 2 * k + 1)
        assert ("ok", "dropped", "corrupt")[status] == frame.status
        if frame.image is not None:
            assert (height, width, pixel) == (24, 32, 2)
            pixels = np.frombuffer(blosc2.decompress2(payload), "<u2").reshape(24, 32)
            np.testing.assert_array_equal(pixels, frame.image)


def rig_of(*names: str, width: int = 32) -> Rig:
    lens = OpenCVLens(100, 100, 16, 12)
    return Rig(tuple(Camera(name, width, 24, lens, Pose(np.eye(3), np.zeros(3))) for name in names))


def test_a_rig_chooses_and_orders_the_cameras(tmp_path: Path) -> None:
    write(tmp_path, 5)
    with open_recording(tmp_path, rig_of("right")) as recording:
        assert [info.name for info in recording.cameras] == ["right"]
        assert {f.camera for f in recording} == {"right"}
    with pytest.raises(InputError, match="no camera 'top' of the rig; it has left, right"):
        open_recording(tmp_path, rig_of("top"))
    with pytest.raises(InputError, match="32x24 px, but the rig's camera 'left' is 64x24"):
        open_recording(tmp_path, rig_of("left", width=64))


def test_nothing_is_overwritten(tmp_path: Path) -> None:
    write(tmp_path, 2)
    before = (tmp_path / "recording.mcap").read_bytes()
    with pytest.raises(InputError, match=r"holds a recording already \(recording\.mcap\)"):
        RecordingWriter(tmp_path, CAMERAS)
    assert (tmp_path / "recording.mcap").read_bytes() == before
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be written"):
        RecordingWriter(tmp_path / "file" / "rec", CAMERAS)


def test_frames_that_were_not_announced_are_refused(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path, CAMERAS) as writer:
        with pytest.raises(ValueError, match="camera 'top'; announced are left, right"):
            writer.write(Frame("top", 0, 0, 0, picture(0, False)))
        with pytest.raises(ValueError, match=r"\(24, 32\) announced"):
            writer.write(Frame("left", 0, 0, 0, np.zeros((5, 5), np.uint8)))
        with pytest.raises(ValueError, match="are for frames"):
            writer.write_channel("camera/left/frame", 0, b"")


def interrupted(folder: Path) -> None:
    with RecordingWriter(folder, CAMERAS) as writer:
        for frame in frames(6):
            writer.write(frame)
        raise KeyboardInterrupt


def test_an_interrupted_recording_is_readable_and_does_not_look_whole(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        interrupted(tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["recording.mcap.part"]
    with open_recording(tmp_path) as recording:
        assert "its writer did not finish" in recording.notes[0]
        check_equal(list(recording), frames(6))
    with pytest.raises(InputError, match=r"holds a recording already \(recording\.mcap\.part\)"):
        RecordingWriter(tmp_path, CAMERAS)


KILLED = """
import sys, numpy as np
from pathlib import Path
from mosca.data.frames import CameraInfo, Frame
from mosca.recording import RecordingWriter
rng = np.random.default_rng(0)
writer = RecordingWriter(Path(sys.argv[1]), [CameraInfo("a", 640, 480, 8, 100.0)])
for k in range(10**6):
    writer.write(Frame("a", k, 10_000_000 * k, 0, rng.integers(0, 255, (480, 640)).astype(np.uint8)))
    print(k, flush=True)
"""


def test_a_killed_writer_leaves_what_it_wrote(tmp_path: Path) -> None:
    process = subprocess.Popen([sys.executable, "-c", KILLED, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    with process.stdout:
        written = next(int(line) for line in process.stdout if int(line) == 40)
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
    assert [p.name for p in tmp_path.iterdir()] == ["recording.mcap.part"]
    rng = np.random.default_rng(0)
    with open_recording(tmp_path) as recording:
        read = list(recording)
        assert recording.n_frames is None
        assert "its writer did not finish" in recording.notes[0]
    # At most the chunk of 1 MiB that was being filled is lost: 3.4 of these frames, and a buffer's rest.
    assert len(read) >= written - 4
    for k, frame in enumerate(read):
        assert frame.index == k
        np.testing.assert_array_equal(frame.image, rng.integers(0, 255, (480, 640)).astype(np.uint8))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    folder = tmp_path_factory.mktemp("whole")
    write(folder, 6)
    return (folder / "recording.mcap").read_bytes()


def read_bytes(folder: Path, data: bytes) -> tuple[list[Frame], tuple[str, ...]]:
    (folder / "recording.mcap").write_bytes(data)
    with open_recording(folder) as recording:
        return list(recording), recording.notes


@settings(QUIET, max_examples=80)
@given(share=st.floats(0, 1, exclude_max=True))
def test_a_file_cut_anywhere_gives_a_beginning_and_says_so(tmp_path: Path, whole: bytes, share: float) -> None:
    try:
        found, notes = read_bytes(tmp_path, whole[: int(share * len(whole))])
    except InputError:
        return
    check_equal(found, frames(6)[: len(found)])
    assert notes


@settings(QUIET, max_examples=150)
@given(data=st.data())
def test_flipped_bytes_never_give_a_wrong_picture(tmp_path: Path, whole: bytes, data: st.DataObject) -> None:
    damaged = bytearray(whole)
    for _ in range(data.draw(st.integers(1, 4))):
        # a share of the length, which differs a little from one run to the next
        place = int(data.draw(st.floats(0, 1, exclude_max=True)) * len(whole))
        damaged[place] ^= data.draw(st.integers(1, 255))
    try:
        found, _ = read_bytes(tmp_path, bytes(damaged))
    except InputError:
        return
    true = {(f.camera, f.index): f for f in frames(6)}
    for frame in found:
        if frame.status == "ok":
            np.testing.assert_array_equal(frame.image, true[frame.camera, frame.index].image)


@settings(QUIET, max_examples=100)
@given(data=st.binary(max_size=300), magic=st.booleans())
def test_any_bytes_are_an_input_error(tmp_path: Path, data: bytes, magic: bool) -> None:
    with pytest.raises(InputError):
        read_bytes(tmp_path, (b"\x89MCAP0\r\n" if magic else b"") + data)


def test_damaged_pixels_are_a_corrupt_frame_and_the_rest_is_read(tmp_path: Path, whole: bytes) -> None:
    payload = blosc2.compress2(
        picture(2, False), codec=blosc2.Codec.LZ4, clevel=5, filters=[blosc2.Filter.BITSHUFFLE], typesize=1
    )
    place = whole.index(payload[40:])
    damaged = bytearray(whole)
    damaged[place + 100] ^= 1
    found, _ = read_bytes(tmp_path, bytes(damaged))
    assert len(found) == 12
    bad = [f for f in found if f.note == "its pixels are damaged in the recording"]
    assert [(f.camera, f.index, f.status, f.time_ns) for f in bad] == [("left", 2, "corrupt", 19_999_997)]


def test_chunks_that_others_compressed_are_refused(tmp_path: Path) -> None:
    with open(tmp_path / "recording.mcap", "wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start()
        writer.add_message(writer.register_channel("/camera/left/frame", "mosca.frame.v1", 0), 0, b"", 0)
        writer.finish()
    with pytest.raises(InputError, match=r"compressed with zstd.*run 'mcap decompress'"):
        open_recording(tmp_path)


def test_a_closed_recording_says_so(tmp_path: Path) -> None:
    write(tmp_path, 2)
    recording = open_recording(tmp_path)
    recording.close()
    with pytest.raises(InputError, match="closed; open it again"):
        list(recording)
