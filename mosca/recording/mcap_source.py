"""Reader of ``recording.mcap``; a file whose writer was killed is read up to its cut, with a note."""

import math
import struct
import zlib
from collections import Counter
from collections.abc import Generator, Iterator, Sequence
from contextlib import ExitStack, closing
from io import BufferedReader
from pathlib import Path
from typing import Any

from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.records import Attachment, Channel, Chunk, Message, Metadata
from mcap.stream_reader import StreamReader, breakup_chunk

from mosca.data.detections import Detections
from mosca.data.files.bounded import MOST_IMAGE_BYTES, open_file, parse_json
from mosca.data.frames import CameraInfo, Frame, FrameSet
from mosca.errors import InputError
from mosca.recording import mcap_format as layout
from mosca.recording.account import TOML_NAME, recorded_account
from mosca.recording.crash_buffer import NO_TOKEN, Kept, read_tail, rescued
from mosca.recording.pulses import RecordedPulse, recorded_pulses

LARGEST_RECORD = 1 << 29
_MAGIC = b"\x89MCAP0\r\n"
# Errors that the mcap package raises on damaged files.
_DAMAGE = (McapError, ValueError, KeyError, struct.error, OverflowError, RuntimeError, MemoryError)


class McapRecording:
    """A FrameSource over ``recording.mcap``.

    Frames come in the order in which they were written. A frame whose pixels are damaged is corrupt. Damage beyond
    one frame loses the frames concerned (gaps); it is reported in ``notes``, as is a missing end. Frames that were
    still waiting when the writer was killed come last (``mosca.recording.crash_buffer``). A recording that ``holds``
    "detections" has no frames: ``detection_sets`` yields its content.
    """

    def __init__(self, path: Path, only: Sequence[str] | None = None) -> None:
        """Open ``path``; ``only`` names the cameras to be read and their order (default: all).

        Raises InputError where it is no recording or lacks one of them.
        """
        self.path = path
        self._notes: dict[str, None] = {}
        self._running: set[ExitStack] = set()
        self._closed = False
        self.rig_toml_text: str | None = None
        self.holds: layout.Holds = "frames"
        self._tail: Path | None = None
        infos = {info.name: info for info in self._read_head()}
        self._all_cameras = tuple(infos.values())
        for name in only or ():
            if name not in infos:
                raise InputError(f"{path}: no camera '{name}' of the rig; it has {', '.join(infos)}")
        self._cameras = tuple(infos[name] for name in (only if only is not None else infos))

    @property
    def cameras(self) -> tuple[CameraInfo, ...]:
        """Properties of each camera."""
        return self._cameras

    @property
    def n_frames(self) -> int | None:
        """Number of frames of these cameras, as the file states it; None where its end is missing."""
        topics = {layout.camera_topic(info.name, self.holds) for info in self._cameras}
        with self._opened() as file:
            try:
                summary = make_reader(file).get_summary()
            except (*_DAMAGE, OSError):  # an offset beyond what a file can have
                return None
        if summary is None or summary.statistics is None:
            return None
        counts = summary.statistics.channel_message_counts
        return sum(counts.get(c.id, 0) for c in summary.channels.values() if c.topic in topics)

    @property
    def notes(self) -> tuple[str, ...]:
        """Irregularities of the recording, in words; more are added while frames are read."""
        return tuple(self._notes)

    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames from the start; may be done again. InputError where it holds detections alone."""
        if self.holds != "frames":
            raise InputError(
                f"{self.path}: holds detections and no images; 'mosca reconstruct' reads it, other verbs need a "
                "recording that was captured without --detections"
            )
        names = {layout.camera_topic(info.name, "frames"): info.name for info in self._cameras}
        last = {info.name: -1 for info in self._cameras}
        seen = 0
        with closing(self._messages()) as messages:
            for channel, message in messages:
                camera = names.get(channel.topic)
                if camera is None or channel.message_encoding != layout.FRAME_ENCODING:
                    continue
                seen += 1
                try:
                    frame = layout.unpack_frame(camera, message.data)
                except layout.DamagedMessage as error:
                    self._note(f"a frame of {camera} near {message.log_time} ns is lost: {error}")
                    continue
                last[camera] = frame.index
                yield frame
        self._note_missing(seen)
        for kept in self.waiting():
            # slots are not emptied when their frames are written
            if kept.frame.camera in last and kept.frame.index > last[kept.frame.camera]:
                yield kept.frame

    def waiting(self) -> list[Kept]:
        """Return the frames that had waited longest to be written when the writer was killed; some were written."""
        if self._tail is None:
            return []
        return read_tail(self._tail, self._all_cameras, self._note_text)

    def detection_sets(self) -> Iterator[tuple[FrameSet, dict[str, Detections]]]:
        """Yield the frame sets, without frames, and the detections of each camera; only where it ``holds`` them.

        Sets that were left out or cut off are missing, as the pulse numbers show.
        """
        names = {layout.camera_topic(info.name, "detections"): info.name for info in self._cameras}
        here: dict[str, tuple[int, Detections]] = {}
        seen = 0
        with closing(self._messages()) as messages:
            for channel, message in messages:
                camera = names.get(channel.topic)
                seen += camera is not None
                try:
                    if camera is not None:
                        here[camera] = layout.unpack_detections(camera, message.data)
                    elif channel.topic == f"/{layout.SETS}":
                        told = parse_json(message.data)
                        frame_set = FrameSet(int(told["pulse"]), int(told["time_ns"]))
                        found = {info.name: here.get(info.name, (None, None)) for info in self._cameras}
                        here = {}
                        yield (
                            frame_set,
                            {n: d for n, (p, d) in found.items() if d is not None and p == frame_set.pulse},
                        )
                except (ValueError, KeyError, TypeError) as error:
                    self._note(f"detections near {message.log_time} ns are lost: {_said(error)}")
        self._note_missing(seen)

    def channel(self, name: str) -> Iterator[tuple[int, Any]]:
        """Yield (time_ns, data) of a further channel: JSON as Python values, anything else as bytes."""
        with closing(self._messages()) as messages:
            for channel, message in messages:
                if channel.topic != f"/{name}":
                    continue
                try:
                    is_json = channel.message_encoding == "json"
                    data = parse_json(message.data) if is_json else message.data
                except ValueError as error:
                    self._note(f"a message of {name} at {message.log_time} ns is lost: {error}")
                    continue
                yield message.log_time, data

    def pulses(self) -> tuple[RecordedPulse, ...]:
        """Return a capture's pulses by number, with times and how each frame's was found; others have none."""
        return recorded_pulses(self.channel("clock"), self._all_cameras[0].frame_rate_hz, str(self.path))

    def account(self) -> dict[str, Any]:
        """Return what the recording should hold, by its own account (``recorded_account``), and its notes."""
        return recorded_account(self.path.with_name(TOML_NAME), self.pulses()) | {"notes": list(self.notes)}

    def close(self) -> None:
        """Free the file of every iteration that is under way; may be called twice."""
        self._closed = True
        for stack in tuple(self._running):
            stack.close()

    def __enter__(self) -> "McapRecording":
        """Return the recording itself."""
        return self

    def __exit__(self, *exc: object) -> None:
        """Close it."""
        self.close()

    def _note(self, text: str) -> None:
        self._note_text(f"{self.path}: {text}")

    def _note_text(self, text: str) -> None:
        self._notes.setdefault(text)

    def _note_missing(self, seen: int) -> None:
        """Add a note where the file states another number of its cameras' messages than ``seen``."""
        stated = self.n_frames
        if stated is not None and stated != seen:
            self._note(f"{seen} of the {stated} messages of its cameras that it states are there")

    def _messages(self) -> Generator[tuple[Channel, Message]]:
        channels: dict[int, Channel] = {}
        with_sums = {layout.camera_topic(info.name, self.holds) for info in self._all_cameras}
        for record, intact in self._records():
            if isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Message):
                channel = channels.get(record.channel_id)
                if channel is None:
                    self._note(f"messages of channel {record.channel_id} are lost: what it is called is damaged")
                elif intact or channel.topic in with_sums:
                    yield channel, record

    def _records(self) -> Generator[tuple[Any, bool]]:
        """Yield the records of the file up to its end, or to where the rest cannot be read.

        Each comes with whether its chunk's checksum holds; if not, only records with their own checksums are trusted.
        """
        if self._closed:
            raise InputError(f"{self.path}: the recording is closed; open it again")
        with ExitStack() as stack:
            self._running.add(stack)
            stack.callback(self._running.discard, stack)
            file = stack.enter_context(self._opened())
            records = StreamReader(file, emit_chunks=True, record_size_limit=LARGEST_RECORD).records
            while not self._closed:
                try:
                    record = next(records)
                except StopIteration:
                    return
                except (*_DAMAGE, OSError) as error:
                    self._note(f"cannot be read beyond byte {file.tell()} ({_said(error)})")
                    return
                if not isinstance(record, Chunk):
                    yield record, True
                    continue
                if record.compression in ("lz4", "zstd"):
                    raise InputError(
                        f"{self.path}: its chunks were compressed with {record.compression}; "
                        "version 1 leaves them plain: run 'mcap decompress' on it first"
                    )
                try:
                    inner = breakup_chunk(record)
                except _DAMAGE as error:
                    self._note(f"damaged before byte {file.tell()}; its frames are lost ({_said(error)})")
                    continue
                intact = record.uncompressed_crc in (0, zlib.crc32(record.data))
                if not intact:
                    self._note(f"damaged before byte {file.tell()}; what has no checksum of its own is lost there")
                    inner = _without_doubles(inner)
                for one in inner:
                    yield one, intact

    def _opened(self) -> BufferedReader:
        try:
            return open_file(self.path)
        except OSError as error:
            raise InputError(f"{self.path}: cannot be read: {error.strerror}") from None

    def _read_head(self) -> tuple[CameraInfo, ...]:
        """Read what precedes the first message; note a missing end."""
        with self._opened() as file:
            if file.read(len(_MAGIC)) != _MAGIC:
                raise InputError(f"{self.path}: is not an MCAP file; record it again or name another")
            file.seek(-len(_MAGIC), 2)
            if file.read() != _MAGIC:
                self._note("its writer did not finish; it is read up to where it was cut")
        if self.path.suffix == ".part":
            self._note("its writer did not finish; it is read up to where it was cut")
        metadata: dict[str, dict[str, str]] = {}
        with closing(self._records()) as records:
            for record, _ in records:
                if isinstance(record, Metadata):
                    metadata[record.name] = record.metadata
                elif isinstance(record, Attachment) and record.name == "rig.toml":
                    self.rig_toml_text = record.data.decode("utf-8", errors="replace")
                elif isinstance(record, Channel):
                    break
        return self._camera_infos(metadata)

    def _camera_infos(self, metadata: dict[str, dict[str, str]]) -> tuple[CameraInfo, ...]:
        for name, fields in metadata.items():
            if not layout.is_sealed(name, fields):
                raise InputError(f"{self.path}: what it says of {name} is damaged: its checksum is wrong")
        version = metadata.get(layout.PROFILE, {}).get("version")
        if metadata.get(layout.PROFILE, {}).get("holds") == "detections":
            self.holds = "detections"
        if self.path.suffix == ".part":
            self._tail = _tail(self.path, metadata.get(layout.PROFILE, {}))
        if version != layout.VERSION:
            raise InputError(
                f"{self.path}: version {version} of a mosca recording; version {layout.VERSION} can be read"
                if version
                else f"{self.path}: an MCAP file, but not a mosca recording; record it with mosca capture"
            )
        cameras = []
        for name, fields in metadata.items():
            if not name.startswith("camera/"):
                continue
            try:
                cameras.append(_camera_info(name.removeprefix("camera/"), fields))
            except (KeyError, ValueError) as error:
                raise InputError(f"{self.path}: what it says of {name} is damaged: {error}") from None
        if not cameras:
            raise InputError(f"{self.path}: names no camera; it was cut before the first frame")
        stated = metadata[layout.PROFILE].get("cameras", str(len(cameras)))
        if stated != str(len(cameras)):
            raise InputError(f"{self.path}: describes {len(cameras)} of its {stated} cameras; the rest is damaged")
        rig_sum = metadata[layout.PROFILE].get("rig_crc32")
        if rig_sum is not None and (self.rig_toml_text is None or layout.text_sum(self.rig_toml_text) != rig_sum):
            self._note("the rig file inside is damaged and left out")
            self.rig_toml_text = None
        return tuple(cameras)


def _without_doubles(records: Sequence[Any]) -> list[Any]:
    """Return the records of a damaged chunk without those that occur twice.

    Checksums of frames do not cover their channel: of two with one channel and number, one is another camera's.
    """

    def key(record: Any) -> tuple[str, int, int]:
        if isinstance(record, Channel):
            return "channel", record.id, 0
        return ("message", record.channel_id, record.sequence) if isinstance(record, Message) else ("", id(record), 0)

    times = Counter(map(key, records))
    return [record for record in records if times[key(record)] == 1]


def _tail(part: Path, fields: dict[str, str]) -> Path | None:
    """Return the file of frames that waited to be written to ``part``; ``fields``: what ``part`` states of itself."""
    try:
        token = bytes.fromhex(fields.get("tail_token", NO_TOKEN.hex()))
    except ValueError:
        return None
    return rescued(part, Path(fields["tail"]), token) if "tail" in fields else None


def _said(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}".rstrip(": ")


def _camera_info(name: str, fields: dict[str, str]) -> CameraInfo:
    clock, event = fields["clock"], fields["stamp_event"]
    width, height, bits = (int(fields[key]) for key in ("width", "height", "bit_depth"))
    rate_hz = float(fields["frame_rate_hz"])
    n_bytes = width * height * (1 if bits <= 8 else 2)
    if min(width, height, bits) < 1 or bits > 16 or n_bytes > MOST_IMAGE_BYTES or not 0 <= rate_hz < math.inf:
        raise ValueError(f"{width}x{height} px of {bits} bit at {rate_hz:g} frames/s")
    if clock not in ("device", "host", "session") or event not in layout.EVENTS:
        raise ValueError(f"clock {clock!r}, stamp event {event!r}")
    return CameraInfo(
        name,
        width,
        height,
        bits,
        rate_hz,
        clock,  # type: ignore[arg-type]
        event,
    )
