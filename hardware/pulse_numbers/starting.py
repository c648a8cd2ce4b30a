"""First phase of the numbering: buffers are pending until the pulse of each camera's first frame is known."""

from collections.abc import Mapping
from typing import NamedTuple

from hardware.pulse_numbers.camera_state import CameraState, NumberedBuffer, earliest_arrival_ns
from hardware.pulse_numbers.clock_model import HostPulseTimes
from hardware.pulse_numbers.clock_sync import ClockPulses
from hardware.pulse_numbers.running import Running
from hardware.pulse_numbers.settings import NumberingSettings


class Started(NamedTuple):
    """The next phase, and the buffers that were pending, numbered and in order of pulses."""

    running: Running
    numbered: list[NumberedBuffer]


class Starting:
    """Finds the first pulses of ``cameras`` by readings of their clocks, else by a vote of arrivals.

    ``by_clocks``: whether readings may decide at all; with free-running cameras they may not.
    """

    def __init__(
        self,
        cameras: Mapping[str, CameraState],
        settings: NumberingSettings,
        clocks: ClockPulses,
        *,
        by_clocks: bool,
        notes: list[str],
    ) -> None:
        self._cameras, self._settings, self._clocks = cameras, settings, clocks
        self._by_clocks, self._notes = by_clocks, notes
        self._first_arrival_ns: int | None = None

    def try_start(self, now_ns: int) -> Started | None:
        """Return the next phase once enough is known at host time ``now_ns``, else None."""
        if self._first_arrival_ns is None:
            self._first_arrival_ns = now_ns
        cameras = self._cameras.values()
        waited = now_ns - self._first_arrival_ns > self._settings.start_wait_ns
        if self._by_clocks and all(self._clocks.trusted(name) for name in self._cameras):
            if waited or all(camera.pending for camera in cameras):
                return self._start_by_clocks()
            return None
        if waited or all(len(camera.pending) >= self._settings.start_votes for camera in cameras):
            return self.start_by_arrivals()
        return None

    def start_by_arrivals(self) -> Started | None:
        """Begin with the cameras that have delivered; None where none has."""
        period_ns, start_ns = self._settings.period_ns, self._settings.start_ns
        earliest = {c.name: earliest_arrival_ns(c.pending, period_ns) for c in self._cameras.values() if c.pending}
        if not earliest:
            return None
        first = min(earliest.values())
        skipped = 0
        if start_ns is not None:
            skipped = max(int((first - start_ns) // period_ns), 0)
        times = HostPulseTimes(round(first - skipped * period_ns), period_ns)
        running = self._running(times, by_clocks=False)
        numbered: list[NumberedBuffer] = []
        for name, arrival_ns in earliest.items():
            numbered += running.begin_by_arrival(self._cameras[name], arrival_ns)
        return _sorted(running, numbered)

    def _start_by_clocks(self) -> Started | None:
        """Begin by readings of the device clocks; None where they do not fit, so that arrivals vote."""
        first = {c.name: c.pending[0] for c in self._cameras.values() if c.pending}
        begun = self._clocks.begin(first, self._settings.start_ns)
        if begun is None:
            self._by_clocks = False
            return None
        running = self._running(begun.times, by_clocks=True)
        numbered: list[NumberedBuffer] = []
        for name, pulse in begun.pulses.items():
            numbered += running.begin_by_clock(self._cameras[name], pulse)
        return _sorted(running, numbered)

    def _running(self, times: HostPulseTimes, *, by_clocks: bool) -> Running:
        clocks = self._clocks if by_clocks else None
        return Running(self._cameras, self._settings, times, clocks=clocks, notes=self._notes)


def _sorted(running: Running, numbered: list[NumberedBuffer]) -> Started:
    # pulse by pulse, as they would have come: frame grouping waits for a few pulses only
    return Started(running, sorted(numbered, key=lambda one: one.pulse))
