"""The project's MCAP layout, version 1: content of ``recording.mcap``, for other readers.

The file is a plain MCAP file (mcap.dev) with uncompressed chunks; profile ``mosca-recording``.

- Metadata record ``mosca-recording``: ``version`` = "1", ``holds`` = "frames" (assumed where it is missing) or
  "detections". Optional: ``tail`` = a file in which frames wait to be written, ``tail_token`` = 16 bytes in
  hexadecimal digits that identify it (``mosca.recording.crash_buffer``); ``cameras``, their number; ``rig_crc32`` of
  the attachment.
- Metadata record ``camera/NAME`` for each camera, in the rig's order: ``width``, ``height``,
  ``bit_depth``, ``frame_rate_hz``, ``clock`` (device, host or session), ``stamp_event``.
- Both hold ``crc32``, eight hexadecimal digits, of the record's name and its other entries in the order of their
  keys, each followed by a zero byte: name, key, value, key, value ... (older recordings have none).
- Attachment ``rig.toml`` (application/toml), where the rig was known.
- Channel ``/camera/NAME/frame`` for each camera, message encoding ``mosca.frame.v1``; a message for each frame, lost
  and damaged ones too, in order of arrival. ``log_time`` is the frame's stamp [ns] (0 if it is negative),
  ``publish_time`` the host's time of arrival [ns] where it is known, else the stamp; ``sequence`` the low
  32 bits of the camera's counter.
- Instead of it, where the recording holds detections: channel ``/camera/NAME/detections`` for each camera, message
  encoding ``mosca.detections.v3``, a message for each usable frame of a frame set; ``log_time``, ``publish_time`` and
  ``sequence`` are the frame's, as above. A message of channel ``/sets`` (JSON) ends each frame set, empty ones too:
  ``pulse`` and ``time_ns``, the set's number and time.
- Channel ``/NAME`` for each further channel (commands, events, onboard streams) on the same clock as the
  frames; message encoding ``json`` (an object a message) or ``application/octet-stream``. A capture's ``/clock`` has
  the pulses and the raw stamps of the frames (``mosca.recording.pulses``, docs/capture.md).

A ``mosca.frame.v1`` message, little-endian, without padding::

    u32 crc32 of the header's other bytes and the note     (zlib.crc32)
    u32 crc32 of the payload
    u8  status         0 ok, 1 dropped, 2 corrupt
    u8  stamp event    0 exposure_start, 1 exposure_middle, 2 readout
    u8  bytes a pixel  1 or 2; 0 where there is no image
    u8  reserved, 0
    u32 height, u32 width [px]
    i64 index, i64 time [ns], i64 exposure [ns], i64 row time [ns]
    u32 length of the note, then the note (UTF-8)
    payload: one blosc2 chunk (bitshuffle, LZ4 or Zstandard) of the pixels, row by row, little-endian

A ``mosca.detections.v3`` message, little-endian, without padding::

    u32 crc32 of the bytes that follow                     (zlib.crc32)
    u8  stamp event    as above
    u8, u16            reserved, 0
    u32 n, the number of detections
    i64 pulse of the frame set, i64 index, i64 time [ns], i64 exposure [ns], i64 row time [ns] of the frame
    n x 12 f64         x, y [px], covariance xx, xy, yy [px2], diameter [px], peak [DN], elongation, standard
                       deviation of the diameter [px], ellipticity (2) and its standard deviation (v2: 9, without
                       these three; v1: 8, also without the diameter's)
    n x u8             flags (1 saturated, 2 merged, 4 partly hidden, 8 unrefined)
"""

import struct
import zlib
from collections.abc import Mapping
from typing import Literal, get_args

import numpy as np

from mosca.data.detections import Detections
from mosca.data.files.bounded import MOST_IMAGE_BYTES
from mosca.data.frames import Frame, FrameStatus, StampEvent

PROFILE = "mosca-recording"
VERSION = "1"
FRAME_ENCODING = "mosca.frame.v1"
DETECTIONS_ENCODING = "mosca.detections.v3"
SETS = "sets"
STATUSES: tuple[FrameStatus, ...] = get_args(FrameStatus)
EVENTS: tuple[StampEvent, ...] = get_args(StampEvent)
Codec = Literal["lz4", "zstd"]
Holds = Literal["frames", "detections"]

_SUMS = struct.Struct("<II")
_HEADER = struct.Struct("<BBBBIIqqqqI")
_SUM = struct.Struct("<I")
_DETECTIONS = struct.Struct("<BBHIqqqqq")
_NUMBERS = (12, 9, 8)  # of this version and of older ones
_CODECS = {"lz4": ("LZ4", 5), "zstd": ("ZSTD", 1)}


class DamagedMessage(ValueError):
    """A message of a camera whose header cannot be trusted."""


def sealed(name: str, entries: Mapping[str, str]) -> dict[str, str]:
    """Return the entries of the metadata record ``name`` with their checksum."""
    return {**entries, "crc32": _seal(name, entries)}


def is_sealed(name: str, entries: Mapping[str, str]) -> bool:
    """Return whether a metadata record is as it was written; older ones without a checksum pass."""
    return entries.get("crc32", (seal := _seal(name, entries))) == seal


def _seal(name: str, entries: Mapping[str, str]) -> str:
    words = [name, *(word for key in sorted(entries) if key != "crc32" for word in (key, entries[key]))]
    return text_sum("".join(f"{word}\0" for word in words))


def text_sum(text: str) -> str:
    """Return the crc32 of a text, eight hexadecimal digits."""
    return f"{zlib.crc32(text.encode('utf-8')):08x}"


def camera_topic(camera: str, holds: Holds) -> str:
    """Return the topic of a camera's frames or detections."""
    return f"/camera/{camera}/{'frame' if holds == 'frames' else 'detections'}"


def pack_frame(frame: Frame, codec: Codec) -> bytes:
    """Return the message of ``frame``."""
    image = frame.image
    payload = b"" if image is None else _packed(image.astype(image.dtype.newbyteorder("<"), copy=False), codec)
    height, width = (0, 0) if image is None else image.shape
    note = frame.note.encode("utf-8")
    header = _HEADER.pack(
        STATUSES.index(frame.status),
        EVENTS.index(frame.stamp_event),
        0 if image is None else image.dtype.itemsize,
        0,
        height,
        width,
        frame.index,
        frame.time_ns,
        frame.exposure_ns,
        frame.row_time_ns,
        len(note),
    )
    return b"".join((_SUMS.pack(zlib.crc32(header + note), zlib.crc32(payload)), header, note, payload))


def unpack_frame(camera: str, message: bytes) -> Frame:
    """Return the frame of a message; a corrupt one where the pixels are damaged.

    Raises DamagedMessage where the header is damaged, so that not even the frame's time can be trusted.
    """
    start = _SUMS.size + _HEADER.size
    if len(message) < start:
        raise DamagedMessage("message cut short")
    header_sum, payload_sum = _SUMS.unpack_from(message)
    status, event, pixel, _, height, width, index, time_ns, exposure_ns, row_ns, n_note = _HEADER.unpack_from(
        message, _SUMS.size
    )
    data_at = start + n_note
    if zlib.crc32(memoryview(message)[_SUMS.size : data_at]) != header_sum:
        raise DamagedMessage("wrong checksum of the header")
    if status >= len(STATUSES) or event >= len(EVENTS):
        raise DamagedMessage("unknown status or stamp event")
    note = message[start:data_at].decode("utf-8", errors="replace")
    image = None
    if STATUSES[status] == "ok":
        payload = message[data_at:]
        image = None if zlib.crc32(payload) != payload_sum else _unpacked(payload, height, width, pixel)
        if image is None:
            status, note = STATUSES.index("corrupt"), "its pixels are damaged in the recording"
    return Frame(camera, index, time_ns, exposure_ns, image, STATUSES[status], EVENTS[event], row_ns, note)


def _packed(image: np.ndarray, codec: Codec) -> bytes:
    import blosc2  # takes half a second to import

    kind, level = _CODECS[codec]
    packed: bytes = blosc2.compress2(
        np.ascontiguousarray(image),
        codec=blosc2.Codec[kind],
        clevel=level,
        filters=[blosc2.Filter.BITSHUFFLE],
        typesize=image.dtype.itemsize,
        nthreads=1,
    )
    return packed


def _unpacked(payload: bytes, height: int, width: int, pixel: int) -> np.ndarray | None:
    """Return the image (height, width), or None where the payload does not hold one."""
    import blosc2  # as above

    if pixel not in (1, 2) or height * width * pixel > MOST_IMAGE_BYTES:
        return None
    try:
        # a chunk of a few bytes may decompress to gigabytes
        if blosc2.get_cbuffer_sizes(payload)[0] != height * width * pixel:
            return None
        pixels = blosc2.decompress2(payload, nthreads=1)
    except (ValueError, RuntimeError):
        return None
    if len(pixels) != height * width * pixel:
        return None
    image = np.frombuffer(pixels, dtype="<u2" if pixel == 2 else "u1").reshape(height, width)
    return image.astype(np.uint16 if pixel == 2 else np.uint8, copy=False)


def pack_detections(pulse: int, frame: Frame, found: Detections) -> bytes:
    """Return the message of what was found in ``frame`` of the frame set ``pulse``."""
    xx, xy, yy = found.covariance_px2[:, 0, 0], found.covariance_px2[:, 0, 1], found.covariance_px2[:, 1, 1]
    size = (
        found.diameter_px,
        found.peak,
        found.elongation,
        found.diameter_sigma_px,
        found.ellipticity,
        found.ellipticity_sigma,
    )
    numbers = np.column_stack((found.xy_px, xx, xy, yy, *size))
    event = EVENTS.index(frame.stamp_event)
    times = (frame.index, frame.time_ns, frame.exposure_ns, frame.row_time_ns)
    header = _DETECTIONS.pack(event, 0, 0, len(found), pulse, *times)
    body = b"".join((header, numbers.astype("<f8").tobytes(), found.flags.tobytes()))
    return _SUM.pack(zlib.crc32(body)) + body


def unpack_detections(camera: str, message: bytes) -> tuple[int, Detections]:
    """Return the pulse and the detections of a message; raises DamagedMessage."""
    start = _SUM.size + _DETECTIONS.size
    if len(message) < start or zlib.crc32(memoryview(message)[_SUM.size :]) != _SUM.unpack_from(message)[0]:
        raise DamagedMessage("wrong checksum, or cut short")
    _, _, _, n, pulse, *_ = _DETECTIONS.unpack_from(message, _SUM.size)
    columns = next((k for k in _NUMBERS if len(message) == start + n * (8 * k + 1)), 0)
    if not columns:
        raise DamagedMessage(f"{n} detections announced in {len(message)} bytes")
    numbers = np.frombuffer(message, "<f8", n * columns, start).reshape(n, columns)
    flags = np.frombuffer(message, np.uint8, n, start + n * 8 * columns)
    covariance = numbers[:, [2, 3, 3, 4]].reshape(n, 2, 2)
    diameter, peak, elongation = numbers[:, 5:8].T
    unknown = np.empty(0)
    sigma = numbers[:, 8] if columns > 8 else unknown
    shape = (numbers[:, 9:11], numbers[:, 11]) if columns > 9 else (unknown, unknown)
    return pulse, Detections(camera, numbers[:, :2], covariance, diameter, peak, elongation, flags, sigma, *shape)
