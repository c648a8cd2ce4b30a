"""Messages of NatNet 3.0, 3.1, 4.0 and 4.1, encoded; commands of clients, taken apart. Little-endian, packed.

The layouts are those that Motive's recorded traffic (3.0) and the open clients show. From 4.1 on each section states
its size, and a frame holds assets (none here) and a precision time stamp (zero: there is no IEEE 1588 clock), as in
the SDK's example client.
"""

import struct
from collections.abc import Sequence
from ipaddress import IPv4Address
from typing import NamedTuple

import numpy as np

from hardware.streams.values import StreamedBody, StreamedSet, StreamedSkeleton, StreamFrame, StreamModel
from mosca.data.arrays import Array

Version = tuple[int, int]
VERSIONS: tuple[Version, ...] = ((3, 0), (3, 1), (4, 0), (4, 1))
SIZED: Version = (4, 1)
"""From this version on sections state their size."""

CONNECT, SERVER_INFO, REQUEST, RESPONSE, REQUEST_MODEL, MODEL = range(6)
REQUEST_FRAME, FRAME, TEXT, DISCONNECT, KEEP_ALIVE = range(6, 11)
ECHO, ECHO_ANSWER, DISCOVER, UNRECOGNISED = 12, 13, 14, 100
HEADER = struct.Struct("<HH")
MOST_BYTES = 65507
"""Largest payload of a UDP datagram over IPv4."""
TICKS_PER_S = 10_000_000
"""Rate of the high-resolution clock that stamps frames; NS_PER_TICK follows."""
NS_PER_TICK = 1_000_000_000 // TICKS_PER_S
NAME_BYTES = 256
_SUFFIX = struct.Struct("<IIdQQQ")
_STAMPS = struct.Struct("<QQQ")
_END, _SIZED_END = 6, 14
"""Bytes behind the stamps: flags and tag, preceded by the precision stamp from 4.1 on."""
_INFO = struct.Struct(f"<{NAME_BYTES}s4B4BQH?4s")
_SENDER = struct.Struct(f"<{NAME_BYTES}s4B4B")


class FrameStamps(NamedTuple):
    """Times of a frame in ticks of the server's clock: middle of the exposure, data received, transmission."""

    mid_exposure: int
    received: int
    transmit: int


class ClientCommand(NamedTuple):
    """A message of a client."""

    kind: int
    payload: bytes

    @property
    def text(self) -> str:
        """The payload's text up to its zero; signs that are not UTF-8 are replaced."""
        return self.payload.partition(b"\0")[0].decode("utf-8", "replace")


def taken_apart(datagram: bytes) -> ClientCommand | None:
    """Return the message in a datagram, None for one that is shorter than it states.

    Clients state no size for commands that end in a zero byte, so a datagram longer than stated is no fault.
    """
    if len(datagram) < HEADER.size:
        return None
    kind, size = HEADER.unpack_from(datagram)
    if len(datagram) - HEADER.size < size:
        return None
    return ClientCommand(kind, datagram[HEADER.size :])


def message(kind: int, payload: bytes) -> bytes:
    """Return a message; ValueError where it does not fit in a datagram."""
    if HEADER.size + len(payload) > MOST_BYTES:
        raise ValueError(f"a message of {HEADER.size + len(payload)} bytes; {MOST_BYTES} fit in a datagram")
    return HEADER.pack(kind, len(payload)) + payload


def server_info(name: str, server: Sequence[int], version: Version, data_port: int, group: str | None) -> bytes:
    """Return the answer to CONNECT; ``server``: the four numbers of its version."""
    address = IPv4Address(group or 0).packed
    numbers = (*server, *version, 0, 0)
    return message(SERVER_INFO, _INFO.pack(_name(name), *numbers, TICKS_PER_S, data_port, group is not None, address))


def unrecognised(name: str, server: Sequence[int], version: Version) -> bytes:
    """Return the answer to an unknown request; as in Motive's, its payload is a sender's record."""
    return message(UNRECOGNISED, _SENDER.pack(_name(name), *server, *version, 0, 0))


def echo_answer(asked: bytes, now_ticks: int) -> bytes:
    """Return the answer to an echo request: the client's own stamp (8 bytes), then the server's."""
    return message(ECHO_ANSWER, asked[:8].ljust(8, b"\0") + struct.pack("<Q", now_ticks))


def response(value: float | int) -> bytes:
    """Return the answer to a request: a float32 or an int32, as the type of ``value`` is."""
    return message(RESPONSE, struct.pack("<f" if isinstance(value, float) else "<i", value))


def stamped(unstamped: bytes, stamps: FrameStamps, version: Version) -> bytes:
    """Return a frame of data with its stamps."""
    end = len(unstamped) - (_SIZED_END if version >= SIZED else _END)
    return unstamped[: end - _STAMPS.size] + _STAMPS.pack(*stamps) + unstamped[end:]


def unstamped_frame(frame: StreamFrame, version: Version) -> bytes:
    """Return one frame of data whose stamps are 0; ValueError where it does not fit in a datagram."""
    sets = b"".join(_text(name) + _count(len(xyz)) + _floats(xyz) for name, xyz in frame.marker_sets)
    skeletons = b"".join(
        struct.pack("<II", number, len(bones)) + bones.tobytes() for number, bones in frame.skeletons
    )
    sections = [
        (len(frame.marker_sets), sets),
        (len(frame.other), _floats(frame.other)),
        (len(frame.bodies), frame.bodies.tobytes()),
        (len(frame.skeletons), skeletons),
        *([(0, b"")] if version >= SIZED else []),  # assets
        (len(frame.markers), frame.markers.tobytes()),
        (0, b""),  # force plates
        (0, b""),  # devices
    ]
    parts = [_count(frame.number & 0xFFFFFFFF)]
    for count, data in sections:
        parts += [_count(count), *([_count(len(data))] if version >= SIZED else []), data]
    parts.append(_SUFFIX.pack(*frame.timecode, frame.timestamp_s, 0, 0, 0))
    precision = bytes(8) if version >= SIZED else b""
    # the flags, then the tag that ends the data
    return message(FRAME, b"".join(parts) + precision + struct.pack("<HI", frame.params, 0))


def model_message(model: StreamModel, version: Version) -> bytes:
    """Return the definitions of marker sets, bodies and skeletons; ValueError where they do not fit in a datagram."""
    parts = [_count(len(model))]
    for one in model:
        match one:
            case StreamedSet():
                kind, data = 0, _text(one.name) + _count(len(one.markers)) + b"".join(map(_text, one.markers))
            case StreamedBody():
                kind, data = 1, _body(one, version)
            case StreamedSkeleton():
                bones = b"".join(_body(bone, version) for bone in one.bones)
                kind, data = 2, _text(one.name) + struct.pack("<II", one.number, len(one.bones)) + bones
        parts += [_count(kind), *([_count(len(data))] if version >= SIZED else []), data]
    return message(MODEL, b"".join(parts))


def _body(body: StreamedBody, version: Version) -> bytes:
    n = len(body.markers)
    places = struct.pack(f"<{3 * n}f", *(value for place in body.positions for value in place))
    names = b"".join(map(_text, body.markers)) if version >= (4, 0) else b""
    head = struct.pack("<Ii3fI", body.number, body.parent, *body.offset, n)
    return _text(body.name) + head + places + bytes(4 * n) + names  # passive markers have the active label 0


def _text(text: str) -> bytes:
    return text.replace("\0", "").encode()[: NAME_BYTES - 1] + b"\0"


def _name(text: str) -> bytes:
    return text.encode()[: NAME_BYTES - 1]


def _floats(values: Array) -> bytes:
    return np.asarray(values, "<f4").tobytes()


_count = struct.Struct("<I").pack
