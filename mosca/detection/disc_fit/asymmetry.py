"""Compiled: residuals of a fitted disc less those at the opposite side of its centre.

Dark limbs, defocus, motion while the shutter is open: such images are no discs, but ``I(c + d) = I(c - d)``. What
the disc leaves of them is even about the centre: it is not in these differences, which hold noise, an error of the
centre, and what really is odd, such as a hidden part or a neighbour's light. The point opposite to a pixel lies
between four others.
"""

import math
from typing import Any, NamedTuple

from mosca.data.arrays import Array
from mosca.detection.disc_fit.disc_image import FAST, ONE, ZERO, disc_image, f32
from mosca.detection.disc_fit.gauss_newton import DiscFit, Model, Workspace
from mosca.numba_support.decorators import bare_step

RESIDUAL, SIGNAL, THERE = 5, 6, 7
"""Rows of a fit's image, on the grid of pixels: residuals, the target's light [DN], and whether there is a pixel."""
FEWEST = 8
"""Differences from which the misfit of the odd part is known."""


class Grid(NamedTuple):
    """The square of pixels around a target, row by row."""

    side: int
    """0 where the working memory does not hold it."""
    middle: int
    """Number of the pixel with the offset (0, 0)."""
    opposite: int
    """Sum of the numbers of a pixel and of the upper left one of the four around the point opposite to it."""
    weights: tuple[Any, Any, Any, Any]
    """Of those four, row by row."""
    inverse: tuple[float, float, float]
    """Symmetric matrix (xx, xy, yy) from the pixels' places in the map to offsets."""


class Difference(NamedTuple):
    """Residual of a pixel less that at the opposite point [DN]."""

    there: bool
    """Whether the pixel counts: it has an opposite, of which it is the first."""
    number: int
    """Its number in the grid."""
    value: Any
    dark: Any
    """Its dark variance over that of a pixel."""
    signal: Any
    """Its photon variance over the gain."""


@bare_step(fastmath=FAST)
def number_of(i: int, pixels: Array, grid: Grid) -> int:
    """Return the number of pixel i in the grid."""
    i0, i1, i2 = grid.inverse
    x, y = pixels[0, i], pixels[1, i]
    return int(grid.middle + round(i1 * x + i2 * y) * grid.side + round(i0 * x + i1 * y))


@bare_step(fastmath=FAST)
def lay_out(n: int, pixels: Array, fit: DiscFit, shape: tuple[float, float, float], work: Workspace) -> Grid:
    """Write what a fit leaves of n pixels to a grid, and the disc's image as ``disc_image`` does."""
    image = work.image
    there, v, share = pixels[3], pixels[4], image[0]
    disc_image(n, pixels, (f32(fit.x), f32(fit.y), f32(fit.radius), f32(fit.blur)), shape, image)
    m0, m1, m2 = shape
    det = m0 * m2 - m1 * m1
    inverse = (m2 / det, -m1 / det, m0 / det)
    across, down = 2.0 * (inverse[0] * fit.x + inverse[1] * fit.y), 2.0 * (inverse[1] * fit.x + inverse[2] * fit.y)
    half = 0
    for i in range(n):
        column = round(inverse[0] * pixels[0, i] + inverse[1] * pixels[1, i])
        half = max(half, abs(column), abs(round(inverse[1] * pixels[0, i] + inverse[2] * pixels[1, i])))
    # opposite points reach past it by the centre's offset
    side = 2 * half + 1
    column, row = math.floor(across), math.floor(down)
    fx, fy = f32(across - column), f32(down - row)
    middle = half * side + half
    weights = ((ONE - fx) * (ONE - fy), fx * (ONE - fy), (ONE - fx) * fy, fx * fy)
    grid = Grid(side, middle, 2 * middle + row * side + column, weights, inverse)
    if side * side > len(image[THERE]):
        return Grid(0, middle, 0, weights, inverse)
    for k in range(side * side):
        image[THERE, k] = ZERO
    a, b = f32(fit.amplitude), f32(fit.background)
    for i in range(n):
        if there[i] > ZERO:
            k = number_of(i, pixels, grid)
            image[RESIDUAL, k], image[SIGNAL, k], image[THERE, k] = v[i] - b - a * share[i], a * share[i], ONE
    return grid


@bare_step(fastmath=FAST)
def less_opposite(k: int, values: Array, grid: Grid) -> Any:
    """Return the value on the grid at the pixel number k less that at the opposite point."""
    q, w, down = grid.opposite - k, grid.weights, grid.side
    return values[k] - w[0] * values[q] - w[1] * values[q + 1] - w[2] * values[q + down] - w[3] * values[q + down + 1]


@bare_step(fastmath=FAST)
def difference(i: int, pixels: Array, grid: Grid, image: Array) -> Difference:
    """Return the difference between pixel i and the opposite point; each pair of them is given once."""
    k = number_of(i, pixels, grid)
    q, known = grid.opposite - k, image[THERE]
    if pixels[3, i] == ZERO or k > q or q + grid.side + 1 >= grid.side * grid.side:
        return Difference(False, k, ZERO, ZERO, ZERO)
    if known[q] * known[q + 1] * known[q + grid.side] * known[q + grid.side + 1] == ZERO:
        return Difference(False, k, ZERO, ZERO, ZERO)
    dark, signal = ONE, image[SIGNAL, k]
    for j in range(4):
        at, w = q + (j & 1) + (j >> 1) * grid.side, grid.weights[j]
        dark += w * w
        signal += w * w * image[SIGNAL, at]
    return Difference(True, k, less_opposite(k, image[RESIDUAL], grid), dark, signal)


@bare_step(fastmath=FAST)
def asymmetry(
    n: int, pixels: Array, fit: DiscFit, model: Model, shape: tuple[float, float, float], work: Workspace
) -> Any:
    """Return the mean square of the differences over its expectation, infinite for too few.

    ``pixels``, ``shape``: as in ``disc_image``; overwrites ``work``.
    """
    grid = lay_out(n, pixels, fit, shape, work)
    dark, gain, total, count = f32(model.dark_dn2), f32(model.gain_dn), ZERO, 0
    for i in range(n if grid.side > 0 else 0):
        one = difference(i, pixels, grid, work.image)
        if one.there:
            total += one.value * one.value / (dark * one.dark + gain * one.signal)
            count += 1
    return total / f32(count) if count >= FEWEST else f32(math.inf)
