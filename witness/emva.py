"""EMVA Standard 1288, Release 4.0 Linear, for the properties that a virtual sensor has; numpy only.

Photon transfer (sections 2 and 6): pairs of even images at rising exposure give mean and temporal variance. The
slope of variance over mean is the system gain K, the slope of mean over photons the responsivity R = K eta. Spatial
nonuniformity (sections 4 and 8) is measured on stacks of images in the dark and at half of saturation. Nothing here
depends on how the images were made. All is in counts [DN] unless a name states otherwise.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
QUANTISATION = 1 / 12
"""Variance of rounding in an analogue-to-digital converter [DN^2]."""
LEAST_DARK_VARIANCE = 0.24
"""Dark variance below which rounding dominates and temporal dark noise cannot be measured [DN^2] (section 6.6)."""


def temporal(a: Array, b: Array) -> tuple[float, float]:
    """Return mean and temporal variance of two images of the same light; fixed-pattern noise cancels."""
    a, b = a.astype(float), b.astype(float)
    return float((a.mean() + b.mean()) / 2), float(np.mean((a - b) ** 2) / 2 - (a.mean() - b.mean()) ** 2 / 2)


@dataclass(frozen=True)
class PhotonTransfer:
    """A series of pairs: ``photons``, ``mean``, ``variance`` (n,), rising, the first in the dark."""

    photons: Array
    mean: Array
    variance: Array

    @property
    def saturated(self) -> int:
        """The step of saturation, at which the temporal variance is largest."""
        return int(np.argmax(self.variance))

    def _range(self, low: float, high: float) -> slice | Array:
        signal = self.mean - self.mean[0]
        full = signal[self.saturated]
        inside = (signal >= low * full) & (signal <= high * full)
        inside[self.saturated + 1 :] = False
        result: slice | Array = inside
        return result

    @property
    def gain(self) -> float:
        """K [DN/e-]: slope through zero of variance over mean, both less the dark, up to 70 % of saturation."""
        part = self._range(0.0, 0.7)
        return _slope((self.mean - self.mean[0])[part], (self.variance - self.variance[0])[part])

    @property
    def responsivity(self) -> float:
        """R [DN/photon]: slope through zero of mean over photons, up to 70 % of saturation."""
        part = self._range(0.0, 0.7)
        return _slope(self.photons[part], (self.mean - self.mean[0])[part])

    @property
    def quantum_efficiency(self) -> float:
        """Return eta = R / K."""
        return self.responsivity / self.gain

    @property
    def dark_noise_measurable(self) -> bool:
        """Whether the dark variance is larger than that of rounding."""
        return bool(self.variance[0] >= LEAST_DARK_VARIANCE)

    @property
    def dark_noise_e(self) -> float:
        """Temporal dark noise [e-]; an upper bound where it is not measurable (0.40 / K)."""
        return float(np.sqrt(max(self.variance[0], LEAST_DARK_VARIANCE) - QUANTISATION) / self.gain)

    @property
    def saturation_e(self) -> float:
        """Saturation capacity [e-]."""
        return float(self.quantum_efficiency * self.photons[self.saturated])

    @property
    def linearity_error(self) -> float:
        """LE: mean absolute relative deviation from the line that fits relative deviations best, 5 to 95 %."""
        part = self._range(0.05, 0.95)
        return linearity_error(self.photons[part], (self.mean - self.mean[0])[part])


def linearity_error(photons: Array, signal: Array) -> float:
    """Return the mean of ``|y - (a0 + a1 H)| / (a0 + a1 H)`` for the line fitted with weights 1 / y."""
    design = np.column_stack([np.ones_like(photons), photons]) / signal[:, None]
    line = np.column_stack([np.ones_like(photons), photons]) @ np.linalg.lstsq(design, np.ones_like(signal))[0]
    return float(np.mean(np.abs(signal - line) / np.abs(line)))


def _slope(x: Array, y: Array) -> float:
    return float((x @ y) / (x @ x))


@dataclass(frozen=True)
class Spatial:
    """Mean and spatial variances of a stack: the whole, and its split into rows, columns and single pixels."""

    mean: float
    total: float
    row: float
    column: float
    pixel: float


def spatial(stack: Array) -> Spatial:
    """Return the spatial variances of images (L, M, N) of one light, less the temporal noise left in the mean.

    The variance of the mean image is row + column + pixel + temporal / L, that of the row means row + pixel / N +
    ..., that of the column means column + pixel / M + ...: three equations in three unknowns.
    """
    images, rows, columns = stack.shape
    stack = stack.astype(float)
    average = stack.mean(axis=0)
    left = stack.var(axis=0, ddof=1).mean() / images
    total = average.var(ddof=1) - left
    row_means = average.mean(axis=1).var(ddof=1) - left / columns
    column_means = average.mean(axis=0).var(ddof=1) - left / rows
    equations = np.array([[1.0, 1.0, 1.0], [1.0, 0.0, 1.0 / columns], [0.0, 1.0, 1.0 / rows]])
    row, column, pixel = np.linalg.solve(equations, [total, row_means, column_means])
    return Spatial(float(average.mean()), float(total), float(row), float(column), float(pixel))


def dsnu_e(dark: Spatial, gain: float) -> float:
    """DSNU1288 [e-]: rms of the dark signal over the image."""
    return float(np.sqrt(max(dark.total, 0.0)) / gain)


def prnu(dark: Spatial, half: Spatial) -> float:
    """PRNU1288: rms of the response over the image at half of saturation, as a share."""
    return float(np.sqrt(max(half.total - dark.total, 0.0)) / (half.mean - dark.mean))
