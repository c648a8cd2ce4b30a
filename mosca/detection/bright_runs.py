"""Compiled scan of a frame set's images for bright pixels, 64 at a time.

Called by ``mosca.detection.frame_set_kernel``. It runs without the GIL, on one thread, in whole numbers only.
``mosca.detection.search`` defines a run. A *block* is 64 pixels that follow each other in memory; its *mask* has a
bit for each bright pixel.
"""

from typing import Any, NamedTuple

import numpy as np

from mosca.data.arrays import Array
from mosca.detection.images import ImageSet, limits_of, pixels_of
from mosca.detection.search import END, FIRST, PLACE, ROW
from mosca.numba_support.decorators import bare_step, step
from mosca.numba_support.intrinsics import bits_set, bright_mask, copy_16, trailing_zeros

BLOCK, SHIFT, OVER = 64, 6, 16
"""Pixels in a block, its power of two, and the number of values that are copied at a time."""


class BrightPixels(NamedTuple):
    """The pixels of a frame set's images above their limits."""

    runs: Array
    """(m, 4) int32 in raster order, columns as in ``mosca.detection.search``."""
    values: Array
    """(k,) int32 their grey values [DN]."""
    run_start: Array
    """(n + 1,) int64: where each image's runs begin."""
    value_start: Array
    """(n + 1,) int64: where each image's values begin."""


@bare_step
def mask_of(pixels: Array, limits: Array, block: Any) -> Any:
    """Return the mask of one block of an image; beyond the last pixel nothing is bright."""
    first = block << SHIFT
    if first + BLOCK <= len(pixels):
        at = np.uint64(first * pixels.itemsize)
        return bright_mask(np.uint64(pixels.ctypes.data) + at, pixels, np.uint64(limits.ctypes.data) + at)
    mask = np.int64(0)
    for k in range(len(pixels) - first):
        mask |= np.int64(pixels[first + k] > limits[first + k]) << np.int64(k)
    return mask


@bare_step
def bright_blocks(pixels: Array, limits: Array, blocks: Array, masks: Array, n: int) -> int:
    """Write the blocks with a bright pixel and their masks from index n on; return the index after the last.

    Most of a frame is dark: each block is written, and the next one overwrites it unless it is bright.
    """
    whole = len(pixels) >> SHIFT
    address, limit = np.uint64(pixels.ctypes.data), np.uint64(limits.ctypes.data)
    for block in range(whole):
        at = np.uint64(block * BLOCK * pixels.itemsize)
        mask: Any = bright_mask(address + at, pixels, limit + at)
        blocks[np.uint64(n)], masks[np.uint64(n)] = block, mask
        n += mask != 0
    if len(pixels) % BLOCK:
        mask = mask_of(pixels, limits, whole)
        blocks[n], masks[n] = whole, mask
        n += mask != 0
    return n


@bare_step
def copy_values(pixels: Array, at: int, n: int, values: Array, to: int) -> None:
    """Copy n grey values, 16 at a time where the image is long enough; up to 15 more are overwritten later."""
    if at + n + OVER > len(pixels):
        for k in range(n):
            values[to + k] = pixels[at + k]
        return
    source = np.uint64(pixels.ctypes.data) + np.uint64(at * pixels.itemsize)
    target = np.uint64(values.ctypes.data) + np.uint64(to * values.itemsize)
    for k in range(0, n, 16):
        copy_16(source + np.uint64(k * pixels.itemsize), pixels, target + np.uint64(k * values.itemsize), values)


@bare_step
def bright_runs(
    pixels: Array, width: int, blocks: Array, masks: Array, runs: Array, values: Array, n: int, n_values: int
) -> tuple[int, int]:
    """Write an image's runs in raster order, and their grey values, from indices n and n_values on.

    Returns the indices after the last of both. A run may reach over blocks; the end of a row ends it.
    """
    y, row, last = 0, 0, -1  # a row, its first pixel, and the end of the run before
    first_value = n_values
    for i in range(len(blocks)):
        base, mask = np.int64(blocks[i]) << SHIFT, masks[i]
        while mask != 0:
            filled = mask | (mask - 1)
            begin = base + trailing_zeros(mask)
            stop = base + trailing_zeros(~filled)
            mask &= filled + 1
            while begin < stop:
                while begin >= row + width:
                    y += 1
                    row += width
                end = min(stop, row + width)
                if begin == last and begin > row:
                    runs[n - 1, END] = end - row
                else:
                    runs[n, ROW], runs[n, FIRST], runs[n, END] = y, begin - row, end - row
                    runs[n, PLACE] = n_values - first_value
                    n += 1
                copy_values(pixels, begin, end - begin, values, n_values)
                n_values += end - begin
                last = begin = end
    return n, n_values


@step
def scan_set(images: ImageSet) -> BrightPixels:
    """Return the pixels above their limits of all images of a frame set."""
    n_images, width = len(images.addresses), images.width
    n_blocks = (images.height * width + BLOCK - 1) >> SHIFT
    blocks, masks = np.empty(n_images * n_blocks + 1, np.int32), np.empty(n_images * n_blocks + 1, np.int64)
    start = np.zeros(n_images + 1, np.int64)
    for i in range(n_images):
        pixels, limits = pixels_of(images, i), limits_of(images, i)
        start[i + 1] = bright_blocks(pixels, limits, blocks, masks, start[i])
    most_runs, most_values = n_images * images.height, OVER
    for k in range(start[-1]):
        most_runs += bits_set(masks[k] & ~(masks[k] << 1))
        most_values += bits_set(masks[k])
    runs, values = np.empty((most_runs, 4), np.int32), np.empty(most_values, np.int32)
    run_start, value_start = np.zeros(n_images + 1, np.int64), np.zeros(n_images + 1, np.int64)
    for i in range(n_images):
        own_blocks, own_masks = blocks[start[i] : start[i + 1]], masks[start[i] : start[i + 1]]
        run_start[i + 1], value_start[i + 1] = bright_runs(
            pixels_of(images, i), width, own_blocks, own_masks, runs, values, run_start[i], value_start[i]
        )
    return BrightPixels(runs[: run_start[-1]], values[: value_start[-1]], run_start, value_start)
