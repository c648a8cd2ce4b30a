"""The end of a take: when all wanted pulses were made, and when their frames have arrived."""

import time
from collections.abc import Collection, Mapping

from hardware.pulse_numbers.numbering import PulseNumbers
from hardware.silence import PollingTime
from hardware.trigger import Trigger

DRAIN_S = 0.3
"""Time for which each camera is polled without a frame after the last pulse before the take ends."""
LONGEST_DRAIN_S = 60.0
MARGIN_S = 0.05
"""Time for which the pulses go on after the last one wanted, since a busy machine makes and sees them late."""


class EndOfTake:
    """End of a take after ``pulses`` pulses at ``rate_hz``; with None it never ends.

    ``wait_s``: a take of ``pulses`` ends when nothing from which pulses could be counted has come for this long.
    """

    def __init__(self, pulses: int | None, rate_hz: float, wait_s: float) -> None:
        self._pulses, self._rate_hz, self._wait_s = pulses, rate_hz, wait_s

    @property
    def pulses(self) -> int | None:
        """How many are wanted; None for no end."""
        return self._pulses

    def is_past(self, pulse: int) -> bool:
        """Return whether a pulse lies beyond those wanted."""
        return self._pulses is not None and pulse >= self._pulses

    def none_came(self, trigger: Trigger, numbers: PulseNumbers, now_ns: int, silent_s: float) -> bool:
        """Return whether to wait no longer for pulses: no frame has come for so long, and none was numbered yet."""
        if self._pulses is None or silent_s <= self._wait_s:
            return False
        return trigger.pulse_at(now_ns) is None and numbers.pulse_at(now_ns) is None

    def pulses_over(self, trigger: Trigger, numbers: PulseNumbers, now_ns: int) -> bool:
        """Return whether all pulses wanted were made; a trigger that counts them may lag behind the clock."""
        if self._pulses is None:
            return False
        certain = trigger.pulse_at(now_ns)
        if certain is not None:  # the last one wanted has had its frames: the next one was made
            return certain >= self._pulses
        reached = numbers.pulse_at(now_ns)
        if reached is None or reached < self._pulses + MARGIN_S * self._rate_hz:
            return False
        made = trigger.report().get("pulses")
        return not isinstance(made, int) or made + trigger.skipped() >= self._pulses


def drained(end_ns: int, polling: Mapping[str, PollingTime], done: Collection[str]) -> bool:
    """Return whether no more frames can arrive.

    ``end_ns``: host time when the pulses ended [ns]. ``done``: cameras that are lost, or delivered a later frame.
    """
    if time.monotonic_ns() - end_ns > LONGEST_DRAIN_S * 1e9:
        return True
    return all(polled.idle_after_end_s >= DRAIN_S for name, polled in polling.items() if name not in done)
