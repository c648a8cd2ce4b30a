"""Compiled gathering of the pixels that a disc is fitted to: round windows, masks of neighbours, first sums.

Compiled into the kernel in ``mosca.detection.disc_fit.fit_regions``.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from mosca.data.arrays import Array
from mosca.detection.disc_fit.disc_image import FAST, ONE, ZERO, f32, parts_of
from mosca.detection.search import SEARCH_SIGMAS
from mosca.numba_support.decorators import bare_step
from mosca.numba_support.intrinsics import array_at, copy_16

STEEP_PX = f32(1e-3)  # keeps the ratio of two distances from the middle finite at the middle
X, Y, SHARPER, THERE, V = range(5)
"""Rows of the pixels that a fit takes (5, n): offsets [px], factor by which the edge is sharper there, 1, or 0 for
padding, and grey value [DN]. The last is written 16 at a time: at least as many elements must follow it."""
OVER = 16
EDGE_BLURS, EDGE_PX, EDGE_SHARP_PX = 1.6, 0.5, 1.5
"""How far a fit's window reaches beyond half the region's box, in blurs and in pixels: the box itself goes past the
disc's edge by about 1.2 blurs. The last where edges are sharper than a pixel: small targets leave too few dark pixels
otherwise."""
CORNER_PX = 2
"""How far off a box's corners the background's first estimate is taken."""


EVEN_DN2 = 1e-2
"""A background that rises by less than the root of this [DN] over a window's side is even."""


class RoundWindows(NamedTuple):
    """Pixels of round windows, one for each size of region that occurs in an image."""

    lanes: Array
    """(size,) float32: pixels (5, n) of all windows of an image, concatenated, n padded to a multiple of 8."""
    half: Array
    """(1 + sizes, most rows) int32: how far each row of a size's window reaches to both sides [px]."""
    known: Array
    """(1 + sizes, 2) int64: where a size's window begins in ``lanes``, negative before it is made, and its number of
    pixels. Row 0: where all windows end, and 0."""


class Marked(NamedTuple):
    """Square of pixels of which some are left out of a fit, see ``mark_foreign``."""

    side: int
    left: int
    """First column in the image [px]."""
    top: int
    """First row in the image [px]."""


@bare_step(fastmath=FAST)
def gather(image: Array, centre: tuple[int, int], reach2: float, pixels: Array) -> int:
    """Copy the pixels within the root of ``reach2`` of the pixel ``centre`` and their offsets; return how many."""
    x, y, v = pixels[X], pixels[Y], pixels[V]
    height, width = image.shape
    column, row = centre
    n = 0
    whole = int(math.sqrt(reach2))
    for j in range(max(row - whole, 0), min(row + whole + 1, height)):
        half = int(math.sqrt(reach2 - (j - row) ** 2))
        line = image[j]
        for k in range(max(column - half, 0), min(column + half + 1, width)):
            x[n], y[n], v[n] = f32(k - column), f32(j - row), f32(line[k])
            n += 1
    return n


@bare_step(fastmath=FAST)
def pad(n: int, pixels: Array) -> None:
    """Mark n pixels as there and those up to the next multiple of 8, which sums take at once, as padding."""
    x, y, sharper, there, v = pixels[X], pixels[Y], pixels[SHARPER], pixels[THERE], pixels[V]
    end = (n + 7) // 8 * 8
    for i in range(n):
        there[i] = ONE
    for i in range(n, end):
        x[i] = y[i] = v[i] = there[i] = ZERO
        sharper[i] = ONE


@bare_step(fastmath=FAST)
def window_place(size: int, windows: RoundWindows) -> tuple[Any, Any]:
    """Return the address (uint64) of the pixels (5, n) of the window of a size of region, and n."""
    begin = np.uint64(windows.known[size, 0] * windows.lanes.itemsize)
    return np.uint64(windows.lanes.ctypes.data) + begin, (windows.known[size, 1] + 7) // 8 * 8


@bare_step(fastmath=FAST)
def make_window(size: int, reach2: float, windows: RoundWindows) -> None:
    """Write the pixels that ``gather`` takes off the image's border as the window of this size of region."""
    half, known = windows.half, windows.known
    begin, n = known[0, 0], 0
    whole = int(math.sqrt(reach2))
    for j in range(-whole, whole + 1):
        half[size, j + whole] = int(math.sqrt(reach2 - j * j))
        n += 2 * half[size, j + whole] + 1
    known[size, 0], known[size, 1] = begin, n
    address, columns = window_place(size, windows)
    pixels = array_at(address, windows.lanes, (5, columns))
    known[0, 0] = begin + pixels.size + OVER
    x, y, sharper = pixels[X], pixels[Y], pixels[SHARPER]
    n = 0
    for j in range(-whole, whole + 1):
        for k in range(-half[size, j + whole], half[size, j + whole] + 1):
            x[n], y[n], sharper[n] = f32(k), f32(j), ONE
            n += 1
    pad(n, pixels)


@bare_step(fastmath=FAST)
def made_window(size: int, reach: float, windows: RoundWindows) -> tuple[Any, Any]:
    """Return the place of a window as ``window_place``, which is made where it is the first of its size."""
    if windows.known[size, 0] < 0:
        make_window(size, reach * reach, windows)
    address, columns = window_place(size, windows)
    return address, columns


@bare_step(fastmath=FAST)
def grey_values(image: Array, centre: int, half: Array, v: Array) -> None:
    """Copy the grey values of the rows of a round window about the pixel number ``centre``, 16 at a time.

    Up to 15 more than a row has are read, and overwritten by the next row's.
    """
    width = image.shape[1]
    n, middle = 0, centre - (len(half) // 2) * width
    source, target = np.uint64(image.ctypes.data), np.uint64(v.ctypes.data)
    for j in range(len(half)):
        wide = int(half[j])
        count, at = 2 * wide + 1, middle - wide
        for k in range(0, count, 16):
            p, q = np.uint64((at + k) * image.itemsize), np.uint64((n + k) * v.itemsize)
            copy_16(source + p, image, target + q, v)
        n += count
        middle += width


@bare_step(fastmath=FAST)
def reach_of(size: int, blur: float) -> float:
    """Return how far the fit of a region reaches: its box goes past the edge by about 1.2 blurs."""
    return 0.5 * size + EDGE_BLURS * blur + (EDGE_PX if parts_of(blur) == 1 else EDGE_SHARP_PX)


@bare_step(fastmath=FAST)
def is_inside(image: Array, centre: tuple[int, int], reach: float) -> bool:
    """Return whether the round window about a pixel lies inside the image, with ``OVER`` pixels after it."""
    height, width = image.shape
    far = int(reach)
    middle = centre[1] * width + centre[0]
    inside = far <= centre[0] < width - far and far <= centre[1] < height - far
    result: bool = inside and middle + far * (width + 1) + OVER <= image.size
    return result


@bare_step(fastmath=FAST)
def fill_window(
    image: Array, centre: tuple[int, int], size: int, reach: float, windows: RoundWindows, pixels: Array
) -> int:
    """Copy the grey values about the pixel ``centre`` into the window (5, n) of this size; return how many."""
    far = int(reach)
    middle = centre[1] * image.shape[1] + centre[0]
    n: int = windows.known[size, 1]
    grey_values(image, middle, windows.half[size, : 2 * far + 1], pixels[V])
    for i in range(n, len(pixels[V])):
        pixels[V, i] = ZERO
    return n


@bare_step(fastmath=FAST)
def level_pixels(n: int, pixels: Array, slope: tuple[float, float]) -> None:
    """Take the slope of the background [DN/px] out of the grey values of n pixels, about the offset (0, 0)."""
    if (slope[0] * slope[0] + slope[1] * slope[1]) * n < EVEN_DN2:
        return
    x, y, v = pixels[X], pixels[Y], pixels[V]
    a, b = f32(slope[0]), f32(slope[1])
    for i in range(n):
        v[i] -= a * x[i] + b * y[i]


@bare_step(fastmath=FAST)
def gather_at_border(image: Array, centre: tuple[int, int], reach: float, pixels: Array) -> int:
    """Copy the pixels of the image within ``reach`` of the pixel ``centre``, padded; return how many."""
    n: int = gather(image, centre, reach * reach, pixels)
    for i in range(n):
        pixels[SHARPER, i] = ONE
    pad(n, pixels)
    return n


@bare_step(fastmath=FAST)
def gather_unmarked(
    image: Array,
    centre: tuple[int, int],
    shape: tuple[float, float, float],
    around: tuple[float, float],
    reach: float,
    out: Array,
    marked: Marked,
    pixels: Array,
) -> int:
    """Copy the pixels that are not marked in ``out`` and lie within ``reach`` of a target; return how many.

    Pixel offsets from ``centre`` are mapped by the symmetric matrix ``shape`` (xx, xy, yy), in which the target is
    round, and ``around`` is its middle there. ``out`` (side * side,) and ``marked``: see ``mark_foreign``.
    """
    x, y, sharper, v = pixels[X], pixels[Y], pixels[SHARPER], pixels[V]
    height, width = image.shape
    side, left, top = marked.side, marked.left, marked.top
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
def is_sure(over: Any, error: Any, dark_dn2: float) -> bool:
    """Return whether a pixel that is ``over`` the limit of noise alone [DN] is also above the background's error."""
    result: bool = over > SEARCH_SIGMAS * (math.sqrt(dark_dn2 + error * error) - math.sqrt(dark_dn2))
    return result


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
) -> Marked:
    """Mark in ``marks[0]`` (side * side,), centred on the pixel ``centre``, what is left out of the fit of a region.

    These are saturated pixels, and pixels above the floor, and above what an unknown background explains, that are
    not the region's own, dilated by 2 px, as far as a blurred edge reaches below the floor; by 1 px where the
    dilation covers the region's own. Row follows row without a gap, so that the dilation of a pixel in one of the two
    outermost columns is marked in the next row too: they are not to be used. ``behind``: as in ``take_behind``;
    ``limits``: floor and saturation [DN], and the variance of a pixel [DN^2]; ``marks`` (4, side * side or more): the
    other rows are working memory.
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
    return Marked(side, left, top)


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


@bare_step(fastmath=True)  # only grey values go in
def window_sums(n: int, pixels: Array, threshold: int, level: float) -> tuple[Any, ...]:
    """Return the number of pixels above a threshold, their peak, and the sums (1, x, y, xx, xy, yy) of v - level."""
    x, y, v = pixels[X], pixels[Y], pixels[V]
    limit, base = f32(threshold), f32(level)
    count = s = sx = sy = sxx = sxy = syy = ZERO
    peak = np.int32(0)  # the maximum of integers vectorises, that of floats does not
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
def region_sums(image: Array, runs: Array, centre: tuple[int, int], level: float) -> tuple[Any, ...]:
    """Return peak and sums as ``window_sums`` for the pixels of a region, about the pixel ``centre``."""
    base = f32(level)
    s = sx = sy = sxx = sxy = syy = peak = ZERO
    for i in range(len(runs)):
        py = f32(runs[i, 0] - centre[1])
        for column in range(runs[i, 1], runs[i, 2]):
            value, px = f32(image[runs[i, 0], column]), f32(column - centre[0])
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
def corner_background(image: Array, box: tuple[Any, Any, Any, Any], floor: int) -> float:
    """Return the mean grey value of the dark pixels ``CORNER_PX`` off a box's corners, ``floor`` where none is."""
    left, right, top, bottom = box
    height, width = image.shape
    total, n = 0.0, 0
    for y in (max(top - CORNER_PX, 0), min(bottom + CORNER_PX, height - 1)):
        for x in (max(left - CORNER_PX, 0), min(right + CORNER_PX, width - 1)):
            if image[y, x] <= floor:
                total += image[y, x]
                n += 1
    return total / n if n > 0 else float(floor)
