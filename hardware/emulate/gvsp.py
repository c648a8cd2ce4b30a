"""The stream protocol's packets: one image as leader, payload packets and trailer. Pure."""

import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hardware.emulate.standard import (
    GVSP_HEADER_BYTES,
    IMAGE_PAYLOAD,
    IP_UDP_BYTES,
    LEADER,
    PACKET_OVERHEAD,
    PAYLOAD,
    TRAILER,
    Status,
)
from mosca.data.arrays import Array

HEADER = struct.Struct(">HHI")
Packet = bytes | memoryview


@dataclass(frozen=True)
class Layout:
    """What the leader says of an image: its format, and which part of the sensor it is [px]."""

    pixel_format: int
    width: int
    height: int
    offset_x: int = 0
    offset_y: int = 0


def image_packets(
    block: int, device_ns: int, layout: Layout, pixels: Array, packet_bytes: int
) -> Sequence[Packet]:
    """Return the packets of block ``block``: packet k has the number k.

    ``pixels``: (H, W) uint8 or uint16, sent row by row, two-byte pixels little-endian. ``packet_bytes``: size of a
    packet with IP and UDP headers; the last payload packet may be shorter. ``device_ns``: the device's stamp.
    """
    data = np.ascontiguousarray(pixels, dtype=pixels.dtype.newbyteorder("<")).reshape(-1).view(np.uint8)
    chunk = packet_bytes - PACKET_OVERHEAD
    whole, rest = divmod(data.size, chunk)
    table = np.empty((whole, GVSP_HEADER_BYTES + chunk), np.uint8)
    table[:, :GVSP_HEADER_BYTES] = _headers(block, 1, whole)
    table[:, GVSP_HEADER_BYTES:] = data[: whole * chunk].reshape(whole, chunk)
    sent = table.reshape(-1).data.cast("B") if whole else memoryview(b"")
    size = GVSP_HEADER_BYTES + chunk
    packets: list[Packet] = [_leader(block, device_ns, layout)]
    packets += [sent[k * size : (k + 1) * size] for k in range(whole)]
    if rest:
        packets.append(_header(block, PAYLOAD, whole + 1) + data[whole * chunk :].tobytes())
    packets.append(_trailer(block, len(packets), layout.height))
    return packets


def unavailable(block: int, packet: int) -> bytes:
    """Return the packet that says that packet ``packet`` of ``block`` cannot be sent again."""
    return _header(block, PAYLOAD, packet, Status.PACKET_UNAVAILABLE)


def probe(packet_bytes: int) -> bytes:
    """Return a test packet: as large as ``packet_bytes`` says, block and packet 0, nothing meant by what is in it."""
    return _header(0, PAYLOAD, 0).ljust(packet_bytes - IP_UDP_BYTES, b"\x5a")


def _header(block: int, kind: int, packet: int, status: Status = Status.SUCCESS) -> bytes:
    return HEADER.pack(status, block, kind << 24 | packet)


def _headers(block: int, first: int, count: int) -> Array:
    """Return the headers of payload packets ``first`` ... as bytes (count, 8)."""
    fields = np.empty((count, 2), ">u4")
    fields[:, 0] = block
    fields[:, 1] = (PAYLOAD << 24) + first + np.arange(count)
    return fields.view(np.uint8)


def _leader(block: int, device_ns: int, layout: Layout) -> bytes:
    return _header(block, LEADER, 0) + struct.pack(
        ">HHQIIIIIHH",
        0,
        IMAGE_PAYLOAD,
        device_ns,
        layout.pixel_format,
        layout.width,
        layout.height,
        layout.offset_x,
        layout.offset_y,
        0,
        0,
    )


def _trailer(block: int, packet: int, height: int) -> bytes:
    return _header(block, TRAILER, packet) + struct.pack(">HHI", 0, IMAGE_PAYLOAD, height)
