"""Another PC's clock against this one's, from queries and answers.

The answer was given between query and receipt: half-way, with an error of at most half the round trip (Cristian
1989). The quickest round trips are the most certain; a line through the quicker half gives offset and skew. The
remaining error is the asymmetry of the two ways, far below half of the quickest round trip where both are one cable.
"""

from collections import deque

import numpy as np

PINGS = 150
FEWEST = 5
"""Number of answers from which on the clock is used."""
SPAN_NS = 2e9
"""From pings over a shorter time the skew is not estimated, since scatter would dominate it."""
LARGEST_SKEW = 1e-3


class RemoteClock:
    """Offset and skew of a remote clock; ``here`` converts its time into this machine's."""

    def __init__(self) -> None:
        self._pings: deque[tuple[int, int, int]] = deque(maxlen=PINGS)
        # one value, so that another thread may read it: here, there, skew
        self._fit = (0, 0, 0.0)
        self.error_ns = float("inf")

    @property
    def ready(self) -> bool:
        """True once enough answers have come."""
        return len(self._pings) >= FEWEST

    def certain(self, error_ns: float) -> bool:
        """Return whether the clock is known to ``error_ns``, or cannot be known better since all answers are slow."""
        return self.ready and (self.error_ns <= error_ns or len(self._pings) == PINGS)

    @property
    def skew(self) -> float:
        """How much faster than the other clock this machine's runs."""
        return self._fit[2]

    def take(self, asked_ns: int, remote_ns: int, received_ns: int) -> None:
        """Add a reading: this machine's clock at request and reply, and the remote clock."""
        self._pings.append(((asked_ns + received_ns) // 2, remote_ns, received_ns - asked_ns))
        origin_here, origin_there, _ = self._pings[0]
        pings = np.array(
            [(here - origin_here, there - origin_there, trip) for here, there, trip in self._pings], dtype=float
        )
        quick = pings[pings[:, 2] <= np.median(pings[:, 2])]
        there, offset = quick[:, 1], quick[:, 0] - quick[:, 1]
        # a query that took twice as long has a quarter of the weight
        weight = 1 / quick[:, 2].clip(min=1e3)
        skew = self.skew
        if there.max() - there.min() > SPAN_NS:
            slope, _ = np.polyfit(there, offset, 1, w=weight)
            skew = float(np.clip(slope, -LARGEST_SKEW, LARGEST_SKEW))
        middle = float(np.average(there, weights=weight**2))
        left = offset - skew * (there - middle)
        mean = float(np.average(left, weights=weight**2))
        self._fit = (origin_here + round(middle + mean), origin_there + round(middle), skew)
        self.error_ns = float(quick[:, 2].min()) / 2

    def to_local(self, remote_ns: int) -> int:
        """Return this machine's time [ns] when the other clock showed ``remote_ns``."""
        here, there, skew = self._fit
        return here + (remote_ns - there) + round(skew * (remote_ns - there))

    def to_remote(self, local_ns: int) -> int:
        """Return what the other clock shows at this machine's time ``local_ns`` [ns]."""
        here, there, skew = self._fit
        since = local_ns - here
        return there + since - round(since * skew / (1 + skew))
