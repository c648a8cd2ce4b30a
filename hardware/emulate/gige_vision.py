"""Numbers of the GigE Vision standard (version 2.0) and the datagrams of its control protocol (GVCP)."""

import struct
from dataclasses import dataclass
from enum import IntEnum

from hardware.gvcp import ACK_HEADER, GVCP_KEY, HEADER, SCHEDULED

LARGEST_GVCP_PAYLOAD = 540
IP_UDP_BYTES = 28
GVSP_HEADER_BYTES = 8
PACKET_OVERHEAD = IP_UDP_BYTES + GVSP_HEADER_BYTES
"""SCPS counts IP and UDP headers too; without options they and the GVSP header take 36 bytes of a packet."""
VERSION_2_0 = 0x00020000
MAXIMUM_BLOCK_ID = 65535
TICKS_PER_SECOND = 1_000_000_000


class Status(IntEnum):
    """Status codes of acknowledgements and stream packets."""

    SUCCESS = 0x0000
    NOT_IMPLEMENTED = 0x8001
    INVALID_PARAMETER = 0x8002
    INVALID_ADDRESS = 0x8003
    WRITE_PROTECT = 0x8004
    BAD_ALIGNMENT = 0x8005
    ACCESS_DENIED = 0x8006
    PACKET_UNAVAILABLE = 0x800C
    INVALID_HEADER = 0x800E
    NO_REF_TIME = 0x8013
    OVERFLOW = 0x8015
    ACTION_LATE = 0x8016


ACKNOWLEDGE = 0x01
"""Flag of every command: an answer is wanted."""
EXTENDED_ID = 0x10
"""Flag of PACKETRESEND: 64 bit block numbers, which this device does not use."""

LEADER, TRAILER, PAYLOAD = 1, 2, 3
IMAGE_PAYLOAD = 0x0001
EXTENDED_CHUNKS = 0x4000
"""Flag of the payload's type: chunks follow the image."""
IMAGE_CHUNK, COUNTER_CHUNK = 0x0000C001, 0x0000C002
CHUNK_TAIL_BYTES = 8
"""Trailer of a chunk, behind its data: id and length."""

FIRE_TEST_PACKET = 0x80000000
DO_NOT_FRAGMENT = 0x40000000

PIXEL_FORMATS = {"Mono8": 0x01080001, "Mono10": 0x01100003, "Mono12": 0x01100005, "Mono16": 0x01100007}
"""Numbers of the Pixel Format Naming Convention; all but Mono8 take two bytes a pixel, little-endian."""
FORMAT_OF_DEPTH = {8: "Mono8", 10: "Mono10", 12: "Mono12", 16: "Mono16"}


class Refused(Exception):
    """A request cannot be met; ``status`` goes into the acknowledgement."""

    def __init__(self, status: Status) -> None:
        super().__init__(status.name)
        self.status = status


PAIR = struct.Struct(">II")
RANGE = struct.Struct(">IHH")


@dataclass(frozen=True)
class GvcpCommand:
    """A command as received; ``command`` may be unknown."""

    flags: int
    command: int
    number: int
    payload: bytes


@dataclass(frozen=True)
class ActionCommand:
    """An action command: keys, mask, and its time in the device's clock [ns] (None: at once)."""

    device_key: int
    group_key: int
    group_mask: int
    at_ns: int | None


@dataclass(frozen=True)
class ResendRequest:
    """A request for packets ``first`` to ``last`` of a block."""

    block: int
    first: int
    last: int


def parse(datagram: bytes) -> GvcpCommand | None:
    """Return the command in ``datagram``, None where it is none; one of wrong length has command -1."""
    if len(datagram) < HEADER.size:
        return None
    key, flags, command, length, number = HEADER.unpack_from(datagram)
    if key != GVCP_KEY or number == 0:
        return None
    payload = datagram[HEADER.size :]
    return GvcpCommand(flags, command if len(payload) == length else -1, number, payload)


def acknowledge(request: GvcpCommand, payload: bytes = b"", status: Status = Status.SUCCESS) -> bytes:
    """Return the acknowledgement of ``request``."""
    command = 0 if request.command < 0 else (request.command + 1) & 0xFFFF
    return ACK_HEADER.pack(status, command, len(payload), request.number) + payload


def words(payload: bytes) -> tuple[int, ...]:
    """Return the 32 bit words of ``payload``; Refused where it holds none or a part of one."""
    if not payload or len(payload) % 4:
        raise Refused(Status.INVALID_PARAMETER)
    return struct.unpack(f">{len(payload) // 4}I", payload)


def register_writes(payload: bytes) -> tuple[tuple[int, int], ...]:
    """Return the (address, value) pairs of a WRITEREG."""
    if len(payload) % PAIR.size:
        raise Refused(Status.INVALID_PARAMETER)
    numbers = words(payload)
    return tuple(zip(numbers[::2], numbers[1::2], strict=True))


def memory_range(payload: bytes) -> tuple[int, int]:
    """Return address and length of a READMEM."""
    if len(payload) != RANGE.size:
        raise Refused(Status.INVALID_PARAMETER)
    address, _reserved, length = RANGE.unpack(payload)
    return address, length


def memory_write(payload: bytes) -> tuple[int, bytes]:
    """Return address and data of a WRITEMEM."""
    return words(payload[:4])[0], payload[4:]


def resend(payload: bytes) -> ResendRequest:
    """Return the block and packets that a PACKETRESEND requests; packet ids have 24 bits."""
    if len(payload) < 12:
        raise Refused(Status.INVALID_PARAMETER)
    _channel, block, first, last = struct.unpack_from(">HHII", payload)
    return ResendRequest(block, first & 0xFFFFFF, last & 0xFFFFFF)


def action(request: GvcpCommand) -> ActionCommand:
    """Return the fields of an ACTION command."""
    wanted = 20 if request.flags & SCHEDULED else 12
    if len(request.payload) < wanted:
        raise Refused(Status.INVALID_PARAMETER)
    device_key, group_key, group_mask = struct.unpack_from(">III", request.payload)
    at = struct.unpack_from(">Q", request.payload, 12)[0] if request.flags & SCHEDULED else None
    return ActionCommand(device_key, group_key, group_mask, at)
