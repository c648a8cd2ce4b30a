"""Compiled scan of a frame set's images for bright pixels, 64 at a time.

Called by ``mosca.detection.frame_set_kernel``. It runs without the GIL, on one thread, in whole numbers only.
``mosca.detection.search`` defines a run. A *block* is 64 pixels that follow each other in memory; its *mask* has a
bit for each bright pixel.
"""

from typing import Any, NamedTuple

import numpy as np

from mosca.data.arrays import Array
from mosca.detection.images import ImageSet, limits_of, pixels_of
from mosca.detection.search import END, END_RUN, FIRST, FIRST_RUN, IMAGE, PLACE, ROW, FoundRegions, box_of
from mosca.numba_support.decorators import bare_step, step
from mosca.numba_support.intrinsics import bits_set, bright_mask, copy_16, trailing_zeros

BLOCK, SHIFT, OVER = 64, 6, 16
"""Pixels in a block, its power of two, and the number of values that are copied at a time."""
ROW_COST = 10
"""Assumed cost of a row of a box, in blocks of a whole image (an estimate)."""


class SearchBoxes(NamedTuple):
    """Windows of the images in which targets are searched for."""

    boxes: Array
    """(k, 4) int32 x0, y0, x1, y1 [px], ends included."""
    start: Array
    """(n + 1,) int64: where each image's boxes begin; empty: all of each image is searched."""


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


@step
def bright_blocks_within(
    pixels: Array, limits: Array, width: int, boxes: Array, blocks: Array, masks: Array, n: int
) -> int:
    """Do as ``bright_blocks`` for the blocks that reach into boxes (k, 4) x0, y0, x1, y1, ends included.

    Rows are followed from top to bottom, and in each row the boxes from left to right, so that each block comes once
    and in order.
    """
    height = len(pixels) // width
    order = np.empty(len(boxes), np.int32)  # sorted from the top; few, since with many the whole image is scanned
    for k in range(len(boxes)):
        i = k
        while i > 0 and boxes[order[i - 1], 1] > boxes[k, 1]:
            order[i] = order[i - 1]
            i -= 1
        order[i] = k
    active = np.empty(len(boxes), np.int32)
    n_active, following = 0, 0
    row, done = 0, -1
    while row < height and (n_active > 0 or following < len(boxes)):
        if n_active == 0:
            row = max(row, boxes[order[following], 1])
        while following < len(boxes) and boxes[order[following], 1] <= row:
            i = n_active
            while i > 0 and boxes[active[i - 1], 0] > boxes[order[following], 0]:
                active[i] = active[i - 1]
                i -= 1
            active[i] = order[following]
            n_active += 1
            following += 1
        kept = 0
        for i in range(n_active):
            active[kept] = active[i]
            kept += boxes[active[i], 3] >= row
        n_active = kept
        if row >= height:
            break
        for i in range(n_active):
            first, last = max(boxes[active[i], 0], 0), min(boxes[active[i], 2], width - 1)
            for block in range(max((row * width + first) >> SHIFT, done + 1), ((row * width + last) >> SHIFT) + 1):
                done = block
                mask = mask_of(pixels, limits, block)
                blocks[n], masks[n] = block, mask
                n += mask != 0
        row += 1
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
def scan_set(images: ImageSet, search: SearchBoxes) -> BrightPixels:
    """Return the pixels above their limits of all images of a frame set, or only those in ``search``'s boxes.

    The whole of an image is searched where that is faster than box by box.
    """
    n_images, width = len(images.addresses), images.width
    boxes, box_start = search.boxes, search.start
    n_blocks = (images.height * width + BLOCK - 1) >> SHIFT
    blocks, masks = np.empty(n_images * n_blocks + 1, np.int32), np.empty(n_images * n_blocks + 1, np.int64)
    start = np.zeros(n_images + 1, np.int64)
    for i in range(n_images):
        pixels, limits = pixels_of(images, i), limits_of(images, i)
        own = boxes[:0]
        rows = 0
        if len(box_start) > 0:
            own = boxes[box_start[i] : box_start[i + 1]]
            for k in range(len(own)):
                rows += own[k, 3] - own[k, 1] + 1
        if len(box_start) == 0 or ROW_COST * rows > n_blocks:
            start[i + 1] = bright_blocks(pixels, limits, blocks, masks, start[i])
        else:
            start[i + 1] = bright_blocks_within(pixels, limits, width, own, blocks, masks, start[i])
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


@step
def regions_within(found: FoundRegions, search: SearchBoxes) -> FoundRegions:
    """Return the regions that lie inside one of their image's boxes, off its outermost pixels."""
    regions, boxes, box_start = found.regions, search.boxes, search.start
    kept = np.zeros(len(regions), np.bool_)
    for r in range(len(regions)):
        (left, right, top, bottom), _ = box_of(found.runs, regions[r, FIRST_RUN], regions[r, END_RUN])
        for k in range(box_start[regions[r, IMAGE]], box_start[regions[r, IMAGE] + 1]):
            if boxes[k, 1] < top and boxes[k, 3] > bottom and boxes[k, 0] < left and boxes[k, 2] > right:
                kept[r] = True
                break
    return FoundRegions(found.runs, regions[kept], found.noise[kept])
