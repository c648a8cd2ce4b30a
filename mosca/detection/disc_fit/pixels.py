"""Compiled gathering of the pixels that a target is fitted to.

Compiled into the kernel in ``mosca.detection.disc_fit.fit_regions``.
"""

import math
from typing import NamedTuple

import numpy as np

from mosca.data.arrays import Array
from mosca.detection.disc_fit.gauss_newton import FAST, ONE, ZERO, f32
from mosca.numba_support.decorators import bare_step, step
from mosca.numba_support.intrinsics import copy_16, image_at

SMALL = f32(1e-3)
X, Y, SHARPER, THERE, V = range(5)
"""Rows of the pixels that a fit takes (5, n): offsets [px], how much sharper the edge is there, 1, or 0 where there
is only padding, and grey value. The last is written 16 at a time: room for as many must follow."""
OVER = 16


class Windows(NamedTuple):
    """Round windows about a pixel, one for each size of region, as they are needed.

    Pixels of all windows of an image one after the other in ``lanes`` (1, room), each padded to a multiple of 8.
    ``half`` (1 + sizes, most rows): how far each row of a size's window reaches to both sides. A row of ``known``
    (1 + sizes, 2): where that size's window begins, negative where it is not made yet, and its number of pixels;
    row 0: where all end, and -.
    """

    lanes: Array
    half: Array
    known: Array


@step(fastmath=FAST)
def lent(rows: Array) -> Array:
    """Return a contiguous array (n, m) as one that does not own its memory, so that nobody counts who uses it.

    Counting costs more than a fit's sums where arrays go through many hands. The caller keeps ``rows``.
    """
    return image_at(np.uint64(rows.ctypes.data), rows, rows.shape[0], rows.shape[1])


@bare_step(fastmath=FAST)
def gather(image: Array, place: tuple[int, int], reach2: float, pixels: Array) -> int:
    """Copy the pixels with a distance from the pixel ``place`` of at most the root of ``reach2``, and their offsets.

    Returns how many.
    """
    x, y, v = pixels[X], pixels[Y], pixels[V]
    height, width = image.shape
    column, row = place
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
    """Tell n pixels from the padding to the next multiple of 8, which sums take at once."""
    x, y, sharper, there, v = pixels[X], pixels[Y], pixels[SHARPER], pixels[THERE], pixels[V]
    end = (n + 7) // 8 * 8
    for i in range(n):
        there[i] = ONE
    for i in range(n, end):
        x[i] = y[i] = v[i] = there[i] = ZERO
        sharper[i] = ONE


@step(fastmath=FAST)
def make_window(size: int, reach2: float, windows: Windows) -> None:
    """Write the pixels that ``gather`` takes off the image's border as the window of this size of region."""
    _, half, known = windows
    begin, n = known[0, 0], 0
    whole = int(math.sqrt(reach2))
    for j in range(-whole, whole + 1):
        half[size, j + whole] = int(math.sqrt(reach2 - j * j))
        n += 2 * half[size, j + whole] + 1
    known[size, 0], known[size, 1] = begin, n
    pixels = window_of(size, windows)
    known[0, 0] = begin + pixels.size + OVER
    x, y, sharper = pixels[X], pixels[Y], pixels[SHARPER]
    n = 0
    for j in range(-whole, whole + 1):
        for k in range(-half[size, j + whole], half[size, j + whole] + 1):
            x[n], y[n], sharper[n] = f32(k), f32(j), ONE
            n += 1
    pad(n, pixels)


@step(fastmath=FAST)
def window_of(size: int, windows: Windows) -> Array:
    """Return the pixels (5, n) of the window of a size of region."""
    lanes, _, known = windows
    at = np.uint64(lanes.ctypes.data) + np.uint64(known[size, 0] * lanes.itemsize)
    return image_at(at, lanes, 5, (known[size, 1] + 7) // 8 * 8)


@bare_step(fastmath=FAST)
def grey_values(image: Array, place: int, half: Array, v: Array) -> None:
    """Copy the grey values of the rows of a round window about the pixel number ``place``, 16 at a time.

    Up to 15 more than a row has are read, and overwritten by the next row's.
    """
    width = image.shape[1]
    n, middle = 0, place - (len(half) // 2) * width
    source, target = np.uint64(image.ctypes.data), np.uint64(v.ctypes.data)
    for j in range(len(half)):
        wide = int(half[j])
        count, at = 2 * wide + 1, middle - wide
        for k in range(0, count, 16):
            p, q = np.uint64((at + k) * image.itemsize), np.uint64((n + k) * v.itemsize)
            copy_16(source + p, image, target + q, v)  # type: ignore[call-arg]
        n += count
        middle += width


@bare_step(fastmath=FAST)
def reach_of(size: int, blur: float) -> float:
    """Return how far the fit of a region reaches: its box goes past the edge by about 1.2 blurs."""
    return 0.5 * size + 1.6 * blur + 0.5


@step(fastmath=FAST)
def gather_round(
    image: Array, place: tuple[int, int], size: int, reach: float, windows: Windows, scratch: Array
) -> tuple[int, Array]:
    """Return how many pixels lie within ``reach`` of the pixel ``place``, and those, padded."""
    height, width = image.shape
    far = int(reach)
    if windows.known[size, 0] < 0:
        make_window(size, reach * reach, windows)
    middle = place[1] * width + place[0]
    inside = far <= place[0] < width - far and far <= place[1] < height - far
    if inside and middle + far * (width + 1) + OVER <= image.size:
        n, pixels = windows.known[size, 1], window_of(size, windows)
        grey_values(image, middle, windows.half[size, : 2 * far + 1], pixels[V])
        for i in range(n, len(pixels[V])):
            pixels[V, i] = ZERO
        return n, pixels
    n = gather(image, place, reach * reach, scratch)
    for i in range(n):
        scratch[SHARPER, i] = ONE
    pad(n, scratch)
    return n, scratch


@bare_step(fastmath=FAST)
def gather_unmarked(
    image: Array,
    place: tuple[int, int],
    shape: tuple[float, float, float],
    around: tuple[float, float],
    reach: float,
    marks: tuple[Array, int, int, int],
    pixels: Array,
) -> int:
    """Copy the pixels that ``blank`` leaves and that lie within ``reach`` of a target; return how many.

    Pixel offsets from ``place`` are turned by the symmetric matrix ``shape`` (xx, xy, yy), in which the target is
    round, and ``around`` is its middle there. ``marks``: those of ``blank``, its side, first column and row.
    """
    x, y, sharper, v = pixels[X], pixels[Y], pixels[SHARPER], pixels[V]
    height, width = image.shape
    out, side, left, top = marks
    n = 0
    first_row, end_row = rows_within(shape, around, reach)
    for j in range(max(place[1] + first_row, 0, top), min(place[1] + end_row, height, top + side)):
        first, end = span_within(shape, around, reach, j - place[1])
        line, at, dy = image[j], (j - top) * side - left, float(j - place[1])
        for i in range(max(place[0] + first, 0, left), min(place[0] + end, width, left + side)):
            dx = float(i - place[0])
            x[n], y[n] = f32(shape[0] * dx + shape[1] * dy), f32(shape[1] * dx + shape[2] * dy)
            v[n] = f32(line[i])
            n += out[at + i] == 0
    # turned with the target, the round blur becomes narrower to one side, wider to the other
    m0, m1, m2, ax, ay = f32(shape[0]), f32(shape[1]), f32(shape[2]), f32(around[0]), f32(around[1])
    for i in range(n):
        qx, qy = x[i] - ax, y[i] - ay
        wx, wy = m0 * qx + m1 * qy, m1 * qx + m2 * qy
        sharper[i] = (math.sqrt(qx * qx + qy * qy) + SMALL) / (math.sqrt(wx * wx + wy * wy) + SMALL)
    return n


@bare_step(fastmath=FAST)
def half_side(shape: tuple[float, float, float], around: tuple[float, float], reach: float) -> int:
    """Return how far from the middle pixel ``gather_unmarked`` looks, and ``blank`` for what lies around that."""
    first_row, end_row = rows_within(shape, around, reach)
    first, end = rows_within((shape[2], shape[1], shape[0]), (around[1], around[0]), reach)
    return int(max(-first_row, end_row, -first, end)) + 2


@bare_step(fastmath=FAST)
def rows_within(
    shape: tuple[float, float, float], around: tuple[float, float], reach: float
) -> tuple[int, int]:
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
