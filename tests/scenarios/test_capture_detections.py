"""Recordings of detections: what is written is read, and gives the tracks that the images give."""

import struct
import tomllib
import zlib
from contextlib import suppress

import numpy as np
import pytest
from capture_rig import Line, openers, write_rig
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

from mosca.camera.projection import project
from mosca.data.detections import Detections
from mosca.data.files.rig_file import read_rig
from mosca.data.frames import CameraInfo, Frame, FrameSet
from mosca.detection.scheduler import FrameSetDetector, detect_ahead
from mosca.errors import InputError
from mosca.formats.tracks.tracks_csv import read_tracks_csv
from mosca.pipeline import PipelineSettings, run, run_seen
from mosca.recording import RecordingWriter, mcap_format, open_recording
from mosca.recording.count_sets import counted
from mosca.recording.mcap_format import unpack_detections
from mosca.synchronisation import Assembly, assemble
from scenarios.cli.main import cli
from scenarios.lab.capture import CaptureRequest, capture

SIZE, NAMES, RATE = (160, 120), ("left", "right", "top"), 50.0
LENS = """
[camera.lens]
model = "opencv"
fx_px = 200.0
fy_px = 200.0
cx_px = 79.5
cy_px = 59.5
[camera.pose]
position_m = [{x}, {y}, -2.0]
rotation_wxyz = [1.0, 0.0, 0.0, 0.0]
"""
PLACES = {"left": (-0.4, 0.0), "right": (0.4, 0.0), "top": (0.0, -0.3)}


def rig_file(tmp_path, calibrated=True):
    path = write_rig(tmp_path / "rig.toml", NAMES, SIZE, RATE)
    if not calibrated:
        return path
    text = path.read_text()
    for name, (x, y) in PLACES.items():
        head = f'name = "{name}"\nsize = [{SIZE[0]}, {SIZE[1]}]\n'
        text = text.replace(head, head + LENS.format(x=x, y=y))
    path.write_text(text)
    return path


def targets(pulse):
    turn = 0.03 * pulse
    ring = np.linspace(0, 2 * np.pi, 5)[:4] + turn
    return np.column_stack((0.2 * np.cos(ring), 0.15 * np.sin(ring), 0.1 * np.sin(2 * ring)))


def picture(camera, pulse):
    """Blurred discs of 5 px where a camera sees the targets, on dark noise; 4 x 4 samples a pixel."""
    rng = np.random.default_rng([len(camera.name), ord(camera.name[0]), pulse])
    image = rng.normal(5.0, 1.0, (SIZE[1], SIZE[0]))
    y, x = np.mgrid[: SIZE[1], : SIZE[0]]
    for u, v in project(camera, targets(pulse)):
        image += 180 * np.clip(3.0 - np.hypot(x - u, y - v), 0.0, 1.0)
    return np.clip(image.round(), 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def takes(tmp_path_factory):
    """Captures of the same pulses: frames, and detections."""
    folder = tmp_path_factory.mktemp("takes")
    path = rig_file(folder)
    # made before: a line whose pulses are late tries the numbering, not the capture
    images = {c.name: [picture(c, pulse) for pulse in range(90)] for c in read_rig(path).cameras}
    for kind in ("frames", "detections"):
        request = CaptureRequest(path, folder / kind, frames=60, detections=kind == "detections")
        line = Line(RATE, misses={"top": {20, 21}})
        outcome = capture(request, None, *openers(line, images, SIZE))
        assert outcome.lost == 0
        assert outcome.cameras["top"].dropped == 2
        assert outcome.cameras["left"].dropped == 0
    return folder


def test_the_detections_are_those_of_the_images(takes):
    rig = read_rig(takes / "rig.toml")
    with open_recording(takes / "frames", rig) as source:
        steps = list(run(source, rig, PipelineSettings(lookahead=0)))
    with open_recording(takes / "detections", rig) as recording:
        sets = list(recording.detection_sets())
        assert recording.n_frames == 178
        assert recording.notes == ()
    assert [s.pulse for s, _ in sets] == [step.frame_set.pulse for step in steps] == list(range(60))
    for (frame_set, found), step in zip(sets, steps, strict=True):
        assert frame_set.time_ns == pytest.approx(step.frame_set.time_ns, abs=10_000)
        assert list(found) == list(step.detections)
        for name in found:
            assert_same(found[name], step.detections[name])
            assert len(found[name]) == 4
    document = tomllib.loads((takes / "detections" / "recording.toml").read_text())
    assert document["holds"] == "detections"
    assert document["camera"][2]["frames"]["ok"] == 58


def assert_same(a, b):
    assert a.camera == b.camera
    for field in ("xy_px", "covariance_px2", "diameter_px", "peak", "elongation", "flags"):
        np.testing.assert_array_equal(getattr(a, field), getattr(b, field))


def test_tracks_are_bit_for_bit_those_of_the_images(takes, tmp_path):
    rig = read_rig(takes / "rig.toml")
    chosen = PipelineSettings(volume=((-1.0, -1.0, -0.5), (1.0, 1.0, 0.5)), lookahead=0)
    with open_recording(takes / "frames", rig) as source:
        wanted = list(run(source, rig, chosen))
    with open_recording(takes / "frames", rig) as source:
        look = FrameSetDetector(chosen.detection, {info.name: info.bit_depth for info in source.cameras})
        with RecordingWriter(tmp_path / "kept", source.cameras, holds="detections") as writer:
            for frame_set, found, _ in detect_ahead(look, assemble(source, source.cameras), 2):
                writer.write_set(frame_set, found)
    with open_recording(tmp_path / "kept", rig) as recording:
        given_steps = list(run_seen(counted(recording.detection_sets(), recording.cameras, Assembly()), rig, chosen))
    assert len(given_steps) == len(wanted)
    assert sum(len(step.samples) for step in wanted) > 150
    for a, b in zip(given_steps, wanted, strict=True):
        np.testing.assert_array_equal(a.points.xyz, b.points.xyz)
        np.testing.assert_array_equal(a.points.covariance, b.points.covariance)
        assert a.frame_set.time_ns == b.frame_set.time_ns
        for name in a.samples.__dataclass_fields__:
            np.testing.assert_array_equal(getattr(a.samples, name), getattr(b.samples, name))


def test_the_verb_reconstructs_from_both(takes, tmp_path):
    told = {}
    for kind in ("frames", "detections"):
        out = tmp_path / f"{kind}.csv"
        arguments = ["reconstruct", str(takes / kind), "--rig", str(takes / "rig.toml"), "--out", str(out)]
        arguments += ["--set", "lookahead=0"]  # detections were made while the images came
        result = CliRunner().invoke(cli, arguments, catch_exceptions=False)
        assert result.exit_code == 0, result.output
        told[kind] = (result.output.splitlines()[0], read_tracks_csv(out))
    tracks, others = told["frames"][1], told["detections"][1]
    assert len(tracks) == len(others) > 150
    np.testing.assert_allclose(tracks.xyz, others.xyz, atol=1e-5)
    truth = np.array([targets(frame) for frame in tracks.frame])
    nearest = np.linalg.norm(truth - tracks.xyz[:, None], axis=2).min(axis=1)
    assert np.sqrt(np.mean(nearest**2)) < 0.002
    assert told["detections"][0] == "178 frames in 60 sets, 58 of them complete"


def test_verbs_that_need_images_say_so(takes):
    with open_recording(takes / "detections") as recording, pytest.raises(InputError, match="without --det"):
        next(iter(recording))


def test_what_is_kept_follows_the_documented_layout(takes):
    with open(takes / "detections" / "recording.mcap", "rb") as file:
        reader = make_reader(file)
        told = {m.name: m.metadata for m in reader.iter_metadata()}["mosca-recording"]
        rig_crc32 = f"{zlib.crc32((takes / 'rig.toml').read_bytes()):08x}"
        entries = {"cameras": "3", "holds": "detections", "rig_crc32": rig_crc32, "version": "1"}
        words = "\0".join(["mosca-recording", *(word for entry in entries.items() for word in entry), ""])
        assert told == {**entries, "crc32": f"{zlib.crc32(words.encode()):08x}"}
        schema, channel, message = next(reader.iter_messages(topics=["/camera/left/detections"]))
    assert (schema.name, channel.message_encoding) == ("mosca.detections.v3",) * 2
    data = message.data
    checksum, event, _, _, n, pulse, index, time_ns, exposure_ns, row_ns = struct.unpack_from("<IBBHIqqqqq", data)
    assert checksum == zlib.crc32(data[4:])
    assert (event, n, pulse, index, time_ns, exposure_ns, row_ns) == (0, 4, 0, 0, 0, 500_000, 0)
    numbers = np.frombuffer(data, "<f8", 12 * n, 52).reshape(n, 12)
    camera = read_rig(takes / "rig.toml").camera("left")
    seen = project(camera, targets(0))
    away = np.linalg.norm(seen[:, None] - numbers[None, :, :2], axis=2).min(axis=0)
    assert away.max() < 0.1
    assert (numbers[:, 8] > 0).all()
    assert (numbers[:, 11] > 0).all()
    assert len(data) == 52 + 97 * n
    new = unpack_detections("left", data)[1]
    np.testing.assert_array_equal(np.column_stack([new.ellipticity, new.ellipticity_sigma]), numbers[:, 9:])
    # version 2 had no ellipticity, version 1 no standard deviations of the diameters either
    for columns in (8, 9):
        before = data[4:52] + numbers[:, :columns].tobytes() + data[-n:]
        old = unpack_detections("left", struct.pack("<I", zlib.crc32(before)) + before)[1]
        np.testing.assert_array_equal(old.xy_px, new.xy_px)
        np.testing.assert_array_equal(old.flags, new.flags)
        assert old.diameter_sigma_px.any() == (columns > 8)
        assert not old.ellipticity.any()
        assert not old.ellipticity_sigma.any()


def small_detections(rng, camera, n):
    a = rng.normal(size=(n, 2, 2))
    covariance = a @ np.swapaxes(a, 1, 2)
    covariance[:, 1, 0] = covariance[:, 0, 1]
    flags = rng.integers(0, 16, n).astype(np.uint8)
    return Detections(camera, rng.normal(size=(n, 2)), covariance, *rng.normal(size=(3, n)), flags)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 40), st.integers(0, 2**40), st.integers(0, 2**32))
def test_packing_is_lossless(n, pulse, seed):
    rng = np.random.default_rng(seed)
    found = small_detections(rng, "left", n)
    frame = Frame("left", 7, 9, 3, np.zeros((2, 2), np.uint8))
    message = mcap_format.pack_detections(pulse, frame, found)
    got, read = mcap_format.unpack_detections("left", message)
    assert got == pulse
    assert_same(read, found)
    place = int(rng.integers(len(message)))
    spoilt = message[:place] + bytes([message[place] ^ 1]) + message[place + 1 :]
    with pytest.raises(mcap_format.DamagedMessage):
        mcap_format.unpack_detections("left", spoilt)


@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=200))
def test_any_bytes_are_a_damaged_message(data):
    for message in (data, struct.pack("<I", zlib.crc32(data)) + data):
        with suppress(mcap_format.DamagedMessage):
            mcap_format.unpack_detections("left", message)


def test_a_recording_that_was_cut_gives_its_whole_sets(tmp_path):
    rng = np.random.default_rng(0)
    cameras = [CameraInfo(name, 2, 2, 8, RATE) for name in NAMES]
    image = np.zeros((2, 2), np.uint8)
    with RecordingWriter(tmp_path / "whole", cameras, holds="detections") as writer:
        for pulse in range(40):
            if pulse in (11, 12):  # left out because the machine was behind
                continue
            shown = NAMES if pulse != 5 else ()
            frames = {name: Frame(name, pulse, pulse * 20_000_000, 0, image) for name in shown}
            found = {name: small_detections(rng, name, 3) for name in shown}
            writer.write_set(FrameSet(pulse, pulse * 20_000_000, frames), found, dict.fromkeys(shown, 77))
            writer.flush()
        with pytest.raises(ValueError, match="recording of detections"):
            writer.write(Frame("left", 1, 1, 1, image))
    data = (tmp_path / "whole" / "recording.mcap").read_bytes()
    wanted = [pulse for pulse in range(40) if pulse not in (11, 12)]
    for cut in rng.integers(len(data) // 3, len(data), 30):
        part = tmp_path / "part"
        part.mkdir(exist_ok=True)
        (part / "recording.mcap.part").write_bytes(data[:cut])
        with open_recording(part) as recording:
            sets = list(recording.detection_sets())
        pulses = [frame_set.pulse for frame_set, _ in sets]
        assert pulses == wanted[: len(pulses)]
        assert [len(found) for _, found in sets] == [0 if p == 5 else 3 for p in pulses]


def test_frames_and_detections_do_not_mix(tmp_path):
    with (
        RecordingWriter(tmp_path, [CameraInfo("left", 2, 2, 8, RATE)]) as writer,
        pytest.raises(ValueError, match="recording of frames"),
    ):
        writer.write_set(FrameSet(0, 0), {})
