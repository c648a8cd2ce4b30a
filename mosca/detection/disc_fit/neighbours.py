"""Compiled gathering of a target's pixels without those of its neighbours: marks, and pixels that are mapped.

Compiled into the kernel in ``mosca.detection.disc_fit.fit_regions``.
"""

import math

import numpy as np

from mosca.data.arrays import Array
from mosca.detection.disc_fit.disc_image import FAST, f32
from mosca.detection.disc_fit.pixels import SHARPER, STEEP_PX, V, X, Y
from mosca.detection.search import is_sure
from mosca.numba_support.decorators import bare_step


@bare_step(fastmath=FAST)
def gather_unmarked(
    image: Array,
    centre: tuple[int, int],
    shape: tuple[float, float, float],
    around: tuple[float, float],
    reach: float,
    out: Array,
    side: int,
    pixels: Array,
) -> int:
    """Copy the pixels that are not marked in ``out`` and lie within ``reach`` of a target; return how many.

    Pixel offsets from ``centre`` are mapped by the symmetric matrix ``shape`` (xx, xy, yy), in which the target is
    round, and ``around`` is its middle there. ``out`` (side * side,): see ``mark_foreign``.
    """
    x, y, sharper, v = pixels[X], pixels[Y], pixels[SHARPER], pixels[V]
    height, width = image.shape
    left, top = centre[0] - side // 2, centre[1] - side // 2
    n = 0
    first_row, end_row = rows_within(shape, around, reach)
    for j in range(max(centre[1] + first_row, 0, top), min(centre[1] + end_row, height, top + side)):
        first, end = span_within(shape, around, reach, j - centre[1])
        line, at, dy = image[j], (j - top) * side - left, float(j - centre[1])
        for i in range(max(centre[0] + first, 0, left), min(centre[0] + end, width, left + side)):
            dx = float(i - centre[0])
            x[n], y[n] = f32(shape[0] * dx + shape[1] * dy), f32(shape[1] * dx + shape[2] * dy)
            v[n] = f32(line[i])
            n += out[at + i] == 0
    # the map that makes the target round makes the blur elliptic
    m0, m1, m2, ax, ay = f32(shape[0]), f32(shape[1]), f32(shape[2]), f32(around[0]), f32(around[1])
    for i in range(n):
        qx, qy = x[i] - ax, y[i] - ay
        wx, wy = m0 * qx + m1 * qy, m1 * qx + m2 * qy
        sharper[i] = (math.sqrt(qx * qx + qy * qy) + STEEP_PX) / (math.sqrt(wx * wx + wy * wy) + STEEP_PX)
    return n


@bare_step(fastmath=FAST)
def half_side(shape: tuple[float, float, float], around: tuple[float, float], reach: float) -> int:
    """Return how far from its middle pixel ``gather_unmarked`` takes pixels, and 2 px more for ``mark_foreign``."""
    first_row, end_row = rows_within(shape, around, reach)
    first, end = rows_within((shape[2], shape[1], shape[0]), (around[1], around[0]), reach)
    return int(max(-first_row, end_row, -first, end)) + 2


@bare_step(fastmath=FAST)
def rows_within(shape: tuple[float, float, float], around: tuple[float, float], reach: float) -> tuple[int, int]:
    """Return the first and the end row in which pixel offsets d have ``|M d - around| <= reach``."""
    m0, m1, m2 = shape
    det = m0 * m2 - m1 * m1
    middle, half = (m0 * around[1] - m1 * around[0]) / det, reach * math.sqrt(m0 * m0 + m1 * m1) / abs(det)
    return math.ceil(middle - half), math.floor(middle + half) + 1


@bare_step(fastmath=FAST)
def span_within(
    shape: tuple[float, float, float], around: tuple[float, float], reach: float, row: int
) -> tuple[int, int]:
    """Return the first and the end column of a row in which ``|M d - around| <= reach``."""
    m0, m1, m2 = shape
    a = m0 * m0 + m1 * m1
    p, q = m1 * row - around[0], m2 * row - around[1]
    half_b = m0 * p + m1 * q
    d = half_b * half_b - a * (p * p + q * q - reach * reach)
    if d <= 0.0:
        return 0, 0
    half = math.sqrt(d)
    return math.ceil((-half_b - half) / a), math.floor((-half_b + half) / a) + 1


@bare_step(fastmath=FAST)
def sure_pixels(n: int, pixels: Array, behind: Array, middle: tuple[int, int], floor: int, dark_dn2: float) -> int:
    """Return how many of n pixels are above ``floor``, and above what an unknown background explains."""
    count = 0
    for i in range(n):
        over = pixels[V, i] - floor
        if over > 0:
            row, column = middle[1] + int(pixels[Y, i]), middle[0] + int(pixels[X, i])
            count += is_sure(over, behind[1, row, column], dark_dn2)
    return count


@bare_step(fastmath=FAST)
def mark_foreign(
    image: Array,
    behind: Array,
    runs: Array,
    centre: tuple[int, int],
    limits: tuple[int, float, float],
    side: int,
    marks: Array,
) -> None:
    """Mark in ``marks[0]`` (side * side,), centred on the pixel ``centre``, what is left out of the fit of a region.

    Marked are saturated pixels and foreign ones: pixels that are not the region's own and are above the floor, and
    above what an unknown background explains. The foreign pixels are dilated by 2 px, as far as a blurred edge
    reaches below the floor; by 1 px where the dilation covers the region's own. Rows follow each other without a gap,
    so the dilation of a pixel in one of the two outermost columns is marked in the next row too: these columns are
    not to be used. ``behind``: as in ``take_behind``; ``limits``: floor and saturation [DN], and the variance of a
    pixel [DN^2]; ``marks`` (4, side * side or more): the other rows are working memory.
    """
    floor, full, dark_dn2 = limits
    height, width = len(image), len(image[0])
    left, top = centre[0] - side // 2, centre[1] - side // 2
    n = side * side
    out, own, others, wide = marks[0], marks[1], marks[2], marks[3]
    for k in range(n):
        out[k] = own[k] = others[k] = 0
    for i in range(len(runs)):
        j = runs[i, 0] - top
        if 0 <= j < side:
            for k in range(max(int(runs[i, 1]) - left, 0), min(int(runs[i, 2]) - left, side)):
                own[j * side + k] = 1
    first, end = max(-left, 0), min(width - left, side)
    for j in range(max(-top, 0), min(height - top, side)):
        line, at = image[top + j], np.uint64(j * side + first)
        for k in range(end - first):
            value = line[np.uint64(left + first) + np.uint64(k)]
            out[at + np.uint64(k)] = value >= full
            others[at + np.uint64(k)] = (value > floor) & (own[at + np.uint64(k)] == 0)
        for k in range(end - first if len(behind) > 0 else 0):
            over = int(line[left + first + k]) - floor
            if over > 0 and not is_sure(over, behind[1, top + j, left + first + k], dark_dn2):
                others[at + np.uint64(k)] = 0
    # by 1 px to all sides, then by another
    dilate(others, wide, n, side)
    for k in range(n):
        out[k] |= wide[k]
    dilate(wide, others, n, side)
    for k in range(n):
        out[k] |= others[k] & (own[k] ^ 1)


@bare_step(fastmath=FAST)
def dilate(marks: Array, grown: Array, n: int, side: int) -> None:
    """Write to ``grown`` the marks (n,) of a window and those of their 8 neighbours, 0 in the first and last row."""
    for k in range(side + 1):
        grown[k] = grown[n - 1 - k] = 0
    # unsigned indices cannot be negative, so that the compiler can vectorise
    one, row = np.uint64(1), np.uint64(side)
    for k in range(n - 2 * side - 2):
        i = np.uint64(k)
        above = marks[i] | marks[i + one] | marks[i + one + one]
        i += row
        here = marks[i] | marks[i + one] | marks[i + one + one]
        middle = i + one
        i += row
        grown[middle] = above | here | marks[i] | marks[i + one] | marks[i + one + one]
