"""Software trigger: this machine tells each camera to expose, pulse by pulse, and waits for the frames.

Waiting makes the pairing certain for cameras without a clock, and keeps from triggering cameras that are not ready,
which they ignore silently. The price is the rate: a pulse that has to wait is late, which is counted.
"""

import threading
import time
from bisect import bisect_right
from collections.abc import Mapping

from hardware.driver import CameraDriver, DeviceError
from hardware.silence import Looks

PATIENCE_S = 5.0
"""The next pulse comes once a missing frame was looked for in vain for so long: a frame that came still later would
be taken for the next pulse's. Only looks count: time in which this machine did not run them says nothing."""
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
        self._times_ns: list[int] = []
        self._awaited: set[str] = set()
        self._gone: set[str] = set()
        self._fired_ns: int | None = None
        self._looks: dict[str, Looks] = {}
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
            self._gone.discard(camera)
            self._missed[camera] = 0
            self._changed.notify()

    def looked_in_vain(self, camera: str, began_ns: int, ended_ns: int) -> None:
        """Wait no longer for a frame that was looked for long enough since the last pulse."""
        with self._changed:
            self._gone.discard(camera)
            if camera not in self._awaited or self._fired_ns is None or began_ns < self._fired_ns:
                return
            looks = self._looks.setdefault(camera, Looks())
            looks.in_vain(began_ns, ended_ns, None)
            if looks.vain_s >= PATIENCE_S:
                self._give_up(camera)

    def camera_lost(self, camera: str) -> None:
        """Wait no longer for a camera that is gone."""
        with self._changed:
            self._gone.add(camera)
            if camera in self._awaited:
                self._give_up(camera)

    def _give_up(self, camera: str) -> None:
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
                present = self._drivers.keys() - self._gone
                self._awaited = {name for name in present if self._missed[name] < GIVEN_UP}
                self._fired_ns = None
                self._times_ns.append(time.monotonic_ns())
                self._looks.clear()
            for name, driver in list(self._drivers.items()):
                try:
                    driver.software_trigger()
                except DeviceError as error:  # the camera's own thread reports and reopens it
                    self.failed.setdefault(name, str(error))
            due += self._period_s
            self._await_frames()

    def _await_frames(self) -> None:
        with self._changed:
            self._fired_ns = time.monotonic_ns()
            while self._awaited and not self._stop.is_set():
                self._changed.wait(0.05)
