"""Stream channel (GVSP): an image as leader, payload packets and trailer; sending, resending, loss of packets."""

import socket
import struct
from collections import Counter, OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from threading import Lock

import numpy as np

from hardware.emulate.faults import FaultDraws
from hardware.emulate.gige_vision import (
    EXTENDED_CHUNKS,
    GVSP_HEADER_BYTES,
    IMAGE_CHUNK,
    IMAGE_PAYLOAD,
    IP_UDP_BYTES,
    LEADER,
    PACKET_OVERHEAD,
    PAYLOAD,
    TRAILER,
    ResendRequest,
    Status,
)
from mosca.data.arrays import Array

HEADER = struct.Struct(">HHI")
Packet = bytes | memoryview


@dataclass(frozen=True)
class ImageLayout:
    """Image fields of the leader: pixel format, and the part of the sensor [px]."""

    pixel_format: int
    width: int
    height: int
    offset_x: int = 0
    offset_y: int = 0


def chunk(number: int, data: bytes) -> bytes:
    """Return a chunk as appended to an image and to the chunks before it."""
    return data + struct.pack(">II", number, len(data))


def image_packets(
    block: int, device_ns: int, layout: ImageLayout, pixels: Array, packet_bytes: int, chunks: bytes | None = None
) -> Sequence[Packet]:
    """Return the packets of block ``block``: packet k has the number k.

    ``pixels``: (H, W) uint8 or uint16, sent row by row, two-byte pixels little-endian. ``packet_bytes``: size of a
    packet with IP and UDP headers; the last payload packet may be shorter. ``device_ns``: the device's stamp.
    ``chunks``: data after the image, which is a chunk itself then; None without chunk data.
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
    """Return the status packet: packet ``packet`` of ``block`` is not available any more."""
    return _header(block, PAYLOAD, packet, Status.PACKET_UNAVAILABLE)


def probe(packet_bytes: int) -> bytes:
    """Return a test packet: of ``packet_bytes``, block and packet 0, arbitrary data."""
    return _header(0, PAYLOAD, 0).ljust(packet_bytes - IP_UDP_BYTES, b"\x5a")


def _header(block: int, kind: int, packet: int, status: Status = Status.SUCCESS) -> bytes:
    return HEADER.pack(status, block, kind << 24 | packet)


def _headers(block: int, first: int, count: int) -> Array:
    """Return the headers of payload packets ``first`` ... as bytes (count, 8)."""
    fields = np.empty((count, 2), ">u4")
    fields[:, 0] = block
    fields[:, 1] = (PAYLOAD << 24) + first + np.arange(count)
    return fields.view(np.uint8)


def _leader(block: int, device_ns: int, layout: ImageLayout, kind: int) -> bytes:
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


KEPT_BLOCKS = 100
"""Blocks kept for resending: a second at 100 Hz, since a busy client requests packets late."""
SEND_BUFFER = 4 << 20
LARGEST_RESEND = 2048
"""Most packets in the answer to one request."""
_IP_MTU_DISCOVER, _MAY_FRAGMENT, _DO_NOT_FRAGMENT = 10, 0, 2
Destination = tuple[str, int]


class Stream:
    """Sends from ``address``; ``counts`` has packets_sent, packets_lost, packets_unsent, resend_requests,
    packets_resent, resends_refused and test_packets. Threads may share it.
    """

    def __init__(self, address: str, draws: FaultDraws) -> None:
        self._draws = draws
        self._lock = Lock()
        self._kept: OrderedDict[int, Sequence[Packet]] = OrderedDict()
        self.counts: Counter[str] = Counter()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
        self._socket.bind((address, 0))
        self.source_port: int = self._socket.getsockname()[1]

    def send(self, block: int, packets: Sequence[Packet], to: Destination) -> None:
        """Send the ``packets`` of ``block`` except those drawn as lost; keep all of them."""
        with self._lock:
            self._kept.pop(block, None)
            self._kept[block] = packets
            if len(self._kept) > KEPT_BLOCKS:
                self._kept.popitem(last=False)
        lost = self._draws.lost(len(packets))
        for number, packet in enumerate(packets):
            if number not in lost:
                self._send(packet, to)
        self._count("packets_sent", len(packets) - len(lost))
        self._count("packets_lost", len(lost))

    def resend(self, wanted: ResendRequest, to: Destination) -> None:
        """Send kept packets again, or the status packet that states that they are not available."""
        with self._lock:
            kept = self._kept.get(wanted.block, ())
        refused = self._draws.refused()
        self._count("resend_requests")
        self._count("resends_refused", refused)
        asked = range(wanted.first, min(wanted.last, wanted.first + LARGEST_RESEND - 1) + 1)
        lost = self._draws.lost_again(len(asked))
        for place, number in enumerate(asked):
            if not kept or refused:
                self._send(unavailable(wanted.block, number), to)
                return  # one answer is enough for all
            if number >= len(kept):
                self._send(unavailable(wanted.block, number), to)
            elif place in lost:
                self._count("packets_lost")
            else:
                self._send(kept[number], to)
                self._count("packets_resent")

    def fire_test_packet(self, packet_bytes: int, to: Destination) -> None:
        """Send one packet of the present size in SCPS, so that a client can see whether it arrives."""
        self._send(probe(packet_bytes), to)
        self._count("test_packets")

    def fragment(self, may: bool) -> None:
        """Set whether the network may fragment packets that are too large for it."""
        how = _MAY_FRAGMENT if may else _DO_NOT_FRAGMENT
        self._socket.setsockopt(socket.IPPROTO_IP, _IP_MTU_DISCOVER, how)

    def forget(self) -> None:
        """Keep nothing of what was sent."""
        with self._lock:
            self._kept.clear()

    def close(self) -> None:
        """Free the socket."""
        self._socket.close()

    def _send(self, packet: Packet, to: Destination) -> None:
        # one by one: a client with packet sockets (Aravis as root) would receive packets sent together (segmentation
        # offload) as one
        try:
            self._socket.sendto(packet, to)
        except OSError:
            # counted: a client may name an invalid destination, or a size that the network does not carry
            self._count("packets_unsent")

    def _count(self, what: str, by: int = 1) -> None:
        with self._lock:
            self.counts[what] += by
