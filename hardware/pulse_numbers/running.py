"""Second phase of the numbering: each camera's device clock is followed, and found again by a vote after a jump."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from hardware.driver import Grabbed
from hardware.pulse_numbers.camera_state import (
    CameraState,
    Found,
    NumberedBuffer,
    behind_others_ns,
    earliest_arrival_ns,
    index_after_jump,
)
from hardware.pulse_numbers.clock_model import LARGEST_RESIDUAL, HostPulseTimes, StampPulse
from hardware.pulse_numbers.clock_sync import ClockPulses
from hardware.pulse_numbers.counting import OFF_PULSE, CountedPulses
from hardware.pulse_numbers.free_running import FreeClock
from hardware.pulse_numbers.settings import NumberingSettings

STALL_NS = 100_000_000
"""Largest delay of a frame, with the stamps in order, before its device clock is suspected; none can be early."""


class Running:
    """Numbers the buffers of ``cameras`` once the host times of the pulses are known.

    ``pulse_times``: when each pulse's frames arrive. ``clocks``: readings of the device clocks; None where arrivals
    decide alone.
    """

    def __init__(
        self,
        cameras: Mapping[str, CameraState],
        settings: NumberingSettings,
        pulse_times: HostPulseTimes,
        *,
        clocks: ClockPulses | None,
        notes: list[str],
    ) -> None:
        self.pulse_times = pulse_times
        self._cameras, self._settings, self._clocks, self._notes = cameras, settings, clocks, notes
        self._period_ns = settings.period_ns
        self._counting = CountedPulses(
            pulse_times, settings, self._delay_of_stamped_ns, notes, follows=clocks is None
        )

    def follows_clock(self, name: str) -> bool:
        """Return whether readings of this camera's clock are used."""
        return self._clocks is not None and self._clocks.trusted(name)

    def begin_by_clock(self, camera: CameraState, pulse: int) -> list[NumberedBuffer]:
        """Number the pending buffers; the first belongs to ``pulse``."""
        camera.latency_ns = self._delay_ns(camera.pending[0], pulse)
        return list(self._lock(camera, StampPulse(pulse, 0.0)))

    def begin_by_arrival(self, camera: CameraState, earliest_ns: float) -> list[NumberedBuffer]:
        """Number the pending buffers; with the shortest delay the first would have arrived at ``earliest_ns``."""
        if camera.free is not None:
            pending, camera.pending = camera.pending, []
            return [self._nearest(camera, camera.free, buffer) for buffer in pending]
        if camera.stampless:
            return list(self._counting.begin(camera, earliest_ns))
        pulse = self.pulse_times.pulse_of(earliest_ns)
        camera.latency_ns = earliest_ns - self.pulse_times.at(pulse)
        return list(self._lock(camera, StampPulse(pulse, 0.0)))

    def take(self, camera: CameraState, buffer: Grabbed) -> Iterator[NumberedBuffer]:
        """Take a buffer; yield those whose pulses are known by now."""
        if camera.free is not None:
            yield self._nearest(camera, camera.free, buffer)
        elif not camera.started or camera.pending or (camera.stampless and buffer.device_ns is None):
            camera.pending.append(buffer)
            yield from self.settle(camera)
        else:
            yield from self._follow(camera, buffer)

    def settle(self, camera: CameraState, final: bool = False) -> Iterator[NumberedBuffer]:
        """Number the pending buffers once that is possible: by a reading of the device clock, else by a vote.

        ``final``: number them now, since no more frames or readings come.
        """
        if camera.stampless:
            yield from self._counting.settle(camera, final)
            return
        clocks = self._clocks
        if not camera.pending or clocks is None or not clocks.trusted(camera.name):
            yield from self._vote(camera, final)
            return
        split = index_after_jump(camera.pending, self._period_ns)
        found = clocks.pulse(camera.name, camera.pending[split])
        if found is not None:
            yield from self._found(camera, split, found)
        elif len(camera.pending) < self._settings.reading_wait and not final:
            return
        elif camera.suspect_pulse is None or split or self._too_early(camera, camera.suspect_pulse):
            yield from self._vote(camera, final)
        else:
            yield from self._found(camera, split, StampPulse(camera.suspect_pulse, 0.0))

    def _too_early(self, camera: CameraState, pulse: int) -> bool:
        """Return whether the pending buffers arrived too early for their first one to be of ``pulse``."""
        earliest = earliest_arrival_ns(camera.pending, self._period_ns) - camera.latency_ns
        return earliest - self.pulse_times.at(pulse) < -OFF_PULSE * self._period_ns

    def _vote(self, camera: CameraState, final: bool) -> Iterator[NumberedBuffer]:
        """Number the pending buffers once enough frames have voted; all of them when ``final``."""
        votes = self._settings.votes
        if not camera.pending or (len(camera.pending) < votes and not final):
            return
        split = index_after_jump(camera.pending, self._period_ns)
        if split and not final and len(camera.pending) - split < votes:
            return  # it jumped again during the vote: the new clock's frames vote too
        earliest = earliest_arrival_ns(camera.pending[split:], self._period_ns)
        pulse = self.pulse_times.pulse_of(earliest - camera.latency_ns - self._usual_delay_ns(camera))
        behind_ns = behind_others_ns(camera.pending[split:], self._period_ns)
        yield from self._found(camera, split, StampPulse(pulse, behind_ns))

    def _found(self, camera: CameraState, split: int, first: StampPulse) -> Iterator[NumberedBuffer]:
        """Number the pending buffers; the first by the present clock, at index ``split``, is of pulse ``first``."""
        pulse = first.pulse
        before, camera.pending = camera.pending[:split], camera.pending[split:]
        by_line = self._by_line(camera, first)
        for buffer in before:
            yield self._by_arrival(camera, buffer) if by_line is None else self._late(camera, buffer)
        if by_line is not None:
            if abs(by_line.residual_ns) > LARGEST_RESIDUAL * self._period_ns:
                self._notes.append(f"{camera.name}: its frame of pulse {pulse} was exposed between pulses")
        elif camera.started and pulse != camera.suspect_pulse:
            camera.relocks += 1
            self._notes.append(f"{camera.name}: its clock jumped or restarted; found again at pulse {pulse}")
        elif not camera.started and pulse > 0:
            self._notes.append(f"{camera.name}: its first frame is of pulse {pulse}")
        camera.suspect_pulse = None
        if by_line is None:
            yield from self._lock(camera, _on_grid(first))
            return
        pending, camera.pending = camera.pending, []
        stamp = pending[0].device_ns
        if stamp is not None:
            camera.clock.pulse_of(stamp)  # the line follows stamps that fit it
        yield self._numbered(camera, by_line.pulse, by_line.residual_ns, pending[0])
        yield from self._follow_all(camera, pending[1:])

    def _by_line(self, camera: CameraState, first: StampPulse) -> StampPulse | None:
        """Return the first pending stamp's pulse by the camera's own line, which is more precise than ``first``.

        None where its clock did not run on: the line is farther from ``first`` than the uncertainty of ``first``.
        """
        stamp = camera.pending[0].device_ns
        if stamp is None or not camera.clock.locked:
            return None
        line = camera.clock.nearest(stamp)
        apart_ns = (line.pulse - first.pulse) * self._period_ns + line.residual_ns - first.residual_ns
        if abs(apart_ns) > max(first.error_ns, LARGEST_RESIDUAL * self._period_ns):
            return None
        return StampPulse(first.pulse, first.residual_ns + apart_ns)

    def _lock(self, camera: CameraState, first: StampPulse) -> Iterator[NumberedBuffer]:
        """Align the device clock: its first pending stamp is of pulse ``first``; number the rest by it."""
        pending, camera.pending = camera.pending, []
        camera.started = True
        while pending and pending[0].device_ns is None:
            yield self._by_arrival(camera, pending.pop(0))
        for buffer in pending[:1]:
            if buffer.device_ns is not None:
                camera.clock.lock(first.pulse, buffer.device_ns, first.residual_ns)
            yield self._numbered(camera, first.pulse, first.residual_ns, buffer, error_ns=first.error_ns)
        yield from self._follow_all(camera, pending[1:])

    def _follow_all(self, camera: CameraState, buffers: Sequence[Grabbed]) -> Iterator[NumberedBuffer]:
        for buffer in buffers:
            if camera.pending:  # suspected again: what follows waits
                camera.pending.append(buffer)
            else:
                yield from self._follow(camera, buffer)

    def _nearest(self, camera: CameraState, clock: FreeClock, buffer: Grabbed) -> NumberedBuffer:
        """Number a frame of a free-running camera by its exposure time."""
        at_ns = clock.at(buffer)
        pulse = max(self.pulse_times.pulse_of(at_ns), 0)
        return NumberedBuffer(camera.name, pulse, at_ns - self.pulse_times.at(pulse), buffer, "free")

    def _follow(self, camera: CameraState, buffer: Grabbed) -> Iterator[NumberedBuffer]:
        """Number a buffer by its stamp, or make it pending where the device clock is suspect."""
        stamp = buffer.device_ns
        if stamp is None:
            yield self._by_arrival(camera, buffer)
            return
        if not camera.clock.locked:
            camera.clock.lock(self.pulse_times.pulse_of(self._arrival_ns(camera, buffer)), stamp)
        found = camera.clock.pulse_of(stamp)
        if found is None or self._suspect(camera, found.pulse, buffer):
            camera.pending.append(buffer)
            camera.suspect_pulse = None if found is None else found.pulse
            return
        if self._clocks is None or not self._clocks.trusted(camera.name):
            self.pulse_times.take(found.pulse, self._arrival_ns(camera, buffer))
        elif self._clocks.follow(camera.name, found.pulse, buffer) is not None:
            camera.latency_ns = min(camera.latency_ns, self._delay_ns(buffer, found.pulse))
        yield self._numbered(camera, found.pulse, found.residual_ns, buffer)

    def _arrival_ns(self, camera: CameraState, buffer: Grabbed) -> float:
        return buffer.host_ns - buffer.exposure_ns - camera.latency_ns

    def _delay_ns(self, buffer: Grabbed, pulse: int) -> float:
        """Return how long after its pulse a frame arrived, less its exposure [ns]."""
        return buffer.host_ns - buffer.exposure_ns - self.pulse_times.at(pulse)

    def _suspect(self, camera: CameraState, pulse: int, buffer: Grabbed) -> bool:
        """Return whether a frame that the device clock puts after a gap arrives as if it were of another pulse."""
        delay = self._arrival_ns(camera, buffer) - self.pulse_times.at(pulse)
        # where clock and trigger counter agree, a late arrival only means a busy machine
        if self._clocks is not None and self._clocks.trusted(camera.name):
            gap = pulse - camera.last_pulse > 1 and not camera.counter.confirms(pulse, buffer)
            if not gap:
                return False
            read = self._clocks.pulse(camera.name, buffer)
            return read is None or read.pulse != pulse
        if pulse - camera.last_pulse > 1 and not camera.counter.confirms(pulse, buffer):
            unusual = delay - self._usual_delay_ns(camera)
            block, last = buffer.block_id, camera.last_block
            restarted = block is not None and last is not None and block <= last
            limit = OFF_PULSE * self._period_ns
            if not -limit < unusual < (limit if restarted else max(limit, STALL_NS)):
                return True
        camera.delays.append(delay)
        if len(camera.delays) > self._settings.votes:
            camera.delays.popleft()
        return False

    def _delay_of_stamped_ns(self, camera: CameraState) -> float:
        """Return the present delay of the other cameras' frames, of those with stamps [ns]; 0 without such."""
        others = self._delays_of_others_ns(camera)
        return float(np.median(others)) if others else 0.0

    def _delays_of_others_ns(self, camera: CameraState) -> list[float]:
        return [min(c.delays) for c in self._cameras.values() if c is not camera and c.delays and not c.pending]

    def _usual_delay_ns(self, camera: CameraState) -> float:
        """Return the present delay of frames [ns]: the other cameras', without others this camera's own."""
        others = self._delays_of_others_ns(camera)
        return float(np.median(others)) if others else min(camera.delays, default=0.0)

    def _late(self, camera: CameraState, buffer: Grabbed) -> NumberedBuffer:
        """Number a buffer that was exposed between pulses: by its stamp if its block id agrees, else by arrival."""
        if buffer.device_ns is not None:
            nearest = camera.clock.nearest(buffer.device_ns)
            if nearest.pulse == self._by_block(camera, buffer):
                return self._numbered(camera, nearest.pulse, nearest.residual_ns, buffer)
        return self._by_arrival(camera, buffer)

    def _by_block(self, camera: CameraState, buffer: Grabbed) -> int | None:
        """Return a buffer's pulse by its block id after the last one; None where there is none, or it is behind."""
        block, last = buffer.block_id, camera.last_block
        return None if block is None or last is None or block <= last else camera.last_pulse + block - last

    def _by_arrival(self, camera: CameraState, buffer: Grabbed) -> NumberedBuffer:
        """Number a buffer whose stamp gives no pulse: by its block id after the last one, else by its arrival.

        A buffer with a stamp that fits no pulse was not exposed at the time of its pulse.
        """
        by_block = self._by_block(camera, buffer)
        if by_block is not None:
            arrival = self._arrival_ns(camera, buffer)
            if self.pulse_times.at(by_block) < arrival + OFF_PULSE * self._period_ns:
                found: Found = "neighbours" if buffer.device_ns is None else "arrival"
                return self._numbered(camera, by_block, 0.0, buffer, found)
        pulse = self.pulse_times.pulse_of(self._arrival_ns(camera, buffer))
        return self._numbered(camera, max(pulse, camera.last_pulse + 1), 0.0, buffer, "arrival")

    def _numbered(
        self,
        camera: CameraState,
        pulse: int,
        residual_ns: float,
        buffer: Grabbed,
        found: Found | None = None,
        error_ns: float = 0.0,
    ) -> NumberedBuffer:
        camera.last_block, camera.last_pulse = buffer.block_id, pulse
        camera.counter.take(pulse, buffer)
        by_stamp: Found = "clock" if self.follows_clock(camera.name) else "stamp"
        return NumberedBuffer(camera.name, pulse, residual_ns, buffer, found or by_stamp, error_ns)


def _on_grid(first: StampPulse) -> StampPulse:
    """Return a pulse given by a reading, with residual 0 where the reading does not exclude that."""
    off_ns = abs(first.residual_ns)
    return StampPulse(first.pulse, 0.0, off_ns) if off_ns <= first.error_ns else first
