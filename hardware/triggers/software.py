"""Software trigger: this machine tells each camera to expose, pulse by pulse, and waits for the frames.

Waiting makes the pairing certain for cameras without a clock, and keeps from triggering cameras that are not ready,
which they ignore silently. The price is the rate: a pulse that has to wait is late, which is counted.
"""

import threading
import time
from bisect import bisect_right
from collections.abc import Mapping

from hardware.driver import CameraDriver, DeviceError

PATIENCE_PERIODS = 5
"""A pulse waits for missing frames at most so many periods, and a quarter of a second at least."""
GIVEN_UP = 3
"""A camera that missed so many pulses running is not waited for until it delivers again."""


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
        self._patience_s = max(PATIENCE_PERIODS * self._period_s, 0.25)
        self._times_ns: list[int] = []
        self._awaited: set[str] = set()
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
        """Tick off the camera's frame of the last pulse; the next one waits until all are here."""
        with self._changed:
            self._awaited.discard(camera)
            self._missed[camera] = 0
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
                self._awaited = {name for name in self._drivers if self._missed[name] < GIVEN_UP}
                self._times_ns.append(time.monotonic_ns())
            for name, driver in list(self._drivers.items()):
                try:
                    driver.software_trigger()
                except DeviceError as error:  # the camera's own thread reports and reopens it
                    self.failed.setdefault(name, str(error))
            due += self._period_s
            self._await_frames()

    def _await_frames(self) -> None:
        deadline = time.monotonic() + self._patience_s
        with self._changed:
            while self._awaited and not self._stop.is_set():
                left = deadline - time.monotonic()
                if left <= 0:
                    for name in self._awaited:
                        self._missed[name] += 1
                    return
                self._changed.wait(min(left, 0.05))
