"""Software trigger: commands each camera to expose, pulse by pulse, and waits for the frames.

Waiting makes the pairing certain for cameras without a clock, and avoids triggers to cameras that are not ready,
which they ignore silently. The cost is the rate: pulses that come due meanwhile are skipped and counted
(``hardware.pulse_grid``). A frame's time is taken from when its camera's command was sent and returned.
"""

import logging
import threading
from bisect import bisect_right
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

from hardware.driver import CameraDriver, DeviceError, Grabbed
from hardware.pulse_grid import LATEST_TIME, HostClock, PulseGrid, SentPulse
from hardware.pulse_numbers.clock_model import ExposureStart, StampPulse
from hardware.silence import PollingTime

FRAME_TIMEOUT_S = 5.0
"""Polling time for a missing frame before the next pulse: a frame that came even later would be numbered as the next
pulse's. Time in which this process did not poll does not count (``hardware.silence``)."""
MISSES_TO_IGNORE = 3
"""A camera that missed this many pulses in a row is not waited for until it delivers again."""
REST = 10
"""A camera whose command failed gets none for this many times the duration of that: it then delays the others for a
tenth of the time at most; with half of it for a fifth, with double of it the camera comes back later."""
log = logging.getLogger("mosca.hardware.triggers")


@dataclass
class _Commands:
    """Commands to one camera: host times and numbers of the pulses, in order.

    ``at_ns``: when each was carried out, as the driver reports it; None where that is not known (yet). ``error_ns``:
    largest error of that.
    """

    sent_ns: list[int] = field(default_factory=list)
    numbers: list[int] = field(default_factory=list)
    at_ns: list[int | None] = field(default_factory=list)
    error_ns: list[int] = field(default_factory=list)


class SoftwareTrigger:
    """Triggers all ``drivers`` that can be, ``rate_hz`` times a second at most; ``clock`` is for tests."""

    def __init__(self, drivers: Mapping[str, CameraDriver], rate_hz: float, clock: HostClock | None = None) -> None:
        for name, driver in drivers.items():
            if not driver.capabilities.software_trigger:
                raise DeviceError(
                    f"camera '{name}': has no software trigger; use another [hardware.trigger] source, "
                    "serial or external for instance"
                )
        self._drivers = drivers
        self._clock = clock or HostClock()
        self._grid = PulseGrid(rate_hz, self._clock)
        self._made = _Commands()
        self._commands = {name: _Commands() for name in drivers}
        self._awaited: set[str] = set()
        self._lost: set[str] = set()
        self._resting_until_ns = dict.fromkeys(drivers, 0)
        self._fired_ns: int | None = None
        self._polling: dict[str, PollingTime] = {}
        self._missed = dict.fromkeys(drivers, 0)
        self._changed = threading.Condition()
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._unsent: Counter[str] = Counter()
        self._slow_answers: Counter[str] = Counter()
        self.failed: dict[str, str] = {}

    def start(self) -> int | None:
        """Begin with pulse 0 now; return this machine's time of it [ns]."""
        self._stop.clear()
        for commands in (self._made, *self._commands.values()):
            commands.sent_ns.clear()
            commands.numbers.clear()
            commands.at_ns.clear()
            commands.error_ns.clear()
        begin_ns = self._grid.begin()
        self._thread = threading.Thread(target=self.run, name="software trigger", daemon=True)
        self._thread.start()
        return begin_ns

    def stop(self) -> None:
        """Make no more pulses."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def pulse_at(self, host_ns: int) -> int | None:
        """Return the last pulse that was made before ``host_ns``."""
        index = bisect_right(self._made.sent_ns, host_ns) - 1
        return self._made.numbers[index] if index >= 0 else None

    def pulse_of(self, camera: str, buffer: Grabbed, read: ExposureStart | None = None) -> StampPulse | None:
        """Return the last pulse that was sent to ``camera`` before ``buffer`` arrived, and how late it was.

        ``read``: its time of exposure by the camera's clock, used where it is more precise than the command's time.
        """
        commands = self._commands[camera]
        index = bisect_right(commands.sent_ns, buffer.host_ns) - 1
        if index < 0:
            return None
        number, sent_ns, done_ns = commands.numbers[index], commands.sent_ns[index], commands.at_ns[index]
        latest_ns = max(buffer.host_ns - buffer.exposure_ns, sent_ns)
        if done_ns is None:  # no answer yet: after it was sent, before the exposure ended
            at_ns, error_ns = (sent_ns + latest_ns) / 2, (latest_ns - sent_ns) / 2
        else:
            at_ns, error_ns = float(done_ns), float(commands.error_ns[index])
        if read is not None and read.error_ns < error_ns and read.within(sent_ns, latest_ns):
            at_ns, error_ns = read.at_ns, read.error_ns
        late_ns, limit_ns = self._late_ns(number, at_ns), LATEST_TIME * self._grid.period_ns
        self._slow_answers[camera] += late_ns > limit_ns
        return StampPulse(number, min(late_ns, limit_ns), error_ns + max(late_ns - limit_ns, 0.0))

    def session_ns(self, host_ns: int) -> int | None:
        """Return a host time from pulse 0 on [ns]; None before it."""
        return host_ns - self._grid.begin_ns if self._made.sent_ns else None

    def new_pulses(self) -> list[SentPulse]:
        """Return the pulses sent since the last call."""
        return self._grid.new_pulses()

    def skipped(self, before: int | None = None) -> int:
        """Return how many pulses were skipped, of those ``before`` a number."""
        return self._grid.skipped(before)

    def notes(self, before: int | None = None) -> list[str]:
        """Return what went wrong with the pulses ``before`` a number, one line each."""
        notes = self._grid.skipped_note("software trigger", before)
        for name, count in self._unsent.items():
            notes.append(
                f"camera '{name}': {count} pulses were not sent to it: the commands to the cameras before it took "
                "too long; use a lower rate_hz or a trigger line"
            )
        for name, count in (+self._slow_answers).items():
            notes.append(
                f"camera '{name}': {count} frames have uncertain times: its trigger commands took "
                "about half a period or longer; use a lower rate_hz or a trigger line"
            )
        return notes + [f"software trigger: {text}" for text in self.failed.values()]

    def frame_arrived(self, camera: str, host_ns: int) -> None:
        """Register the camera's frame of the last pulse; the next one waits until all have arrived."""
        with self._changed:
            self._awaited.discard(camera)
            self._lost.discard(camera)
            self._missed[camera] = 0
            self._changed.notify()

    def poll_timed_out(self, camera: str, began_ns: int, ended_ns: int) -> None:
        """Wait no longer for a frame that was polled for long enough since the last pulse."""
        with self._changed:
            self._lost.discard(camera)
            if camera not in self._awaited or self._fired_ns is None or began_ns < self._fired_ns:
                return
            polled = self._polling.setdefault(camera, PollingTime())
            polled.timed_out(began_ns, ended_ns, None)
            if polled.idle_s >= FRAME_TIMEOUT_S:
                self._stop_waiting(camera)

    def camera_lost(self, camera: str) -> None:
        """Wait no longer for a camera that does not answer."""
        with self._changed:
            self._lost.add(camera)
            if camera in self._awaited:
                self._stop_waiting(camera)

    def _stop_waiting(self, camera: str) -> None:
        self._awaited.discard(camera)
        self._missed[camera] += 1
        self._changed.notify()

    def report(self) -> dict[str, object]:
        """Return pulses made, those skipped because frames were waited for, and what went wrong by camera."""
        return {
            "pulses": len(self._made.numbers),
            "skipped_pulses": self._grid.skipped(),
            "unsent": dict(self._unsent),
            "slow_answers": dict(+self._slow_answers),
            **self.failed,
        }

    def close(self) -> None:
        """Stop."""
        self.stop()

    def run(self) -> None:
        """Make pulses until ``stop``; run by the thread that ``start`` starts."""
        while True:
            number = self._grid.await_next(self._stop)
            if number is None:
                return
            self._fire(number)
            self._await_frames()

    def _fire(self, number: int) -> None:
        with self._changed:
            self._fired_ns = None
            self._polling.clear()
            self._awaited.clear()
            self._made.numbers.append(number)
            self._made.sent_ns.append(self._clock.now_ns())
        sent = [pair for name in list(self._drivers) if (pair := self._command(name, number)) is not None]
        if sent:
            self._grid.sent(number, sent[0][0], sent[-1][1])

    def _command(self, name: str, number: int) -> tuple[int, int] | None:
        """Trigger a camera; return the host times before and after [ns], None where it is not ready or it is late."""
        commands = self._commands[name]
        with self._changed:
            before_ns = self._clock.now_ns()
            if name in self._lost or before_ns < self._resting_until_ns[name]:
                return None
            if self._late_ns(number, before_ns) > LATEST_TIME * self._grid.period_ns:
                self._unsent[name] += 1
                return None
            if self._missed[name] < MISSES_TO_IGNORE:
                self._awaited.add(name)
            commands.numbers.append(number)
            commands.at_ns.append(None)
            commands.error_ns.append(0)
            commands.sent_ns.append(before_ns)  # last, since readers depend on it
        try:
            at_ns = self._drivers[name].software_trigger()
            commands.error_ns[-1] = max(self._clock.now_ns() - at_ns, 0)
            commands.at_ns[-1] = at_ns  # last, since readers depend on it
        except DeviceError as error:  # the camera's own thread notes it and opens it again
            log.debug("software trigger: %s", error)
            with self._changed:
                self.failed.setdefault(name, str(error))
                after_ns = self._clock.now_ns()
                self._resting_until_ns[name] = after_ns + REST * (after_ns - before_ns)
                if name in self._awaited:
                    self._stop_waiting(name)
        return before_ns, self._clock.now_ns()

    def _late_ns(self, number: int, at_ns: float) -> float:
        return at_ns - self._grid.begin_ns - self._grid.nominal_ns(number)

    def _await_frames(self) -> None:
        with self._changed:
            self._fired_ns = self._clock.now_ns()
            while self._awaited and not self._stop.is_set():
                self._changed.wait(0.05)
