"""Messages between stations as bytes: little-endian, versioned, exact.

A message of detections is a head of 80 bytes, two names, and columns of n targets:

| bytes | type | field |
|---|---|---|
| 0-1 | 2 chars | ``MO`` |
| 2 | uint8 | version, 3 |
| 3 | uint8 | kind: 1 detections, 2 health |
| 4 | uint8 | status: 0 detected, 1 no frame, 2 corrupt frame, 3 skipped (the station was behind) |
| 5, 6 | uint8 | bytes of the station's and the camera's name |
| 7 | uint8 | 0 |
| 8 | uint64 | epoch: a random number of this start of the station |
| 16 | uint64 | sequence: counts this camera's messages from 0 |
| 24 | int64 | pulse, as the station counts |
| 32 | int64 | time_ns: mid-exposure; pulse k is at k periods |
| 40 | int64 | exposure_ns |
| 48 | int64 | arrival_ns: the station's clock when the frame was there |
| 56 | int64 | sent_ns: the station's clock when the message left |
| 64 | uint64 | n |
| 72 | uint64 | bytes of the whole message |
| 80 | utf-8 | station, camera; zeros up to a multiple of 8 |
| then | float64 | xy_px (n, 2); covariance_px2 xx, xy, yy (n, 3); diameter_px, peak, elongation (n) |
| then | float64 | diameter_sigma_px (n); ellipticity (n, 2), ellipticity_sigma (n) |
| then | uint8 | flags (n) |

A message of health is bytes 0-3 and a JSON object in utf-8 with the fields of ``HealthMessage``. An answer of the
clock, and an order to start, is epoch (uint64) and a time of the station's clock (int64); a query whether a
station's last message was received is epoch (uint64) and its name, the answer a byte: 1 yes, 0 not yet. Numbers are
exact to the last bit: merged detections equal local ones.
"""

import json
import struct
from dataclasses import asdict, dataclass
from typing import Annotated, Literal

import numpy as np
from pydantic import ConfigDict, Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass as checked_dataclass

from mosca.data.detections import Detections
from mosca.data.files.toml import in_words
from mosca.errors import MoscaError

VERSION = 3
MAGIC = b"MO"
DETECTIONS, HEALTH = 1, 2
DetectionStatus = Literal["detected", "no frame", "corrupt", "skipped"]
STATUSES: tuple[DetectionStatus, ...] = ("detected", "no frame", "corrupt", "skipped")
State = Literal["starting", "holding", "armed", "running", "ended", "failed"]
MOST_TARGETS = 100_000
_HEAD = struct.Struct("<2sBBBBBBQQqqqqqQQ")
_CLOCK = struct.Struct("<Qq")
_EPOCH = struct.Struct("<Q")
YES, NOT_YET = b"\1", b"\0"
"""Answers to whether a station's last message was received."""


class MessageError(MoscaError):
    """Bytes that are no message of this version."""


@dataclass(frozen=True, eq=False)
class DetectionMessage:
    """One camera's detections of one pulse; times in ns. Empty unless ``status`` is "detected"."""

    station: str
    epoch: int
    sequence: int
    pulse: int
    time_ns: int
    exposure_ns: int
    arrival_ns: int
    sent_ns: int
    status: DetectionStatus
    detections: Detections


Count = Annotated[int, Field(ge=0)]
_CHECKED = ConfigDict(extra="ignore", allow_inf_nan=False)


@checked_dataclass(frozen=True, config=_CHECKED)
class StationCamera:
    """A camera of a station, and the number of messages that its station has sent of it."""

    name: Annotated[str, Field(min_length=1, max_length=255)]
    width: Annotated[int, Field(ge=1)]
    height: Annotated[int, Field(ge=1)]
    bit_depth: Annotated[int, Field(ge=1, le=16)]
    rate_hz: Annotated[float, Field(gt=0)]
    sent: Count = 0


@checked_dataclass(frozen=True, config=_CHECKED)
class HealthMessage:
    """State and counts of a station."""

    station: Annotated[str, Field(min_length=1, max_length=60)]
    epoch: Annotated[int, Field(ge=0, lt=1 << 64)]
    sent_ns: Annotated[int, Field(ge=-(1 << 63), lt=1 << 63)]
    """Time of its own clock [ns]."""
    state: State
    """``holding``: makes the pulses, waits for the start command; ``armed``: waits for frames; ``failed``: see
    ``notes``."""
    cameras: tuple[StationCamera, ...] = ()
    refused: Count = 0
    """Messages that the engine did not take."""
    skipped: Count = 0
    """Frames that the station did not process because it was behind."""
    notes: tuple[str, ...] = ()
    """The latest notes."""


_HEALTH = TypeAdapter(HealthMessage)


def pack_detections(message: DetectionMessage) -> bytes:
    """Return ``message`` as bytes. ValueError for a covariance that is not symmetric."""
    found = message.detections
    n = len(found)
    station, camera = message.station.encode(), found.camera.encode()
    covariance = found.covariance_px2
    if not np.array_equal(covariance[:, 0, 1], covariance[:, 1, 0]):
        raise ValueError(f"camera '{found.camera}', pulse {message.pulse}: covariance is not symmetric")
    names = station + camera
    names += bytes(-len(names) % 8)
    columns = np.concatenate(
        [
            found.xy_px.ravel(),
            covariance.reshape(n, 4)[:, [0, 1, 3]].ravel(),
            found.diameter_px,
            found.peak,
            found.elongation,
            found.diameter_sigma_px,
            found.ellipticity.ravel(),
            found.ellipticity_sigma,
        ]
    ).astype("<f8")
    size = _HEAD.size + len(names) + columns.nbytes + n
    head = _HEAD.pack(
        MAGIC, VERSION, DETECTIONS, STATUSES.index(message.status), len(station), len(camera), 0,
        message.epoch, message.sequence, message.pulse, message.time_ns, message.exposure_ns, message.arrival_ns,
        message.sent_ns, n, size,
    )  # fmt: skip
    return b"".join((head, names, columns.tobytes(), found.flags.tobytes()))


def unpack_detections(data: bytes) -> DetectionMessage:
    """Return the message that ``data`` holds; MessageError for anything else."""
    _check_start(data, DETECTIONS)
    if len(data) < _HEAD.size:
        raise MessageError(f"detections: {len(data)} bytes given, {_HEAD.size} are the least")
    (_, _, _, status, n_station, n_camera, _, epoch, sequence, pulse, time_ns, exposure_ns, arrival_ns, sent_ns,
     n, size) = _HEAD.unpack_from(data)  # fmt: skip
    begin = _HEAD.size + n_station + n_camera
    begin += -begin % 8
    if n > MOST_TARGETS or size != len(data) or size != begin + 97 * n:
        raise MessageError(f"detections: {len(data)} bytes given for {n} targets, {begin + 97 * n} are wanted")
    if status >= len(STATUSES) or (status and n):
        raise MessageError(f"detections: status {status} with {n} targets")
    try:
        station = data[_HEAD.size : _HEAD.size + n_station].decode()
        camera = data[_HEAD.size + n_station : _HEAD.size + n_station + n_camera].decode()
    except UnicodeDecodeError:
        raise MessageError("detections: a name is not utf-8") from None
    columns = np.frombuffer(data, "<f8", 12 * n, begin)
    if not np.isfinite(columns).all():
        raise MessageError(f"detections: camera '{camera}', pulse {pulse}: a number is not finite")
    covariance = columns[2 * n : 5 * n].reshape(n, 3)[:, [0, 1, 1, 2]]
    found = Detections(
        camera,
        columns[: 2 * n].reshape(n, 2),
        covariance.reshape(n, 2, 2),
        columns[5 * n : 6 * n],
        columns[6 * n : 7 * n],
        columns[7 * n : 8 * n],
        np.frombuffer(data, np.uint8, n, begin + 96 * n),
        columns[8 * n : 9 * n],
        columns[9 * n : 11 * n].reshape(n, 2),
        columns[11 * n :],
    )
    return DetectionMessage(
        station, epoch, sequence, pulse, time_ns, exposure_ns, arrival_ns, sent_ns, STATUSES[status], found
    )


def pack_health(message: HealthMessage) -> bytes:
    """Return ``message`` as bytes."""
    return MAGIC + bytes((VERSION, HEALTH)) + json.dumps(asdict(message)).encode()


def unpack_health(data: bytes) -> HealthMessage:
    """Return the message that ``data`` holds; MessageError for anything else."""
    _check_start(data, HEALTH)
    try:
        return _HEALTH.validate_json(data[4:])
    except ValidationError as error:
        raise MessageError(f"health: {in_words(error.errors()[0])}") from None


def pack_clock(epoch: int, clock_ns: int) -> bytes:
    """Return the answer of a station's clock."""
    return _CLOCK.pack(epoch, clock_ns)


def unpack_clock(data: bytes) -> tuple[int, int]:
    """Return epoch and clock [ns] of an answer; MessageError for anything else."""
    if len(data) != _CLOCK.size:
        raise MessageError(f"clock: {len(data)} bytes given, {_CLOCK.size} are wanted")
    epoch, clock_ns = _CLOCK.unpack(data)
    return epoch, clock_ns


def pack_heard(station: str, epoch: int) -> bytes:
    """Return the query whether the last message of this start of a station was received."""
    return _EPOCH.pack(epoch) + station.encode()


def unpack_heard(data: bytes) -> tuple[str, int]:
    """Return station and epoch of such a query; MessageError for anything else."""
    if len(data) < _EPOCH.size:
        raise MessageError(f"heard: {len(data)} bytes given, {_EPOCH.size} are the least")
    return data[_EPOCH.size :].decode(errors="replace"), _EPOCH.unpack_from(data)[0]


def _check_start(data: bytes, kind: int) -> None:
    if len(data) < 4 or data[:2] != MAGIC:
        raise MessageError("a message that does not begin with 'MO'; something else publishes under 'mosca/'")
    if data[2] != VERSION:
        raise MessageError(f"a message of version {data[2]}, this is version {VERSION}; install the same on all PCs")
    if data[3] != kind:
        raise MessageError(f"a message of kind {data[3]}, {kind} is wanted")
