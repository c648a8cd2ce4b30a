"""Sums over the images of a camera with an unchanged view: each pixel's mean and temporal variance."""

import numpy as np

from mosca.data.arrays import Array


class PixelStatistics:
    """Sums of the images (H, W) of one camera; ``add`` takes each image."""

    def __init__(self, height: int, width: int, bits: int) -> None:
        """``bits``: significant bits of a pixel."""
        self.bits, self.images = bits, 0
        self._sum, self._square = np.zeros((height, width)), np.zeros((height, width))
        self._frame_means: list[float] = []
        self.histogram = np.zeros(2**bits, np.int64)
        """Number of pixels with each grey value, all images together."""

    def add(self, image: Array) -> None:
        """Add an image (H, W) of whole grey values."""
        values = image.astype(np.float64)
        self.images += 1
        self._sum += values
        self._square += values * values
        self._frame_means.append(float(values.mean()))
        self.histogram += np.bincount(image.ravel(), minlength=len(self.histogram))[: len(self.histogram)]

    @property
    def mean(self) -> Array:
        """Mean of each pixel (H, W) [DN]."""
        return np.asarray(self._sum / self.images)

    @property
    def variance(self) -> Array:
        """Temporal variance of each pixel (H, W) [DN^2], minus that of the whole image's mean (flicker of a lamp)."""
        n = self.images
        common = float(np.var(self._frame_means, ddof=1)) - float(np.mean(self._raw_variance)) / self._sum.size
        return np.asarray(self._raw_variance - max(common, 0.0) * (n > 2))

    @property
    def _raw_variance(self) -> Array:
        n = self.images
        return np.asarray(np.maximum(self._square - self._sum**2 / n, 0.0) / (n - 1))
