"""Learned typical diameter of the targets, and whether they are so alike that an image's size is evidence.

Markers are of one size: an image that is too small for it shows a partly hidden target. Particles differ: a small
image may show a small target, so sizes are no longer judged.
"""

import math

import numpy as np

from mosca.correspondence.hypothesis import HALF_HIDDEN, SIZE_SIGMAS
from mosca.data.arrays import middle
from mosca.data.detections import MERGED, PARTIAL, SATURATED, UNREFINED
from mosca.data.rays import ANGLE, FLAGS, ORIGIN, RayTable
from mosca.data.tracks import Points

LEAST_GAIN = 0.05
"""Weight of a frame set in the exponential averages. At first it is larger, 2 / (n + 1) for the n-th set: in the
first sets small targets are measured without the knowledge of others."""
QUARTILES = 1.349
"""Distance of a normal distribution's quartiles, in standard deviations."""
ODD = MERGED | PARTIAL | SATURATED | UNREFINED
"""Flags of images that are no measure of the sizes' noise."""
GAPS = (0.954, 0.689, 0.585, 0.528, 0.492, 0.465, 0.443)
"""Medians of the differences of the two largest of 2, 3 ... 8 and more normal values, in standard deviations. A wand
of two balls out of focus with half of them gives 74, 47 and 33 um in three takes of another renderer, with these 74,
52 and 33, with twice 94, 52 and 45."""


class TypicalSize:
    """Typical size of points on which three or more cameras agree; frame sets with fewer than three are not used."""

    def __init__(self) -> None:
        self.diameter_m = 0.0
        """Typical diameter; 0 until it is known."""
        self.scatter = 0.0
        """Standard deviation of the targets' areas, relative."""
        self._image_noise = 0.0
        self._sets = self._compared = 0

    @property
    def known(self) -> bool:
        """Whether any frame set has been used."""
        return self._sets > 0

    @property
    def alike(self) -> bool:
        """Whether a half-hidden target can be distinguished from a small one."""
        return SIZE_SIGMAS * self.scatter <= HALF_HIDDEN

    @property
    def image_noise(self) -> float:
        """Standard deviation of the areas of one target's images, relative: what lens and focus do to sizes, too.

        Learned until a typical size is. 0 where it is so large that half-hidden targets would pass: such images are
        not of one target.
        """
        return self._image_noise if SIZE_SIGMAS * self._image_noise <= HALF_HIDDEN else 0.0

    def learn(self, points: Points, table: RayTable) -> None:
        """Take a frame set's points and the rays that they were made from."""
        if not self.known:
            self._compare(points, table)
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

    def _compare(self, points: Points, table: RayTable) -> None:
        """Learn the noise of sizes from the two largest images of each target: the smaller ones may be hidden."""
        seen = points.n_cameras >= 3
        if not seen.any():
            return
        rays, xyz = points.rays[seen], points.xyz[seen]
        at = np.where(rays >= 0, rays + table.start[:-1], 0)
        away = np.linalg.norm(xyz[:, None] - table.views[:, ORIGIN : ORIGIN + 3], axis=2)
        clean = (rays >= 0) & (table.rays[at, FLAGS].astype(int) & ODD == 0)
        sizes = np.where(clean, table.rays[at, ANGLE] * away, 0.0)
        many = clean.sum(axis=1)
        if not (many >= 3).any():
            return
        second, largest = np.partition(sizes[many >= 3], -2, axis=1)[:, -2:].T
        gaps = 2.0 * np.log(largest / second) / np.array(GAPS)[np.minimum(many[many >= 3], len(GAPS) + 1) - 2]
        self._compared += 1
        gain = max(2 / (self._compared + 1), LEAST_GAIN)
        self._image_noise += gain * (middle(np.sort(gaps)) - self._image_noise)
