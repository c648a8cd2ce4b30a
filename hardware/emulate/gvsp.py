"""The stream protocol's packets: one image as leader, payload packets and trailer. Pure."""

import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hardware.emulate.standard import (
    EXTENDED_CHUNKS,
    GVSP_HEADER_BYTES,
    IMAGE_CHUNK,
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


def chunk(number: int, data: bytes) -> bytes:
    """Return a chunk as it stands behind an image, and behind the chunks before it."""
    return data + struct.pack(">II", number, len(data))


def image_packets(
    block: int,
    device_ns: int,
    layout: Layout,
    pixels: Array,
    packet_bytes: int,
    chunks: bytes | None = None,
) -> Sequence[Packet]:
    """Return the packets of block ``block``: packet k has the number k.

    ``pixels``: (H, W) uint8 or uint16, sent row by row, two-byte pixels little-endian. ``packet_bytes``: size of a
    packet with IP and UDP headers; the last payload packet may be shorter. ``device_ns``: the device's stamp.
    ``chunks``: what follows the image, which is a chunk itself then; None without chunk data.
    """
    data = np.ascontiguousarray(pixels, dtype=pixels.dtype.newbyteorder("<")).reshape(-1).view(np.uint8)
    kind = IMAGE_PAYLOAD
    if chunks is not None:
        kind |= EXTENDED_CHUNKS
        behind = struct.pack(">II", IMAGE_CHUNK, data.size) + chunks
        data = np.concatenate([data, np.frombuffer(behind, np.uint8)])
    share = packet_bytes - PACKET_OVERHEAD
    whole, rest = divmod(data.size, share)
    table = np.empty((whole, GVSP_HEADER_BYTES + share), np.uint8)
    table[:, :GVSP_HEADER_BYTES] = _headers(block, 1, whole)
    table[:, GVSP_HEADER_BYTES:] = data[: whole * share].reshape(whole, share)
    sent = table.reshape(-1).data.cast("B") if whole else memoryview(b"")
    size = GVSP_HEADER_BYTES + share
    packets: list[Packet] = [_leader(block, device_ns, layout, kind)]
    packets += [sent[k * size : (k + 1) * size] for k in range(whole)]
    if rest:
        packets.append(_header(block, PAYLOAD, whole + 1) + data[whole * share :].tobytes())
    packets.append(_trailer(block, len(packets), layout.height, kind))
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


def _leader(block: int, device_ns: int, layout: Layout, kind: int) -> bytes:
    return _header(block, LEADER, 0) + struct.pack(
        ">HHQIIIIIHH",
        0,
        kind,
        device_ns,
        layout.pixel_format,
        layout.width,
        layout.height,
        layout.offset_x,
        layout.offset_y,
        0,
        0,
    )


def _trailer(block: int, packet: int, height: int, kind: int) -> bytes:
    return _header(block, TRAILER, packet) + struct.pack(">HHI", 0, kind, height)
