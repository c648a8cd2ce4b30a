"""The trigger line: a pulse generator wired to the Line1 input of many cameras."""

import time
from collections.abc import Callable, Iterable, Sequence
from threading import Event, Lock, Thread
from typing import Protocol

from mosca.errors import InputError

SECOND = 1_000_000_000
FIRST_PULSE_AFTER_NS = 20_000_000
FASTEST_HZ = 10_000.0


class Triggered(Protocol):
    """What hangs on the line."""

    def pulse(self, number: int, time_ns: int) -> None:
        """Take pulse ``number``, whose edge is at the monotonic time ``time_ns``."""
        ...


class TriggerLine:
    """Numbers pulses from 0 at each ``start`` and makes pulse k at t0 + k / rate: no sleep's error adds up.

    A pulse carries the time at which it is due. A machine that is late hands it on late, and the cameras still
    expose at its time, as those behind a real generator would; ``stop`` makes those first that were due before it.
    ``ended``: asked before each pulse whether it is one too many.
    """

    def __init__(
        self, cameras: Iterable[Triggered], ended: Callable[[int], bool] = lambda number: False
    ) -> None:
        self._cameras: Sequence[Triggered] = tuple(cameras)
        self._ended = ended
        self._lock = Lock()
        self._stop = Event()
        self._thread: Thread | None = None
        self._emitted = 0
        self._until_ns = 0
        self.first_ns = 0

    @property
    def emitted(self) -> int:
        """Pulses that were made since the last ``start``, by whichever way."""
        return self._emitted

    @property
    def running(self) -> bool:
        """Whether pulses are being made."""
        return self._thread is not None and self._thread.is_alive()

    def pulse(self, number: int, time_ns: int) -> None:
        """Hand pulse ``number`` at the monotonic time ``time_ns`` to every camera; for other generators too."""
        for camera in self._cameras:
            camera.pulse(number, time_ns)
        self._emitted = number + 1

    def start(self, rate_hz: float) -> None:
        """Begin with pulse 0; InputError for a rate that cannot be."""
        if not 0.0 < rate_hz <= FASTEST_HZ:
            raise InputError(
                f"trigger line: {rate_hz:g} Hz given; above 0 and at most {FASTEST_HZ:g} is wanted"
            )
        with self._lock:
            self._halt()
            self._stop.clear()
            self._emitted = 0
            self.first_ns = time.monotonic_ns() + FIRST_PULSE_AFTER_NS
            self._thread = Thread(target=self._run, args=(rate_hz,), name="trigger line", daemon=True)
            self._thread.start()

    def stop(self) -> None:
        """Make no more pulses; returns when the last one is made."""
        with self._lock:
            self._halt()

    def _halt(self) -> None:
        self._until_ns = time.monotonic_ns()
        self._stop.set()
        if self._thread is not None:
            self._thread.join()

    def _run(self, rate_hz: float) -> None:
        number = 0
        while not self._ended(number):
            due_ns = self.first_ns + round(number * SECOND / rate_hz)
            if self._stop.wait(max(due_ns - time.monotonic_ns(), 0) / SECOND) and due_ns > self._until_ns:
                return
            self.pulse(number, due_ns)
            number += 1
