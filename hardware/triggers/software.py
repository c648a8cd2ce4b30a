"""Software trigger: commands each camera to expose, pulse by pulse, and waits for the frames.

Waiting makes the pairing certain for cameras without a clock, and keeps from triggering cameras that are not ready,
which they ignore silently. The price is the rate: a pulse that has to wait is late, which is counted.
"""

import logging
import threading
import time
from bisect import bisect_right
from collections.abc import Mapping

from hardware.driver import CameraDriver, DeviceError
from hardware.silence import PollingTime

FRAME_TIMEOUT_S = 5.0
"""Polling time for a missing frame before the next pulse: a frame that came still later would be numbered as the next
pulse's. Time in which this process did not poll does not count (``hardware.silence``)."""
MISSES_TO_IGNORE = 3
"""A camera that missed so many pulses in a row is not waited for until it delivers again."""
log = logging.getLogger("mosca.hardware.triggers")


class SoftwareTrigger:
    """Triggers all ``drivers`` that can be, ``rate_hz`` times a second at most."""

    def __init__(self, drivers: Mapping[str, CameraDriver], rate_hz: float) -> None:
        for name, driver in drivers.items():
            if not driver.capabilities.software_trigger:
                raise DeviceError(
                    f"camera '{name}': has no software trigger; use another [hardware.trigger] source, "
                    "serial or external for instance"
                )
        self._drivers = drivers
        self._period_s = 1 / rate_hz
        self._times_ns: list[int] = []
        self._awaited: set[str] = set()
        self._lost: set[str] = set()
        self._fired_ns: int | None = None
        self._polling: dict[str, PollingTime] = {}
        self._missed = dict.fromkeys(drivers, 0)
        self._changed = threading.Condition()
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self.late_pulses = 0
        self.failed: dict[str, str] = {}

    def start(self) -> int | None:
        """Begin with pulse 0 now."""
        self._stop.clear()
        self._times_ns.clear()
        self._thread = threading.Thread(target=self._run, name="software trigger", daemon=True)
        self._thread.start()
        return None

    def stop(self) -> None:
        """Make no more pulses."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def pulse_at(self, host_ns: int) -> int | None:
        """Return the last pulse that was made before ``host_ns``."""
        index = bisect_right(self._times_ns, host_ns) - 1
        return index if index >= 0 else None

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

    @property
    def waiting_since_ns(self) -> int | None:
        """Host time of the last pulse while its frames are awaited [ns], None before it was made."""
        with self._changed:
            return self._fired_ns

    def _stop_waiting(self, camera: str) -> None:
        self._awaited.discard(camera)
        self._missed[camera] += 1
        self._changed.notify()

    def report(self) -> dict[str, object]:
        """Return pulses made, and how many were late because frames were waited for."""
        return {"pulses": len(self._times_ns), "late_pulses": self.late_pulses, **self.failed}

    def close(self) -> None:
        """Stop."""
        self.stop()

    def _run(self) -> None:
        due = time.monotonic()
        while not self._stop.is_set():
            wait = due - time.monotonic()
            if wait > 0 and self._stop.wait(wait):
                return
            if wait < -0.5 * self._period_s:
                self.late_pulses += 1
                due = time.monotonic()
            with self._changed:
                present = self._drivers.keys() - self._lost
                self._awaited = {name for name in present if self._missed[name] < MISSES_TO_IGNORE}
                self._fired_ns = None
                self._times_ns.append(time.monotonic_ns())
                self._polling.clear()
            for name, driver in list(self._drivers.items()):
                try:
                    driver.software_trigger()
                except DeviceError as error:  # the camera's own thread notes it and opens it again
                    log.debug("software trigger: %s", error)
                    self.failed.setdefault(name, str(error))
            due += self._period_s
            self._await_frames()

    def _await_frames(self) -> None:
        with self._changed:
            self._fired_ns = time.monotonic_ns()
            while self._awaited and not self._stop.is_set():
                self._changed.wait(0.05)
