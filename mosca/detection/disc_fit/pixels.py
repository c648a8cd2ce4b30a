"""Compiled gathering of the pixels that a disc is fitted to: round windows, masks of neighbours, first sums.

Compiled into the kernel in ``mosca.detection.disc_fit.fit_regions``.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from mosca.data.arrays import Array
from mosca.detection.disc_fit.disc_image import FAST, ONE, ZERO, f32, parts_of
from mosca.numba_support.decorators import bare_step
from mosca.numba_support.intrinsics import array_at, copy_16

STEEP_PX = f32(1e-3)  # keeps the ratio of two distances from the middle finite at the middle
X, Y, SHARPER, THERE, V = range(5)
"""Rows of the pixels that a fit takes (5, n): offsets [px], factor by which the edge is sharper there, 1, or 0 for
padding, and grey value [DN]. The last is written 16 at a time: at least as many elements must follow it."""
OVER = 16
EDGE_BLURS, EDGE_PX, EDGE_SHARP_PX = 1.6, 0.5, 1.5
"""How far a fit's window reaches beyond half the region's box, in blurs and in pixels: the box itself goes past the
disc's edge by about 1.2 blurs. The last takes the place of the second where edges are sharper than a pixel: small
targets would leave too few dark pixels otherwise."""
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
    """Return the place of a window as ``window_place``; make the window where it is the first of its size."""
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
