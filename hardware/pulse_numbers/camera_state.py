"""State of one camera while its buffers are numbered by pulse, and what a run of pending buffers shows together.

A buffer whose pulse is not known yet is *pending*. Together, pending buffers show when the first of them would have
arrived with the shortest delay among them, and whether the device clock jumped between them.
"""

import statistics
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

from hardware.driver import Grabbed
from hardware.pulse_numbers.clock_model import DeviceClock
from hardware.pulse_numbers.free_running import FreeClock
from hardware.pulse_numbers.trigger_counter import TriggerCounter

BACKWARD_STEP, OFF_GRID_STEP = -0.2, 0.25
"""Shares of a period: a stamp farther behind the last one than ``BACKWARD_STEP``, or farther off whole periods from
it than ``OFF_GRID_STEP``, shows that the clock jumped."""
FEWEST_STAMPS = 3
"""Fewest stamps that show which is late: of two that are not whole periods apart, it may be either."""


Found = Literal["trigger", "clock", "stamp", "count", "arrival", "neighbours", "free", "played"]
"""How a frame's pulse was found, in this order: by the command that this computer sent, waiting for its frame; by
readings of the camera's clock; by its time stamps, whose first pulse the arrivals decided; by its counter, confirmed
by arrivals; by its arrival, which is not certain; by the frames beside it; as the pulse nearest to a free-running
camera's frame; by its place in a file that is played."""


@dataclass(frozen=True, eq=False)
class NumberedBuffer:
    """A buffer with its pulse."""

    camera: str
    pulse: int
    """Pulse number, from 0."""
    residual_ns: float
    """Deviation of its time stamp from the camera's line of pulses [ns]."""
    buffer: Grabbed
    found: Found
    """How the number was found."""
    error_ns: float = 0.0
    """Largest error of the time, where it was measured by commands or readings of clocks [ns]."""


@dataclass
class CameraState:
    """State of one camera."""

    name: str
    clock: DeviceClock
    latency_ns: float = 0.0
    """Delay of its frames beyond exposure, against the earliest camera [ns]."""
    started: bool = False
    """Whether a buffer of it was numbered."""
    relocks: int = 0
    """How often its clock jumped and was aligned again."""
    pending: list[Grabbed] = field(default_factory=list)
    """Buffers whose pulse is not known yet."""
    delays: deque[float] = field(default_factory=deque)
    """Arrival delays of its latest frames [ns]."""
    last_block: int | None = None
    """Block id of the last numbered buffer."""
    last_pulse: int = -1
    """Pulse of the last numbered buffer; -1 before any."""
    last_counts: tuple[int, Grabbed] | None = None
    """Pulse and buffer from which frames without time stamps are counted (``hardware.pulse_numbers.counting``)."""
    proven: bool = True
    """Whether the pulses of its frames without time stamps are certain."""
    recounted: bool = False
    """Whether arrivals contradicted the count."""
    played: bool = False
    """Whether it is a file that is played: its frames follow no clock and are counted."""
    suspect_pulse: int | None = None
    """Pulse that the device clock gave for the first pending buffer; None where it gave none."""
    counter: TriggerCounter = field(default_factory=TriggerCounter)
    free: FreeClock | None = None
    """Set for a free-running camera."""
    unidentified: list[Grabbed] = field(default_factory=list)
    """Buffers without block id and stamp since the last numbered one."""

    @property
    def stampless(self) -> bool:
        """Whether it has sent no time stamp, and is triggered or played."""
        return self.free is None and not self.clock.locked and all(b.device_ns is None for b in self.pending)


def earliest_arrival_ns(pending: Sequence[Grabbed], period_ns: float) -> float:
    """Return when the first of ``pending`` would have arrived with the shortest delay among them [ns]."""
    stamps = [(b, b.device_ns) for b in pending]
    first = next((stamp for _, stamp in stamps if stamp is not None), None)
    if first is None:
        block = pending[0].block_id
        steps = [k if block is None or b.block_id is None else b.block_id - block for k, b in enumerate(pending)]
        return min(b.host_ns - b.exposure_ns - k * period_ns for k, b in zip(steps, pending, strict=True))
    return min(
        b.host_ns - b.exposure_ns - round((s - first) / period_ns) * period_ns for b, s in stamps if s is not None
    )


def behind_others_ns(pending: Sequence[Grabbed], period_ns: float) -> float:
    """Return how far the first stamp of ``pending`` is behind the line of the others [ns]; 0 for fewer than three."""
    stamps = [b.device_ns for b in pending if b.device_ns is not None]
    if len(stamps) < FEWEST_STAMPS:
        return 0.0
    since = [stamp - stamps[0] for stamp in stamps[1:]]
    return -statistics.median(one - round(one / period_ns) * period_ns for one in since)


def index_after_jump(pending: Sequence[Grabbed], period_ns: float) -> int:
    """Return the index after the last jump of the device clock within ``pending``; 0 where there is none."""
    split = 0
    last: int | None = None
    for index, buffer in enumerate(pending):
        if buffer.device_ns is None:
            continue
        if last is not None:
            steps = (buffer.device_ns - last) / period_ns
            if steps < BACKWARD_STEP or abs(steps - round(steps)) > OFF_GRID_STEP:
                split = index
        last = buffer.device_ns
    return split
