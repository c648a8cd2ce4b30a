"""How costly something is, whatever the machine and whatever else runs on it."""

import time


def cost(work):
    """Return the processor time of ``work`` in units of a fixed piece of plain Python, timed before and after it.

    The unit is a tenth of a second on the machine on which the limits were set. Time that the machine gives to others
    counts in neither.
    """
    before = _seconds(_unit)
    spent = _seconds(work)
    return spent / min(before, _seconds(_unit))


def _seconds(work):
    start = time.thread_time()
    work()
    return time.thread_time() - start


def _unit():
    table = {}
    for k in range(650_000):
        table[k % 1000] = table.get(k % 997, 0.5) * 0.999 + k
    return table
