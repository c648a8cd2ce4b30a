"""Alignment of the stations' pulse counts: each counts for itself, and only pulse numbers cross PCs.

All cameras share one trigger cable, so a pulse's frames arrive at all stations at about the same time. The counts of
two stations differ by a whole number, the *shift*, and the time of arrival, in one clock
(``hardware.transport.clock``), shows it: the earliest of some arrivals, since frames come late, never early.

- Start: the earliest station's pulse 0 is the session's. A station that counts from another pulse is noted, and its
  count is shifted.
- A station that starts later, or again, is aligned to the pulses that the others have followed.
- Arrivals of two stations must agree to a quarter of a period: a station that lies between pulses is left out, and
  noted. Cameras that deliver later by whole periods than the others' cannot be distinguished from a wrong count.
- A station whose frames come before their pulse counts too far ahead, and is aligned again. One whose frames come
  late may be slow or count wrongly: that is only noted.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

from hardware.pulse_numbers.clock_model import HostPulseTimes

VOTE_S = 0.2
FEWEST_VOTES, MOST_VOTES = 5, 100
LARGEST_RESIDUAL = 0.25
"""Share of a period by which a station may lie off the pulses."""
EARLY, EARLY_FRAMES = 0.4, 10
LATE = 0.6


@dataclass
class _Alignment:
    """One station's count against the session's."""

    epoch: int | None = None
    shift: int | None = None
    latency_ns: float = 0.0
    known: bool = False
    """Whether its latency was measured."""
    votes: dict[int, int] = field(default_factory=dict)
    """Earliest arrival of each of its pulses [ns]."""
    early: int = 0
    """Frames in a row that came before their pulse."""
    noted_late: bool = False
    refused: bool = False
    least_late: float | None = None
    window_end: int = 0


class StationPulses:
    """Shifts of ``stations``, from arrivals; ``notes``: events, each as (station, text).

    ``start_wait_s``: how long after the first arrival stations may be silent before the others begin without them.
    """

    def __init__(self, stations: Sequence[str], rate_hz: float, start_wait_s: float) -> None:
        self.period_ns = 1e9 / rate_hz
        self.notes: list[tuple[str, str]] = []
        self._alignments = {name: _Alignment() for name in stations}
        self._times: HostPulseTimes | None = None
        self._votes = min(max(round(VOTE_S * rate_hz), FEWEST_VOTES), MOST_VOTES)
        self._start_wait_ns = start_wait_s * 1e9
        self._first_ns: int | None = None

    @property
    def started(self) -> bool:
        """True once the session has its pulse 0."""
        return self._times is not None

    @property
    def start_ns(self) -> int | None:
        """Host time of pulse 0 [ns], late by the transport of its frames; None before the start."""
        return None if self._times is None else round(self._times.at(0))

    def shift(self, station: str) -> int | None:
        """Return the number that is added to the station's count; None while it is not known."""
        return self._alignments[station].shift

    def take(self, station: str, epoch: int, pulse: int, local_ns: int) -> None:
        """Take an arrival: ``pulse`` as the station counts, ``local_ns``: host time less exposure."""
        state = self._alignments[station]
        if epoch != state.epoch:
            self.restarted(station)
            state.epoch = epoch
        if state.shift is not None and self._times is not None:
            self._follow(station, pulse + state.shift, local_ns, self._times)
            return
        state.votes[pulse] = min(local_ns, state.votes.get(pulse, local_ns))
        if self._times is None:
            self.try_start(local_ns)
        elif len(state.votes) >= self._votes:
            self._find(station, state, self._times)

    def restarted(self, station: str) -> None:
        """Forget a station's count: it has restarted. The latency of its frames is kept."""
        state = self._alignments[station]
        state.epoch, state.shift, state.early, state.refused = None, None, 0, False
        state.votes.clear()

    def try_start(self, now_ns: int) -> None:
        """Begin the session where all stations have voted, or the wait for the others is over."""
        ready = [state for state in self._alignments.values() if len(state.votes) >= self._votes]
        if self._times is not None or not ready:
            return
        first_ns = min(min(state.votes.values()) for state in ready)
        if len(ready) < len(self._alignments) and now_ns - first_ns < self._start_wait_ns:
            return
        # arrival of each station's own pulse 0 with the shortest delay
        zeros = {
            name: min(at - k * self.period_ns for k, at in state.votes.items())
            for name, state in self._alignments.items()
            if len(state.votes) >= self._votes
        }
        # arrivals fix the phase; the station that has counted longest fixes the number
        longest = min(zeros, key=lambda name: zeros[name])
        times = self._times = HostPulseTimes(round(zeros[longest]), self.period_ns)
        for name in sorted(zeros, key=lambda name: zeros[name]):
            self._find(name, self._alignments[name], times)

    def _find(self, station: str, state: _Alignment, times: HostPulseTimes) -> None:
        """Set the station's shift by its votes, or vote again where they lie between pulses."""
        began = not state.known
        pulse, at = min(state.votes.items())
        guess = times.pulse_of(at) - pulse
        late = min(t - times.at(k + guess) for k, t in state.votes.items()) - state.latency_ns
        steps = round(late / self.period_ns)
        residual = late - steps * self.period_ns
        state.votes.clear()
        if abs(residual) > LARGEST_RESIDUAL * self.period_ns:
            if not state.refused:
                self.notes.append(
                    (
                        station,
                        f"its frames lie {abs(residual) / self.period_ns:.2f} of a period off the others' pulses; it "
                        "is left out: is it on the same trigger cable, with cameras that deliver as fast?",
                    )
                )
            state.refused = True
            return
        state.shift = guess + steps
        state.refused, state.noted_late, state.least_late, state.early = False, False, None, 0
        if began:
            state.latency_ns, state.known = residual, True
        if state.shift:
            self.notes.append(
                (station, f"counts from another pulse: its pulse 0 is pulse {state.shift} of the session")
            )
        state.window_end = 0

    def _follow(self, station: str, number: int, local_ns: int, times: HostPulseTimes) -> None:
        """Follow the arrivals of an aligned station; ``number``: the session's pulse."""
        state = self._alignments[station]
        late = local_ns - state.latency_ns - times.at(number)
        if late < -EARLY * self.period_ns:
            state.early += 1
            if state.early >= EARLY_FRAMES:
                self.notes.append((station, "its frames come before their pulses: it counts wrongly; placed anew"))
                state.shift, state.early = None, 0
                state.votes.clear()
            return
        state.early = 0
        times.take(number, local_ns - state.latency_ns)
        state.least_late = late if state.least_late is None else min(state.least_late, late)
        if number < state.window_end:
            return
        slow = state.window_end > 0 and state.least_late > LATE * self.period_ns
        if slow and not state.noted_late:
            self.notes.append(
                (
                    station,
                    f"its frames come {state.least_late / self.period_ns:.1f} periods after their pulses: it cannot "
                    "keep up, or counts wrongly since then",
                )
            )
        state.noted_late = slow
        state.least_late, state.window_end = None, number + round(1e9 / self.period_ns)
