"""The pulse number of each buffer, from the camera's device clock.

Frame counters do not show missed triggers, and a busy machine delays arrivals by more than a period. Device time
stamps are a linear function of the pulse number (``hardware.pulse_numbers.clock_model``), except for *which* pulse
the first one is. Where all device clocks can be read (``hardware.pulse_numbers.clock_sync``) the readings give it: at
the start, and for a frame after a gap, which waits for the next reading of its camera's clock. Else the earliest of a
few arrivals decides (a vote), at the start and whenever a clock jumped:

- start (``hardware.pulse_numbers.starting``): cameras are armed before the pulses begin, so the earliest camera's
  first frame is the first pulse (unless ``start_ns``, when the pulses began, shows that all missed it); the others
  count from there.
- a time stamp that fits no pulse, or is before the last one (``hardware.pulse_numbers.running``): the camera
  restarted or its clock was set; its next frames are pending until enough have voted, then all are released.
- a time stamp that fits a later pulse, while its frame does not arrive as the other cameras' do: the clock
  may have jumped by whole periods, and the next frames vote. A busy machine is late for all cameras alike.
- a camera without time stamps is counted, and checked by arrivals (``hardware.pulse_numbers.counting``).
- a buffer without block id and time stamp waits for the next one, from which its pulse follows.

Nothing is dropped: each buffer comes out once, in order, with its pulse.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence

from hardware.driver import ClockReading, Grabbed
from hardware.pulse_numbers.camera_state import CameraState, NumberedBuffer
from hardware.pulse_numbers.clock_model import DeviceClock, ExposureStart
from hardware.pulse_numbers.clock_sync import ClockPulses
from hardware.pulse_numbers.free_running import FreeClock
from hardware.pulse_numbers.running import Running
from hardware.pulse_numbers.settings import NumberingSettings
from hardware.pulse_numbers.starting import Starting
from hardware.pulse_numbers.trigger_counter import TriggerCounter


class PulseNumbers:
    """Numbers the buffers of all ``cameras`` by pulse.

    Parameters
    ----------
    cameras
        Names.
    rate_hz
        Rate of the pulses.
    start_ns
        Host time when the pulses began [ns], None where that is not known.
    start_wait_s
        How long after the first arrival cameras may be silent before the others begin without them.
    free
        Free-running cameras; each of their frames belongs to the pulse nearest to it, so a pulse may have two of
        them, or none.
    played
        Files that are played: their frames follow no clock and are counted.
    """

    def __init__(
        self,
        cameras: Sequence[str],
        rate_hz: float,
        start_ns: int | None = None,
        start_wait_s: float = 1.0,
        free: Collection[str] = (),
        played: Collection[str] = (),
    ) -> None:
        self._settings = NumberingSettings.at_rate(rate_hz, start_ns, start_wait_s)
        self.notes: list[str] = []
        """Jumps of device clocks, one line each."""
        period_ns = self.period_ns = self._settings.period_ns
        self._cameras = {
            name: CameraState(
                name, DeviceClock(period_ns), free=FreeClock(rate_hz) if name in free else None, played=name in played
            )
            for name in cameras
        }
        self._clocks = ClockPulses(period_ns)
        self._phase: Starting | Running = Starting(
            self._cameras, self._settings, self._clocks, by_clocks=not free, notes=self.notes
        )

    @property
    def relocks(self) -> Mapping[str, int]:
        """How often each device clock jumped and was aligned again."""
        return {name: camera.relocks for name, camera in self._cameras.items()}

    @property
    def trigger_counters(self) -> Mapping[str, TriggerCounter]:
        """What each camera's own trigger counter shows."""
        return {name: camera.counter for name, camera in self._cameras.items()}

    def take(self, name: str, buffer: Grabbed) -> Iterator[NumberedBuffer]:
        """Take a buffer in order of its camera's delivery; yield those whose pulses are known by now."""
        camera = self._cameras[name]
        if buffer.unidentified and camera.clock.locked and not camera.pending:
            camera.unidentified.append(buffer)
            return
        last = camera.last_pulse
        for one in self._number(camera, buffer):
            yield from self._between(camera, last, one.pulse)
            yield one

    def read(self, name: str, reading: ClockReading) -> Iterator[NumberedBuffer]:
        """Take a reading of a device clock; yield buffers that waited for it."""
        self._clocks.take(name, reading)
        if isinstance(self._phase, Running):
            yield from self._phase.settle(self._cameras[name])

    def host_time(self, name: str, buffer: Grabbed) -> ExposureStart | None:
        """Return when a frame's exposure began, by readings of its device clock; None where that is not known."""
        return self._clocks.host_time(name, buffer)

    def wants_reading(self, name: str) -> int | None:
        """Return the host time [ns] since which a reading of a device clock is wanted; None where none is."""
        phase, pending = self._phase, self._cameras[name].pending
        if not isinstance(phase, Running) or not pending or not phase.follows_clock(name):
            return None
        return max(pending[0].host_ns, self._clocks.checked_ns(name))

    def rest(self) -> Iterator[NumberedBuffer]:
        """Yield what is still pending when no more buffers come."""
        phase = self._phase
        if isinstance(phase, Starting):
            started = phase.start_by_arrivals()
            if started is None:
                return
            phase = self._phase = started.running
            yield from started.numbered
        for camera in self._cameras.values():
            while camera.pending:
                yield from phase.settle(camera, final=True)
            last = camera.last_pulse
            yield from self._between(camera, last, last + len(camera.unidentified) + 1)

    def pulse_at(self, host_ns: int) -> int | None:
        """Return the pulse whose frames would arrive nearest to ``host_ns``; None before the start."""
        return self._phase.pulse_times.pulse_of(host_ns) if isinstance(self._phase, Running) else None

    def session_ns(self, host_ns: int) -> int | None:
        """Return a host time in pulse time (pulse k at k periods) [ns]; None before the start.

        Late by the latency from pulse to the earliest arrival, a few ms, where ``start_ns`` is not known.
        """
        if not isinstance(self._phase, Running):
            return None
        times, start_ns = self._phase.pulse_times, self._settings.start_ns
        begin = times.at(0) if start_ns is None else start_ns
        return round((host_ns - begin) * self.period_ns / times.period_ns)

    def _number(self, camera: CameraState, buffer: Grabbed) -> Iterator[NumberedBuffer]:
        """Yield what can be numbered now that ``buffer`` has come."""
        if isinstance(self._phase, Running):
            yield from self._phase.take(camera, buffer)
            return
        camera.pending.append(buffer)
        started = self._phase.try_start(buffer.host_ns)
        if started is not None:
            self._phase = started.running
            yield from started.numbered

    def _between(self, camera: CameraState, last: int, following: int) -> Iterator[NumberedBuffer]:
        """Number unidentified buffers after pulse ``last``, before the ``following`` one.

        Where the camera had no pulse in between, they are late packets of the last frame.
        """
        waiting, camera.unidentified = camera.unidentified, []
        for k, buffer in enumerate(waiting, start=1):
            yield NumberedBuffer(camera.name, max(last, min(last + k, following - 1)), 0.0, buffer, "neighbours")
