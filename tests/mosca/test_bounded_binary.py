"""Binary files whose headers promise more than they hold, and files that are no files, end in one line."""

import os
import struct
import subprocess
import sys
import zlib
from fractions import Fraction

import av
import blosc2
import cv2
import ezc3d
import numpy as np
import pytest

from mosca.data.frames import CameraInfo, Frame
from mosca.errors import InputError
from mosca.formats.rigs.rig_formats import read_any_rig
from mosca.formats.tracks.c3d import read_c3d
from mosca.recording import RecordingWriter, open_recording
from mosca.recording.folder import read_image
from mosca.recording.mcap_format import pack_frame, unpack_frame
from mosca.recording.video import open_video

FIFOS = """
import sys
from pathlib import Path
from mosca.data.files.target_file import read_target_file
from mosca.data.motion.asf import read_asf_amc
from mosca.data.motion.bvh import read_bvh
from mosca.data.motion.joint_csv import read_points_csv
from mosca.errors import InputError
from mosca.formats.rigs.rig_formats import read_any_rig
from mosca.formats.tracks.tracks_file import read_tracks
from mosca.formats.tracks.c3d import read_c3d
from mosca.formats.tracks.trc import read_trc
from mosca.recording import McapRecording
from mosca.recording.folder import read_image
from mosca.recording.stamps import read_stamps
from mosca.recording.video import open_video
from reports.record import read_record
from scenarios.score.reference import read_reference
from scenarios.spec.scenario import load_scenario
from hardware.transport.signed import read_key
from twin.scenes.user_markers import read_marker_table

pipe = Path(sys.argv[1])
def image(path):
    raise InputError(read_image(path)[1])
READERS = [
    read_target_file, read_bvh, read_points_csv, read_c3d, read_trc, McapRecording, open_video, read_record, image,
    load_scenario, read_key, read_marker_table, lambda path: read_asf_amc(path, path), read_any_rig,
    lambda path: read_stamps(path, {"a": "a"}, None), *(lambda path, name=name: read_any_rig(path, name)
    for name in ("mosca", "aniposelib", "caliscope", "opencv", "qtm", "openptv")),
]
for read in READERS:
    try:
        read(pipe)
        print("read", read)
    except InputError as error:
        print("refused", str(error))
for suffix in (".csv", ".npz", ".c3d", ".trc"):
    pipe = pipe.rename(pipe.with_suffix(suffix))
    for read in (read_tracks, read_reference):
        try:
            read(pipe)
            print("read", read)
        except InputError as error:
            print("refused", str(error))
print("done")
"""


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no named pipes")
def test_no_reader_waits_for_a_pipe(tmp_path):
    path = tmp_path / "a"
    os.mkfifo(path)
    done = subprocess.run([sys.executable, "-c", FIFOS, str(path)], capture_output=True, text=True, timeout=120)
    *lines, last = done.stdout.splitlines()
    assert last == "done", done.stderr
    assert len(lines) == 29
    assert all(line.startswith("refused") for line in lines), lines


def png(width, height, depth=8, colour=0):
    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    packed = zlib.compress(bytes(1 << 16))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", packed) + chunk(b"IEND", b"")


def bmp(width, height):
    head = struct.pack("<IiiHHIIiiII", 40, width, height, 1, 8, 0, 0, 0, 0, 0, 0)
    return b"BM" + struct.pack("<IHHI", 14 + len(head), 0, 0, 14 + len(head)) + head


def tiff(**tags):
    known = {"width": 256, "height": 257, "bits": 258, "photometric": 262, "tile_width": 322, "tile_height": 323}
    rows = {known[name]: value for name, value in tags.items()} | {273: 8, 277: 1, 278: 1, 279: 8}
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in sorted(rows.items()))
    return b"II*\0" + struct.pack("<I", 16) + bytes(8) + struct.pack("<H", len(rows)) + entries + bytes(4)


@pytest.mark.parametrize(
    "data",
    [
        png(1 << 15, 1 << 15), png(20_000, 20_000, 16, 6), bmp(1 << 15, -(1 << 15)), bmp(-(1 << 31), 1),
        tiff(width=1 << 15, height=1 << 15, bits=8, photometric=1),
        tiff(width=64, height=64, bits=16, photometric=1, tile_width=1 << 20, tile_height=1 << 20),
    ],
    ids=["png", "png 16 bit rgba", "bmp", "bmp negative", "tiff", "tiff tiles"],
)  # fmt: skip
def test_an_image_that_states_a_gigabyte_is_refused_undecoded(tmp_path, monkeypatch, data):
    path = tmp_path / "000000.png"
    path.write_bytes(data)
    monkeypatch.setattr(cv2, "imdecode", lambda *given: pytest.fail("decoded"))
    image, fault = read_image(path)
    assert image is None
    assert "000000.png: states " in fault
    assert " px of " in fault


def test_large_images_of_real_sensors_are_read(tmp_path):
    """14,204 x 10,652 px of 16 bit, the largest of Sony's."""
    path = tmp_path / "000000.png"
    path.write_bytes(png(14_204, 10_652, 16))
    assert "states" not in read_image(path)[1]


def test_a_chunk_that_states_gigabytes_is_corrupt(monkeypatch):
    message = pack_frame(Frame("a", 0, 0, 0, np.zeros((24, 32), np.uint8)), "lz4")
    payload_at = 8 + 48
    payload = bytearray(message[payload_at:])
    assert blosc2.get_cbuffer_sizes(bytes(payload))[0] == 24 * 32
    struct.pack_into("<i", payload, 4, (1 << 31) - 64)  # nbytes of a blosc2 chunk's header
    head = message[8:payload_at]
    forged = struct.pack("<II", zlib.crc32(head), zlib.crc32(payload)) + head + bytes(payload)
    monkeypatch.setattr(blosc2, "decompress2", lambda *given, **more: pytest.fail("unpacked"))
    assert unpack_frame("a", forged).status == "corrupt"


@pytest.mark.parametrize("size", [(1 << 60, 1 << 60), (0, 24), (-32, 24)])
def test_a_camera_of_an_impossible_size_is_refused(tmp_path, size):
    with RecordingWriter(tmp_path / "r", (CameraInfo("a", *size, 8, 100.0),), "") as writer:
        writer.write(Frame("a", 0, 0, 0, None, "dropped"), 5)
    with pytest.raises(InputError, match=rf"what it says of camera/a is damaged: {size[0]}x{size[1]} px"):
        open_recording(tmp_path / "r")


@pytest.mark.parametrize(
    "doctype", ['<!DOCTYPE calibration [<!ENTITY a "b">]>', '<!DOCTYPE calibration SYSTEM "file:///etc/passwd">']
)
def test_a_document_type_in_qtm_is_refused(tmp_path, doctype):
    path = tmp_path / "a.qca.txt"
    text = "<calibration><cameras/></calibration>"
    path.write_text(text)
    with pytest.raises(InputError, match="no calibrated camera"):
        read_any_rig(path, "qtm")
    path.write_text(doctype + text)
    with pytest.raises(InputError, match=r"a\.qca\.txt: not an XML file .*<!DOCTYPE calibration> stands in it"):
        read_any_rig(path, "qtm")


def test_a_list_of_other_files_is_no_video(tmp_path):
    """FFmpeg goes by the content, and would open what the list names."""
    ffv1(tmp_path / "b.mkv", {})
    path = tmp_path / "a.mp4"
    path.write_text("ffconcat version 1.0\nfile b.mkv\n")
    with av.open(str(path)) as container:
        assert container.streams.video[0].width == 32
    with pytest.raises(InputError, match=r"a\.mp4: cannot be read as a video"):
        open_video(path)


def test_a_video_may_have_a_colon_in_its_name(tmp_path, monkeypatch):
    """FFmpeg takes what precedes it for a protocol."""
    monkeypatch.chdir(tmp_path)
    ffv1(tmp_path / "cam:1.mkv", {})
    open_video((tmp_path / "cam:1.mkv").relative_to(tmp_path)).close()


def ffv1(path, options, count=8):
    rng = np.random.default_rng(1)
    images = [rng.integers(0, 256, (24, 32)).astype(np.uint8) for _ in range(count)]
    with av.open(str(path), "w", format="matroska") as container:
        stream = container.add_stream("ffv1", rate=100, options=options)
        stream.width, stream.height, stream.pix_fmt = 32, 24, "gray"
        for k, image in enumerate(images):
            frame = av.VideoFrame.from_ndarray(image, format="gray")
            frame.pts, frame.time_base = k, Fraction(1, 100)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return images


@pytest.mark.parametrize(("options", "lost"), [({"g": "1"}, 1), ({"g": "4"}, 2)], ids=["key frames", "every fourth"])
def test_a_damaged_slice_of_ffv1_is_a_corrupt_frame(tmp_path, options, lost):
    """Frame 2 is damaged; without a key frame it damages the next one too, up to frame 4."""
    path = tmp_path / "a.mkv"
    images = ffv1(path, options)
    with av.open(str(path)) as container:
        packet = [bytes(one) for one in container.demux(video=0)][2]
    data = bytearray(path.read_bytes())
    data[data.index(packet) + len(packet) // 3] ^= 4
    path.write_bytes(data)
    with open_recording(tmp_path, fps=100.0) as recording:
        frames = list(recording)
        assert recording.notes == ()
    assert [one.status for one in frames] == ["ok"] * 2 + ["corrupt"] * lost + ["ok"] * (6 - lost)
    assert all(np.array_equal(one.image, images[one.index]) for one in frames if one.status == "ok")


def test_a_packet_that_lacks_whole_slices_is_a_corrupt_frame(tmp_path):
    """As in a file that was cut at a slice's end: frame 2 has three of its four slices."""
    (tmp_path / "cut").mkdir()
    images = ffv1(tmp_path / "a.mkv", {"g": "1", "slices": "4"})
    with av.open(str(tmp_path / "a.mkv")) as whole, av.open(str(tmp_path / "cut" / "a.mkv"), "w") as cut:
        stream = cut.add_stream_from_template(whole.streams.video[0])
        for k, packet in enumerate(one for one in whole.demux(video=0) if one.size):
            data = bytes(packet)
            last = 8 + int.from_bytes(data[-8:-5], "big")
            new = av.Packet(data[:-last] if k == 2 else data)
            new.pts, new.dts, new.time_base, new.stream = packet.pts, packet.dts, packet.time_base, stream
            new.is_keyframe = True
            cut.mux(new)
    with open_recording(tmp_path / "cut", fps=100.0) as recording:
        frames = list(recording)
    assert [one.status for one in frames] == ["ok"] * 2 + ["corrupt"] + ["ok"] * 5
    assert all(np.array_equal(one.image, images[one.index]) for one in frames if one.status == "ok")


def test_ffv1_without_checksums_is_read_with_a_note(tmp_path):
    images = ffv1(tmp_path / "a.mkv", {"slicecrc": "0"})
    with open_recording(tmp_path, fps=100.0) as recording:
        assert "FFV1 has no checksums" in recording.notes[0]
        assert all(np.array_equal(one.image, image) for one, image in zip(recording, images, strict=True))


def test_a_damaged_configuration_of_ffv1_is_refused(tmp_path):
    path = tmp_path / "a.mkv"
    ffv1(path, {})
    with av.open(str(path)) as container:
        record = bytes(container.streams.video[0].codec_context.extradata)
    data = bytearray(path.read_bytes())
    data[data.index(record) + len(record) - 2] ^= 1
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"a\.mkv: states no known coding"):
        open_recording(tmp_path, fps=100.0)


def c3d(path, n_frames=4):
    document = ezc3d.c3d()
    document["parameters"]["POINT"]["RATE"]["value"] = [100.0]
    document["parameters"]["POINT"]["LABELS"]["value"] = ["a"]
    document["data"]["points"] = np.ones((4, 1, n_frames))
    document.write(str(path))
    return bytearray(path.read_bytes())


def after(data, group, name):
    """Return where the type of a parameter stands."""
    return data.index(name, data.index(group)) + len(name) + 2


def test_a_c3d_file_of_too_many_samples_is_refused(tmp_path):
    path = tmp_path / "a.c3d"
    data = c3d(path)
    struct.pack_into("<H", data, 2, 60_000)
    struct.pack_into("<H", data, 8, 60_000)
    path.write_bytes(data)
    with pytest.raises(InputError, match="60000 points in 60000 frames; at most 3145728 samples"):
        read_c3d(path)


def test_a_c3d_file_whose_last_frame_precedes_its_first_is_refused(tmp_path):
    path = tmp_path / "a.c3d"
    data = c3d(path)
    struct.pack_into("<HH", data, 6, 27, 13)
    path.write_bytes(data)
    with pytest.raises(InputError, match="its header states frames 27 to 13"):
        read_c3d(path)


def test_a_c3d_file_without_its_rotations_is_refused(tmp_path):
    """ezc3d 1.7 ends the process on the first and reads memory that is not its own on the second."""
    path = tmp_path / "a.c3d"
    whole = c3d(path)
    assert read_c3d(path).xyz.shape == (4, 1, 3)
    data = whole.copy()
    for name, value in ((b"USED", 100), (b"RATIO", 1)):
        struct.pack_into("<H", data, after(data, b"ROTATION", name) + 2, value)
    path.write_bytes(data)
    with pytest.raises(InputError, match="cut short"):
        read_c3d(path)
    data = whole.copy()
    data[after(data, b"ROTATION", b"USED") + 1] = 2
    path.write_bytes(data)
    with pytest.raises(InputError, match="parameter ROTATION:USED has no value"):
        read_c3d(path)


def test_a_text_of_c3d_without_a_length_is_refused(tmp_path):
    """A single character, as the format has it: ezc3d 1.7 reads memory that is not its own."""
    path = tmp_path / "a.c3d"
    data = c3d(path)
    at = after(data, b"ANALOG", b"DESCRIPTIONS")
    data[at : at + 5] = b"\xff\0A\0\0"  # the type, no dimension, the text, no description
    path.write_bytes(data)
    with pytest.raises(InputError, match="parameter 'DESCRIPTIONS' is a text without a length"):
        read_c3d(path)
