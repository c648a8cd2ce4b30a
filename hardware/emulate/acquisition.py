"""A camera's acquisition: which trigger makes an exposure, what number it has, and what waits to be sent."""

import heapq
from collections import Counter, deque
from collections.abc import Callable, Mapping, MutableMapping
from dataclasses import dataclass
from typing import Literal

from hardware.emulate.features import ACQUISITION_MODES, ACTIVATIONS, COUNTER_SOURCES, TRIGGER_SOURCES
from hardware.emulate.gvsp import Layout, chunk
from hardware.emulate.registers import Value
from hardware.emulate.shutter import Exposure, Shutter
from hardware.emulate.standard import CHUNK_TAIL_BYTES, COUNTER_CHUNK, MAXIMUM_BLOCK_ID

SECOND = 1_000_000_000
PULSE_WIDTH_NS = 100_000
"""Length of a line pulse: its falling edge comes so much after its rising one."""
EXPOSURES_WAITING = 128
"""Images that a camera keeps while the machine it runs on is held up; a trigger beyond them is lost and counted."""
ACTIONS_WAITING = 16
LONGEST_ARREARS_NS = SECOND
"""A camera that runs free and was held up takes at most what it missed in this time."""
Source = Literal["Software", "Line1", "Action1"]


@dataclass(frozen=True)
class Shot:
    """An exposure with what was set when it began: everything that its image depends on.

    ``session``: counts the stops of acquisition; a shot of an earlier one is not sent any more. ``chunks``: what
    follows the image, None without chunk data.
    """

    exposure: Exposure
    block: int
    device_ns: int
    layout: Layout
    session: int
    chunks: bytes | None = None


class Acquisition:
    """Begins exposures as the settings ``values`` (by feature name) say; not to be used by two threads at a time.

    ``stamp``: the device's clock at a monotonic time. ``full_readout_ns``: of an image of ``sensor_height`` rows.
    ``first_block``: number of the first block of each acquisition. ``counts``: what became of the triggers.
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
        self._waiting: deque[Shot] = deque()
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
        """Take no more triggers, and drop what waits."""
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

    def next_shot(self, now_ns: int) -> Shot | float | None:
        """Return the next shot, else the seconds until one may be due, else None where nothing is foreseen."""
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
        """Return the time between two images at least, as exposure and height are set."""
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
        layout = Layout(*(int(self._values[name]) for name in names))
        stamp = self._stamp(exposure.start_ns)
        self._waiting.append(Shot(exposure, self._block, stamp, layout, self.session, self._chunks()))
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
    """Return the size of an image and the chunks behind it, as a camera's settings have them."""
    image = int(values["Width"]) * int(values["Height"]) * (int(values["PixelFormat"]) >> 16 & 0xFF) // 8
    if not values["ChunkModeActive"]:
        return image
    return image + CHUNK_TAIL_BYTES + (4 + CHUNK_TAIL_BYTES if values["ChunkEnable"] else 0)
