"""A camera's clock beside this machine's, by asking it: what it showed between question and answer (Cristian 1989).

Frames that arrive late, behind a busy machine, tell nothing of when they were taken. A clock that was read a moment
ago does, to half the time that the answer took: a fraction of a millisecond on a quiet machine, and a slow answer is
known to be one. What was read before a clock was set does not hold after it; readings that contradict each other
show that.
"""

from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass

from hardware.driver import ClockReading, Grabbed
from hardware.pulse_numbers.clock_model import HostLine

DRIFT = 1e-4
"""A reading loses so much certainty with time: quartz keeps 1e-4."""
SLACK_NS = 200_000
"""What a device may take to answer, beyond what is measured."""
LARGEST_ERROR, FARTHEST, SURE = 0.3, 0.35, 0.1
"""Shares of a period: an instant less certain tells no pulse, one farther from a pulse is of none, and the line of
pulses follows what is more certain."""
LONGEST_LATE_NS = 10_000_000_000
START_SLACK = 0.25
"""The order to start is stamped half-way between question and answer: pulse 0 may be somewhat later, or earlier."""
MOST_MISFITS = 20
MOST_STRETCHES = 8


@dataclass
class _Stretch:
    """Readings that agree, up to the one begun at ``last_ns``; ``best``: the most certain of them."""

    best: ClockReading
    last_ns: int


class ReadClock:
    """Readings of one camera's clock, in stretches between which it was set, jumped, or began anew."""

    def __init__(self) -> None:
        self._stretches: deque[_Stretch] = deque(maxlen=MOST_STRETCHES)

    @property
    def checked_ns(self) -> int:
        """When the last reading was begun, by this machine's clock; 0 before any."""
        return self._stretches[-1].last_ns if self._stretches else 0

    def take(self, reading: ClockReading) -> None:
        """Take a reading; one that contradicts those before begins a stretch."""
        if self._stretches:
            stretch = self._stretches[-1]
            best = stretch.best
            elapsed = reading.host_ns - best.host_ns
            drifted = DRIFT * abs(elapsed)
            unsure = reading.error_ns + best.error_ns + drifted + SLACK_NS
            if abs(elapsed - (reading.device_ns - best.device_ns)) <= unsure:
                stretch.last_ns = reading.before_ns
                if reading.error_ns <= best.error_ns + drifted:
                    stretch.best = reading
                return
        self._stretches.append(_Stretch(reading, reading.before_ns))

    def at(self, device_ns: int, arrived_ns: int) -> tuple[float, float] | None:
        """Return this machine's time [ns] of a frame's stamp, and how far off that may be [ns]; None without reading.

        ``arrived_ns``: when the frame was here; the first reading after that tells, else the last one before.
        """
        if not self._stretches:
            return None
        best = next((s for s in self._stretches if s.last_ns >= arrived_ns), self._stretches[-1]).best
        since = device_ns - best.device_ns
        return best.host_ns + since, best.error_ns + DRIFT * abs(since)


class ReadPulses:
    """Which pulse a frame is of, by its camera's clock as it was read; ``line``: when pulses are, on this machine's.

    A camera whose stamps do not fit what its clock showed (they count something else) is not trusted any more.
    """

    def __init__(self, period_ns: float) -> None:
        self.line: HostLine | None = None
        self._period_ns = period_ns
        self._clocks: dict[str, ReadClock] = {}
        self._misfits: Counter[str] = Counter()

    def take(self, name: str, reading: ClockReading) -> None:
        """Take a reading of a camera's clock."""
        if self._misfits[name] < MOST_MISFITS:
            self._clocks.setdefault(name, ReadClock()).take(reading)

    def trusted(self, name: str) -> bool:
        """Return whether the camera's clock can be read."""
        return name in self._clocks

    def checked_ns(self, name: str) -> int:
        """Return this machine's time when a camera's clock was last read."""
        return self._clocks[name].checked_ns

    def instant(self, name: str, buffer: Grabbed) -> tuple[float, float] | None:
        """Return when a frame was taken, by this machine's clock [ns], and the error; None where it is not known."""
        if buffer.device_ns is None or name not in self._clocks:
            return None
        found = self._clocks[name].at(buffer.device_ns, buffer.host_ns)
        if found is None or found[1] > LARGEST_ERROR * self._period_ns:
            return None
        late = buffer.host_ns - buffer.exposure_ns - found[0]
        return found if -found[1] - SLACK_NS < late < LONGEST_LATE_NS else None

    def begin(self, first: Mapping[str, Grabbed], start_ns: int | None) -> dict[str, int] | None:
        """Return the pulses of the cameras' first frames, and begin the line; None where that cannot be told.

        The earliest is of the first pulse, unless ``start_ns``, when the pulses began, shows that all missed it.
        """
        taken = {name: self.instant(name, buffer) for name, buffer in first.items()}
        known = {name: found[0] for name, found in taken.items() if found is not None}
        if not known or len(known) < len(taken):
            return None
        earliest, skipped = min(known.values()), 0
        if start_ns is not None:
            skipped = max(int((earliest - start_ns) // self._period_ns + START_SLACK), 0)
        self.line = HostLine(round(earliest - skipped * self._period_ns), self._period_ns)
        return {name: self.line.pulse_of(at_ns) for name, at_ns in known.items()}

    def pulse(self, name: str, buffer: Grabbed) -> int | None:
        """Return a frame's pulse; None where its camera's clock was not read since it came, or it fits no pulse."""
        if self.line is None or name not in self._clocks or self.checked_ns(name) < buffer.host_ns:
            return None
        found = self.instant(name, buffer)
        if found is None:
            self._misfit(name)
            return None
        self._misfits[name] = 0
        pulse = self.line.pulse_of(found[0])
        return pulse if abs(found[0] - self.line.at(pulse)) < FARTHEST * self._period_ns else None

    def follow(self, name: str, pulse: int, buffer: Grabbed) -> float | None:
        """Let the line follow a frame whose pulse is known; return when it was taken [ns], None where not known."""
        found = self.instant(name, buffer)
        if found is None or self.line is None:
            return None
        if found[1] < SURE * self._period_ns:
            self.line.take(pulse, found[0])
        return found[0]

    def _misfit(self, name: str) -> None:
        self._misfits[name] += 1
        if self._misfits[name] >= MOST_MISFITS:
            del self._clocks[name]
