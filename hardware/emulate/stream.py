"""A device's stream channel: sends packets, keeps the last blocks for who asks again, loses what it is told to."""

import socket
from collections import Counter, OrderedDict
from collections.abc import Sequence
from threading import Lock

from hardware.emulate.faults import Luck
from hardware.emulate.gvcp import Resend
from hardware.emulate.gvsp import Packet, probe, unavailable

KEPT_BLOCKS = 100
"""A second at 100 Hz: a client on a busy machine asks late."""
SEND_BUFFER = 4 << 20
LARGEST_RESEND = 2048
"""Packets that one request is answered with at most."""
_IP_MTU_DISCOVER, _MAY_FRAGMENT, _DO_NOT_FRAGMENT = 10, 0, 2
Destination = tuple[str, int]


class Stream:
    """Sends from ``address``; ``counts`` has packets_sent, packets_lost, packets_unsent, resend_requests,
    packets_resent, resends_refused and test_packets. Threads may share it.
    """

    def __init__(self, address: str, luck: Luck) -> None:
        self._luck = luck
        self._lock = Lock()
        self._kept: OrderedDict[int, Sequence[Packet]] = OrderedDict()
        self.counts: Counter[str] = Counter()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
        self._socket.bind((address, 0))
        self.source_port: int = self._socket.getsockname()[1]

    def send(self, block: int, packets: Sequence[Packet], to: Destination) -> None:
        """Send ``packets``, which are those of ``block``, but for those that chance takes; keep them all."""
        with self._lock:
            self._kept.pop(block, None)
            self._kept[block] = packets
            if len(self._kept) > KEPT_BLOCKS:
                self._kept.popitem(last=False)
        lost = self._luck.lost(len(packets))
        for number, packet in enumerate(packets):
            if number not in lost:
                self._send(packet, to)
        self._count("packets_sent", len(packets) - len(lost))
        self._count("packets_lost", len(lost))

    def resend(self, wanted: Resend, to: Destination) -> None:
        """Send kept packets again, or say that they are not to be had."""
        with self._lock:
            kept = self._kept.get(wanted.block, ())
        refused = self._luck.refused()
        self._count("resend_requests")
        self._count("resends_refused", refused)
        asked = range(wanted.first, min(wanted.last, wanted.first + LARGEST_RESEND - 1) + 1)
        lost = self._luck.lost_again(len(asked))
        for place, number in enumerate(asked):
            if not kept or refused:
                self._send(unavailable(wanted.block, number), to)
                return  # one answer tells it of all
            if number >= len(kept):
                self._send(unavailable(wanted.block, number), to)
            elif place in lost:
                self._count("packets_lost")
            else:
                self._send(kept[number], to)
                self._count("packets_resent")

    def fire_test_packet(self, packet_bytes: int, to: Destination) -> None:
        """Send one packet of the size that SCPS has now, so that a client can see whether it arrives."""
        self._send(probe(packet_bytes), to)
        self._count("test_packets")

    def fragment(self, may: bool) -> None:
        """Let the network cut packets that are too large for it, or not."""
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
        # one by one: a client that reads the network below UDP, as Aravis does for root, would see packets that were
        # handed over together (segmentation offload) as one
        try:
            self._socket.sendto(packet, to)
        except OSError:
            # a client may name a destination that is none, or a size that the network does not carry: counted
            self._count("packets_unsent")

    def _count(self, what: str, by: int = 1) -> None:
        with self._lock:
            self.counts[what] += by
