"""Cameras without devices: pulses from a thread, and drivers that answer them, with faults on demand."""

import queue
import textwrap
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from hardware.driver import Capabilities, ClockReading, DeviceError, DeviceReport, Grabbed
from hardware.trigger import External

SIZE = (32, 24)
EXPOSURE_NS = 500_000


def write_rig(path, names, size=SIZE, rate=100.0, more="", camera=""):
    """Write a rig file of ``names``; ``camera``: further keys of [[camera]], ``more``: of [camera.hardware]."""
    text = f"[hardware]\nrate_hz = {rate}\n"
    for name in names:
        text += textwrap.dedent(f"""
            [[camera]]
            name = "{name}"
            size = [{size[0]}, {size[1]}]
            {camera}
            [camera.hardware]
            driver = "gige"
            serial = "{name}"
            {more}
            """)
    path.write_text(text)
    return path


def picture(camera: str, pulse: int) -> np.ndarray:
    """A picture that no other camera or pulse has."""
    width, height = SIZE
    image = np.zeros((height, width), np.uint8)
    image[0, :4] = np.frombuffer(np.uint32(pulse).tobytes(), np.uint8)
    image[1, 0] = sum(camera.encode()) % 256
    return image


def pulse_in(frame) -> int:
    """The pulse of a frame of ``picture``."""
    return int(np.frombuffer(frame.image[0, :4].tobytes(), np.uint32)[0])


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
    picture: Callable[[str, int], np.ndarray] = picture


class PulseThread(External):
    """Pulses at a rate in a thread, each ``delay_s`` after it is due; ``fire`` triggers the drivers."""

    delay_s = 0.0

    def __init__(self, rate_hz: float) -> None:
        self.rate_hz, self.drivers, self.made, self.begin_ns = rate_hz, {}, 0, 0
        self.ended = threading.Event()
        self._thread = None

    def start(self):
        self.ended.clear()
        self.begin_ns = time.monotonic_ns()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()
        return self.begin_ns

    def stop(self):
        self.ended.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def report(self):
        return {"pulses": self.made}

    close = stop

    def due_ns(self, number):
        return self.begin_ns + round(number * 1e9 / self.rate_hz)

    def fire(self, number):
        """Trigger the drivers with a pulse; False ends the thread."""
        for driver in list(self.drivers.values()):
            driver.pulse(number)
        return True

    def _run(self):
        while not self.ended.is_set():
            wait = self.due_ns(self.made) * 1e-9 + self.delay_s - time.monotonic()
            if wait > 0 and self.ended.wait(wait):
                return
            if not self.fire(self.made):
                return
            self.made += 1


class FakeDevice:
    """Base of all fake drivers: an index on the trigger line, a queue of frames, no settings."""

    def __init__(self, name, line, size):
        self.name, self.line, self.size = name, line, size
        self.frames: queue.Queue = queue.Queue()
        self.armed, self.closed, self.block, self.count = False, False, 0, 0
        line.drivers[name] = self

    def configure(self, settings):
        return DeviceReport("fake", settings.serial, *self.size, 8, EXPOSURE_NS, {"Gain": 0.0})

    def arm(self):
        self.armed, self.block = True, 0

    def disarm(self):
        self.armed = False

    def statistics(self):
        return {"exposed": self.count}

    def close(self):
        self.closed = True


class FakeLine(PulseThread):
    """Pulses that wait until a camera's loss and return were noticed."""

    def fire(self, number):
        while any(driver.unnoticed(number) for driver in self.drivers.copy().values()):
            if self.ended.wait(0.002):
                return False
        return super().fire(number)


class FakeDriver(FakeDevice):
    """A camera on the line (or on software), named after its settings' serial."""

    def __init__(self, name, settings, fake, line, size=SIZE):
        if line.made in fake.gone:
            raise DeviceError(f"camera '{name}': not there")
        super().__init__(name, line, size)
        self.fake, self.asked, self.lost = fake, 0, False
        self.boot_ns = time.monotonic_ns() - round(fake.offset_s * 1e9)

    @property
    def capabilities(self):
        return Capabilities(device_clock=self.fake.clock, hardware_trigger=True, software_trigger=self.fake.software)

    def software_trigger(self):
        now = time.monotonic_ns()
        self._expose(self.count, now)
        return now

    def clock(self):
        if not self.fake.readable:
            return None
        self.asked += 1
        if self.asked > 1 and self.asked % 3:
            raise DeviceError(f"camera '{self.name}': does not tell its clock (timeout)")
        before = time.monotonic_ns()
        return ClockReading(self._stamp(before), before, time.monotonic_ns())

    def unnoticed(self, number):
        """Return whether pulses must wait: it is gone, or back, and the reader has not noticed yet."""
        gone = self.fake.gone
        if not gone:
            return False
        here = self.armed and not self.lost
        return (number == gone[-1] and not self.lost) or (number == gone[-1] + 20 and not here)

    def pulse(self, number):
        self._expose(number, self.line.due_ns(number))

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

    def _stamp(self, host_ns):
        return round((host_ns - self.boot_ns) * (1 + self.fake.ppm * 1e-6))

    def _expose(self, number, at_ns):
        if not self.armed or number in self.fake.misses or number in self.fake.gone:
            return
        stamp = self._stamp(at_ns) if self.fake.clock else None
        image = None if number in self.fake.spoilt else self.fake.picture(self.name, number)
        self.frames.put((self.block, stamp, image, at_ns + EXPOSURE_NS))
        self.block += 1
        self.count += 1
