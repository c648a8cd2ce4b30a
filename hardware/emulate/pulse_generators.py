"""Sources of trigger pulses: a generator wired to Line1 of many cameras, and the serial generator, emulated.

The serial one implements ``hardware.triggers.pulse_protocol`` on a pseudo-terminal, with a frequency error of its
quartz, and calls back at each pulse, so that emulated cameras can be wired to it.
"""

import math
import os
import select
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from threading import Event, Lock, Thread
from typing import Protocol, Self

from hardware.triggers.pulse_protocol import PROTOCOL
from mosca.errors import InputError

SECOND = 1_000_000_000
FIRST_PULSE_AFTER_NS = 20_000_000
FASTEST_HZ = 10_000.0


class Triggered(Protocol):
    """A device on the trigger line."""

    def pulse(self, number: int, time_ns: int) -> None:
        """Take pulse ``number``, whose edge is at the monotonic time ``time_ns``."""
        ...


class TriggerLine:
    """Numbers pulses from 0 at each ``start`` and makes pulse k at t0 + k / rate: sleep errors do not add up.

    A pulse carries the time at which it is due. A busy machine delivers it late, but the cameras expose at the due
    time, as with a real generator; ``stop`` first makes the pulses that were due before it.
    ``ended``: called with the number of each pulse before it is made; True ends the pulses before it.
    """

    def __init__(self, cameras: Iterable[Triggered], ended: Callable[[int], bool] = lambda number: False) -> None:
        self._cameras: Sequence[Triggered] = tuple(cameras)
        self._ended = ended
        self._lock = Lock()
        self._stop = Event()
        self._thread: Thread | None = None
        self._until_ns = 0
        self.first_ns = 0

    def add(self, other: Triggered) -> None:
        """Wire one more device to the line; before it is started."""
        self._cameras = (*self._cameras, other)

    @property
    def running(self) -> bool:
        """Whether pulses are being made."""
        return self._thread is not None and self._thread.is_alive()

    def pulse(self, number: int, time_ns: int) -> None:
        """Trigger every camera with pulse ``number`` at the monotonic time ``time_ns``; for other generators too."""
        for camera in self._cameras:
            camera.pulse(number, time_ns)

    def start(self, rate_hz: float) -> None:
        """Begin with pulse 0; InputError for an impossible rate."""
        if not 0.0 < rate_hz <= FASTEST_HZ:
            raise InputError(f"trigger line: {rate_hz:g} Hz given; above 0 and at most {FASTEST_HZ:g} is wanted")
        with self._lock:
            self._halt()
            self._stop.clear()
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


OnPulse = Callable[[int, int], None]
SLOWEST_MHZ, FASTEST_MHZ = 100, 2_000_000


class PulseBox:
    """A pulse generator at ``port``; ``on_pulse(number, time_ns)`` is called at each pulse, in monotonic time."""

    def __init__(self, on_pulse: OnPulse | None = None, drift_ppm: float = 0.0) -> None:
        self._on_pulse = on_pulse
        self._speed = 1 + drift_ppm * 1e-6
        import pty  # terminals, which Windows has not
        import tty

        self._master, self._slave = pty.openpty()
        tty.setraw(self._master)
        tty.setraw(self._slave)
        self.port = os.ttyname(self._slave)
        self._rate_hz = 100.0
        self._begin: float | None = None
        self._until = math.inf
        self._made = 0
        self._changed = threading.Condition()
        self._closed = False
        self._threads = [
            threading.Thread(target=self._answer, name="pulse box, serial", daemon=True),
            threading.Thread(target=self._pulse, name="pulse box, pulses", daemon=True),
        ]
        for thread in self._threads:
            thread.start()

    @property
    def made(self) -> int:
        """How many pulses were made since the last start."""
        return self._made

    def answer(self, line: str) -> str:
        """Carry out a line, and return the box's answer to it."""
        words = line.split()
        match words:
            case ["V"]:
                return PROTOCOL
            case ["F", rate] if rate.isdigit() and self._begin is None:
                self._rate_hz = min(max(int(rate), SLOWEST_MHZ), FASTEST_MHZ) / 1000
                return f"F {round(self._rate_hz * 1000)}"
            case ["W", width] if width.isdigit():
                return f"W {width}"
            case ["S", "1"]:
                with self._changed:
                    self._made, self._begin, self._until = 0, time.monotonic(), math.inf
                    self._changed.notify_all()
                return "S 1"
            case ["S", "0"]:
                with self._changed:
                    if self._begin is not None:
                        # pulses due until now are still made, however late this machine makes them
                        self._until = time.monotonic()
                        self._changed.notify_all()
                        self._changed.wait_for(lambda: self._begin is None)
                return f"S 0 {self._made}"
            case ["P", number] if self._begin is not None:
                since = (time.monotonic() - self._begin) * self._speed * self._rate_hz
                return f"P {number} {int(since)} {int((since % 1) / self._rate_hz * 1e6)}"
        return "E not understood, or not now"

    def close(self) -> None:
        """Stop the pulses and remove the port; may be called twice."""
        if self._closed:
            return
        with self._changed:
            self._closed, self._begin = True, None
            self._changed.notify_all()
        for thread in self._threads:
            thread.join()
        os.close(self._master)
        os.close(self._slave)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def _answer(self) -> None:
        waiting = b""
        while not self._closed:
            if not select.select([self._master], [], [], 0.1)[0]:
                continue
            waiting += os.read(self._master, 256)
            *lines, waiting = waiting.split(b"\n")
            for line in lines:
                os.write(self._master, self.answer(line.decode("ascii", errors="replace")).encode() + b"\n")

    def _pulse(self) -> None:
        while True:
            with self._changed:
                begin = self._begin
                if self._closed:
                    return
                if begin is None:
                    self._changed.wait(0.1)
                    continue
                due = begin + self._made / self._rate_hz / self._speed
                wait = due - time.monotonic()
                if due > self._until:
                    self._begin = None
                    self._changed.notify_all()
                    continue
                if wait > 0:
                    self._changed.wait(wait)
                    continue
                number = self._made
                self._made += 1
            if self._on_pulse is not None:
                self._on_pulse(number, round(due * 1e9))
