"""Polls the device clocks, each in a thread of its own: no frame waits for an answer.

A clock is read a few times before its camera's first frame. It is read again every few seconds, so that drift adds
little, and whenever a frame's pulse depends on it.
"""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping

from hardware.driver import CameraDriver, ClockReading, DeviceError
from hardware.pulse_numbers.numbering import PulseNumbers

FIRST_READINGS, QUICK_NS, POLL_INTERVAL_S = 5, 500_000, 2.0
"""Most first readings, which end with one whose error is below ``QUICK_NS``; interval of later ones. In the interval
a clock may drift by 0.2 ms; half of it gains 0.1 ms for twice the queries, double of it costs 0.2 ms, of 1 ms."""
ASK_AGAIN_NS = 100_000_000
log = logging.getLogger("mosca.hardware.clocks")


class ClockPoller:
    """Polls the clocks of ``drivers`` (by name, as they are now); ``on_reading`` is called with the camera's name."""

    def __init__(self, drivers: Mapping[str, CameraDriver], on_reading: Callable[[str], None]) -> None:
        self.readings: deque[tuple[str, ClockReading]] = deque()
        """Readings that were not taken yet, oldest first."""
        self._drivers, self._on_reading = drivers, on_reading
        self._wanted: dict[str, threading.Event] = {}
        self._asked_ns: dict[str, int] = {}
        self._stop = threading.Event()
        self._threads: list[threading.Thread] = []

    def start(self) -> None:
        """Read each clock for the first time, and continue with those that can be read."""
        for name in self._drivers:
            if not self.begin(name):
                continue
            self._wanted[name] = threading.Event()
            thread = threading.Thread(target=self._poll, args=(name,), name=f"clock {name}", daemon=True)
            thread.start()
            self._threads.append(thread)

    def begin(self, name: str) -> bool:
        """Read the clock of a camera that has just been opened; return whether it can be read."""
        return self._read(name, FIRST_READINGS)

    def ask(self, numbers: PulseNumbers) -> None:
        """Request readings of the clocks that frames wait for."""
        for name, wanted in self._wanted.items():
            since_ns = numbers.wants_reading(name)
            asked_ns, now_ns = self._asked_ns.get(name, 0), time.monotonic_ns()
            if since_ns is not None and (asked_ns <= since_ns or now_ns - asked_ns > ASK_AGAIN_NS):
                self._asked_ns[name] = now_ns
                wanted.set()

    def close(self) -> None:
        """Read no more; may be called twice."""
        self._stop.set()
        for wanted in self._wanted.values():
            wanted.set()
        for thread in self._threads:
            thread.join()
        self._threads.clear()

    def _poll(self, name: str) -> None:
        wanted = self._wanted[name]
        while not self._stop.is_set():
            wanted.wait(POLL_INTERVAL_S)
            wanted.clear()
            if not self._stop.is_set():
                self._read(name, 1)

    def _read(self, name: str, times: int) -> bool:
        for _ in range(times):
            try:
                reading = self._drivers[name].clock()
            except DeviceError as error:  # no answer in time, or lost: its reading thread finds out which
                log.debug("camera '%s': clock not read (%s)", name, error)
                return True
            if reading is None:
                return False
            self.readings.append((name, reading))
            self._on_reading(name)
            if reading.error_ns < QUICK_NS:
                break
        return True
