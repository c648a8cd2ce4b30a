"""A take at its own pace into a server, through faults, until it ends or is stopped."""

import heapq
import itertools
import threading
import time
from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from hardware.streams.fault_line import FaultLine
from hardware.streams.stream_server import Outgoing, StreamServer
from hardware.streams.values import StreamFrame

SHORT_S = 0.05
AHEAD = 8
MOST_KEPT = 100_000
"""Frames whose lateness is kept."""


class StreamPlayer:
    """Plays frames into ``server``; a frame is due at its time stamp, ``speed`` times as fast (None: at once).

    ``late_s``: how much later than due the newest frames were handed over. ``played``: frames until now.
    """

    def __init__(self, server: StreamServer, line: FaultLine | None = None, speed: float | None = 1.0) -> None:
        self.server, self._line, self._speed = server, line, speed
        self.played = 0
        self._late = np.zeros(MOST_KEPT, np.float32)
        self._waiting: list[tuple[int, int, Outgoing]] = []
        self._order = itertools.count()
        self._stopped = threading.Event()

    @property
    def late_s(self) -> "np.ndarray[tuple[int], np.dtype[np.float32]]":
        """(n,) how late frames were handed over [s]."""
        return self._late[: min(self.played, MOST_KEPT)]

    @property
    def stopped(self) -> bool:
        """Whether ``stop`` was called."""
        return self._stopped.is_set()

    def stop(self) -> None:
        """End ``play``; may be called from another thread or from a signal handler."""
        self._stopped.set()

    def play(self, frames: Iterable[StreamFrame], period_s: float, seconds: float | None = None) -> None:
        """Play ``frames``, ``period_s`` apart, to their end, for ``seconds`` or until ``stop``."""
        start_ns, first_s = time.monotonic_ns(), None
        for encoded in self._ahead(frames):
            stamp_s = encoded.frame.timestamp_s
            first_s = stamp_s if first_s is None else first_s
            at_s = stamp_s - first_s
            if self._speed is None:
                due_ns = time.monotonic_ns()
            else:
                due_ns = start_ns + round(at_s * 1e9 / self._speed)
            if seconds is not None and due_ns - start_ns >= seconds * 1e9:
                break
            if not self._wait(due_ns):
                return
            self._take(encoded, at_s, due_ns, period_s)
            self.played += 1
        for delay_s, outgoing in () if self._line is None else self._line.rest():
            self._push(delay_s, outgoing)
        if self._waiting:
            self._wait(max(at_ns for at_ns, _, _ in self._waiting))

    def _ahead(self, frames: Iterable[StreamFrame]) -> Iterator[Outgoing]:
        """Yield frames encoded some at a time, in the pause after one was sent: half the work of one by one."""
        rest = iter(frames)
        while some := [self.server.encoded(frame) for frame in itertools.islice(rest, AHEAD)]:
            yield from some

    def _take(self, encoded: Outgoing, at_s: float, due_ns: int, period_s: float) -> None:
        server, line = self.server, self._line
        now_ns = time.monotonic_ns()
        self._late[self.played % MOST_KEPT] = (now_ns - due_ns) * 1e-9
        if line is None:
            server.deliver(server.prepare(encoded, due_ns, now_ns))
            return
        line.steer(server, at_s)
        frame = line.changed(encoded.frame, at_s)
        outgoing = server.prepare(
            encoded if frame is encoded.frame else server.encoded(frame),
            due_ns + server.offset_ns,
            now_ns + server.offset_ns,
        )
        for delay_s, one in line.routed(outgoing, at_s, period_s):
            self._push(delay_s, one)
        self._wait(0)

    def _push(self, delay_s: float, outgoing: Outgoing) -> None:
        """Deliver after a delay, but never before what was pushed earlier."""
        at_ns = time.monotonic_ns() + round(delay_s * 1e9)
        if self._waiting:
            at_ns = max(at_ns, max(waiting[0] for waiting in self._waiting))
        heapq.heappush(self._waiting, (at_ns, next(self._order), outgoing))

    def _wait(self, until_ns: int) -> bool:
        """Wait until a time, delivering what is due before it; False where it was stopped."""
        while True:
            now = time.monotonic_ns()
            while self._waiting and self._waiting[0][0] <= now:
                self.server.deliver(heapq.heappop(self._waiting)[2])
            next_ns = min(until_ns, self._waiting[0][0]) if self._waiting else until_ns
            if now >= until_ns:
                return not self._stopped.is_set()
            wait_s = max(0.0, (next_ns - now) * 1e-9)
            if wait_s < SHORT_S:
                time.sleep(wait_s)  # cheaper, and rarely later, than to wait for an event
            elif self._stopped.wait(wait_s - SHORT_S / 2):
                return False


def looped(frames: Iterable[StreamFrame], period_s: float) -> Iterator[StreamFrame]:
    """Yield frames again and again; numbers and time stamps go on, ``period_s`` after the last frame."""
    number, shift_s = 0, 0.0
    while True:
        first = last = None
        for frame in frames:
            first = frame if first is None else first
            last = frame
            yield replace(frame, number=frame.number + number, timestamp_s=frame.timestamp_s + shift_s)
        if first is None or last is None:
            return
        number += last.number - first.number + 1
        shift_s += last.timestamp_s - first.timestamp_s + period_s


def account_lines(player: StreamPlayer, seconds: float, line: FaultLine | None = None) -> list[str]:
    """Return what became of a stream: frames, each client's, commands, faults."""
    server = player.server
    late = player.late_s
    told = (
        f", p99 {1e3 * np.quantile(late, 0.99):.2f} ms late, at most {1e3 * late.max():.2f} ms" if len(late) else ""
    )
    lines = [f"{player.played} frames in {seconds:.1f} s{told}", *server.lines()]
    return lines + [account.line() for account in (line.accounts if line else ())]
