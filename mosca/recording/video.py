"""A camera's frames in a video file, read through PyAV (FFmpeg).

A frame's number is derived from its presentation time: the usual spacing counts as one frame, so a frame that the
recorder left out is dropped and shifts no other. Where the times are too uneven for that (more than a quarter of the
spacing), frames are counted instead, with a note in the recording's notes.

Mono rule: grey and YUV formats give the luma plane *as stored*, without any expansion of its range (so that
lossless video gives the very values that were written). RGB formats go through FFmpeg's conversion to grey
(BT.601). Formats deeper than 8 bit give uint16.
"""

import statistics
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import av
import numpy as np
from av.container import InputContainer
from av.video.frame import VideoFrame

from mosca.data.arrays import Array
from mosca.data.files.bounded import open_file
from mosca.data.frames import CameraInfo, Frame
from mosca.data.rig import Camera
from mosca.errors import InputError
from mosca.recording.ffv1 import is_without_sums, whole_slices
from mosca.recording.folder import check_size
from mosca.recording.image_sequence import dropped_frame, numbered_frame
from mosca.recording.stamps import Stamps

VIDEO_SUFFIXES = (".mp4", ".mkv", ".avi", ".mov")
LARGEST_PX = 1 << 26
"""Largest image [px]; 8K has half of that. A decoder keeps several images, up to 8 bytes a pixel."""
_OPTIONS = {
    # a file of these names may list other files and addresses, which FFmpeg would open
    "format_whitelist": "matroska,mov,avi",
    "protocol_whitelist": "file",
    "max_pixels": str(LARGEST_PX),
}


@dataclass(frozen=True)
class VideoFeed:
    """One camera's video file; ``numbers`` maps presentation time -> frame number, counted from 0.

    ``damaged``: presentation times of packets that differ from what was written, though they may be decoded.
    """

    info: CameraInfo
    path: Path
    numbers: dict[int, int]
    damaged: frozenset[int] = frozenset()

    def frame_numbers(self) -> set[int]:
        """Return the numbers of the frames that the file holds."""
        return set(self.numbers.values())

    def frames(self, first: int, last: int, stamps: Stamps) -> Generator[Frame]:
        """Yield the frames ``first`` to ``last``: those left out are dropped, undecodable ones corrupt."""
        name, expected = self.info.name, first
        recorded = self.frame_numbers()
        with open_video(self.path) as container:
            for number, image in self._decoded(container):
                while expected < number:
                    yield self._absent(expected, recorded, stamps)
                    expected += 1
                if number == expected <= last:
                    yield numbered_frame(name, number, stamps.of(name, number), image, "")
                    expected += 1
        for number in range(expected, last + 1):
            yield self._absent(number, recorded, stamps)

    def _absent(self, number: int, recorded: set[int], stamps: Stamps) -> Frame:
        stamp = stamps.of(self.info.name, number)
        if number in recorded:
            fault = f"{self.path}: frame {number} cannot be decoded"
            return numbered_frame(self.info.name, number, stamp, None, fault)
        return dropped_frame(self.info.name, number, stamp, f"{self.path}: no frame {number}")

    def _decoded(self, container: InputContainer) -> Generator[tuple[int, Array]]:
        """Yield (number, image) of what can be decoded; a packet that cannot be is passed over."""
        stream = container.streams.video[0]
        packets = container.demux(stream)
        while True:
            try:
                packet = next(packets)
                frames = packet.decode()
            except StopIteration:
                return
            except av.error.FFmpegError:
                continue
            for frame in frames:
                if not isinstance(frame, VideoFrame) or frame.is_corrupt or frame.pts not in self.numbers:
                    continue
                if frame.pts in self.damaged:
                    continue
                if (frame.width, frame.height) == (self.info.width, self.info.height):
                    yield self.numbers[frame.pts], luma(frame)


def luma(frame: VideoFrame) -> Array:
    """Return the mono image (H, W) of a decoded frame, uint8 or uint16, by the rule of this module."""
    bits = frame.format.components[0].bits
    if not frame.format.name.startswith(("gray", "yuv", "nv")) or bits > 16:
        return np.ascontiguousarray(frame.to_ndarray(format="gray"))
    plane = memoryview(frame.planes[0])
    if bits <= 8:
        rows = np.frombuffer(plane, dtype=np.uint8).reshape(-1, frame.planes[0].line_size)
        return rows[: frame.height, : frame.width].copy()
    order = ">u2" if frame.format.is_big_endian else "<u2"
    deep = np.frombuffer(plane, dtype=order).reshape(-1, frame.planes[0].line_size // 2)
    return deep[: frame.height, : frame.width].astype(np.uint16)


def open_video(path: Path) -> InputContainer:
    """Open a video file; InputError for other files."""
    try:
        open_file(path).close()  # FFmpeg would wait for a named pipe
        # metadata: titles and the like, which nothing here reads
        container = av.open(f"file:{path}", options=_OPTIONS, metadata_errors="replace")
    except (av.error.FFmpegError, OSError) as error:
        raise InputError(f"{path}: cannot be read as a video: {error.strerror}") from None
    if not container.streams.video:
        container.close()
        raise InputError(f"{path}: holds no video stream")
    context = container.streams.video[0].codec_context
    # the context is None where the coding is unknown, and has no size where that is too large
    if context is None or not (context.width > 0 and context.height > 0) or context.pix_fmt is None:
        container.close()
        raise InputError(
            f"{path}: states no known coding, pixel format and size up to {LARGEST_PX} px; convert it with ffmpeg"
        )
    return container


def video_feed(name: str, path: Path, camera: Camera | None, rate_hz: float) -> tuple[VideoFeed, str]:
    """Return the feed of a video file for the camera called ``name`` and a note ("" where all is well).

    Raises InputError where the file is no video, holds no frame, or is not of the rig's camera's size.
    """
    with open_video(path) as container:
        stream = container.streams.video[0]
        check_size(path, (stream.width, stream.height), camera)
        bits = stream.format.components[0].bits
        times, damaged, unsummed = _packets(container, path)
        numbers, note = _number(times, path)
        note = note or unsummed
        seconds = container.duration / av.time_base if container.duration else 0.0
        if stream.average_rate and seconds * float(stream.average_rate) > max(numbers.values()) + 3:
            note = note or f"{path}: cut short: it states {seconds:.3f} s and ends earlier"
        info = CameraInfo(name, stream.width, stream.height, max(8, bits), rate_hz)
    return VideoFeed(info, path, numbers, damaged), note


def stated_rate_hz(path: Path) -> float | None:
    """Return the frame rate that the video file states, if it does."""
    with open_video(path) as container:
        rate = container.streams.video[0].average_rate
    return float(rate) if rate else None


def _packets(container: InputContainer, path: Path) -> tuple[list[int], frozenset[int], str]:
    """Return the presentation times, those of damaged packets, and a note ("" unless FFV1 has no checksums).

    Damage is detected in FFV1 with checksums. After a damaged packet it decodes wrongly up to the next key frame.
    """
    stream = container.streams.video[0]
    is_ffv1 = stream.codec_context.name == "ffv1"
    has_slices = is_ffv1 and bool(stream.codec_context.extradata)  # version 3; FFmpeg checks this record itself
    times: list[int] = []
    slices: list[int] = []
    keys: list[bool] = []
    any_plain = False
    packets = container.demux(stream)
    while True:
        try:
            packet = next(packets)
        except (StopIteration, av.error.FFmpegError):
            break
        if packet.pts is None or not packet.size:
            continue
        times.append(packet.pts)
        if has_slices:
            data = bytes(packet)
            slices.append(whole_slices(data))
            keys.append(packet.is_keyframe)
            any_plain |= not slices[-1] and is_without_sums(data)
    if not is_ffv1 or any(slices) or (has_slices and not any_plain):
        return sorted(set(times)), frozenset(_damaged(times, slices, keys)), ""
    note = f"{path}: its FFV1 has no checksums, so damage is not seen; encode with -level 3 -slicecrc 1"
    return sorted(set(times)), frozenset(), note


def _damaged(times: list[int], slices: list[int], keys: list[bool]) -> Iterator[int]:
    """Yield the times of damaged packets; whole packets all have the same number of slices."""
    wanted, broken = max(slices, default=0), False
    for time, found, is_key in zip(times, slices, keys, strict=False):
        broken = found == 0 or found < wanted or (broken and not is_key)
        if broken:
            yield time


def _number(times: list[int], path: Path) -> tuple[dict[int, int], str]:
    """Number presentation times by the spacings between them, or by counting where these are uneven.

    Containers round times to their tick. So steps are compared with the mean of the single steps, and a
    tick is allowed on top of the quarter.
    """
    if not times:
        raise InputError(f"{path}: holds no frame")
    steps = [later - earlier for earlier, later in pairwise(times)]
    if not steps:
        return {times[0]: 0}, ""
    usual = statistics.median(steps)
    spacing = statistics.fmean(step for step in steps if step < 1.5 * usual)
    numbers = [0]
    for step in steps:
        n = max(1, round(step / spacing))
        if abs(step - n * spacing) > 0.25 * spacing + 1:
            note = f"{path}: its times are uneven, so frames are counted; one left out would not be seen"
            return {time: k for k, time in enumerate(times)}, note
        numbers.append(numbers[-1] + n)
    return dict(zip(times, numbers, strict=True)), ""
