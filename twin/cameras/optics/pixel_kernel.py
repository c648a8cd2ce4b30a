"""What one pixel collects from a point of light: the pixel's square convolved with the lens's blur.

Both are separable, so an image is a product of functions of one coordinate: the share of a line's light that a pixel
at distance s [px] collects, and its integral from minus infinity to s. For a Gaussian blur of sigma the share is
Phi((s + 1/2)/sigma) - Phi((s - 1/2)/sigma). It is tabulated with its derivative and read by cubic Hermite
interpolation: the error is below 1e-7 for sigma >= 0.4 px, below 1e-4 for 0.1 px. All pixels of a row lie at the same
fraction of a step of the table. They are therefore stored one after the other, and read with the same coefficients.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from mosca.data.arrays import Array
from mosca.numba_support.decorators import callable_bare_step

STEPS_PER_PX = 32
EDGE, SPOT, ROWS = 0, 1, 2
"""What is tabulated: the steps along a row of a piece of boundary and of a spot of light, and the shares of rows."""


@dataclass(frozen=True, eq=False)
class PixelKernel:
    """How the light of a point spreads to the pixels around it, by its place between two of them."""

    reach: int
    """Distance [px] beyond which a pixel collects nothing."""
    taps: Array
    """(3, STEPS_PER_PX, 4, 2 reach + 1): for EDGE, SPOT and ROWS, each step between two pixels and each pixel: the
    value there, the change to the next step, and the slopes at both times the step."""


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
    weight, slope = ndtr(a) - ndtr(b), (bell_a - bell_b) / sigma_px
    # the light cut off at each end is added at that end, so that the whole is exactly 1
    share = (share - share[0]) / (share[-1] - share[0])
    rows, whole = _by_pixel(weight, slope), np.array([1.0, 0.0, 0.0, 0.0])[:, None]
    taps = np.stack(
        [
            _steps(_by_pixel(share, weight), whole), _steps(rows, 0.0 * whole),
            np.concatenate([rows, np.zeros((STEPS_PER_PX, 4, 1))], axis=2),
        ]
    )  # fmt: skip
    taps.setflags(write=False)
    return PixelKernel(reach, taps)


def _by_pixel(values: Array, slopes: Array) -> Array:
    """Return the coefficients (STEPS_PER_PX, 4, 2 reach) of a function given at the table's distances."""
    step = 1.0 / STEPS_PER_PX
    columns = np.stack([values[:-1], np.diff(values), step * slopes[:-1], step * slopes[1:]])
    return np.ascontiguousarray(columns.reshape(4, -1, STEPS_PER_PX).transpose(2, 0, 1))


def _steps(values: Array, whole: Array) -> Array:
    """Return the changes (STEPS_PER_PX, 4, 2 reach + 1) from pixel to pixel, in the direction of the row.

    ``values``: of distances from -reach on; ``whole`` (4, 1): beyond +reach.
    """
    shape = (STEPS_PER_PX, 4, 1)
    padded = np.concatenate([np.zeros(shape), values, np.broadcast_to(whole, shape)], axis=2)
    return -np.diff(padded, axis=2)[:, :, ::-1]


@callable_bare_step
def fill_taps(taps: Array, what: int, at: float, out: Array) -> None:
    """Write what a point gives to the 2 reach + 1 pixels about it that it reaches.

    EDGE, SPOT: the changes from each pixel to the next; ``at``: how far the point lies after a pixel (0 to 1), the
    first value being that of the pixel ``reach - 1`` before that one. ROWS: the shares of rows, from the same row on;
    ``at``: how far the point lies before a row.
    """
    p = at * STEPS_PER_PX
    step = min(int(p), STEPS_PER_PX - 1)
    f = p - step
    g = 1.0 - f
    change, before, after = f + f * g * (f - g), f * g * g, f * f * g
    for q in range(out.shape[0]):
        out[q] = (
            taps[what, step, 0, q] + change * taps[what, step, 1, q]
            + before * taps[what, step, 2, q] - after * taps[what, step, 3, q]
        )  # fmt: skip
