"""Timing of an emulated camera: its device clock, its shutter, and which trigger makes an exposure.

The clock takes host times (monotonic) [ns]; it never waits.
"""

import heapq
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping, MutableMapping
from dataclasses import dataclass
from typing import Literal

from hardware.emulate.features import ACQUISITION_MODES, ACTIVATIONS, COUNTER_SOURCES, TRIGGER_SOURCES
from hardware.emulate.gige_vision import CHUNK_TAIL_BYTES, COUNTER_CHUNK, MAXIMUM_BLOCK_ID
from hardware.emulate.registers import Value
from hardware.emulate.stream import ImageLayout, chunk

PtpStatus = Literal["Disabled", "Listening", "Uncalibrated", "Slave"]
LISTENING_NS = 200_000_000
LOCKING_NS = 500_000_000
"""Times after PTP is switched on: until a device listens to its master, and until it is locked to it."""

_COMMON_MINUS_MONOTONIC = time.time_ns() - time.monotonic_ns()


def common_ns(mono_ns: int) -> int:
    """Return the time of the PTP master (this machine's time of day, without its later steps) at ``mono_ns``."""
    return mono_ns + _COMMON_MINUS_MONOTONIC


@dataclass(frozen=True)
class ClockJump:
    """A jump of the clock: it is ``by_ns`` further ahead from the monotonic time ``mono_ns`` on."""

    mono_ns: int
    by_ns: int


@dataclass(frozen=True)
class EmulatedClock:
    """A device clock with offset, drift and jumps.

    Once locked to a PTP master it shows the master's time exactly: there are no synchronisation messages, only their
    effect.
    """

    booted_ns: int
    """Host time of the boot [ns]."""
    offset_ns: int = 0
    """Time shown at the boot [ns]."""
    drift_ppm: float = 0.0
    jumps: tuple[ClockJump, ...] = ()
    ptp_ns: int | None = None
    """Host time when PTP was switched on [ns], None while it is off."""

    def at(self, mono_ns: int) -> int:
        """Return what the clock shows at ``mono_ns`` [ns], never below 0."""
        if self.ptp_status(mono_ns) == "Slave":
            return common_ns(mono_ns)
        return max(self._free(mono_ns), 0)

    def when(self, device_ns: int) -> int:
        """Return the monotonic time at which the clock shows ``device_ns``, in its present state."""
        now = time.monotonic_ns()
        if self.ptp_status(now) == "Slave":
            return device_ns - _COMMON_MINUS_MONOTONIC
        ahead = device_ns - self._free(now)
        return now + round(ahead / (1.0 + self.drift_ppm * 1e-6))

    def ptp_status(self, mono_ns: int) -> PtpStatus:
        """Return the state of PTP at ``mono_ns``."""
        if self.ptp_ns is None:
            return "Disabled"
        since = mono_ns - self.ptp_ns
        if since < LISTENING_NS:
            return "Listening"
        return "Uncalibrated" if since < LOCKING_NS else "Slave"

    def offset_from_master(self, mono_ns: int) -> int:
        """Return what the clock shows less the master's time [ns]."""
        return self.at(mono_ns) - common_ns(mono_ns)

    def _free(self, mono_ns: int) -> int:
        elapsed = mono_ns - self.booted_ns
        jumped = sum(jump.by_ns for jump in self.jumps if jump.mono_ns <= mono_ns)
        return self.offset_ns + jumped + elapsed + round(elapsed * self.drift_ppm * 1e-6)


@dataclass(frozen=True)
class SensorExposure:
    """One exposure; times are host times (monotonic)."""

    number: int
    """Number of the trigger, which is the number of the source's frame."""
    start_ns: int
    """Start of exposure [ns]."""
    out_ns: int
    """Time when it has ended and is read out [ns]."""


class Shutter:
    """A shutter that opens on triggers that come when it is ready."""

    def __init__(self) -> None:
        self._ready_ns = 0

    def open(self, number: int, time_ns: int, exposure_ns: int, readout_ns: int) -> SensorExposure | None:
        """Return the exposure that trigger ``number`` at ``time_ns`` begins, None where the camera is busy.

        The sensor reads one image out while it exposes the next, but does not begin two exposures at once nor read
        out faster than ``readout_ns`` an image.
        """
        if time_ns < self._ready_ns:
            return None
        self._ready_ns = time_ns + max(exposure_ns, readout_ns)
        return SensorExposure(number, time_ns, time_ns + exposure_ns + readout_ns)

    def reset(self) -> None:
        """Be ready at once: acquisition starts anew."""
        self._ready_ns = 0


SECOND = 1_000_000_000
PULSE_WIDTH_NS = 100_000
"""Length of a line pulse: the time from its rising to its falling edge."""
EXPOSURES_WAITING = 128
"""Most images that a camera keeps while its machine is stalled; further triggers are lost and counted."""
ACTIONS_WAITING = 16
LONGEST_ARREARS_NS = SECOND
"""Longest time whose missed images a free-running camera makes up for after it was stalled."""
Source = Literal["Software", "Line1", "Action1"]


@dataclass(frozen=True)
class PendingImage:
    """An exposure with the settings at its begin: everything that its image depends on."""

    exposure: SensorExposure
    block: int
    device_ns: int
    layout: ImageLayout
    session: int
    """Number of stops of acquisition before it; an image of an earlier session is not sent any more."""
    chunks: bytes | None = None
    """Chunk data behind the image, or None."""


class Acquisition:
    """Exposures according to the settings ``values`` (by feature name); not to be used by two threads at a time.

    ``stamp``: the device's clock at a monotonic time. ``full_readout_ns``: readout time of ``sensor_height`` rows.
    ``first_block``: number of the first block of each acquisition. ``counts``: triggers by outcome.
    """

    def __init__(
        self,
        values: MutableMapping[str, Value],
        stamp: Callable[[int], int],
        full_readout_ns: float,
        sensor_height: int,
        first_block: int,
        counts: Counter[str],
    ) -> None:
        self._values, self._stamp, self._counts = values, stamp, counts
        self._row_ns = full_readout_ns / sensor_height
        self._first_block = self._block = first_block
        self._shutter = Shutter()
        self._waiting: deque[PendingImage] = deque()
        self._scheduled: list[int] = []
        self._left: int | None = None
        self._own_number = 0
        self._free_ns = 0
        self.active = False
        self.session = 0

    def start(self, now_ns: int) -> None:
        """Begin to take triggers, or to run free; block numbers and own trigger numbers start anew."""
        self.active, self._left = True, self._frames_asked()
        self._block, self._own_number, self._free_ns = self._first_block, 0, now_ns
        self._shutter.reset()

    def stop(self) -> None:
        """Take no more triggers, and drop waiting images."""
        self.active = False
        self.session += 1
        self._waiting.clear()
        self._scheduled.clear()

    def pulse(self, number: int, time_ns: int) -> None:
        """Take pulse ``number`` of the line, which rises at ``time_ns``: its number is that of the source's frame."""
        if self._values["CounterEventSource"] == COUNTER_SOURCES["Line1"]:
            self._values["CounterValue"] = (int(self._values["CounterValue"]) + 1) % 2**32
        falling = self._values["TriggerActivation"] == ACTIVATIONS["FallingEdge"]
        self._take("Line1", number, time_ns + (PULSE_WIDTH_NS if falling else 0))

    def trigger(self, source: Source, time_ns: int) -> None:
        """Take a trigger that has no number: the camera counts those that it takes, also while it is busy."""
        self._counts["triggers"] += 1
        if self._take(source, self._own_number, time_ns):
            self._own_number += 1

    def schedule(self, due_ns: int) -> bool:
        """Take an action at ``due_ns``; False where too many wait already."""
        if len(self._scheduled) >= ACTIONS_WAITING:
            return False
        heapq.heappush(self._scheduled, due_ns)
        return True

    def next_image(self, now_ns: int) -> PendingImage | float | None:
        """Return the next image to send, else the seconds until one may be due, else None."""
        while self._scheduled and self._scheduled[0] <= now_ns:
            self.trigger("Action1", heapq.heappop(self._scheduled))
        free = self.active and self._values["TriggerMode"] == 0
        if free and not self._waiting and self._free_ns <= now_ns:
            self._expose(self._own_number, self._free_ns)
            self._own_number += 1
            self._free_ns = max(self._free_ns + self._period_ns(), now_ns - LONGEST_ARREARS_NS)
        if self._waiting:
            return self._waiting.popleft()
        due = self._scheduled[:1] + ([self._free_ns] if free else [])
        return max(min(due) - now_ns, 0) / SECOND if due else None

    def shortest_period_ns(self) -> int:
        """Return the shortest time between two images at the set exposure and height."""
        return max(self._readout_ns(), self._exposure_ns())

    def _take(self, source: Source, number: int, time_ns: int) -> bool:
        """Begin exposure ``number`` if acquisition waits for ``source``; return whether it does."""
        values = self._values
        waits = values["TriggerMode"] == 1 and values["TriggerSource"] == TRIGGER_SOURCES[source]
        if not (self.active and waits):
            self._counts["unarmed"] += 1
            return False
        self._expose(number, time_ns)
        return True

    def _expose(self, number: int, time_ns: int) -> None:
        exposure = self._shutter.open(number, time_ns, self._exposure_ns(), self._readout_ns())
        if exposure is None:
            self._counts["ignored"] += 1
            return
        if len(self._waiting) >= EXPOSURES_WAITING:
            self._counts["overrun"] += 1
            return
        names = ("PixelFormat", "Width", "Height", "OffsetX", "OffsetY")
        layout = ImageLayout(*(int(self._values[name]) for name in names))
        stamp = self._stamp(exposure.start_ns)
        self._waiting.append(PendingImage(exposure, self._block, stamp, layout, self.session, self._chunks()))
        self._block = self._block % MAXIMUM_BLOCK_ID + 1
        self._counts["exposures"] += 1
        if self._left is not None:
            self._left -= 1
            self.active = self._left > 0

    def _chunks(self) -> bytes | None:
        if not self._values["ChunkModeActive"]:
            return None
        count = int(self._values["CounterValue"]).to_bytes(4, "big")
        return chunk(COUNTER_CHUNK, count) if self._values["ChunkEnable"] else b""

    def _frames_asked(self) -> int | None:
        mode = self._values["AcquisitionMode"]
        if mode == ACQUISITION_MODES["Continuous"]:
            return None
        return int(self._values["AcquisitionFrameCount"]) if mode == ACQUISITION_MODES["MultiFrame"] else 1

    def _exposure_ns(self) -> int:
        return round(float(self._values["ExposureTime"]) * 1000)

    def _readout_ns(self) -> int:
        return round(self._row_ns * int(self._values["Height"]))

    def _period_ns(self) -> int:
        if not self._values["AcquisitionFrameRateEnable"]:
            return self.shortest_period_ns()
        return max(self.shortest_period_ns(), round(SECOND / float(self._values["AcquisitionFrameRate"])))


def payload_bytes(values: Mapping[str, Value]) -> int:
    """Return the size of an image and the chunks behind it under a camera's settings."""
    image = int(values["Width"]) * int(values["Height"]) * (int(values["PixelFormat"]) >> 16 & 0xFF) // 8
    if not values["ChunkModeActive"]:
        return image
    return image + CHUNK_TAIL_BYTES + (4 + CHUNK_TAIL_BYTES if values["ChunkEnable"] else 0)
