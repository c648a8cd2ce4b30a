"""Which pulse is which: stations count for themselves, and only pulse numbers cross PCs.

All cameras hang on one trigger cable, so a pulse's frames arrive at all stations at about the same time. A station's
count and another's belong together by a whole number, its *shift*, and the time of arrival, in one clock
(``hardware.transport.clock``), shows it: the earliest of some arrivals, since frames come late, never early.

- Start: the earliest station's pulse 0 is the session's. A station that counts from another pulse is noted, and
  counted on from there.
- Who comes later, or comes back, finds its place on the line of pulses that the others have kept up.
- Arrivals of two stations must agree to a quarter of a period: a station that lies between pulses is left out, and
  noted. Cameras that deliver later by whole periods than the others' cannot be distinguished from a wrong count.
- A station whose frames come before their pulse counts too far ahead, and is placed anew. One whose frames come late
  may be slow or count wrongly: that is noted, and no more.
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
    epoch: int | None = None
    shift: int | None = None
    latency_ns: float = 0.0
    known: bool = False
    votes: dict[int, int] = field(default_factory=dict)
    early: int = 0
    told_late: bool = False
    refused: bool = False
    least_late: float | None = None
    window_end: int = 0


class StationPulses:
    """Shifts of ``stations``, from arrivals; ``notes``: what happened, (station, text) each.

    ``start_wait_s``: how long after the first arrival stations may be silent before the rest begins without them.
    """

    def __init__(self, stations: Sequence[str], rate_hz: float, start_wait_s: float) -> None:
        self.period_ns = 1e9 / rate_hz
        self.notes: list[tuple[str, str]] = []
        self._places = {name: _Alignment() for name in stations}
        self._line: HostPulseTimes | None = None
        self._votes = min(max(round(VOTE_S * rate_hz), FEWEST_VOTES), MOST_VOTES)
        self._start_wait_ns = start_wait_s * 1e9
        self._first_ns: int | None = None

    @property
    def started(self) -> bool:
        """True once the session has its pulse 0."""
        return self._line is not None

    @property
    def start_ns(self) -> int | None:
        """Time of pulse 0 by this machine's clock [ns], late by its frames' way here; None before the start."""
        return None if self._line is None else round(self._line.at(0))

    def shift(self, station: str) -> int | None:
        """Return what is added to the station's count; None while that is not known."""
        return self._places[station].shift

    def late_ns(self, station: str, pulse: int, local_ns: int) -> float | None:
        """Return how far behind its pulse (in the station's count) an arrival is, beyond what is usual."""
        place = self._places[station]
        if self._line is None or place.shift is None:
            return None
        return local_ns - place.latency_ns - self._line.at(pulse + place.shift)

    def take(self, station: str, epoch: int, pulse: int, local_ns: int) -> None:
        """Take an arrival: ``pulse`` as the station counts, ``local_ns``: host time less exposure."""
        place = self._places[station]
        if epoch != place.epoch:
            self.restarted(station)
            place.epoch = epoch
        if place.shift is not None:
            self._follow(station, place, pulse, local_ns)
            return
        place.votes[pulse] = min(local_ns, place.votes.get(pulse, local_ns))
        if self._line is None:
            self.try_start(local_ns)
        elif len(place.votes) >= self._votes:
            self._find(station, place)

    def restarted(self, station: str) -> None:
        """Forget a station's count: it began anew. How fast its frames come is kept."""
        place = self._places[station]
        place.epoch, place.shift, place.early, place.refused = None, None, 0, False
        place.votes.clear()

    def try_start(self, now_ns: int) -> None:
        """Name the start where all stations have voted, or those that have will wait no longer."""
        ready = [place for place in self._places.values() if len(place.votes) >= self._votes]
        if self._line is not None or not ready:
            return
        first_ns = min(min(place.votes.values()) for place in ready)
        if len(ready) < len(self._places) and now_ns - first_ns < self._start_wait_ns:
            return
        # each station's own pulse 0, had it come as quickly as the quickest
        zeros = {
            name: min(at - k * self.period_ns for k, at in place.votes.items())
            for name, place in self._places.items()
            if len(place.votes) >= self._votes
        }
        # arrivals fix the phase; the station that has counted longest fixes the number
        longest = min(zeros, key=lambda name: zeros[name])
        self._line = HostPulseTimes(round(zeros[longest]), self.period_ns)
        for name in sorted(zeros, key=lambda name: zeros[name]):
            self._find(name, self._places[name])

    def _find(self, station: str, place: _Alignment) -> None:
        """Set the station's shift by its votes, or begin to vote anew where they lie between pulses."""
        assert self._line is not None
        line = self._line
        began = not place.known
        pulse, at = min(place.votes.items())
        guess = line.pulse_of(at) - pulse
        late = min(t - line.at(k + guess) for k, t in place.votes.items()) - place.latency_ns
        steps = round(late / self.period_ns)
        residual = late - steps * self.period_ns
        place.votes.clear()
        if abs(residual) > LARGEST_RESIDUAL * self.period_ns:
            if not place.refused:
                self.notes.append(
                    (
                        station,
                        f"its frames lie {abs(residual) / self.period_ns:.2f} of a period off the others' pulses; it "
                        "is left out: is it on the same trigger cable, with cameras that deliver as fast?",
                    )
                )
            place.refused = True
            return
        place.shift = guess + steps
        place.refused, place.told_late, place.least_late, place.early = False, False, None, 0
        if began:
            place.latency_ns, place.known = residual, True
        if place.shift:
            self.notes.append(
                (station, f"counts from another pulse: its pulse 0 is pulse {place.shift} of the session")
            )
        place.window_end = 0

    def _follow(self, station: str, place: _Alignment, pulse: int, local_ns: int) -> None:
        assert self._line is not None
        assert place.shift is not None
        number = pulse + place.shift
        late = local_ns - place.latency_ns - self._line.at(number)
        if late < -EARLY * self.period_ns:
            place.early += 1
            if place.early >= EARLY_FRAMES:
                self.notes.append(
                    (station, "its frames come before their pulses: it counts wrongly; placed anew")
                )
                place.shift, place.early = None, 0
                place.votes.clear()
            return
        place.early = 0
        self._line.take(number, local_ns - place.latency_ns)
        place.least_late = late if place.least_late is None else min(place.least_late, late)
        if number < place.window_end:
            return
        slow = place.window_end > 0 and place.least_late > LATE * self.period_ns
        if slow and not place.told_late:
            self.notes.append(
                (
                    station,
                    f"its frames come {place.least_late / self.period_ns:.1f} periods after their pulses: it cannot "
                    "keep up, or counts wrongly since then",
                )
            )
        place.told_late = slow
        place.least_late, place.window_end = None, number + round(1e9 / self.period_ns)
