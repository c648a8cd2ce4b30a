"""What is known of a camera while its pulses are numbered, and what frames tell that wait for their numbers.

A frame that waits is *held*. Those that are held together say when the first of them would have come had it been as
quick as the quickest, and whether the camera's clock jumped between them.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

from hardware.driver import Grabbed
from hardware.pulse_numbers.clock_model import CameraClock
from hardware.pulse_numbers.free_running import FreeClock
from hardware.pulse_numbers.trigger_counter import TriggerWitness


@dataclass
class NumberedCamera:
    """One camera: its ``clock`` once ``started``, what is ``held``, how late (``lates``) its last frames were [ns].

    ``doubted``: the pulse that its clock said of the first frame that is held; None where it said none. ``nameless``:
    what came since of frames that say nothing of themselves.
    """

    name: str
    clock: CameraClock
    latency_ns: float = 0.0
    started: bool = False
    relocks: int = 0
    held: list[Grabbed] = field(default_factory=list)
    lates: deque[float] = field(default_factory=deque)
    last_block: int | None = None
    last_pulse: int = 0
    doubted: int | None = None
    witness: TriggerWitness = field(default_factory=TriggerWitness)
    free: FreeClock | None = None
    nameless: list[Grabbed] = field(default_factory=list)


def earliest_ns(held: Sequence[Grabbed], period_ns: float) -> float:
    """Return when the first of ``held`` would have arrived had it been as quick as the quickest of them."""
    stamps = [(b, b.device_ns) for b in held]
    first = next((stamp for _, stamp in stamps if stamp is not None), None)
    if first is None:
        return min(b.host_ns - b.exposure_ns - k * period_ns for k, b in enumerate(held))
    return min(
        b.host_ns - b.exposure_ns - round((s - first) / period_ns) * period_ns
        for b, s in stamps
        if s is not None
    )


def after_jump(held: Sequence[Grabbed], period_ns: float) -> int:
    """Return the index after the last jump of the clock within ``held``; 0 where it runs evenly."""
    split = 0
    last: int | None = None
    for index, buffer in enumerate(held):
        if buffer.device_ns is None:
            continue
        if last is not None:
            steps = (buffer.device_ns - last) / period_ns
            if steps < -0.2 or abs(steps - round(steps)) > 0.25:
                split = index
        last = buffer.device_ns
    return split
