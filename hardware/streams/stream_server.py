"""Common base of all streams: a server that takes frames and waits for no client, and frames on their way to it."""

import time
from abc import ABC, abstractmethod
from collections.abc import Hashable, Sequence
from contextlib import ExitStack
from typing import Self

from hardware.streams.values import StreamFrame


class Outgoing:
    """A frame on its way, with its times in the server's clock [ns].

    ``encoded``: the frame as a server encoded it before it is due, under a key of that server.
    """

    def __init__(self, frame: StreamFrame) -> None:
        self.frame = frame
        self.mid_ns = self.received_ns = self.transmit_ns = 0
        self.encoded: dict[Hashable, bytes] = {}


class StreamServer(ABC):
    """Serves the frames given to ``send``, from construction until ``close``; a context manager.

    ``frames``: number sent, whoever received them. For faults on demand: ``offset_ns`` is added to the server's
    clock; with ``lost`` the line carries nothing.
    """

    def __init__(self) -> None:
        self.frames = 0
        self.offset_ns = 0
        self.lost = False

    @abstractmethod
    def where(self) -> str:
        """Return the stream's address, units and axes as a line."""

    @abstractmethod
    def connected(self) -> int:
        """Return how many clients there are that get frames, as far as the protocol shows it."""

    @abstractmethod
    def deliver(self, outgoing: Outgoing) -> None:
        """Send a prepared frame to everyone; never waits."""

    @abstractmethod
    def start(self) -> None:
        """Begin to serve; after ``shut`` at the same place, with no clients."""

    @abstractmethod
    def shut(self, why: str = "server restarted") -> None:
        """Leave the network and forget the clients; may be called twice."""

    @abstractmethod
    def lines(self) -> list[str]:
        """Return what became of the frames, as lines."""

    def encode(self, outgoing: Outgoing) -> None:  # noqa: B027  not every protocol can
        """Encode a frame ahead of the time at which it is sent."""

    def set_line(self, offset_ns: int, lost: bool) -> None:
        """Set ``offset_ns`` and ``lost``."""
        self.offset_ns, self.lost = offset_ns, lost

    def clock_ns(self) -> int:
        """Return the server's clock, which stamps frames: monotonic, plus ``offset_ns``."""
        return time.monotonic_ns() + self.offset_ns

    def encoded(self, frame: StreamFrame) -> Outgoing:
        """Return a frame encoded ahead of the time at which it is sent."""
        outgoing = Outgoing(frame)
        self.encode(outgoing)
        return outgoing

    def prepare(self, outgoing: Outgoing, mid_ns: int, received_ns: int) -> Outgoing:
        """Stamp a frame for transmission now; its times are of the server's clock [ns]."""
        outgoing.mid_ns, outgoing.received_ns, outgoing.transmit_ns = mid_ns, received_ns, self.clock_ns()
        return outgoing

    def send(self, frame: StreamFrame, mid_ns: int, received_ns: int) -> None:
        """Stamp and send a frame."""
        self.deliver(self.prepare(Outgoing(frame), mid_ns, received_ns))

    def close(self) -> None:
        """Leave the network; may be called twice."""
        self.shut("")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


class JoinedServers(StreamServer):
    """Several servers of different protocols, which are sent the same frames with the same times."""

    def __init__(self, servers: Sequence[StreamServer]) -> None:
        self.servers = tuple(servers)
        super().__init__()

    def where(self) -> str:
        """Return each server's line."""
        return "\n".join(server.where() for server in self.servers)

    def connected(self) -> int:
        """Return how many clients all servers have."""
        return sum(server.connected() for server in self.servers)

    def encode(self, outgoing: Outgoing) -> None:
        """Let each server encode the frame."""
        for server in self.servers:
            server.encode(outgoing)

    def deliver(self, outgoing: Outgoing) -> None:
        """Let each server send the frame."""
        self.frames += not self.lost
        for server in self.servers:
            server.deliver(outgoing)

    def set_line(self, offset_ns: int, lost: bool) -> None:
        """Set it for each server."""
        super().set_line(offset_ns, lost)
        for server in self.servers:
            server.set_line(offset_ns, lost)

    def start(self) -> None:
        """Start each server."""
        for server in self.servers:
            server.start()

    def shut(self, why: str = "server restarted") -> None:
        """Shut each server, also where one of them fails."""
        with ExitStack() as stack:
            for server in self.servers:
                stack.callback(server.shut, why)

    def lines(self) -> list[str]:
        """Return each server's lines."""
        return [line for server in self.servers for line in server.lines()]
