"""Writer of a recording: ``recording.mcap`` (see ``mosca.recording.mcap_format``) beside ``recording.toml``.

During writing the file is called ``recording.mcap.part``, and ``recording.toml`` is written last. So a folder whose
writer was killed is never taken for a complete recording; its content can still be read.
"""

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import tomli_w
from mcap.writer import CompressionType, Writer

from mosca.data.arrays import Array
from mosca.data.detections import Detections
from mosca.data.files.whole_file import write_text
from mosca.data.frames import CameraInfo, Frame, FrameSet
from mosca.errors import InputError
from mosca.recording import mcap_format as layout
from mosca.recording.account import TOML_NAME
from mosca.recording.crash_buffer import TAIL_NAME, Tail

MCAP_NAME = "recording.mcap"
PART_NAME = "recording.mcap.part"
CHUNK_BYTES = 1 << 20
"""Size of a chunk [B]: a killed writer loses at most the one it was filling, or data since the last ``flush``."""

_FOR_PEOPLE = """\
# A recording of cameras. The frames are in recording.mcap, a plain MCAP file (mcap.dev): a channel
# /camera/NAME/frame a camera, message encoding mosca.frame.v1; further channels are JSON or bytes.
# log_time is the stamp of the frame in the clock named below [ns], publish_time the host's time of arrival.
# A message of mosca.frame.v1 is, little-endian: u32 crc32 of header and note, u32 crc32 of payload,
# u8 status (0 ok, 1 dropped, 2 corrupt), u8 stamp event (0 exposure_start, 1 exposure_middle, 2 readout),
# u8 bytes a pixel, u8 0, u32 height, u32 width, i64 index, i64 time_ns, i64 exposure_ns, i64 row_time_ns,
# u32 length of note, note, payload: one blosc2 chunk of the pixels, row by row.
# A recording of detections has /camera/NAME/detections (mosca.detections.v3) instead; the schemas in the file tell.

"""


@dataclass
class _Count:
    ok: int = 0
    dropped: int = 0
    corrupt: int = 0


class RecordingWriter:
    """Context manager that writes frames, or detections, and further channels to a folder as they come.

    ``path``: the folder, made if need be; InputError where it holds a recording already. ``cameras``: the cameras'
    properties. ``rig_toml_text``: the rig file, kept inside. ``codec``: "lz4" (fast) or "zstd" (smaller); both
    lossless. ``holds``: "frames", or "detections" without images. ``about``: tables for ``recording.toml``, to be
    filled before ``close``. ``tail_bytes``: size of memory for waiting frames (``keep``) that outlives this process,
    where the system has such; 0 for none. When the body raises, or the disk is full (InputError), what was written
    stays readable as an unfinished recording. Not to be shared by threads,
    except ``pack``, ``reserve``, ``keep`` and ``forget``.
    """

    def __init__(
        self,
        path: Path,
        cameras: Sequence[CameraInfo],
        rig_toml_text: str | None = None,
        codec: layout.Codec = "lz4",
        holds: layout.Holds = "frames",
        tail_bytes: int = 0,
    ) -> None:
        self.path = Path(path)
        self.holds = holds
        self.about: dict[str, Any] = {}
        self._cameras = {info.name: info for info in cameras}
        self._codec = codec
        self._counts = {name: _Count() for name in self._cameras}
        self._other_counts: dict[str, int] = {}
        self._times_ns: tuple[int, int] | None = None
        for name in (MCAP_NAME, PART_NAME, TAIL_NAME):
            if (self.path / name).exists():
                raise InputError(f"{self.path}: holds a recording already ({name}); choose another folder")
        self._made_folder = not self.path.exists()
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            self._file = open(self.path / PART_NAME, "xb")  # noqa: SIM115 (closed by close)
        except OSError as error:
            raise InputError(f"{self.path}: cannot be written: {error.strerror}") from None
        self._mcap = Writer(self._file, chunk_size=CHUNK_BYTES, compression=CompressionType.NONE)
        self._mcap.start(profile=layout.PROFILE, library="mosca")
        self._tail = _tail(cameras, tail_bytes)
        where = {} if self._tail is None else {"tail": str(self._tail.path), "tail_token": self._tail.token.hex()}
        if rig_toml_text is not None:
            where["rig_crc32"] = layout.text_sum(rig_toml_text)
        about = {"version": layout.VERSION, "holds": holds, "cameras": str(len(cameras)), **where}
        self._mcap.add_metadata(layout.PROFILE, layout.sealed(layout.PROFILE, about))
        for info in cameras:
            fields = {key: str(value) for key, value in asdict(info).items() if key != "name"}
            self._mcap.add_metadata(f"camera/{info.name}", layout.sealed(f"camera/{info.name}", fields))
        if rig_toml_text is not None:
            self._mcap.add_attachment(0, 0, "rig.toml", "application/toml", rig_toml_text.encode("utf-8"))
        text = (layout.__doc__ or "").encode("utf-8")
        encoding = layout.FRAME_ENCODING if holds == "frames" else layout.DETECTIONS_ENCODING
        schema = self._mcap.register_schema(encoding, "text/plain", text)
        self._channels = {
            name: self._mcap.register_channel(layout.camera_topic(name, holds), encoding, schema)
            for name in self._cameras
        }
        self._other_channels: dict[tuple[str, str], int] = {}
        self._json_schema: int | None = None
        self.flush()  # from now on it can be opened, whatever becomes of this process

    def pack(self, frame: Frame) -> bytes:
        """Return the message of ``frame`` for ``write``; may be called by any thread.

        Raises ValueError for a camera that was not announced or an image of another size than announced.
        """
        info = self._cameras.get(frame.camera)
        if info is None:
            raise ValueError(f"frame of camera '{frame.camera}'; announced are {', '.join(self._cameras)}")
        if frame.image is not None and frame.image.shape != (info.height, info.width):
            raise ValueError(
                f"frame {frame.index} of {frame.camera}: {frame.image.shape} given, "
                f"{(info.height, info.width)} announced"
            )
        return layout.pack_frame(frame, self._codec)

    def write(self, frame: Frame, host_time_ns: int | None = None, message: bytes | None = None) -> None:
        """Append ``frame``; ``host_time_ns`` is when it reached this machine, where that is known.

        ``message``: the result of ``pack``, where that was called before. Raises ValueError as ``pack`` does, and
        where the recording holds detections.
        """
        if self.holds != "frames":
            raise ValueError(f"frame of camera '{frame.camera}' for a recording of {self.holds}")
        self._add(frame, self.pack(frame) if message is None else message, host_time_ns)

    def write_set(
        self,
        frame_set: FrameSet,
        detections: Mapping[str, Detections],
        host_times_ns: Mapping[str, int] | None = None,
    ) -> None:
        """Append what was found in the frames of a set, in a recording that holds detections."""
        if self.holds != "detections":
            raise ValueError(f"detections of pulse {frame_set.pulse} for a recording of {self.holds}")
        for name, found in detections.items():
            frame = frame_set.frames[name]
            message = layout.pack_detections(frame_set.pulse, frame, found)
            self._add(frame, message, (host_times_ns or {}).get(name))
        self.write_channel(layout.SETS, frame_set.time_ns, {"pulse": frame_set.pulse, "time_ns": frame_set.time_ns})

    def write_channel(self, name: str, time_ns: int, data: bytes | Mapping[str, Any]) -> None:
        """Append a message to the further channel ``name``: bytes as they are, a mapping as JSON.

        ``time_ns`` is on the frames' clock. Raises ValueError for a name that frames use.
        """
        if name.startswith("camera/") or not name:
            raise ValueError(f"channel '{name}': names that start with camera/ are for frames")
        encoding = "application/octet-stream" if isinstance(data, bytes) else "json"
        channel = self._other_channels.get((name, encoding))
        if channel is None:
            channel = self._mcap.register_channel(f"/{name}", encoding, self._schema_of(encoding))
            self._other_channels[name, encoding] = channel
        payload = data if isinstance(data, bytes) else json.dumps(dict(data)).encode("utf-8")
        stamp = max(time_ns, 0)
        with self._disk():
            self._mcap.add_message(channel, log_time=stamp, data=payload, publish_time=stamp)
        self._other_counts[name] = self._other_counts.get(name, 0) + 1

    def reserve(self, image: Array) -> int | None:
        """Copy an image whose frame is not known yet into memory that outlives this process; return its slot.

        None without such memory or a free slot. ``reserve``, ``keep`` and ``forget`` may be called by any thread.
        """
        return None if self._tail is None else self._tail.reserve(image)

    def keep(self, frame: Frame, host_time_ns: int | None = None, slot: int | None = None) -> int | None:
        """Copy a frame that waits to be written into that memory; return its slot or None. ``slot``: of its image."""
        return None if self._tail is None else self._tail.put(frame, host_time_ns, slot)

    def forget(self, slot: int) -> None:
        """Free a slot whose frame was written and flushed."""
        if self._tail is not None:
            self._tail.free(slot)

    def flush(self) -> None:
        """Flush to the operating system, so that what was written so far survives this process."""
        with self._disk():
            self._mcap.flush()

    def close(self) -> None:
        """Finish the recording: index, name, ``recording.toml``; may be called twice."""
        if self._file.closed:
            return
        with self._disk():
            self._end_file()
            (self.path / PART_NAME).replace(self.path / MCAP_NAME)
            write_text(self.path / TOML_NAME, self._toml())
        self._close_tail()

    def abandon(self) -> None:
        """Close the file as it is; it can be read up to here. May be called twice."""
        with suppress(OSError):  # what could not be written before cannot be now
            self._file.close()
        self._close_tail()

    def __enter__(self) -> "RecordingWriter":
        """Return the writer itself."""
        return self

    def __exit__(self, kind: type[BaseException] | None, *exc: object) -> None:
        """Finish the recording; if the body raised, leave it marked as unfinished, or remove it where it is empty."""
        if kind is None:
            self.close()
        elif not self._file.closed and self._times_ns is None and not self._other_counts:
            self.abandon()
            (self.path / PART_NAME).unlink()
            if self._made_folder:
                with suppress(OSError):  # another process put something else there
                    self.path.rmdir()
        elif not self._file.closed:
            try:
                self._end_file()
            except OSError:  # report the error that ended the body instead
                self.abandon()
            self._close_tail()

    def _close_tail(self) -> None:
        if self._tail is not None:
            self._tail.close()

    @contextmanager
    def _disk(self) -> Iterator[None]:
        """Convert an error of the disk into a one-line InputError, and leave the file readable up to there."""
        try:
            yield
        except OSError as error:
            self.abandon()
            raise InputError(
                f"{self.path}: cannot be written any more: {error.strerror}; what it holds can be read; "
                "make room and record the rest into another folder"
            ) from None

    def _add(self, frame: Frame, message: bytes, host_time_ns: int | None) -> None:
        stamp = max(frame.time_ns, 0)
        with self._disk():
            self._mcap.add_message(
                self._channels[frame.camera],
                log_time=stamp,
                data=message,
                publish_time=stamp if host_time_ns is None else host_time_ns,
                sequence=frame.index & 0xFFFFFFFF,
            )
        count = self._counts[frame.camera]
        setattr(count, frame.status, getattr(count, frame.status) + 1)
        first, last = self._times_ns or (frame.time_ns, frame.time_ns)
        self._times_ns = (min(first, frame.time_ns), max(last, frame.time_ns))

    def _end_file(self) -> None:
        self._mcap.finish()
        self._file.flush()
        os.fsync(self._file.fileno())
        self._file.close()

    def _schema_of(self, encoding: str) -> int:
        if encoding != "json":
            return 0
        if self._json_schema is None:
            self._json_schema = self._mcap.register_schema("object", "jsonschema", b'{"type": "object"}')
        return self._json_schema

    def _toml(self) -> str:
        first, last = self._times_ns or (0, 0)
        document = {
            "format": layout.PROFILE,
            "version": int(layout.VERSION),
            "holds": self.holds,
            "first_time_ns": first,
            "duration_s": (last - first) / 1e9,
            "camera": [
                {**asdict(info), "frames": asdict(self._counts[name])} for name, info in self._cameras.items()
            ],
            "channel": [{"name": name, "messages": n} for name, n in self._other_counts.items()],
            **self.about,
        }
        return _FOR_PEOPLE + tomli_w.dumps(document)


def _tail(cameras: Sequence[CameraInfo], tail_bytes: int) -> Tail | None:
    """Return memory for frames that wait; None where none is requested, or this system has none."""
    if tail_bytes <= 0:
        return None
    try:
        return Tail(cameras, tail_bytes)
    except OSError:
        return None
