"""Compiled gathering of the pixels around a region, and first sums over them.

The kernel in ``mosca.refine_kernels`` compiles this in, and Numba keeps a cached kernel as long as *its own* file is
unchanged: after a change here, remove the ``__pycache__`` folder beside this file.
"""

import math
from typing import Any

import numpy as np

from mosca.data.arrays import Array
from mosca.refine_fit import ONE, ZERO, f32, pixel_step, step

OWN, OUT = 1, 2
"""Marks of ``blank``: the region's own pixels, and those to be left out."""


@step
def blank(
    image: Array, runs: Array, place: tuple[int, int], floor: int, full: float, out: Array
) -> tuple[int, int]:
    """Mark in ``out`` (side, side), centred on ``place``, what does not belong into the fit of a region.

    That are saturated pixels, and pixels above ``floor`` that are not the region's own with what lies around
    them: 2 px, as far as a blurred edge reaches below the floor; 1 px where it is the region's own. Returns the
    first column and row of ``out`` in the image.
    """
    side = len(out)
    height, width = len(image), len(image[0])
    left, top = place[0] - side // 2, place[1] - side // 2
    out[:, :] = 0
    for i in range(len(runs)):
        j = runs[i, 0] - top
        if 0 <= j < side:
            for k in range(max(int(runs[i, 1]) - left, 0), min(int(runs[i, 2]) - left, side)):
                out[j, k] = OWN
    for j in range(max(-top, 0), min(height - top, side)):
        for k in range(max(-left, 0), min(width - left, side)):
            value = image[top + j, left + k]
            if value >= full:
                out[j, k] |= OUT
            if value > floor and not out[j, k] & OWN:
                for q in range(max(j - 2, 0), min(j + 3, side)):
                    for p in range(max(k - 2, 0), min(k + 3, side)):
                        if not out[q, p] & OWN or max(abs(q - j), abs(p - k)) < 2:
                            out[q, p] |= OUT
    return left, top


@step
def copy_eight(line: Array, k: Any, v: Array, at: Any) -> None:
    """Copy eight grey values; all are read before one is written, so that the compiler may do it at once."""
    one, two, three, four = np.uint64(1), np.uint64(2), np.uint64(3), np.uint64(4)
    five, six, seven = np.uint64(5), np.uint64(6), np.uint64(7)
    a, b, c, d = line[k], line[k + one], line[k + two], line[k + three]
    e, f, g, h = line[k + four], line[k + five], line[k + six], line[k + seven]
    v[at], v[at + one], v[at + two], v[at + three] = f32(a), f32(b), f32(c), f32(d)
    v[at + four], v[at + five], v[at + six], v[at + seven] = f32(e), f32(f), f32(g), f32(h)


@step
def gather(image: Array, place: tuple[int, int], reach: float, xyv: tuple[Array, Array, Array, Array]) -> int:
    """Copy the pixels within ``reach`` of the pixel ``place``, and their offsets from it; return how many."""
    x, y, v, _ = xyv
    height, width = image.shape
    column, row = place
    n = 0
    whole = int(reach)
    reach2 = f32(reach * reach)
    for j in range(max(row - whole, 0), min(row + whole + 1, height)):
        fy = f32(j - row)
        half = int(math.sqrt(max(reach2 - fy * fy, ZERO)))
        first, end = max(column - half, 0), min(column + half + 1, width)
        line = image[j]
        if first + (end - first + 7) // 8 * 8 <= width:
            # eight at a time; what is written beyond the end is overwritten by the next row
            for k in range(first, end, 8):
                copy_eight(line, np.uint64(k), v, np.uint64(n + k - first))
            for k in range(first, end, 8):
                at = np.uint64(n + k - first)
                fx = f32(k - column)
                for i in range(8):
                    x[at + np.uint64(i)] = fx + f32(i)
                    y[at + np.uint64(i)] = fy
        else:
            for k in range(first, end):
                x[n + k - first], y[n + k - first], v[n + k - first] = f32(k - column), fy, f32(line[k])
        n += end - first
    return n


@pixel_step
def window_sums(
    n: int, xyv: tuple[Array, Array, Array, Array], threshold: int, level: float
) -> tuple[Any, ...]:
    """Return the number of pixels above a threshold, their peak, and the sums (1, x, y, xx, xy, yy) of v - level."""
    x, y, v, _ = xyv
    limit, base = f32(threshold), f32(level)
    count = peak = s = sx = sy = sxx = sxy = syy = ZERO
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
        peak = max(peak, v[i])
    return np.int64(count), peak, (s, sx, sy, sxx, sxy, syy)


@step
def gather_unmarked(
    image: Array,
    place: tuple[int, int],
    shape: tuple[float, float, float],
    around: tuple[float, float],
    reach: float,
    marks: tuple[Array, int, int],
    xyv: tuple[Array, Array, Array, Array],
) -> int:
    """Copy the pixels that ``blank`` leaves and that lie within ``reach`` of a target; return how many.

    Pixel offsets from ``place`` are turned by the symmetric matrix ``shape`` (xx, xy, yy), in which the target is
    round, and ``around`` is its middle there. ``marks``: the ``out`` of ``blank``, its first column and row.
    """
    x, y, v, sharper = xyv
    height, width = image.shape
    out, left, top = marks
    n = 0
    first_row, end_row = rows_within(shape, around, reach)
    for j in range(max(place[1] + first_row, 0, top), min(place[1] + end_row, height, top + len(out))):
        first, end = span_within(shape, around, reach, j - place[1])
        for i in range(max(place[0] + first, 0, left), min(place[0] + end, width, left + len(out))):
            if not out[j - top, i - left] & OUT:
                dx, dy = i - place[0], j - place[1]
                px, py = shape[0] * dx + shape[1] * dy, shape[1] * dx + shape[2] * dy
                x[n], y[n], v[n] = f32(px), f32(py), f32(image[j, i])
                # turned with the target, the round blur becomes narrower to one side, wider to the other
                qx, qy = px - around[0], py - around[1]
                wide = math.hypot(shape[0] * qx + shape[1] * qy, shape[1] * qx + shape[2] * qy)
                sharper[n] = f32((math.hypot(qx, qy) + 1e-3) / (wide + 1e-3))
                n += 1
    return n


@step
def half_side(shape: tuple[float, float, float], around: tuple[float, float], reach: float) -> int:
    """Return how far from the middle pixel ``gather_unmarked`` looks, and ``blank`` for what lies around that."""
    first_row, end_row = rows_within(shape, around, reach)
    first, end = rows_within((shape[2], shape[1], shape[0]), (around[1], around[0]), reach)
    return int(max(-first_row, end_row, -first, end)) + 2


@step
def rows_within(
    shape: tuple[float, float, float], around: tuple[float, float], reach: float
) -> tuple[int, int]:
    """Return the first and the end row in which pixel offsets d have ``|M d - around| <= reach``."""
    m0, m1, m2 = shape
    det = m0 * m2 - m1 * m1
    middle, half = (m0 * around[1] - m1 * around[0]) / det, reach * math.sqrt(m0 * m0 + m1 * m1) / abs(det)
    return math.ceil(middle - half), math.floor(middle + half) + 1


@step
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


@step
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


@step
def box_of(runs: Array) -> tuple[tuple[Any, Any, Any, Any], Any]:
    """Return a region's left, right, top and bottom pixel, and its number of pixels."""
    left, right, n = runs[0, 1], runs[0, 2], np.int64(0)
    for i in range(len(runs)):
        left = min(left, runs[i, 1])
        right = max(right, runs[i, 2])
        n += runs[i, 2] - runs[i, 1]
    return (np.int64(left), np.int64(right - 1), np.int64(runs[0, 0]), np.int64(runs[-1, 0])), n


@step
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
