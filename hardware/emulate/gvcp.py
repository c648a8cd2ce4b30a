"""The control protocol's datagrams: commands taken apart, acknowledgements put together. Pure."""

import struct
from dataclasses import dataclass

from hardware.emulate.standard import GVCP_KEY, SCHEDULED, Refused, Status

HEADER = struct.Struct(">BBHHH")
ACK_HEADER = struct.Struct(">HHHH")
PAIR = struct.Struct(">II")
RANGE = struct.Struct(">IHH")


@dataclass(frozen=True)
class Request:
    """A command as it came. ``command`` need not be one that is known."""

    flags: int
    command: int
    number: int
    payload: bytes


@dataclass(frozen=True)
class Action:
    """An action command: keys, mask, and when, in the device's clock [ns]; None: at once."""

    device_key: int
    group_key: int
    group_mask: int
    at_ns: int | None


@dataclass(frozen=True)
class Resend:
    """A request for packets ``first`` to ``last`` of a block."""

    block: int
    first: int
    last: int


def parse(datagram: bytes) -> Request | None:
    """Return the command in ``datagram``, None where it is none; one of wrong length has command -1."""
    if len(datagram) < HEADER.size:
        return None
    key, flags, command, length, number = HEADER.unpack_from(datagram)
    if key != GVCP_KEY or number == 0:
        return None
    payload = datagram[HEADER.size :]
    return Request(flags, command if len(payload) == length else -1, number, payload)


def acknowledge(request: Request, payload: bytes = b"", status: Status = Status.SUCCESS) -> bytes:
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


def resend(payload: bytes) -> Resend:
    """Return what a PACKETRESEND asks for; packet numbers have 24 bits."""
    if len(payload) < 12:
        raise Refused(Status.INVALID_PARAMETER)
    _channel, block, first, last = struct.unpack_from(">HHII", payload)
    return Resend(block, first & 0xFFFFFF, last & 0xFFFFFF)


def action(request: Request) -> Action:
    """Return what an ACTION command says."""
    wanted = 20 if request.flags & SCHEDULED else 12
    if len(request.payload) < wanted:
        raise Refused(Status.INVALID_PARAMETER)
    device_key, group_key, group_mask = struct.unpack_from(">III", request.payload)
    at = struct.unpack_from(">Q", request.payload, 12)[0] if request.flags & SCHEDULED else None
    return Action(device_key, group_key, group_mask, at)
