"""Device clock against host clock: a reading gives the device's time between request and answer (Cristian 1989).

Late arrivals on a busy machine do not show when frames were exposed. A recent reading of the device clock does, with
an error of half the round trip: a fraction of a millisecond on a quiet machine, and larger for a slow answer. A
reading from before a clock was set does not hold after that; contradicting readings show it.
"""

from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

from hardware.driver import ClockReading, Grabbed
from hardware.pulse_numbers.clock_model import ExposureStart, HostPulseTimes, StampPulse

DRIFT = 1e-4
"""Growth of a reading's error with time [s/s]: quartz keeps 1e-4."""
SLACK_NS = 200_000
"""Allowance for a device's processing time."""
LARGEST_ERROR, PULSE_GATE, PRECISE = 0.3, 0.35, 0.1
"""Shares of a period: a time with an error above the first gives no pulse; a time farther from a pulse than the
second belongs to none; only a time with an error below the third adjusts the pulse times."""
LONGEST_DELAY_NS = 10_000_000_000
START_SLACK = 0.25
"""The start command is timed half-way between request and answer: pulse 0 may be somewhat later, or earlier."""
MOST_MISFITS = 20
MOST_SEGMENTS = 8


@dataclass
class _Segment:
    """Readings that agree, up to the one begun at ``last_ns``."""

    best: ClockReading
    """The one with the smallest error."""
    last_ns: int


class ClockReadings:
    """Readings of one device clock, in segments between which it was set, jumped, or restarted."""

    def __init__(self) -> None:
        self._segments: deque[_Segment] = deque(maxlen=MOST_SEGMENTS)

    @property
    def checked_ns(self) -> int:
        """Host time when the last reading was begun; 0 before any."""
        return self._segments[-1].last_ns if self._segments else 0

    def take(self, reading: ClockReading) -> None:
        """Take a reading; one that contradicts those before begins a segment."""
        if self._segments:
            segment = self._segments[-1]
            best = segment.best
            elapsed = reading.host_ns - best.host_ns
            drifted = DRIFT * abs(elapsed)
            tolerance = reading.error_ns + best.error_ns + drifted + SLACK_NS
            if abs(elapsed - (reading.device_ns - best.device_ns)) <= tolerance:
                segment.last_ns = reading.before_ns
                if reading.error_ns <= best.error_ns + drifted:
                    segment.best = reading
                return
        self._segments.append(_Segment(reading, reading.before_ns))

    def at(self, device_ns: int, arrived_ns: int) -> ExposureStart | None:
        """Return the host time of a frame's stamp; None without reading.

        ``arrived_ns``: when the frame arrived; the first reading after that is used, else the last one before.
        """
        if not self._segments:
            return None
        best = next((s for s in self._segments if s.last_ns >= arrived_ns), self._segments[-1]).best
        since = device_ns - best.device_ns
        return ExposureStart(best.host_ns + since, best.error_ns + DRIFT * abs(since))


class FirstPulses(NamedTuple):
    """Pulses of the cameras' first frames, and the host times of the pulses."""

    times: HostPulseTimes
    pulses: dict[str, int]


class ClockPulses:
    """The pulse of each frame by readings of its camera's device clock.

    A camera whose stamps do not fit the readings (they count something else) is not trusted any more.
    """

    def __init__(self, period_ns: float) -> None:
        self._times: HostPulseTimes | None = None
        self._period_ns = period_ns
        self._clocks: dict[str, ClockReadings] = {}
        self._misfits: Counter[str] = Counter()

    def take(self, name: str, reading: ClockReading) -> None:
        """Take a reading of a device clock."""
        if self._misfits[name] < MOST_MISFITS:
            self._clocks.setdefault(name, ClockReadings()).take(reading)

    def trusted(self, name: str) -> bool:
        """Return whether the device clock can be read."""
        return name in self._clocks

    def checked_ns(self, name: str) -> int:
        """Return the host time when a device clock was last read."""
        return self._clocks[name].checked_ns

    def host_time(self, name: str, buffer: Grabbed) -> ExposureStart | None:
        """Return the host time of a frame's stamp; None where it is not known."""
        if buffer.device_ns is None or name not in self._clocks:
            return None
        found = self._clocks[name].at(buffer.device_ns, buffer.host_ns)
        if found is None or found[1] > LARGEST_ERROR * self._period_ns:
            return None
        delay = buffer.host_ns - buffer.exposure_ns - found[0]
        return found if -found[1] - SLACK_NS < delay < LONGEST_DELAY_NS else None

    def begin(self, first: Mapping[str, Grabbed], start_ns: int | None) -> FirstPulses | None:
        """Return the pulses of the cameras' first frames, and begin the pulse times; None where they are not known.

        The earliest frame is the first pulse's, unless ``start_ns``, when the pulses began, shows that all missed it.
        """
        taken = {name: self.host_time(name, buffer) for name, buffer in first.items()}
        known = {name: found[0] for name, found in taken.items() if found is not None}
        if not known or len(known) < len(taken):
            return None
        earliest, skipped = min(known.values()), 0
        if start_ns is not None:
            skipped = max(int((earliest - start_ns) // self._period_ns + START_SLACK), 0)
        times = self._times = HostPulseTimes(round(earliest - skipped * self._period_ns), self._period_ns)
        return FirstPulses(times, {name: times.pulse_of(at_ns) for name, at_ns in known.items()})

    def pulse(self, name: str, buffer: Grabbed) -> StampPulse | None:
        """Return a frame's pulse; None where its device clock was not read since it arrived, or it fits no pulse.

        Its deviation from the pulse is as accurate as the readings and the pulse times: a few ms.
        """
        if self._times is None or name not in self._clocks or self.checked_ns(name) < buffer.host_ns:
            return None
        found = self.host_time(name, buffer)
        if found is None:
            self._misfit(name)
            return None
        self._misfits[name] = 0
        pulse = self._times.pulse_of(found.at_ns)
        residual_ns = found.at_ns - self._times.at(pulse)
        if abs(residual_ns) >= PULSE_GATE * self._period_ns:
            return None
        return StampPulse(pulse, residual_ns, found.error_ns + SLACK_NS + PRECISE * self._period_ns)

    def follow(self, name: str, pulse: int, buffer: Grabbed) -> float | None:
        """Adjust the pulse times by a frame whose pulse is known; return its host time [ns], None where not known."""
        found = self.host_time(name, buffer)
        if found is None or self._times is None:
            return None
        if found[1] < PRECISE * self._period_ns:
            self._times.take(pulse, found[0])
        return found[0]

    def _misfit(self, name: str) -> None:
        self._misfits[name] += 1
        if self._misfits[name] >= MOST_MISFITS:
            del self._clocks[name]
