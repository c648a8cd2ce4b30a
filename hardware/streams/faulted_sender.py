"""Frames sent to a server through faults on demand: their content changed, their messages late, lost or twice."""

import heapq
import itertools
import time

from hardware.streams.fault_line import FaultLine
from hardware.streams.stream_server import Outgoing, StreamServer
from hardware.streams.values import StreamFrame


class FaultedSender:
    """Sends frames to ``server`` as changed by the faults of ``line``; None: as they are.

    Delayed messages wait here until ``deliver_due`` is called at their time.
    """

    def __init__(self, server: StreamServer, line: FaultLine | None = None) -> None:
        self._server, self._line = server, line
        self._waiting: list[tuple[int, int, Outgoing]] = []
        self._order = itertools.count()

    def send(self, made: StreamFrame | Outgoing, at_s: float, mid_ns: int, period_s: float) -> None:
        """Send a frame, or one encoded before, received now.

        ``at_s``: from the first frame on [s]; ``mid_ns``: mid-exposure in the monotonic clock; ``period_s``: time
        between frames.
        """
        server, line, now_ns = self._server, self._line, time.monotonic_ns()
        encoded = made if isinstance(made, Outgoing) else Outgoing(made)
        if line is None:
            server.deliver(server.prepare(encoded, mid_ns, now_ns))
            return
        line.steer(server, at_s)
        frame = line.changed(encoded.frame, at_s)
        outgoing = server.prepare(
            encoded if frame is encoded.frame else server.encoded(frame),
            mid_ns + server.offset_ns,
            now_ns + server.offset_ns,
        )
        for delay_s, one in line.routed(outgoing, at_s, period_s):
            self._push(delay_s, one)
        self.deliver_due()

    def deliver_due(self) -> int | None:
        """Deliver due messages; return when the next is due, in the monotonic clock [ns], None where none waits."""
        while self._waiting and self._waiting[0][0] <= time.monotonic_ns():
            self._server.deliver(heapq.heappop(self._waiting)[2])
        return self._waiting[0][0] if self._waiting else None

    def release(self) -> int | None:
        """Release messages that a fault holds back until their successor comes; return when the last is due [ns]."""
        for delay_s, outgoing in () if self._line is None else self._line.rest():
            self._push(delay_s, outgoing)
        return max((at_ns for at_ns, _, _ in self._waiting), default=None)

    def _push(self, delay_s: float, outgoing: Outgoing) -> None:
        """Deliver after a delay, but never before what was pushed earlier."""
        at_ns = time.monotonic_ns() + round(delay_s * 1e9)
        if self._waiting:
            at_ns = max(at_ns, max(waiting[0] for waiting in self._waiting))
        heapq.heappush(self._waiting, (at_ns, next(self._order), outgoing))
