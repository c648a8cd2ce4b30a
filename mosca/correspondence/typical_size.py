"""Learned typical diameter of the targets, and whether they are so alike that an image's size is evidence.

Markers are of one size: an image that is too small for it shows a partly hidden target. Particles differ: a small
image may show a small target, so sizes are no longer judged.
"""

import math
from collections import deque

import numpy as np

from mosca.camera.ray_table import FIRST_AREA_NOISE, LONG
from mosca.correspondence.hypothesis import FIRST_HIDDEN, HALF_HIDDEN
from mosca.data.arrays import Array, middle
from mosca.data.detections import MERGED, PARTIAL, SATURATED, UNREFINED
from mosca.data.rays import ANGLE, FLAGS, ORIGIN, RayTable
from mosca.data.tracks import Points

LEAST_GAIN = 0.05
"""Weight of a frame set in the exponential averages. At first it is larger, 2 / (n + 1) for the n-th set: in the
first sets small targets are measured without the knowledge of others."""
ALIKE_SIGMAS = 4.0
"""Standard deviations of sizes that must be less than what half-hidden targets lack, or sizes are no evidence, and
from which an image surely lacks a part."""
QUARTILES = 1.349
"""Distance of a normal distribution's quartiles, in standard deviations."""
ODD = LONG | MERGED | PARTIAL | SATURATED | UNREFINED
"""Flags of images that are no measure of the sizes' noise."""
COMPARED, SELDOM, MOST_TARGETS = 20, 10, 20
"""Images of one target are compared in as many frame sets at the start, and later in every so many-th, of at most so
many targets. The latest COMPARED of them count."""
GAPS = (0.954, 0.689, 0.585, 0.528, 0.492, 0.465, 0.443)
"""Medians of the differences of the two largest of 2, 3 ... 8 and more normal values, in standard deviations. A wand
of two balls out of focus with half of them gives 74, 47 and 33 um in three takes of another renderer, with these 74,
52 and 33, with twice 94, 52 and 45."""
LARGEST = (0.564, 0.846, 1.029, 1.163, 1.267, 1.352, 1.424)
"""Means of the largest of as many normal values, in standard deviations."""


class TypicalSize:
    """Typical size of points on which three or more cameras agree; frame sets with fewer than three are not used."""

    def __init__(self) -> None:
        self._largest_m = 0.0
        self.scatter = 0.0
        """Standard deviation of the targets' areas, relative."""
        self.area_noise = FIRST_AREA_NOISE
        """Standard deviation of the areas of one target's images, relative: what lens and focus do to sizes, too.
        0 where it is so large that half-hidden targets would pass: such images are not of one target."""
        self._excess = 0.0
        self.hidden = FIRST_HIDDEN
        """Share of the images that are of partly hidden targets."""
        self._compared: deque[Array] = deque(maxlen=COMPARED)
        """Logarithms of images' sizes (n, c) of targets with three or more; -inf for no image."""
        self._sets = self._seen = 0

    @property
    def diameter_m(self) -> float:
        """Typical diameter; 0 until it is known. Points have that of their largest image, which noise makes so."""
        return self._largest_m * math.exp(-0.5 * self._excess)

    @property
    def known(self) -> bool:
        """Whether any frame set has been used."""
        return self._sets > 0

    @property
    def alike(self) -> bool:
        """Whether a half-hidden target can be distinguished from a small one."""
        return ALIKE_SIGMAS * self.scatter <= HALF_HIDDEN

    def learn(self, points: Points, table: RayTable) -> None:
        """Take a frame set's points and the rays that they were made from."""
        self._seen += 1
        if not self.known or self._seen <= COMPARED or self._seen % SELDOM == 0:
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
        self._largest_m += gain * (median - self._largest_m)
        self.scatter += gain * (scatter - self.scatter)

    def _compare(self, points: Points, table: RayTable) -> None:
        """Learn the noise of sizes from images of targets that three cameras see."""
        seen = np.flatnonzero(points.n_cameras >= 3)
        seen = seen[:: max(len(seen) // MOST_TARGETS, 1)]
        rays, xyz = points.rays[seen], points.xyz[seen]
        at = np.where(rays >= 0, rays + table.start[:-1], 0)
        away = np.linalg.norm(xyz[:, None] - table.views[:, ORIGIN : ORIGIN + 3], axis=2)
        clean = (rays >= 0) & np.isfinite(table.rays[at, ANGLE]) & (table.rays[at, FLAGS].astype(int) & ODD == 0)
        sizes = np.log(table.rays[at, ANGLE] * away, where=clean, out=np.full(clean.shape, -math.inf))
        sizes = sizes[clean.sum(axis=1) >= 3]
        if len(sizes):
            self._compared.append(sizes)
            self._estimate(np.concatenate(self._compared))

    def _estimate(self, sizes: Array) -> None:
        """Estimate the noise and how many are hidden from logarithms of sizes (n, c), -inf for no image.

        The two largest images of each target tell the noise: smaller ones may be hidden.
        """
        second, largest = np.partition(sizes, -2, axis=1)[:, -2:].T
        images = np.isfinite(sizes)
        n = np.minimum(images.sum(axis=1), len(GAPS) + 1) - 2
        each, luck = 2.0 * (largest - second) / np.array(GAPS)[n], np.array(LARGEST)[n]
        noise = middle(np.sort(each))
        if not 0.0 < ALIKE_SIGMAS * noise <= HALF_HIDDEN:
            self.area_noise, self._excess, self.hidden = 0.0, 0.0, FIRST_HIDDEN
            return
        self.area_noise, self._excess = noise, middle(np.sort(each * luck))
        missing = 1.0 - np.exp(2.0 * sizes - 2.0 * largest[:, None] + noise * luck[:, None])[images]
        surely = ALIKE_SIGMAS * noise
        many = (float(np.count_nonzero(missing > surely)) + 0.5) / (len(missing) + 1.0)
        self.hidden = many / (1.0 - surely)  # any share is hidden as often as another
