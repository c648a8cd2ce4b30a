"""Learned typical diameter of the targets, and whether they are so alike that an image's size is evidence.

Markers are of one size: an image that is too small for it shows a partly hidden target. Particles differ: a small
image may show a small target, so sizes are no longer judged.
"""

import math

import numpy as np

from mosca.correspondence.hypothesis import HALF_HIDDEN, SIZE_SIGMAS
from mosca.data.arrays import middle
from mosca.data.tracks import Points

LEAST_GAIN = 0.05
"""Weight of a frame set in the exponential averages. At first it is larger, 2 / (n + 1) for the n-th set: in the
first sets small targets are measured without the knowledge of others."""
QUARTILES = 1.349
"""Distance of a normal distribution's quartiles, in standard deviations."""


class TypicalSize:
    """Typical size of points on which three or more cameras agree; frame sets with fewer than three are not used."""

    def __init__(self) -> None:
        self.diameter_m = 0.0
        """Typical diameter; 0 until it is known."""
        self.scatter = 0.0
        """Standard deviation of the targets' areas, relative."""
        self._sets = 0

    @property
    def known(self) -> bool:
        """Whether any frame set has been used."""
        return self._sets > 0

    @property
    def alike(self) -> bool:
        """Whether a half-hidden target can be distinguished from a small one."""
        return SIZE_SIGMAS * self.scatter <= HALF_HIDDEN

    def learn(self, points: Points) -> None:
        """Take a frame set's points."""
        sure = np.sort(points.diameter_m[points.n_cameras >= 3])
        n = len(sure)
        if n < 3:
            return
        self._sets += 1
        gain = max(2 / (self._sets + 1), LEAST_GAIN)
        median = middle(sure)
        # scatter of the logarithm, since an area cannot be negative; an area is the diameter squared. Hidden targets
        # spread sizes only below the median, merged ones only above it: the narrower side counts
        low, high = float(sure[n // 4]), float(sure[3 * n // 4])
        side = min(high / median, median / low) if low > 0.0 else 1.0
        scatter = 4 * math.log(side) / QUARTILES
        self.diameter_m += gain * (median - self.diameter_m)
        self.scatter += gain * (scatter - self.scatter)
