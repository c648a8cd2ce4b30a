"""Tying of a library's UDP socket to one peer, so that no other program's packets reach it; others are named.

The protocols of GigE Vision are not authenticated, and Aravis reads what comes to its ports. A connected UDP socket
receives from its peer only: the kernel filters, at no cost per packet. A second socket at the same address and port
receives all other packets, which are counted. A program that forges the peer's address and port is not stopped; that
needs a separate network for the cameras.
"""

import ctypes
import logging
import os
import socket
import struct
import time
from collections import Counter
from collections.abc import Iterable, Mapping

from hardware.driver import REFUSED, DeviceError

log = logging.getLogger("mosca.hardware.drivers")
Address = tuple[str, int]
DESCRIPTORS = "/proc/self/fd"
LOOK_S, LOOK_PACKETS = 1.0, 2000
"""Interval at which refused packets are counted, and most packets each time: a flood costs a few ms a second."""
MOST_NAMED = 16
"""Most addresses that are counted by name, since a stranger may invent any number of them."""
_ATTACH_FILTER, _MEMINFO, _MEMINFO_WORDS, _DROPS = 26, 55, 9, 8
"""Linux' SO_ATTACH_FILTER and SO_MEMINFO, whose ninth word counts the packets for which a socket had no room."""
_SOURCE_ADDRESS = 0xFFF00000 + 12
"""Offset of the source address for classic BPF: SKF_NET_OFF and the IPv4 header's (linux/filter.h)."""


def udp_sockets() -> dict[int, Address]:
    """Return this process's IPv4 UDP sockets (descriptor -> local address); none where these are hidden."""
    found: dict[int, Address] = {}
    try:
        descriptors = [int(name) for name in os.listdir(DESCRIPTORS)]
    except FileNotFoundError:  # not Linux
        return found
    for descriptor in descriptors:
        try:
            if not os.readlink(f"{DESCRIPTORS}/{descriptor}").startswith("socket:"):
                continue
            one = socket.socket(fileno=os.dup(descriptor))
        except OSError:  # closed meanwhile
            continue
        with one:
            if one.family == socket.AF_INET and one.type == socket.SOCK_DGRAM:
                found[descriptor] = one.getsockname()
    return found


class PeerSocket:
    """A library's UDP socket at ``local``, tied to ``peer`` (address, port).

    Port 0 of the peer is "not known": then any port of its address is accepted, and refused packets are not counted.
    ``what`` names camera and channel in the log. Does not close the library's socket.
    """

    def __init__(self, local: Address, peer: Address, what: str) -> None:
        self._what = what
        self._refused: Counter[str] = Counter()
        self._dropped = 0
        self._looked_s = time.monotonic()
        self._watch: socket.socket | None = None
        descriptor = next((fd for fd, address in udp_sockets().items() if address == local), None)
        if descriptor is None or not peer[0]:
            raise DeviceError(f"no socket at {local[0]}:{local[1]} for '{peer[0]}'")
        with socket.socket(fileno=os.dup(descriptor)) as library:
            try:
                if peer[1] == 0:
                    _accept_address(library, peer[0])
                else:
                    self._watch = _tied(library, local, peer)
            except OSError as error:
                raise DeviceError(f"the socket at {local[0]}:{local[1]} ({error.strerror or error})") from None

    def look(self) -> None:
        """Count what strangers sent, at most once a second."""
        if time.monotonic() - self._looked_s >= LOOK_S:
            self._count()

    def counts(self) -> Mapping[str, int]:
        """Return the refused packets so far, by sender."""
        self._count()
        counts = {f"{REFUSED} {sender}": number for sender, number in self._refused.items()}
        if self._dropped:
            counts[f"{REFUSED} senders that were too fast to be named"] = self._dropped
        return counts

    def close(self) -> None:
        """Stop watching."""
        if self._watch is not None:
            self._watch.close()
            self._watch = None

    def _count(self) -> None:
        self._looked_s = time.monotonic()
        if self._watch is None:
            return
        for _ in range(LOOK_PACKETS):
            try:
                _, (host, port) = self._watch.recvfrom(1)
            except BlockingIOError:
                break
            except OSError:  # a message of the network about an earlier packet
                continue
            self._refuse(f"{host}:{port}")
        information = self._watch.getsockopt(socket.SOL_SOCKET, _MEMINFO, 4 * _MEMINFO_WORDS)
        self._dropped = struct.unpack(f"={_MEMINFO_WORDS}I", information)[_DROPS]

    def _refuse(self, sender: str) -> None:
        if sender not in self._refused and len(self._refused) >= MOST_NAMED:
            sender = "other addresses"
        if sender not in self._refused:
            log.warning("%s: packets from %s, which is not the camera, are refused", self._what, sender)
        self._refused[sender] += 1


def tied(local: Address, peer: Address, what: str) -> PeerSocket | None:
    """Return a ``PeerSocket``; where there can be none, log that and return None."""
    try:
        guarded = PeerSocket(local, peer, what)
    except DeviceError as error:
        log.warning("%s: accepts packets of every program (%s); keep other programs off its network", what, error)
        return None
    if peer[1] == 0:
        log.warning("%s: does not tell its source port; packets from all ports of %s are accepted", what, peer[0])
    return guarded


def merged(sockets: Iterable[PeerSocket | None]) -> dict[str, int]:
    """Return the refused packets of all, by sender."""
    total: Counter[str] = Counter()
    for one in sockets:
        total.update({} if one is None else one.counts())
    return dict(total)


def _tied(library: socket.socket, local: Address, peer: Address) -> socket.socket:
    """Connect the library's socket; return another at the same address and port that receives all other packets."""
    library.connect(peer)
    library.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    watch = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        watch.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        watch.setblocking(False)
        watch.bind(local)
        watch.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 0)
    except OSError:
        watch.close()
        raise
    finally:  # else a third program could join the two
        library.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 0)
    return watch


def _accept_address(library: socket.socket, host: str) -> None:
    """Let the kernel drop packets not from ``host``, by a filter: load the source, compare, accept or drop."""
    address = int.from_bytes(socket.inet_aton(host), "big")
    code = [(0x20, 0, 0, _SOURCE_ADDRESS), (0x15, 0, 1, address), (0x06, 0, 0, 0xFFFFFFFF), (0x06, 0, 0, 0)]
    program = ctypes.create_string_buffer(b"".join(struct.pack("=HBBI", *line) for line in code))
    library.setsockopt(socket.SOL_SOCKET, _ATTACH_FILTER, struct.pack("@HP", len(code), ctypes.addressof(program)))
