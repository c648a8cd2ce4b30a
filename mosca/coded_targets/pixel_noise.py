"""Noise of the pixels of an image with coded targets, learned from this image by photon transfer.

``var(I) = variance + gain (I - level)`` (EMVA 1288, Release 4.0, section 2). It is estimated at two grey values: that
of most pixels, and that of the dots, away from their edges. At both the variance is that of second differences along
rows (Immerkaer 1996), by their median, which edges, stains and shading hardly change. Where dots are too small for
that, the gain is the guess that ``mosca.detection.pixel_noise`` makes of a camera without targets.
"""

import math
from typing import NamedTuple

import numpy as np

from mosca.coded_targets.dots import AXX, AXY, AYY, X, Y
from mosca.data.arrays import Array
from mosca.detection.local_background import ROUNDING_DN2
from mosca.detection.pixel_noise import GUESSED_DARK_E
from mosca.numba_support.decorators import kernel

SAMPLED_ROWS = 16
FROM_EDGE_PX = 2.5
"""Pixels of a dot lie at least this far from its edge: a blur of 0.8 px leaves them 0.1 % of it."""
MEDIAN_VARIANCE = 10.5
"""Relative variance of a variance from the median of n second differences, times n: 3.9 from their mean square, since
neighbours share pixels, and a median has 0.37 of its efficiency."""


MOST_BEND_DN = 1 << 18
"""Largest second difference of an image of 16 bits."""


class GreyValueNoise(NamedTuple):
    """Variance of a pixel of grey value I: ``variance_dn2 + gain_dn (I - level_dn)``, not inverted."""

    level_dn: float
    variance_dn2: float
    gain_dn: float


def noise_of(image: Array) -> float:
    """Return the standard deviation of the noise of most pixels of an image [DN], at least that of rounding."""
    return math.sqrt(_most_pixels(image)[1])


def pixel_noise(
    image: Array, frames: Array, full_dn: int, dark_dn2: float | None, gain_dn: float | None
) -> GreyValueNoise:
    """Return the noise of the pixels of ``image`` (H, W) with dots ``frames`` (n, FRAME).

    ``full_dn``: grey value of saturated pixels. ``dark_dn2``: variance without light; ``gain_dn``: increase of the
    variance with the grey value; None where they are not known.
    """
    level, variance = _most_pixels(image)
    if dark_dn2 is not None:
        variance = max(variance, dark_dn2)
    if gain_dn is not None:
        return GreyValueNoise(level, variance, gain_dn)
    guess = math.sqrt(variance) / GUESSED_DARK_E
    total, weight = 1 / guess, 1 / guess**2
    bends, light = bends_in_dots(image, frames, full_dn)
    if len(bends):
        lit = _variance(bends)
        rise = light - level
        information = len(bends) / MEDIAN_VARIANCE * (rise / lit) ** 2
        total += information * (lit - variance) / rise if information > 0 else 0.0
        weight += information
    return GreyValueNoise(level, variance, max(total / weight, 1e-3 * guess))


def _most_pixels(image: Array) -> tuple[float, float]:
    """Return grey value and variance of most pixels of an image (H, W)."""
    rows = image[:: max(1, image.shape[0] // SAMPLED_ROWS)].astype(np.float32)
    return float(np.median(rows)), _variance(np.abs(rows[:, 2:] - 2 * rows[:, 1:-1] + rows[:, :-2]).ravel())


def _variance(bends: Array) -> float:
    """Return a pixel's variance from absolute second differences (n,), whole numbers."""
    if not bends.size:
        return ROUNDING_DN2
    # whole numbers stand for all values that are rounded to them
    whole = np.bincount(np.minimum(bends, MOST_BEND_DN).astype(np.int64))
    share = np.cumsum(whole) / len(bends)
    k = int(np.searchsorted(share, 0.5))
    below = share[k - 1] if k else 0.0
    first, width = (k - 0.5, 1.0) if k else (0.0, 0.5)
    median = first + width * (0.5 - below) / (share[k] - below)
    return float(max((1.4826 * median) ** 2 / 6.0, ROUNDING_DN2))


@kernel
def bends_in_dots(image: Array, frames: Array, full_dn: int) -> tuple[Array, float]:
    """Return the absolute second differences (n,) along rows within the dots of ``frames``, and their mean light.

    Pixels of ``full_dn`` are saturated and left out.
    """
    found, light = np.empty(image.size), 0.0
    n = 0
    for frame in frames:
        det = frame[AXX] * frame[AYY] - frame[AXY] ** 2
        shorter = 0.5 * (frame[AXX] + frame[AYY]) - math.hypot(0.5 * (frame[AXX] - frame[AYY]), frame[AXY])
        inner = 1.0 - FROM_EDGE_PX / shorter
        if inner <= 0.0:
            continue
        half_x = inner * math.hypot(frame[AXX], frame[AXY])
        half_y = inner * math.hypot(frame[AXY], frame[AYY])
        left, right = max(int(frame[X] - half_x), 1), min(int(frame[X] + half_x) + 1, image.shape[1] - 2)
        for row in range(max(int(frame[Y] - half_y), 0), min(int(frame[Y] + half_y) + 1, image.shape[0] - 1) + 1):
            for column in range(left, right + 1):
                dx, dy = column - frame[X], row - frame[Y]
                u, v = (frame[AYY] * dx - frame[AXY] * dy) / det, (frame[AXX] * dy - frame[AXY] * dx) / det
                if u * u + v * v < inner * inner and n < len(found):
                    before, here, after = image[row, column - 1], image[row, column], image[row, column + 1]
                    if max(before, here, after) < full_dn:
                        found[n] = abs(float(before) - 2.0 * float(here) + float(after))
                        light += here
                        n += 1
    return found[:n].copy(), light / max(n, 1)
