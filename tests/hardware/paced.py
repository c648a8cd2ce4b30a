"""Trigger pulses at a generator's rate, each made only after the previous frames were grabbed.

At most one frame of each camera is in flight, so that socket buffers never overflow on a busy machine.
"""

import time
from collections.abc import Callable

from hardware.emulate.serve import Served

PERIOD_NS = 10_000_000


def make_pulses(
    up: Served, count: int, grabbed: Callable[[], int], there: Callable[[int], int] = lambda number: number
) -> int:
    """Make pulses 0 to ``count`` - 1, due at 100 Hz by the cameras' clocks; return when pulse 0 was due [ns].

    ``grabbed``: how many frames everybody has by now; ``there``: how many there are of the pulses before one.
    """
    first_ns = time.monotonic_ns() + 20_000_000
    patience = 60_000
    for number in range(count):
        due_ns = first_ns + number * PERIOD_NS
        while patience and grabbed() < there(number):
            time.sleep(0.001)
            patience -= 1
        time.sleep(max(due_ns - time.monotonic_ns(), 0) * 1e-9)
        up.pulse(number, due_ns)
    return first_ns
