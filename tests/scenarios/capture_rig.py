"""Fake cameras for captures: a line of pulses in a thread and frames of any size, in a test or a process of its own.

As a program (``python capture_rig.py RIG OUT NEWEST [detections] [small]``) it captures until it is killed; the file
NEWEST then holds the host's time at which the last frame was grabbed (int64).
"""

import os
import queue
import signal
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "hardware"))
from fake_rig import EXPOSURE_NS, FakeDevice, PulseThread
from fake_rig import write_rig as write_rig_of

from hardware.driver import Capabilities, ClockReading, DeviceError, Grabbed

RATE = 100.0
SIZE = (656, 491)
QUARTER = (164, 123)


def dark_noise(seed=0, size=SIZE, n=8):
    """Frames as a rig in the dark gives them: a background of a few grey values, noise, some bright discs."""
    rng = np.random.default_rng(seed)
    width, height = size
    y, x = np.mgrid[:height, :width]
    frames = []
    for _ in range(n):
        image = rng.normal(6.0, 1.2, (height, width))
        for _ in range(15):
            cx, cy = rng.uniform(10, width - 10), rng.uniform(10, height - 10)
            image += 180 * np.clip(4.5 - np.hypot(x - cx, y - cy), 0, 1)
        frames.append(np.clip(image, 0, 255).astype(np.uint8))
    return frames


def write_rig(path, names, size=SIZE, rate=RATE, more=""):
    return write_rig_of(path, names, size, rate, camera=more)


def ctrl_c(when):
    """Return a progress callback that sends SIGINT (Ctrl-C) once, as soon as ``when()`` is true.

    Progress is reported while pulses run. A timer could fire while cameras are opened: that would end the tests.
    """
    sent = False

    def progress(_done, _wanted):
        nonlocal sent
        if not sent and when():
            sent = True
            os.kill(os.getpid(), signal.SIGINT)

    return progress


class Line(PulseThread):
    """Pulses at a rate; ``misses``: camera -> pulses that it does not see; ``spoilt``: those that come damaged.

    After pulse ``gone_at`` no camera answers; ``asked_in_vain``: those that were queried then.
    """

    # a frame is here once it was exposed: one that is earlier is none of its stamp's
    delay_s = EXPOSURE_NS * 1e-9

    def __init__(self, rate=RATE, misses=None, spoilt=None, gone_at=None):
        super().__init__(rate)
        self.misses, self.spoilt, self.gone_at = misses or {}, spoilt or {}, gone_at
        self.asked_in_vain, self.armed_when_started, self.newest = set(), None, np.zeros(1, np.int64)

    def start(self):
        self.armed_when_started = {name: driver.armed for name, driver in self.drivers.items()}
        return super().start()


class Camera(FakeDevice):
    """A camera on the line; ``images`` come round and round, or a function of the pulse."""

    def __init__(self, name, line, images, size=SIZE):
        super().__init__(name, line, size)
        self.images, self.given = images, 0

    capabilities = Capabilities(device_clock=True, hardware_trigger=True)

    def software_trigger(self):
        raise DeviceError("none")

    def clock(self):
        now = time.monotonic_ns()
        return ClockReading(now + 5_000_000_000, now, now)

    def pulse(self, number):
        if not self.armed or number in self.line.misses.get(self.name, ()):
            return
        image = self.images(number) if callable(self.images) else self.images[number % len(self.images)]
        if number in self.line.spoilt.get(self.name, ()):
            image = None
        self.frames.put((self.block, self.line.due_ns(number) + 5_000_000_000, image))
        self.block += 1
        self.count += 1

    def grab(self, timeout_s):
        if self.line.gone_at is not None and self.given > self.line.gone_at:
            self.line.asked_in_vain.add(self.name)
            raise DeviceError(f"camera '{self.name}': does not answer any more; check its cable")
        try:
            block, stamp, image = self.frames.get(timeout=timeout_s)
        except queue.Empty:
            return None
        self.given += 1
        image = None if image is None else image.copy()
        now = time.monotonic_ns()
        self.line.newest[0] = max(int(self.line.newest[0]), now)
        return Grabbed(block, stamp, now, EXPOSURE_NS, image, "" if image is not None else "spoilt")


def openers(line, images=None, size=SIZE):
    """Return substitutes for drivers and trigger; ``images``: camera -> images."""
    shared = dark_noise(size=size) if images is None else None

    def open_camera(name, settings):
        if line.asked_in_vain:
            raise DeviceError(f"camera '{name}': does not answer; check its cable")
        return Camera(name, line, shared if images is None else images[name], size)

    return open_camera, lambda rig, drivers: line


if __name__ == "__main__":
    from scenarios.lab.capture import CaptureRequest, capture

    rig, out = Path(sys.argv[1]), Path(sys.argv[2])
    names = ("a", "b", "c", "d")
    line = Line()
    line.newest = np.memmap(sys.argv[3], np.int64, "w+", shape=(1,))
    size = QUARTER if "small" in sys.argv else SIZE
    request = CaptureRequest(write_rig(rig, names, size), out, detections="detections" in sys.argv)
    capture(request, None, *openers(line, size=size))
