"""An estimate of one parameter of one camera, or the reason why the recordings do not determine it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array

SPREAD = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""


@dataclass(frozen=True)
class ParameterEstimate:
    """A parameter of one camera with its standard deviation."""

    camera: str
    key: str
    """Key in a scenario's ``[[camera]]``, for example ``errors.read_noise_e``."""
    value: float
    sigma: float
    """Standard deviation, in the unit of ``value``."""
    evidence: str
    """Data from which it was estimated, in words."""
    correlation: tuple[tuple[str, float], ...] = ()
    """Coefficient of correlation with the estimates of other keys of the camera; each pair is stated once."""


@dataclass(frozen=True)
class NotTold:
    """A parameter of one camera that the recordings do not determine."""

    camera: str
    key: str
    reason: str
    """What is missing, for example "needs a dark recording"."""


Told = ParameterEstimate | NotTold


def root(variance: float, sigma: float) -> tuple[float, float]:
    """Return a standard deviation and its own standard deviation, from a variance and that of the variance.

    A variance that is not above its own uncertainty gives its root, 0 where it is negative, and the root of what
    it may be for the uncertainty.
    """
    if variance <= sigma:
        return math.sqrt(max(variance, 0.0)), math.sqrt(max(variance, 0.0) + sigma)
    value = math.sqrt(variance)
    return value, sigma / (2.0 * value)


def weighted_mean(values: Sequence[float] | Array, sigmas: Sequence[float] | Array) -> tuple[float, float]:
    """Return the weighted mean of measurements and its standard deviation.

    The standard deviation is multiplied by the ratio of Birge (Physical Review 40 (1932) 207) where the measurements
    scatter by more than their own standard deviations.
    """
    value, weight = np.asarray(values, dtype=float), np.asarray(sigmas, dtype=float) ** -2.0
    mean = float(weight @ value / weight.sum())
    sigma = float(weight.sum() ** -0.5)
    if len(value) > 1:
        sigma *= max(1.0, math.sqrt(float(weight @ (value - mean) ** 2) / (len(value) - 1)))
    return mean, sigma
