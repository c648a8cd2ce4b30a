"""Playing of a take into a server at its own pace, through faults, until it ends or is stopped."""

import itertools
import threading
import time
from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from hardware.streams.fault_line import FaultLine
from hardware.streams.faulted_sender import FaultedSender
from hardware.streams.stream_server import Outgoing, StreamServer
from hardware.streams.values import StreamFrame

SHORT_S = 0.05
AHEAD = 8
"""Frames that are encoded together: half the work of one by one."""
REST, WORK = 0.5, 0.25
"""Shares of a period: pause after a frame, in which clients have the processor; then, encoding of later ones."""
MOST_KEPT = 100_000
"""Most frames whose lateness is kept."""


class StreamPlayer:
    """Plays frames into ``server``; a frame is due at its time stamp, ``speed`` times as fast (None: at once).

    ``late_s``: delay of the newest frames, from due to handed over. ``played``: number of frames until now.
    """

    def __init__(self, server: StreamServer, line: FaultLine | None = None, speed: float | None = 1.0) -> None:
        self.server, self._speed = server, speed
        self.played = 0
        self._late = np.zeros(MOST_KEPT, np.float32)
        self._sender = FaultedSender(server, line)
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
        for encoded in self._ahead(frames, 0.0 if self._speed is None else 1e9 * period_s / self._speed):
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
            self._late[self.played % MOST_KEPT] = (time.monotonic_ns() - due_ns) * 1e-9
            self._sender.send(encoded, at_s, due_ns, period_s)
            self.played += 1
        last_ns = self._sender.release()
        if last_ns is not None:
            self._wait(last_ns)

    def _ahead(self, frames: Iterable[StreamFrame], period_ns: float) -> Iterator[Outgoing]:
        """Yield frames, encoded some at a time in the pause after one was sent."""
        rest = iter(frames)
        while True:
            if self.played and period_ns and not self._wait(time.monotonic_ns() + round(REST * period_ns)):
                return
            end_ns = time.monotonic_ns() + (WORK * period_ns or float("inf"))
            some: list[Outgoing] = []
            for frame in itertools.islice(rest, AHEAD):
                some.append(self.server.encoded(frame))
                if time.monotonic_ns() > end_ns:
                    break
            if not some:
                return
            yield from some

    def _wait(self, until_ns: int) -> bool:
        """Wait until a time, delivering what is due before it; False where it was stopped."""
        while True:
            now = time.monotonic_ns()  # taken before deliveries, so that nothing due until then stays behind
            waits_ns = self._sender.deliver_due()
            next_ns = until_ns if waits_ns is None else min(until_ns, waits_ns)
            if now >= until_ns:
                return not self._stopped.is_set()
            wait_s = max(0.0, (next_ns - time.monotonic_ns()) * 1e-9)
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
    """Return lines on what became of a stream: frames, those of each client, commands, faults."""
    server = player.server
    late = player.late_s
    told = (
        f", p99 {1e3 * np.quantile(late, 0.99):.2f} ms late, at most {1e3 * late.max():.2f} ms" if len(late) else ""
    )
    lines = [f"{player.played} frames in {seconds:.1f} s{told}", *server.lines()]
    return lines + [account.line() for account in (line.accounts if line else ())]
