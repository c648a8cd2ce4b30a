"""Pulses for cameras whose frames somebody grabs: at a generator's pace, but never far ahead of who grabs."""

import time
from collections.abc import Callable

from hardware.emulate.serve import Served

PERIOD_NS = 10_000_000
AHEAD = 8
"""Frames that may be on their way: a busy machine must not run out of room for packets, which are then lost."""


def make_pulses(up: Served, count: int, grabbed: Callable[[], int]) -> None:
    """Make pulses 0 to ``count`` - 1 at 100 Hz by the cameras' clocks; ``grabbed``: how many everybody has by now."""
    first_ns = time.monotonic_ns() + 20_000_000
    patience = 60_000
    for number in range(count):
        due_ns = first_ns + number * PERIOD_NS
        while patience and grabbed() < number - AHEAD:
            time.sleep(0.001)
            patience -= 1
        time.sleep(max(due_ns - time.monotonic_ns(), 0) * 1e-9)
        up.pulse(number, due_ns)
