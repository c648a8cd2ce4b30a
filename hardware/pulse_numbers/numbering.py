"""The pulse number of each buffer, from the camera's own clock; what its clock showed when it was asked starts it.

A frame counter cannot tell a missed trigger from none, and a busy machine delays arrivals by more than a period. The
camera's stamps can: they lie on the pulses' line (``hardware.pulse_numbers.clock_model``). What they cannot tell is
*which* pulse the first of them is. Where all cameras' clocks can be read (``hardware.pulse_numbers.clock_sync``)
the readings tell that at once: at the start, and for a frame after a gap, which waits until its camera's clock was
read once more. Else it is voted by the earliest of a few arrivals, at the start and whenever a clock jumped:

- start: cameras are armed before the pulses begin, so the earliest camera's first frame is the first pulse (unless
  ``start_ns``, when the pulses began, shows that all missed it); the others count from there.
- a stamp that lies on no pulse, or before the last one: the camera restarted or its clock was set; its next frames
  are held until enough of them have voted, then all are given.
- a stamp on the line but not on the next pulse, while its frame does not arrive as the other cameras' do: the clock
  may have jumped by whole periods, and the next frames vote. A busy machine is late for all cameras alike.

- what came of a frame whose number and stamp were lost waits for the next one, which tells where it belongs.

Nothing is thrown away: each buffer comes out once, in order, with its pulse.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hardware.driver import ClockReading, Grabbed
from hardware.pulse_numbers.camera_state import NumberedCamera, after_jump, earliest_ns
from hardware.pulse_numbers.clock_model import CameraClock, HostLine
from hardware.pulse_numbers.clock_sync import ReadPulses
from hardware.pulse_numbers.free_running import FreeClock
from hardware.pulse_numbers.trigger_counter import TriggerWitness

VOTE_S, START_S = 0.3, 0.5
"""A vote takes so long, at the start and later: one camera's reader may lag behind the others' on a busy machine, but
not in all of its frames."""
FEWEST_VOTES, MOST_VOTES = 2, 100
PATIENCE_S = 1.0
"""So long a frame waits for a reading of its camera's clock; then it is believed, unless frames come too early."""
STALL_NS = 100_000_000
"""A frame may be so late, with the stamps in order, before its camera's clock is doubted; none can be early."""


@dataclass(frozen=True, eq=False)
class Numbered:
    """A buffer with its place: ``pulse`` from 0, ``residual_ns`` of its stamp off the camera's line of pulses."""

    camera: str
    pulse: int
    residual_ns: float
    buffer: Grabbed


class PulseNumbers:
    """Numbers the buffers of all ``cameras`` by pulse; ``notes`` says what happened to a clock, a line each.

    ``start_ns``: this machine's time when the pulses began, None where that is not known. ``start_wait_s``: how long
    after the first arrival cameras may still be silent before the rest begins without them. ``free``: cameras that
    run free; each of their frames belongs to the pulse nearest to it, so a pulse may have two of them, or none.
    """

    def __init__(
        self,
        cameras: Sequence[str],
        rate_hz: float,
        start_ns: int | None = None,
        start_wait_s: float = 1.0,
        free: Collection[str] = (),
    ) -> None:
        self.period_ns = 1e9 / rate_hz
        self.start_ns = start_ns
        self.notes: list[str] = []
        self._votes, self._start_votes = (
            min(max(round(s * rate_hz), FEWEST_VOTES), MOST_VOTES) for s in (VOTE_S, START_S)
        )
        self._cameras = {
            name: NumberedCamera(
                name, CameraClock(self.period_ns), free=FreeClock(rate_hz) if name in free else None
            )
            for name in cameras
        }
        self._line: HostLine | None = None
        self._read = ReadPulses(self.period_ns)
        self._by_reading = not free
        self._patience = max(round(PATIENCE_S * rate_hz), FEWEST_VOTES)
        self._first_arrival_ns: int | None = None
        self._start_wait_ns = start_wait_s * 1e9

    @property
    def relocks(self) -> Mapping[str, int]:
        """How often each camera's clock had to be found again."""
        return {name: camera.relocks for name, camera in self._cameras.items()}

    @property
    def witnesses(self) -> Mapping[str, TriggerWitness]:
        """What each camera's own trigger counter says."""
        return {name: camera.witness for name, camera in self._cameras.items()}

    def take(self, name: str, buffer: Grabbed) -> Iterator[Numbered]:
        """Take a buffer in order of its camera's delivery; yield those whose pulses are known by now."""
        camera = self._cameras[name]
        if buffer.nameless and camera.clock.locked and not camera.held:
            camera.nameless.append(buffer)
            return
        last = camera.last_pulse
        for one in self._taken(camera, buffer):
            yield from self._between(camera, last, one.pulse)
            yield one

    def _taken(self, camera: NumberedCamera, buffer: Grabbed) -> Iterator[Numbered]:
        """Yield what is numbered now that ``buffer`` has come."""
        if self._line is None:
            camera.held.append(buffer)
            yield from self._try_start(buffer.host_ns)
        elif camera.free is not None:
            yield self._nearest(camera, camera.free, buffer)
        elif not camera.started or camera.held:
            camera.held.append(buffer)
            yield from self._settle(camera)
        else:
            yield from self._follow(camera, buffer)

    def _between(self, camera: NumberedCamera, last: int, following: int) -> Iterator[Numbered]:
        """Place what is nameless after pulse ``last``, before the ``following`` one.

        Where the camera had no pulse in between, it is late packets of the last frame.
        """
        waiting, camera.nameless = camera.nameless, []
        for k, buffer in enumerate(waiting, start=1):
            yield Numbered(camera.name, max(last, min(last + k, following - 1)), 0.0, buffer)

    def read(self, name: str, reading: ClockReading) -> Iterator[Numbered]:
        """Take what a camera's clock showed; yield buffers that waited for it."""
        self._read.take(name, reading)
        if self._line is not None:
            yield from self._settle(self._cameras[name])

    def wants_reading(self, name: str) -> int | None:
        """Return the time [ns] since which a camera's clock has to be read; None where nothing waits for that."""
        held = self._cameras[name].held[:1]
        if self._line is None or not held or not self._reads(name):
            return None
        return max(held[0].host_ns, self._read.checked_ns(name))

    def rest(self) -> Iterator[Numbered]:
        """Yield what is still held when no more buffers come."""
        if self._line is None:
            yield from self._start()
        for camera in self._cameras.values():
            while camera.held:
                yield from self._settle(camera, whole=True)
            yield from self._between(camera, camera.last_pulse, camera.last_pulse + len(camera.nameless) + 1)

    def pulse_at(self, host_ns: int) -> int | None:
        """Return the pulse whose frames would arrive nearest to ``host_ns``; None before the start."""
        return None if self._line is None else self._line.pulse_of(host_ns)

    def session_ns(self, host_ns: int) -> int | None:
        """Return this machine's time in pulse time (pulse k at k periods) [ns]; None before the start.

        Late by the latency from pulse to the earliest arrival, a few ms, where ``start_ns`` is not known.
        """
        if self._line is None:
            return None
        begin = self._line.at(0) if self.start_ns is None else self.start_ns
        return round((host_ns - begin) * self.period_ns / self._line.period_ns)

    def _try_start(self, now_ns: int) -> Iterator[Numbered]:
        if self._first_arrival_ns is None:
            self._first_arrival_ns = now_ns
        waited = now_ns - self._first_arrival_ns > self._start_wait_ns
        if self._by_reading and all(self._read.trusted(name) for name in self._cameras):
            if waited or all(camera.held for camera in self._cameras.values()):
                yield from self._start_by_readings()
            return
        all_here = all(len(camera.held) >= self._start_votes for camera in self._cameras.values())
        if all_here or waited:
            yield from self._start()

    def _start_by_readings(self) -> Iterator[Numbered]:
        """Number what came first by the cameras' clocks; where they do not fit, arrivals are to vote."""
        first = {c.name: c.held[0] for c in self._cameras.values() if c.held}
        pulses = self._read.begin(first, self.start_ns)
        if pulses is None:
            self._by_reading = False
            return
        self._line = self._read.line
        begun: list[Numbered] = []
        for name, pulse in pulses.items():
            camera = self._cameras[name]
            camera.latency_ns = self._late_ns(first[name], pulse)
            begun += self._lock(camera, pulse)
        yield from sorted(begun, key=lambda one: one.pulse)

    def _start(self) -> Iterator[Numbered]:
        """Set the line of pulses by the cameras that are here, and number what they hold."""
        here = {c.name: earliest_ns(c.held, self.period_ns) for c in self._cameras.values() if c.held}
        if not here:
            return
        self._by_reading = False
        first = min(here.values())
        skipped = 0
        if self.start_ns is not None:
            skipped = max(int((first - self.start_ns) // self.period_ns), 0)
        self._line = HostLine(round(first - skipped * self.period_ns), self.period_ns)
        begun: list[Numbered] = []
        for name, earliest in here.items():
            camera = self._cameras[name]
            if camera.free is not None:
                begun += [self._nearest(camera, camera.free, buffer) for buffer in camera.held]
                camera.held = []
                continue
            pulse = self._line.pulse_of(earliest)
            camera.latency_ns = earliest - self._line.at(pulse)
            begun += self._lock(camera, pulse)
        # pulse by pulse, as they would have come: whoever groups them waits for a few pulses only
        yield from sorted(begun, key=lambda one: one.pulse)

    def _reads(self, name: str) -> bool:
        return self._by_reading and self._read.trusted(name)

    def _settle(self, camera: NumberedCamera, whole: bool = False) -> Iterator[Numbered]:
        """Number what ``camera`` holds once that can be told: by a reading of its clock, else by votes.

        ``whole``: now, since no more frames or readings come.
        """
        if not camera.held or not self._reads(camera.name):
            yield from self._vote(camera, whole)
            return
        split = after_jump(camera.held, self.period_ns)
        pulse = self._read.pulse(camera.name, camera.held[split])
        if pulse is not None:
            yield from self._found(camera, split, pulse)
        elif len(camera.held) < self._patience and not whole:
            return
        elif camera.doubted is None or split or self._early(camera, camera.doubted):
            yield from self._vote(camera, whole)
        else:
            yield from self._found(camera, split, camera.doubted)

    def _early(self, camera: NumberedCamera, pulse: int) -> bool:
        """Tell whether what ``camera`` holds came before it can have, were its first frame ``pulse``."""
        assert self._line is not None
        earliest = earliest_ns(camera.held, self.period_ns) - camera.latency_ns
        return earliest - self._line.at(pulse) < -0.6 * self.period_ns

    def _vote(self, camera: NumberedCamera, whole: bool) -> Iterator[Numbered]:
        """Number what ``camera`` holds once enough frames have voted; all of it when ``whole``."""
        if not camera.held or (len(camera.held) < self._votes and not whole):
            return
        assert self._line is not None
        split = after_jump(camera.held, self.period_ns)
        if split and not whole and len(camera.held) - split < self._votes:
            return  # it jumped again while it was voting: the new clock's frames vote too
        earliest = earliest_ns(camera.held[split:], self.period_ns)
        pulse = self._line.pulse_of(earliest - camera.latency_ns - self._usual_ns(camera))
        yield from self._found(camera, split, pulse)

    def _found(self, camera: NumberedCamera, split: int, pulse: int) -> Iterator[Numbered]:
        """Number what ``camera`` holds: its frame ``split``, the first of its clock as it runs now, is ``pulse``."""
        late, camera.held = camera.held[:split], camera.held[split:]
        for buffer in late:
            yield self._by_arrival(camera, buffer)
        if camera.started and pulse != camera.doubted:
            camera.relocks += 1
            self.notes.append(f"{camera.name}: its clock jumped or restarted; found again at pulse {pulse}")
        elif not camera.started and pulse > 0:
            self.notes.append(f"{camera.name}: its first frame is of pulse {pulse}")
        camera.doubted = None
        yield from self._lock(camera, pulse)

    def _lock(self, camera: NumberedCamera, pulse: int) -> Iterator[Numbered]:
        """Begin the camera's clock at ``pulse`` with the first stamp that it holds; number the rest by it."""
        held, camera.held = camera.held, []
        camera.started = True
        locked = False
        for buffer in held:
            if camera.held:  # doubted again: what follows waits its turn
                camera.held.append(buffer)
            elif locked or buffer.device_ns is None:
                yield from self._follow(camera, buffer)
            else:
                camera.clock.lock(pulse, buffer.device_ns)
                locked = True
                yield self._numbered(camera, pulse, 0.0, buffer)

    def _nearest(self, camera: NumberedCamera, clock: FreeClock, buffer: Grabbed) -> Numbered:
        """Place a frame of a camera that runs free by its instant."""
        assert self._line is not None
        at_ns = clock.at(buffer)
        pulse = max(self._line.pulse_of(at_ns), 0)
        return Numbered(camera.name, pulse, at_ns - self._line.at(pulse), buffer)

    def _follow(self, camera: NumberedCamera, buffer: Grabbed) -> Iterator[Numbered]:
        assert self._line is not None
        stamp = buffer.device_ns
        if stamp is None:
            yield self._by_arrival(camera, buffer)
            return
        if not camera.clock.locked:
            camera.clock.lock(self._line.pulse_of(self._arrival_ns(camera, buffer)), stamp)
        placed = camera.clock.place(stamp)
        if placed is None or self._doubtful(camera, placed.pulse, buffer):
            camera.held.append(buffer)
            camera.doubted = None if placed is None else placed.pulse
            return
        if not self._reads(camera.name):
            self._line.take(placed.pulse, self._arrival_ns(camera, buffer))
        elif self._read.follow(camera.name, placed.pulse, buffer) is not None:
            camera.latency_ns = min(camera.latency_ns, self._late_ns(buffer, placed.pulse))
        yield self._numbered(camera, placed.pulse, placed.residual_ns, buffer)

    def _arrival_ns(self, camera: NumberedCamera, buffer: Grabbed) -> float:
        return buffer.host_ns - buffer.exposure_ns - camera.latency_ns

    def _late_ns(self, buffer: Grabbed, pulse: int) -> float:
        """Return how long after its pulse a frame was here, its exposure taken off."""
        assert self._line is not None
        return buffer.host_ns - buffer.exposure_ns - self._line.at(pulse)

    def _doubtful(self, camera: NumberedCamera, pulse: int, buffer: Grabbed) -> bool:
        """Tell whether a frame that the clock places after a gap arrives as if it were of another pulse."""
        assert self._line is not None
        late = self._arrival_ns(camera, buffer) - self._line.at(pulse)
        if self._reads(camera.name):
            gap = pulse - camera.last_pulse > 1 and not camera.witness.confirms(pulse, buffer)
            return gap and self._read.pulse(camera.name, buffer) != pulse
        # clock and counter agree: an arrival that is late tells of a busy machine only
        if pulse - camera.last_pulse > 1 and not camera.witness.confirms(pulse, buffer):
            unusual = late - self._usual_ns(camera)
            block, last = buffer.block_id, camera.last_block
            begun_anew = block is not None and last is not None and block <= last
            limit = 0.6 * self.period_ns
            if not -limit < unusual < (limit if begun_anew else max(limit, STALL_NS)):
                return True
        camera.lates.append(late)
        if len(camera.lates) > self._votes:
            camera.lates.popleft()
        return False

    def _usual_ns(self, camera: NumberedCamera) -> float:
        """Return how late frames are just now: those of the other cameras, without others this camera's own."""
        others = [min(c.lates) for c in self._cameras.values() if c is not camera and c.lates and not c.held]
        return float(np.median(others)) if others else min(camera.lates, default=0.0)

    def _by_arrival(self, camera: NumberedCamera, buffer: Grabbed) -> Numbered:
        """Place a buffer without a stamp: by its block number after the last one, else by arrival."""
        assert self._line is not None
        if (
            buffer.block_id is not None
            and camera.last_block is not None
            and buffer.block_id > camera.last_block
        ):
            by_block = camera.last_pulse + buffer.block_id - camera.last_block
            arrival = self._arrival_ns(camera, buffer)
            if self._line.at(by_block) < arrival + 0.6 * self.period_ns:
                return self._numbered(camera, by_block, 0.0, buffer)
        pulse = self._line.pulse_of(self._arrival_ns(camera, buffer))
        return self._numbered(camera, max(pulse, camera.last_pulse + 1), 0.0, buffer)

    def _numbered(self, camera: NumberedCamera, pulse: int, residual_ns: float, buffer: Grabbed) -> Numbered:
        camera.last_block, camera.last_pulse = buffer.block_id, pulse
        camera.witness.take(pulse, buffer)
        return Numbered(camera.name, pulse, residual_ns, buffer)
