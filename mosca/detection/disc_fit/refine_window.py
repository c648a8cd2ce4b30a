"""Compiled first look at the pixels around a region: what is not its own, sums over the rest.

Compiled into the kernel in ``mosca.detection.disc_fit.fit_regions``.
"""

from typing import Any

import numpy as np

from mosca.data.arrays import Array
from mosca.detection.disc_fit.gauss_newton import FAST, ONE, ZERO, f32
from mosca.detection.disc_fit.pixels import V, X, Y
from mosca.numba_support.decorators import bare_step


@bare_step(fastmath=FAST)
def blank(
    image: Array, runs: Array, place: tuple[int, int], floor: int, full: float, side: int, marks: Array
) -> tuple[int, int]:
    """Mark in ``marks[0]`` (side * side,), centred on ``place``, what does not belong into the fit of a region.

    That are saturated pixels, and pixels above ``floor`` that are not the region's own with what lies around
    them: 2 px, as far as a blurred edge reaches below the floor; 1 px where it is the region's own. Row follows
    row without a gap, so that what lies around a pixel in one of the two outermost columns is marked in the next
    row too: they are not to be used. ``marks`` (4, side * side or more): the others are scratch. Returns the first
    column and row in the image.
    """
    height, width = len(image), len(image[0])
    left, top = place[0] - side // 2, place[1] - side // 2
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
    # 1 px to all sides, then another
    grow(others, wide, n, side)
    for k in range(n):
        out[k] |= wide[k]
    grow(wide, others, n, side)
    for k in range(n):
        out[k] |= others[k] & (own[k] ^ 1)
    return left, top


@bare_step(fastmath=FAST)
def grow(marks: Array, grown: Array, n: int, side: int) -> None:
    """Write to ``grown`` the marks (n,) of a window and those of their 8 neighbours, 0 in the first and last row."""
    for k in range(side + 1):
        grown[k] = grown[n - 1 - k] = 0
    # of unsigned numbers none counts from the end, so that the compiler may take many at once
    one, row = np.uint64(1), np.uint64(side)
    for k in range(n - 2 * side - 2):
        i = np.uint64(k)
        above = marks[i] | marks[i + one] | marks[i + one + one]
        i += row
        here = marks[i] | marks[i + one] | marks[i + one + one]
        middle = i + one
        i += row
        grown[middle] = above | here | marks[i] | marks[i + one] | marks[i + one + one]


@bare_step(fastmath=True)  # only grey values go in
def window_sums(n: int, pixels: Array, threshold: int, level: float) -> tuple[Any, ...]:
    """Return the number of pixels above a threshold, their peak, and the sums (1, x, y, xx, xy, yy) of v - level."""
    x, y, v = pixels[X], pixels[Y], pixels[V]
    limit, base = f32(threshold), f32(level)
    count = s = sx = sy = sxx = sxy = syy = ZERO
    peak = np.int32(0)  # the largest of whole numbers is found many at once, that of others is not
    for i in range(n):
        inside = ONE if v[i] > limit else ZERO
        light = inside * (v[i] - base)
        lx, ly = light * x[i], light * y[i]
        count += inside
        s += light
        sx += lx
        sy += ly
        sxx += lx * x[i]
        sxy += lx * y[i]
        syy += ly * y[i]
    for i in range(n):
        peak = max(peak, np.int32(v[i]))
    return np.int64(count), f32(peak), (s, sx, sy, sxx, sxy, syy)


@bare_step(fastmath=FAST)
def region_sums(image: Array, runs: Array, place: tuple[int, int], level: float) -> tuple[Any, ...]:
    """Return peak and sums as ``window_sums`` for the pixels of a region, about the pixel ``place``."""
    base = f32(level)
    s = sx = sy = sxx = sxy = syy = peak = ZERO
    for i in range(len(runs)):
        py = f32(runs[i, 0] - place[1])
        for column in range(runs[i, 1], runs[i, 2]):
            value, px = f32(image[runs[i, 0], column]), f32(column - place[0])
            light = value - base
            s += light
            sx += light * px
            sy += light * py
            sxx += light * px * px
            sxy += light * px * py
            syy += light * py * py
            peak = max(peak, value)
    return peak, (s, sx, sy, sxx, sxy, syy)


@bare_step(fastmath=FAST)
def box_of(runs: Array, begin: int, end: int) -> tuple[tuple[Any, Any, Any, Any], Any]:
    """Return left, right, top and bottom pixel of the region of these runs, and its number of pixels."""
    left, right, n = runs[begin, 1], runs[begin, 2], np.int64(0)
    for i in range(begin, end):
        left = min(left, runs[i, 1])
        right = max(right, runs[i, 2])
        n += runs[i, 2] - runs[i, 1]
    return (np.int64(left), np.int64(right - 1), np.int64(runs[begin, 0]), np.int64(runs[end - 1, 0])), n


@bare_step(fastmath=FAST)
def corner_level(image: Array, box: tuple[Any, Any, Any, Any], floor: int) -> float:
    """Return the mean grey value of the dark pixels two px off the corners of a box, ``floor`` where none is."""
    left, right, top, bottom = box
    height, width = image.shape
    total, n = 0.0, 0
    for y in (max(top - 2, 0), min(bottom + 2, height - 1)):
        for x in (max(left - 2, 0), min(right + 2, width - 1)):
            if image[y, x] <= floor:
                total += image[y, x]
                n += 1
    return total / n if n > 0 else float(floor)
