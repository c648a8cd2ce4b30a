"""The grid of the pulses that this computer sends: one in each period, on time or not at all.

A pulse that cannot be sent in the first part of its period is skipped and counted; the next one is on the grid. So
pulse k is always near k periods, whatever delays this computer, and none of its frames can be taken for another's.
"""

import threading
import time
from collections import deque
from typing import NamedTuple

LATEST_START = 0.25
"""Share of a period by which a pulse may be late; with half of it a busy machine skips more of them, with double of
it a frame may be nearer to the next pulse."""
LATEST_TIME = 0.45
"""Largest difference of a frame's time from its pulse's, as a share of a period: readers take the nearest pulse."""
UNREAD_PULSES = 100_000
"""Most pulses that are kept for a recording that does not read them."""


class HostClock:
    """The computer's monotonic clock, and waiting by it; tests pass another."""

    def now_ns(self) -> int:
        """Return the time [ns]."""
        return time.monotonic_ns()

    def wait(self, event: threading.Event, seconds: float) -> bool:
        """Wait until ``event`` is set, ``seconds`` at most; return whether it is."""
        return event.wait(seconds)


class SentPulse(NamedTuple):
    """A pulse that this computer sent; host times are of its monotonic clock."""

    number: int
    nominal_ns: int
    """Its time on the grid, from pulse 0 on [ns]."""
    sent_ns: int
    """Host time before the (first camera's) command [ns]."""
    acknowledged_ns: int
    """Host time when the (last camera's) command had returned [ns]."""


class PulseGrid:
    """Numbers and times of due pulses, from ``begin`` on. ``rate_hz``: rate of the grid [1/s]."""

    def __init__(self, rate_hz: float, clock: HostClock) -> None:
        self.period_ns = 1e9 / rate_hz
        self.clock = clock
        self.begin_ns = 0
        """Host time of pulse 0 on the grid [ns]."""
        self._next = 0
        self._skipped: list[tuple[int, int]] = []
        self._sent: deque[SentPulse] = deque(maxlen=UNREAD_PULSES)

    def begin(self) -> int:
        """Begin with pulse 0 now; return the host time [ns]."""
        self.begin_ns = self.clock.now_ns()
        self._next = 0
        self._skipped = []
        return self.begin_ns

    @property
    def last_due(self) -> int | None:
        """The last pulse that was sent or skipped; None before the first."""
        return self._next - 1 if self._next else None

    def nominal_ns(self, number: int) -> int:
        """Return the time of a pulse on the grid, from pulse 0 on [ns]."""
        return round(number * self.period_ns)

    def await_next(self, stop: threading.Event) -> int | None:
        """Wait until a pulse is due and return its number, None once ``stop`` is set; skip pulses that are over."""
        while not stop.is_set():
            late_ns = self.clock.now_ns() - self.begin_ns - self.nominal_ns(self._next)
            over = -int((LATEST_START * self.period_ns - late_ns) // self.period_ns)
            if over > 0:
                self._skipped.append((self._next, self._next + over))
                self._next += over
            elif late_ns < 0:
                self.clock.wait(stop, -late_ns * 1e-9)
            else:
                self._next += 1
                return self._next - 1
        return None

    def sent(self, number: int, sent_ns: int, acknowledged_ns: int) -> None:
        """Register that a pulse was sent, with host times as of ``SentPulse``."""
        self._sent.append(SentPulse(number, self.nominal_ns(number), sent_ns, acknowledged_ns))

    def new_pulses(self) -> list[SentPulse]:
        """Return the pulses sent since the last call."""
        return [self._sent.popleft() for _ in range(len(self._sent))]

    def skipped(self, before: int | None = None) -> int:
        """Return how many pulses were skipped, of those ``before`` a number."""
        limit = self._next if before is None else before
        return sum(max(min(last, limit) - first, 0) for first, last in list(self._skipped))

    def skipped_note(self, what: str, before: int | None) -> list[str]:
        """Return one line on the skipped pulses of ``what``; none where there were none."""
        count = self.skipped(before)
        if not count:
            return []
        return [
            f"{what}: {count} of {self._next if before is None else before} pulses were skipped, the first was "
            f"{self._skipped[0][0]}: they could not be sent in their periods; use a lower rate_hz, shorter "
            "exposures, or a trigger line"
        ]
