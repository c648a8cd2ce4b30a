"""What one pixel collects from a point of light: the pixel's square convolved with the lens's blur.

Both are separable, so an image is a product of functions of one coordinate: ``weight(s)``, the share of a line's
light that a pixel at distance s [px] collects, and its integral ``share(s)``. For a Gaussian blur of sigma:
weight(s) = Phi((s + 1/2)/sigma) - Phi((s - 1/2)/sigma). It is tabulated with its derivative and read by cubic
Hermite interpolation: the error is below 1e-7 for sigma >= 0.4 px, below 1e-4 for 0.1 px.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from mosca.data.arrays import Array
from mosca.numba_support.decorators import bare_step, callable_bare_step

STEPS_PER_PX = 32


@dataclass(frozen=True, eq=False)
class PixelKernel:
    """``table`` (n, 3): share, weight and the weight's slope at distances -reach, -reach + 1/32, ... +reach px."""

    reach: int
    table: Array


def gaussian_kernel(sigma_px: float) -> PixelKernel:
    """Return the kernel of a square pixel behind a Gaussian blur of ``sigma_px`` (0.1 px or more).

    The light beyond the reach of 4.5 sigma + 1/2 px is below 1e-5 of the whole.
    """
    if not sigma_px >= 0.1:
        raise ValueError(f"sigma_px = {sigma_px}: at least 0.1 px; the table cannot follow a sharper image")
    reach = int(np.ceil(4.5 * sigma_px + 0.5))
    s = np.arange(-reach * STEPS_PER_PX, reach * STEPS_PER_PX + 1) / STEPS_PER_PX
    a, b = (s + 0.5) / sigma_px, (s - 0.5) / sigma_px
    bell_a, bell_b = (np.exp(-(q**2) / 2) / np.sqrt(2 * np.pi) for q in (a, b))
    share = sigma_px * (a * ndtr(a) + bell_a - b * ndtr(b) - bell_b)
    table = np.column_stack([share, ndtr(a) - ndtr(b), (bell_a - bell_b) / sigma_px])
    # the light cut off at each end is added at that end, so that the whole is exactly 1
    table[:, 0] = (table[:, 0] - table[0, 0]) / (table[-1, 0] - table[0, 0])
    table.setflags(write=False)
    return PixelKernel(reach, table)


@bare_step
def share(table: Array, reach: int, s: float) -> float:
    """Integral of ``weight`` from -infinity to s."""
    if s <= -reach:
        return 0.0
    if s >= reach:
        return 1.0
    p = (s + reach) * STEPS_PER_PX
    i = int(p)
    result: float = _hermite(table[i, 0], table[i + 1, 0], table[i, 1], table[i + 1, 1], p - i)
    return result


@callable_bare_step
def weight(table: Array, reach: int, s: float) -> float:
    """Share of a line's light that a pixel at distance s collects."""
    if s <= -reach or s >= reach:
        return 0.0
    p = (s + reach) * STEPS_PER_PX
    i = int(p)
    result: float = _hermite(table[i, 1], table[i + 1, 1], table[i, 2], table[i + 1, 2], p - i)
    return result


@bare_step
def _hermite(a: float, b: float, slope_a: float, slope_b: float, f: float) -> float:
    h = 1.0 / STEPS_PER_PX
    d = b - a
    p, q = slope_a * h - d, d - slope_b * h
    return a + f * (d + (1.0 - f) * (p * (1.0 - f) + q * f))
