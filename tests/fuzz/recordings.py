"""Readers of recordings: what is yielded as a good frame is what was written, or what an independent reader sees."""

import csv
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any
from unittest.mock import patch

import av
import cv2
import numpy as np
from fuzz.reader import Reader
from fuzz.tables import whole
from fuzz.toml_files import document, toml_seed

from mosca.data.detections import Detections
from mosca.data.frames import CameraInfo, Frame, FrameSet
from mosca.recording import McapRecording, RecordingWriter, open_recording
from mosca.recording.account import recorded_account
from mosca.recording.crash_buffer import TAIL_NAME, Tail, read_tail, rescued
from mosca.recording.folder import read_image
from mosca.recording.stamps import read_stamps

INFOS = (CameraInfo("left", 32, 24, 8, 100.0, "device", "exposure_middle"), CameraInfo("right", 32, 24, 12, 100.0))
MCAP = "recording.mcap"


def picture(seed: int, deep: bool = False) -> np.ndarray:
    """Return an image of noise, 24 x 32."""
    image = np.random.default_rng(seed).integers(0, 4096 if deep else 256, (24, 32))
    return image.astype(np.uint16 if deep else np.uint8)


def _frames() -> list[Frame]:
    made = []
    for k in range(6):
        time_ns = 10_000_000 * k
        made.append(Frame("left", k, time_ns, 700, picture(k), "ok", "exposure_middle", 11, "a note"))
        made.append(
            Frame("right", k, time_ns, 0, None, "dropped")
            if k == 3
            else Frame("right", k, time_ns, 500, picture(k, True))
        )
    return made


def _plain(frame: Frame) -> dict[str, Any]:
    names = ("camera", "index", "time_ns", "exposure_ns", "image", "status", "stamp_event", "row_time_ns", "note")
    return {name: getattr(frame, name) for name in names}


def _mcap_seed(folder: Path) -> None:
    with RecordingWriter(folder / "r", INFOS, "[[camera]]\n") as writer:
        for frame in _frames():
            writer.write(frame, 5)
            writer.write_channel("commands", frame.time_ns, {"thrust": [1.5, frame.index]})


def _subset(found: list[Any], written: list[Any], told: bool, what: str) -> Any:
    """Return "" where ``found`` are some of ``written`` in their order, all of them unless something was ``told``."""
    from fuzz.values import difference

    at = 0
    for one in found:
        while at < len(written) and difference(one, written[at]):
            at += 1
        if at == len(written):
            return f"{what} {one!r:.300} was never written there"
        at += 1
    return "" if len(found) == len(written) or told else f"{len(found)} of {len(written)} {what}, without a note"


def _mcap(folder: Path) -> Any:
    with open_recording(folder / "r") as recording:
        assert isinstance(recording, McapRecording)
        frames = list(recording)
        commands = list(recording.channel("commands"))
        whole_frames = [_plain(one) for one in frames if one.status != "corrupt"]
        told = bool(recording.notes) or any(one.status == "corrupt" for one in frames)
        return {
            "cameras": [list(vars(info).values()) for info in recording.cameras],
            "rig": "[[camera]]\n" if recording.rig_toml_text is None and recording.notes else recording.rig_toml_text,
            "frames": _subset(whole_frames, [_plain(one) for one in _frames()], told, "frame"),
            "commands": _subset(
                commands, [(f.time_ns, {"thrust": [1.5, f.index]}) for f in _frames()], told, "command"
            ),
        }


def _detections(k: int) -> Detections:
    rng = np.random.default_rng(k)
    n = 4
    return Detections(
        "left", rng.random((n, 2)), np.tile(np.eye(2), (n, 1, 1)), rng.random(n), rng.random(n), rng.random(n),
        np.zeros(n, np.uint8),
    )  # fmt: skip


def _found_seed(folder: Path) -> None:
    with RecordingWriter(folder / "r", INFOS[:1], holds="detections") as writer:
        for k in range(6):
            frame = Frame("left", k, 10_000_000 * k, 700, picture(k))
            frame_set = FrameSet(k, 10_000_000 * k, {"left": frame})
            writer.write_set(frame_set, {"left": _detections(k)})


def _found(folder: Path) -> Any:
    def plain(pulse: int, time_ns: int, found: Detections) -> Any:
        return {"pulse": pulse, "time_ns": time_ns, **{k: getattr(found, k) for k in Detections.__dataclass_fields__}}

    with open_recording(folder / "r") as recording:
        assert isinstance(recording, McapRecording)
        sets = list(recording.detection_sets())
        found = [plain(one.pulse, one.time_ns, seen["left"]) for one, seen in sets if seen]
        told = bool(recording.notes) or len(sets) > len(found)
        written = [plain(k, 10_000_000 * k, _detections(k)) for k in range(6)]
        return {
            "cameras": [list(vars(info).values()) for info in recording.cameras],
            "holds": recording.holds,
            "sets": _subset(found, written, told, "set"),
        }


def _tail_seed(folder: Path) -> None:
    tail = Tail(INFOS, 1 << 20, folder)
    for frame in _frames()[:6]:
        tail.put(frame, 5)
    in_memory = folder / "mosca-memory.tail"
    in_memory.write_bytes(tail.path.read_bytes())
    tail.close()
    with patch("mosca.recording.crash_buffer.MEMORY", folder):  # as after the writer's death
        rescued(folder / "recording.mcap.part", in_memory, tail.token)


def _tail(folder: Path) -> Any:
    notes: list[str] = []
    kept = [_plain(one.frame) for one in read_tail(folder / TAIL_NAME, INFOS, notes.append)]
    return _subset(kept, [_plain(one) for one in _frames()[:6]], bool(notes), "frame")


STAMPS = "frame,camera,time_ns,exposure_ns,status\n" + "".join(
    f"{k},{camera},{k * 10_000_000 + offset},500,{'dropped' if k == 4 else 'ok'}\n"
    for k in range(8)
    for offset, camera in ((0, "a"), (7, "b"))
)


def _stamps(folder: Path) -> Any:
    read = read_stamps(folder / "frames.csv", {"a": "a", "b": "b"}, 100.0)
    return {
        f"{name}{number}": (one.time_ns, one.exposure_ns, one.status)
        for name, rows in read.rows.items()
        for number, one in rows.items()
    }


def _stamps_expected(folder: Path) -> Any:
    with open(folder / "frames.csv", encoding="utf-8-sig", newline="") as file:
        header, *rows = [[cell.strip() for cell in row] for row in csv.reader(file, strict=True) if row]
    stamps = {}
    for row in (dict(zip(header, row, strict=True)) for row in rows):
        times = whole([row["frame"], row["time_ns"], row.get("exposure_ns") or "0"])
        if row["camera"] in ("a", "b"):
            stamps[f"{row['camera']}{times[0]}"] = (times[1], times[2], row.get("status") or "ok")
    return stamps


def _image_seed(suffix: str, deep: bool) -> Callable[[Path], None]:
    return lambda folder: cv2.imwrite(str(folder / f"a.{suffix}"), picture(3, deep)) and None


def _image(folder: Path) -> Any:
    from mosca.errors import InputError

    image, fault = read_image(next(folder.glob("a.*")))
    if image is None:
        raise InputError(fault)  # in a recording: a corrupt frame with this note
    return image


def _image_expected(folder: Path) -> Any:
    image = cv2.imread(str(next(folder.glob("a.*"))), cv2.IMREAD_UNCHANGED)
    return image if image.ndim == 2 else cv2.cvtColor(image[..., :3], cv2.COLOR_BGR2GRAY)


def _video_seed(suffix: str) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        with av.open(str(folder / f"a.{suffix}"), "w") as container:
            # of a damaged slice, FFmpeg's FFV1 decoder shows whatever was in memory: nothing to compare with
            stream = container.add_stream("rawvideo" if suffix == "mkv" else "png", rate=100)
            stream.width, stream.height, stream.pix_fmt = 32, 24, "gray"
            for k in range(8):
                frame = av.VideoFrame.from_ndarray(picture(k), format="gray")
                frame.pts, frame.time_base = k, Fraction(1, 100)
                container.mux(stream.encode(frame))
            container.mux(stream.encode())

    return make


def _video(folder: Path) -> Any:
    with open_recording(folder, fps=100.0) as recording:
        return [one.image for one in recording if one.status == "ok"]


def _video_expected(folder: Path) -> Any:
    """Every image that PyAV decodes, in order of time; a packet that it cannot decode is passed over."""
    images, last = [], -1
    with av.open(str(next(folder.glob("a.*"))), metadata_errors="replace") as container:
        packets = container.demux(container.streams.video[0])
        while True:
            try:
                decoded = next(packets).decode()
            except StopIteration:
                return images
            except av.error.FFmpegError:
                continue
            for frame in decoded:
                if not frame.is_corrupt and frame.pts is not None and frame.pts > last:
                    last = frame.pts
                    images.append(
                        frame.to_ndarray(format="gray") if frame.format.name != "gray" else frame.to_ndarray()
                    )


ACCOUNT = """format = "mosca.recording"
[[camera]]
name = "a"
frames = { ok = 97, dropped = 2, corrupt = 1 }
[[camera]]
name = "b"
frames = { ok = 100, dropped = 0, corrupt = 0 }
[capture]
pulses = 100
stopped_by_hand = false
"""


def _account(folder: Path) -> Any:
    return recorded_account(folder / "a.toml", ())


def _account_expected(folder: Path) -> Any:
    told = document(folder / "a.toml")
    counts = {str(one.get("name")): sum(one.get("frames", {}).values()) for one in told.get("camera", [])}
    pulses = {"pulses": told["capture"]["pulses"]} if "pulses" in told.get("capture", {}) else {}
    return pulses | ({"frames": counts} if counts else {})


READERS = (
    Reader("recording account", (toml_seed(ACCOUNT),), ("a.toml",), _account, _account_expected),
    Reader("recording mcap", (_mcap_seed,), (f"r/{MCAP}",), _mcap),
    Reader("recording detections", (_found_seed,), (f"r/{MCAP}",), _found),
    Reader("recording tail", (_tail_seed,), (TAIL_NAME,), _tail),
    Reader(
        "frames.csv",
        (lambda folder: (folder / "frames.csv").write_text(STAMPS) and None,),
        ("frames.csv",),
        _stamps,
        _stamps_expected,
    ),
    *(
        Reader(
            f"image {suffix}{' 16 bit' if deep else ''}",
            (_image_seed(suffix, deep),),
            ("a.*",),
            _image,
            _image_expected,
        )
        for suffix, deep in (("png", True), ("tif", False), ("tif", True), ("bmp", False))
    ),
    *(
        Reader(f"video {suffix}", (_video_seed(suffix),), ("a.*",), _video, _video_expected)
        for suffix in ("mkv", "avi", "mp4")
    ),
)
