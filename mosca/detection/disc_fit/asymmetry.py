"""Compiled: residuals of a fitted disc less those at the opposite side of its centre.

Images with dark limbs, defocus or motion while the shutter is open are no discs, but have ``I(c + d) = I(c - d)``.
What the disc does not fit of them is even about the centre, so it cancels in these differences. They hold noise, an
error of the centre, and what is odd, such as a hidden part or a neighbour's light. The point opposite to a pixel lies
between four others.
"""

import math
from typing import Any, NamedTuple

from mosca.data.arrays import Array
from mosca.detection.disc_fit.disc_image import FAST, HALF, ONE, ZERO, disc_image, f32
from mosca.detection.disc_fit.gauss_newton import DiscFit, Model, Workspace
from mosca.numba_support.decorators import bare_step

RESIDUAL, SIGNAL, THERE, NUMBER = 5, 6, 7, 8
"""Rows of a fit's image. The first three are on the grid of pixels: residuals, the target's light [DN], and whether
there is a pixel. The last is the number of each pixel of the fit in the grid, -1 for padding."""
FEWEST = 8
"""Least number of differences from which the misfit of the odd part is estimated."""


class Grid(NamedTuple):
    """The square of pixels around a target, row by row."""

    side: int
    """Side of the square [px]; 0 where the working memory does not hold it."""
    opposite: int
    """Sum of the numbers of a pixel and of the upper left one of the four around the point opposite to it."""
    weights: tuple[Any, Any, Any, Any]
    """Weights of those four pixels, row by row."""


class Difference(NamedTuple):
    """Residual of a pixel less that at the opposite point [DN]."""

    there: bool
    """Whether the pixel counts: it has an opposite point and is the first of the two."""
    value: Any
    dark: Any
    """Dark variance of the difference over that of a pixel."""
    signal: Any
    """Photon variance of the difference over the gain."""


@bare_step(fastmath=FAST)
def lay_out(n: int, pixels: Array, fit: DiscFit, shape: tuple[float, float, float], work: Workspace) -> Grid:
    """Write the residuals of n pixels to a grid, and the disc's image as ``disc_image`` does."""
    image = work.image
    x, y, there, v, share = pixels[0], pixels[1], pixels[3], pixels[4], image[0]
    disc_image(n, pixels, (f32(fit.x), f32(fit.y), f32(fit.radius), f32(fit.blur)), fit.profile, shape, image)
    m0, m1, m2 = shape
    det = m0 * m2 - m1 * m1
    # from the pixels' places in the map to offsets
    i0, i1, i2 = f32(m2 / det), f32(-m1 / det), f32(m0 / det)
    across, down = 2.0 * (i0 * fit.x + i1 * fit.y), 2.0 * (i1 * fit.x + i2 * fit.y)
    farthest = ZERO
    for i in range(n):
        farthest = max(farthest, abs(i0 * x[i] + i1 * y[i]), abs(i1 * x[i] + i2 * y[i]))
    half = int(farthest + HALF)
    side = 2 * half + 1
    column, row = math.floor(across), math.floor(down)
    fx, fy = f32(across - column), f32(down - row)
    middle = half * side + half
    weights = ((ONE - fx) * (ONE - fy), fx * (ONE - fy), (ONE - fx) * fy, fx * fy)
    grid = Grid(side, 2 * middle + row * side + column, weights)
    if side * side > len(image[THERE]):
        return Grid(0, 0, weights)
    for k in range(side * side):
        image[THERE, k] = ZERO
    a, b, to_edge = f32(fit.amplitude), f32(fit.background), f32(half) + HALF
    for i in range(n):
        image[NUMBER, i] = -ONE
        if there[i] > HALF:  # below that its background is hardly known
            u, w = i0 * x[i] + i1 * y[i], i1 * x[i] + i2 * y[i]
            k = int(w + to_edge) * side + int(u + to_edge)
            image[NUMBER, i] = f32(k)
            image[RESIDUAL, k], image[SIGNAL, k], image[THERE, k] = v[i] - b - a * share[i], a * share[i], ONE
    return grid


@bare_step(fastmath=FAST)
def less_opposite(k: int, values: Array, grid: Grid) -> Any:
    """Return the value on the grid at the pixel number k less that at the opposite point."""
    q, w, down = grid.opposite - k, grid.weights, grid.side
    return values[k] - w[0] * values[q] - w[1] * values[q + 1] - w[2] * values[q + down] - w[3] * values[q + down + 1]


@bare_step(fastmath=FAST)
def has_opposite(k: int, grid: Grid, image: Array) -> bool:
    """Return whether the pixel number k has an opposite point and is the first of the two."""
    q, known = grid.opposite - k, image[THERE]
    if k < 0 or k > q or q + grid.side + 1 >= grid.side * grid.side:
        return False
    result: bool = known[q] * known[q + 1] * known[q + grid.side] * known[q + grid.side + 1] > ZERO
    return result


@bare_step(fastmath=FAST)
def difference(i: int, grid: Grid, image: Array) -> Difference:
    """Return the difference between pixel i and the opposite point; each pair of them is given once."""
    k = int(image[NUMBER, i])
    q = grid.opposite - k
    if not has_opposite(k, grid, image):
        return Difference(False, ZERO, ZERO, ZERO)
    dark, signal = ONE, image[SIGNAL, k]
    for j in range(4):
        at, w = q + (j & 1) + (j >> 1) * grid.side, grid.weights[j]
        dark += w * w
        signal += w * w * image[SIGNAL, at]
    return Difference(True, less_opposite(k, image[RESIDUAL], grid), dark, signal)


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
        one = difference(i, grid, work.image)
        if one.there:
            total += one.value * one.value / (dark * one.dark + gain * one.signal)
            count += 1
    return total / f32(count) if count >= FEWEST else f32(math.inf)
