"""Unwraps block ids; a stream that restarts is recognised."""

# GigE Vision counts blocks from 1 to 65535 and then from 1 again, unless it uses 64-bit ids
PERIOD = 65535


class BlockIds:
    """Unwraps the 16-bit block ids of one stream, from ``arm`` on.

    A step back by more than half the period is a wrap; a shorter one is a late block or a device that restarted,
    and is left as it is for frame grouping. Ids above the period were never 16-bit ones.
    """

    def __init__(self) -> None:
        self._last: int | None = None
        self._turns = 0

    def unwrapped(self, raw: int) -> int:
        """Return ``raw`` plus the overflows of the counter so far (unwrapped)."""
        last, self._last = self._last, raw
        if last is not None and max(raw, last) <= PERIOD:
            if last - raw > PERIOD // 2:
                self._turns += 1
            elif raw - last > PERIOD // 2 and self._turns:
                # a late block from before the wrap
                self._turns -= 1
        return raw + self._turns * PERIOD
