"""Pixel values from light in the image plane, computed without any code of the project.

A pixel integrates over its unit square; the blur is a Gaussian. Both are separable, so that a pixel's response to a
point of light at (x, y) is ``spread(x - column) * spread(y - row)``, where ``spread`` is the difference of two normal
distribution functions. There are three methods, each a check of the others:
``contour_image`` (Green's theorem along a polygon), ``lines_image`` (parallel scan lines, each from x0 to x1)
and ``points_image`` (points of light with weights); ``witness.render.pixels_by_brute_force`` is a fourth.

Pixel (0, 0) is the centre of the top-left pixel; x along columns, y along rows [px].
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.special import ndtr

Array = NDArray[Any]


def spread(offset: Array, sigma_px: float) -> Array:
    """Return a pixel's response (one axis) to light ``offset`` px from its centre: square convolved with Gaussian."""
    result: Array = ndtr((offset + 0.5) / sigma_px) - ndtr((offset - 0.5) / sigma_px)
    return result


def gathered(offset: Array, sigma_px: float) -> Array:
    """Return the integral of ``spread`` from minus infinity to ``offset``, in closed form.

    The integral of the normal distribution function is z Phi(z) + phi(z).
    """

    def twice(z: Array) -> Array:
        result: Array = z * ndtr(z) + np.exp(-z * z / 2) / np.sqrt(2 * np.pi)
        return result

    return sigma_px * (twice((offset + 0.5) / sigma_px) - twice((offset - 0.5) / sigma_px))


def near(xy: Array, sigma_px: float, width: int, height: int) -> tuple[slice, slice]:
    """Return the rows and columns of pixels that light from points (n, 2) reaches; less than 1e-15 is left out."""
    reach = 0.5 + 8 * sigma_px
    low = np.clip(np.floor(xy.min(axis=0) - reach), 0, (width, height)).astype(int)
    high = np.clip(np.ceil(xy.max(axis=0) + reach) + 1, low, (width, height)).astype(int)
    return slice(low[1], high[1]), slice(low[0], high[0])


def offsets(values: Array, pixels: slice) -> Array:
    """Return the offsets (pixels, n) of coordinates (n,) from each pixel of a slice."""
    return values - np.arange(pixels.start, pixels.stop)[:, None]


def summed(down: Array, across: Array) -> Array:
    """Return the sum over points of the products of (rows, n) and (columns, n).

    BLAS is not used: its threads wait for each other on busy cores.
    """
    return np.asarray(np.einsum("rp,cp->rc", down, across))


def contour_image(polygon: Array, sigma_px: float, width: int, height: int) -> Array:
    """Return the share of each pixel (H, W) that a closed polygon (n, 2) [px] of any shape fills.

    By Green's theorem, the integral of spread(x) spread(y) over the inside is that of gathered(x) spread(y) dy along
    the edge: Gauss-Legendre with 3 points on each side. Sides must be short compared with ``sigma_px``.
    """
    nodes, weights = np.polynomial.legendre.leggauss(3)
    following = np.roll(polygon, -1, axis=0)
    along = ((1 + nodes) / 2)[:, None, None]
    at = (polygon + along * (following - polygon)).reshape(-1, 2)
    dy = (weights[:, None] / 2 * (following - polygon)[:, 1]).ravel()
    image = np.zeros((height, width))
    where = near(polygon, sigma_px, width, height)
    down = dy * spread(offsets(at[:, 1], where[0]), sigma_px)
    image[where] = summed(down, gathered(offsets(at[:, 0], where[1]), sigma_px))
    x, y = (polygon - polygon[0]).T
    turns_left = np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y) > 0
    return image if turns_left else -image


def rectangle_image(
    x: tuple[float, float], y: tuple[float, float], sigma_px: float, width: int, height: int
) -> Array:
    """Return the image of an upright rectangle of light in closed form."""
    columns, rows = np.arange(width), np.arange(height)
    across = gathered(x[1] - columns, sigma_px) - gathered(x[0] - columns, sigma_px)
    down = gathered(y[1] - rows, sigma_px) - gathered(y[0] - rows, sigma_px)
    return np.outer(down, across)


def points_image(xy: Array, weight: Array, sigma_px: float, width: int, height: int) -> Array:
    """Return the image of points of light (n, 2) that send ``weight`` (n,) each [px^2]."""
    image = np.zeros((height, width))
    where = near(xy, sigma_px, width, height)
    down = weight * spread(offsets(xy[:, 1], where[0]), sigma_px)
    image[where] = summed(down, spread(offsets(xy[:, 0], where[1]), sigma_px))
    return image


def lines_image(lines: Array, step_px: float, sigma_px: float, width: int, height: int) -> Array:
    """Return the image of scan lines (n, 3): y, x0, x1 [px], each representing a strip ``step_px`` high."""
    image = np.zeros((height, width))
    if len(lines) == 0:
        return image
    where = near(np.vstack([lines[:, [1, 0]], lines[:, [2, 0]]]), sigma_px, width, height)
    left, right = offsets(lines[:, 1], where[1]), offsets(lines[:, 2], where[1])
    across = gathered(right, sigma_px) - gathered(left, sigma_px)
    image[where] = step_px * summed(spread(offsets(lines[:, 0], where[0]), sigma_px), across)
    return image


def lines_moments(lines: Array, step_px: float) -> tuple[float, Array]:
    """Return area [px^2] and centroid (2,) [px] of scan lines (n, 3): y, x0, x1."""
    length = lines[:, 2] - lines[:, 1]
    area = length.sum()
    if area == 0.0:
        return 0.0, np.full(2, np.nan)
    middle = (lines[:, 1] + lines[:, 2]) / 2
    return float(step_px * area), np.array([length @ middle, length @ lines[:, 0]]) / area


def scan(
    lit: Callable[[Array], Array],
    low: Array,
    high: Array,
    lines_per_px: int = 24,
    coarse_per_px: int = 8,
    halvings: int = 10,
) -> tuple[Array, float]:
    """Return the scan lines (n, 3) of the lit region between two corners [px], and their distance.

    ``lit``: points (n, 2) -> bool (n,). Each line is sampled every 1 / ``coarse_per_px``; where the value changes,
    the edge is found by bisection. Regions thinner than the coarse step may be missed.
    """
    y = np.arange(low[1] + 0.5 / lines_per_px, high[1], 1 / lines_per_px)
    x = np.linspace(low[0], high[0], int(np.ceil((high[0] - low[0]) * coarse_per_px)) + 1)
    answers = lit(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)).reshape(len(y), len(x))
    answers[:, 0] = answers[:, -1] = False  # the frame must lie outside, so that the edges of a line come in pairs
    row, column = np.nonzero(answers[:, 1:] != answers[:, :-1])
    before, after, was = x[column], x[column + 1], answers[row, column]
    for _ in range(halvings):
        middle = (before + after) / 2
        same = lit(np.column_stack([middle, y[row]])) == was if len(row) else np.zeros(0, bool)
        before, after = np.where(same, middle, before), np.where(same, after, middle)
    turn = (before + after) / 2
    # row-major order: the edges of a line come in pairs, and it is lit from the even to the odd one
    return np.column_stack([y[row[::2]], turn[::2], turn[1::2]]), 1 / lines_per_px


def exposed(image_at: Callable[[float], Array], opens: Array, closes: Array, instants: int = 129) -> Array:
    """Return the time integral (H, W) [s] of instantaneous images, each row over its own window.

    ``opens``, ``closes`` (H,) [s]: when each row begins and ends to collect light (none where they cross). A cubic
    spline in time through the images at equally spaced instants over all windows is integrated exactly.
    """
    some = closes > opens
    if not some.any():
        return np.zeros_like(image_at(0.0))
    times = np.linspace(opens[some].min(), closes[some].max(), instants)
    stack = np.array([image_at(t) for t in times])
    out = np.zeros(stack.shape[1:])
    for row in np.flatnonzero(some):
        out[row] = CubicSpline(times, stack[:, row]).integrate(opens[row], closes[row])
    return out


def row_windows(
    height: int,
    length_s: float,
    row_time_s: float,
    light_s: tuple[float, float] = (-np.inf, np.inf),
    lit_s: tuple[float, float] = (-np.inf, np.inf),
) -> tuple[Array, Array]:
    """Return when each row (H,) collects light: from row * row_time for length_s, while lamp and target shine."""
    start = np.arange(height) * row_time_s
    opens = np.maximum(start, max(light_s[0], lit_s[0]))
    return opens, np.maximum(np.minimum(start + length_s, min(light_s[1], lit_s[1])), opens)
