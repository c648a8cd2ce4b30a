"""Device clock and pulses: which pulse a time stamp belongs to, and when the clock jumped; when pulses arrive.

A camera exposes once a pulse, so its stamps lie on a line ``a + b k`` in its own clock; ``b`` is the period of the
pulses in this clock, which differs by its drift. The line is followed by an alpha-beta filter (Bar-Shalom, Li &
Kirubarajan 2001, section 6.5). A stamp between two pulses, or behind the last one, shows that the clock was set or
restarted.
"""

from dataclasses import dataclass
from typing import NamedTuple

PHASE_GAIN = 0.05
PERIOD_GAIN = 0.0005
LARGEST_DRIFT = 2e-3
"""Largest relative deviation of a camera's clock from the nominal rate; quartz keeps 1e-4."""
LARGEST_RESIDUAL, RESIDUAL_PER_STEP, RESIDUAL_AT_MOST = 0.1, 1e-4, 0.2
"""Gate of a stamp about its pulse, what drift adds to it for each pulse, and the largest gate; shares of a period."""
LONGEST_GAP = 2000
"""Over more missed pulses than this a drift of 1e-4 could hide a pulse."""


EARLY_SHARE = 0.3
"""An arrival that is early by more than this share of a period moves the pulse times at once."""
ARRIVAL_PHASE_GAIN, ARRIVAL_PERIOD_GAIN = 0.3, 0.05
"""Gains with which the pulse times follow the earliest arrival of each second."""
FEWEST_ARRIVALS = 8


@dataclass(frozen=True)
class StampPulse:
    """The pulse of a time stamp."""

    pulse: int
    residual_ns: float
    """Deviation of the stamp from the line of pulses [ns]."""
    error_ns: float = 0.0
    """Largest error of the time, where it was measured by commands or readings of clocks [ns]."""
    certain: bool = True
    """Whether it is certainly this pulse."""


class ExposureStart(NamedTuple):
    """When an exposure began, by a reading of its camera's clock; host time (monotonic) [ns]."""

    at_ns: float
    error_ns: float
    """Largest error [ns]."""

    def within(self, earliest_ns: float, latest_ns: float) -> bool:
        """Return whether it may have been between two host times."""
        return earliest_ns - self.error_ns <= self.at_ns <= latest_ns + self.error_ns


class DeviceClock:
    """Conversion of one camera's stamps in its own clock [ns] to pulses; ``period_ns`` is the nominal period.

    Times are kept as integers from the last stamp on, so that nothing is lost in 64-bit epochs.
    """

    def __init__(self, period_ns: float) -> None:
        self.nominal_ns = period_ns
        self.period_ns = period_ns
        self.locked = False
        self._pulse = 0
        self._stamp_ns = 0
        self._offset_ns = 0.0

    def lock(self, pulse: int, stamp_ns: int, residual_ns: float = 0.0) -> None:
        """Restart: ``stamp_ns`` is of ``pulse``, ``residual_ns`` behind its line; the learned rate is kept."""
        self.locked = True
        self._pulse, self._stamp_ns, self._offset_ns = pulse, stamp_ns, -residual_ns

    def pulse_of(self, stamp_ns: int) -> StampPulse | None:
        """Return the pulse of a stamp not older than the last, or None for a clock that jumped.

        The same stamp again is the same pulse again.
        """
        nearest = self.nearest(stamp_ns)
        steps, residual = nearest.pulse - self._pulse, nearest.residual_ns
        if steps < 0 or not self._fits(steps, residual):
            return None
        if steps == 0:
            return nearest
        self._pulse += steps
        self._stamp_ns = stamp_ns
        # the line moves a little towards the stamp: the rest of the residual stays as the offset of the next one
        self._offset_ns = -(1 - PHASE_GAIN) * residual
        self.period_ns = _limited_drift(self.period_ns + PERIOD_GAIN * residual / steps, self.nominal_ns)
        return nearest

    def nearest(self, stamp_ns: int) -> StampPulse:
        """Return the pulse that is nearest to a stamp, however far from it the stamp is; changes nothing."""
        since_ns = stamp_ns - self._stamp_ns - self._offset_ns
        steps = round(since_ns / self.period_ns)
        return StampPulse(self._pulse + steps, since_ns - steps * self.period_ns)

    def _fits(self, steps: int, residual_ns: float) -> bool:
        reach = min(LARGEST_RESIDUAL + RESIDUAL_PER_STEP * abs(steps), RESIDUAL_AT_MOST) * self.period_ns
        return abs(steps) <= LONGEST_GAP and abs(residual_ns) <= reach


class HostPulseTimes:
    """Host time of each pulse's earliest arrival: the lower envelope of the arrivals, as a line.

    Network and operating system delay arrivals, never advance them: the earliest of each second follows the pulses.
    ``at(k)`` is in host time (monotonic) [ns].
    """

    def __init__(self, first_ns: int, period_ns: float) -> None:
        self.nominal_ns = period_ns
        self.period_ns = period_ns
        self._pulse = 0
        self._time_ns = 0.0
        self._origin_ns = first_ns
        self._span = max(round(1e9 / period_ns), FEWEST_ARRIVALS)
        self._least: tuple[float, int] | None = None
        self._until = self._span

    def at(self, pulse: int) -> float:
        """Return the earliest arrival of ``pulse`` [ns]."""
        return self._origin_ns + self._time_ns + (pulse - self._pulse) * self.period_ns

    def pulse_of(self, time_ns: float) -> int:
        """Return the pulse whose earliest arrival is nearest to ``time_ns``."""
        return self._pulse + round((time_ns - self._origin_ns - self._time_ns) / self.period_ns)

    def take(self, pulse: int, time_ns: float) -> None:
        """Take the arrival of a pulse into account; once a second the earliest one moves the line.

        An arrival that is early by a good part of a period moves the line at once: the first ones were all late.
        """
        delay = time_ns - self.at(pulse)
        if delay < -EARLY_SHARE * self.period_ns:
            self._time_ns += delay
            self._least = None
            return
        if self._least is None or delay < self._least[0]:
            self._least = (delay, pulse)
        if pulse < self._until:
            return
        delay, at = self._least
        steps = max(at - self._pulse, 1)
        self._time_ns += (at - self._pulse) * self.period_ns + ARRIVAL_PHASE_GAIN * delay
        self.period_ns = _limited_drift(self.period_ns + ARRIVAL_PERIOD_GAIN * delay / steps, self.nominal_ns)
        self._pulse = at
        self._least = None
        self._until = pulse + self._span


def _limited_drift(period_ns: float, nominal_ns: float) -> float:
    """Return the period, limited to the largest drift from the nominal one."""
    reach = LARGEST_DRIFT * nominal_ns
    return min(max(period_ns, nominal_ns - reach), nominal_ns + reach)
