"""Cameras without devices: a line of pulses in a thread, and drivers that answer it, with faults on demand."""

import queue
import threading
import time
from dataclasses import dataclass, field

import numpy as np

from hardware.driver import Capabilities, ClockReading, DeviceError, DeviceReport, Grabbed
from hardware.trigger import External

SIZE = (32, 24)
EXPOSURE_NS = 500_000


def picture(camera: str, pulse: int) -> np.ndarray:
    """A picture that no other camera or pulse has."""
    width, height = SIZE
    image = np.zeros((height, width), np.uint8)
    image[0, :4] = np.frombuffer(np.uint32(pulse).tobytes(), np.uint8)
    image[1, 0] = sum(camera.encode()) % 256
    return image


@dataclass
class Fake:
    """One camera's behaviour; times in pulses."""

    offset_s: float = 0.0
    ppm: float = 0.0
    misses: frozenset[int] = frozenset()
    spoilt: frozenset[int] = frozenset()
    gone: range = field(default_factory=lambda: range(0))
    clock: bool = True
    software: bool = False
    readable: bool = False  # most answers do not come


class FakeLine(External):
    """Pulses at a rate in a thread; drivers hang on it. It waits until a camera's loss and return were noticed."""

    def __init__(self, rate_hz: float) -> None:
        self.rate_hz, self.drivers, self.made, self.withheld = rate_hz, {}, 0, 0
        self._stop = threading.Event()
        self._thread = None

    def start(self):
        self._stop.clear()
        begin = time.monotonic()
        self._thread = threading.Thread(target=self._run, args=(begin,), daemon=True)
        self._thread.start()
        return round(begin * 1e9)

    def stop(self):
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def report(self):
        return {"pulses": self.made}

    close = stop

    def _run(self, begin):
        while not self._stop.is_set():
            wait = begin + self.made / self.rate_hz - time.monotonic()
            if wait > 0 and self._stop.wait(wait):
                return
            while any(driver.unnoticed(self.made) for driver in self.drivers.copy().values()):
                if self._stop.wait(0.002):
                    return
            for driver in list(self.drivers.values()):
                driver.pulse(self.made, begin + self.made / self.rate_hz)
            self.made += 1


class FakeDriver:
    """A camera on the line (or on software), named after its settings' serial."""

    def __init__(self, name, settings, fake, line):
        if line.made in fake.gone:
            raise DeviceError(f"camera '{name}': not there")
        self.name, self.fake, self.line = name, fake, line
        self.frames: queue.Queue = queue.Queue()
        self.armed, self.closed, self.block, self.count, self.asked = False, False, 0, 0, 0
        self.lost = False
        self.boot = time.monotonic() - fake.offset_s
        line.drivers[name] = self

    @property
    def capabilities(self):
        return Capabilities(
            device_clock=self.fake.clock, hardware_trigger=True, software_trigger=self.fake.software
        )

    def configure(self, settings):
        return DeviceReport("fake", settings.serial, *SIZE, 8, EXPOSURE_NS)

    def arm(self):
        self.armed, self.block = True, 0

    def disarm(self):
        self.armed = False

    def statistics(self):
        return {"exposed": self.count}

    def close(self):
        self.closed = True

    def software_trigger(self):
        self.pulse(self.count, time.monotonic())
        return time.monotonic_ns()

    def clock(self):
        if not self.fake.readable:
            return None
        self.asked += 1
        if self.asked > 1 and self.asked % 3:
            raise DeviceError(f"camera '{self.name}': does not tell its clock (timeout)")
        before = time.monotonic_ns()
        shown = round((time.monotonic() - self.boot) * (1 + self.fake.ppm * 1e-6) * 1e9)
        return ClockReading(shown, before, time.monotonic_ns())

    def unnoticed(self, number):
        """Tell whether pulses have to wait: it is gone, or back, and nobody has found that out yet."""
        gone = self.fake.gone
        if not gone:
            return False
        here = self.armed and not self.lost
        return (number == gone[-1] and not self.lost) or (number == gone[-1] + 20 and not here)

    def pulse(self, number, now):
        if not self.armed or number in self.fake.misses or number in self.fake.gone:
            return
        stamp = round((now - self.boot) * (1 + self.fake.ppm * 1e-6) * 1e9) if self.fake.clock else None
        image = None if number in self.fake.spoilt else picture(self.name, number)
        self.frames.put((self.block, stamp, image, round(now * 1e9) + EXPOSURE_NS))
        self.block += 1
        self.count += 1

    def grab(self, timeout_s):
        if self.line.made in self.fake.gone:
            self.lost = True
            raise DeviceError(f"camera '{self.name}': does not answer any more; check its cable")
        try:
            block, stamp, image, host_ns = self.frames.get(timeout=timeout_s)
        except queue.Empty:
            return None
        note = "" if image is not None else "MISSING_PACKETS"
        # here when it was due, after its exposure: a busy machine is late for some cameras only, which is not tried
        return Grabbed(block, stamp, host_ns, EXPOSURE_NS, image, note)
