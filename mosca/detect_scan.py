"""Compiled scan of a frame set's images for bright pixels, eight bytes at a time.

Called by ``mosca.detect``; free of the GIL, on one thread, in whole numbers only. What a run is: see
``mosca.detect_kernels``.
"""

from typing import NamedTuple

import numpy as np

from mosca.data.arrays import Array
from mosca.detect_kernels import END, FIRST, PLACE, ROW, kernel, step
from mosca.detect_memory import image_at


class Packing(NamedTuple):
    """How the pixels in eight bytes are compared with a grey value at once (see ``bright_words``)."""

    low_bits: np.uint64
    addend: np.uint64
    lane_shift: int


ROW_COST = 30
"""A row of a box takes as long as so many words of a whole image (measured)."""


@step
def is_bright(word: np.uint64, packing: Packing) -> bool:
    """Tell whether a word may hold a bright pixel."""
    return ((((word & packing.low_bits) + packing.addend) | word) & ~packing.low_bits) != np.uint64(0)


@step
def bright_words(words: Array, packing: Packing) -> Array:
    """Return the indices of the words that may hold a bright pixel; most of a frame is dark.

    A word is 8 bytes with a pixel in each lane of 8 or 16 bit. ``addend`` lifts the low bits of a lane into
    its top bit exactly where they reach the grey value searched, and no lane carries into the next.
    """
    top_bits = ~packing.low_bits
    n = len(words)
    blocks = np.empty(n // 4 + 1, np.int32)
    n_blocks = 0
    for block in range(n // 4):
        bits = np.uint64(0)
        for k in range(4):
            word = words[np.uint64(4 * block + k)]
            bits |= ((word & packing.low_bits) + packing.addend) | word
        blocks[n_blocks] = block
        n_blocks += (bits & top_bits) != np.uint64(0)
    if n % 4:
        blocks[n_blocks] = n // 4
        n_blocks += 1
    found = np.empty(4 * n_blocks, np.int32)
    n_found = 0
    for i in range(n_blocks):
        for k in range(4 * blocks[i], min(4 * blocks[i] + 4, n)):
            found[n_found] = k
            n_found += is_bright(words[np.uint64(k)], packing)
    return found[:n_found]


@step
def bright_words_within(words: Array, packing: Packing, width: int, height: int, boxes: Array) -> Array:
    """Do as ``bright_words`` for the words that reach into boxes (k, 4) x0, y0, x1, y1, ends included.

    Row by row over the boxes there, from left to right, so that each word comes once and in order.
    """
    order = np.argsort(boxes[:, 1])
    active = np.empty(len(boxes), np.int32)
    found = np.empty(64, np.int32)
    n_active, n_found, following = 0, 0, 0
    row = 0
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
        done = found[n_found - 1] if n_found else -1
        for i in range(n_active):
            first, last = max(boxes[active[i], 0], 0), min(boxes[active[i], 2], width - 1)
            begin, end = row * width + first, row * width + last
            lanes = np.int64(packing.lane_shift)
            for k in range(max(begin >> lanes, done + 1), min((end >> lanes) + 1, len(words))):
                done = k
                if is_bright(words[np.uint64(k)], packing):
                    if n_found == len(found):
                        longer = np.empty(2 * n_found, np.int32)
                        longer[:n_found] = found
                        found = longer
                    found[n_found] = k
                    n_found += 1
        row += 1
    return found[:n_found]


@step
def bright_runs(image: Array, bright: Array, lanes: int, level: int) -> tuple[Array, Array]:
    """Return the runs (n, 4) of pixels above ``level`` in raster order, and their grey values.

    ``bright``: which words of ``lanes`` pixels to search; the pixels after the last whole word always are.
    """
    width = image.shape[1]
    pixels = image.ravel()
    n_all = len(pixels)
    runs = np.empty((len(bright) * (lanes // 2 + 1) + lanes, 4), np.int32)
    values = np.empty((len(bright) + 1) * lanes + width, np.int32)
    n, n_pixels = 0, 0
    y, row, p = 0, 0, 0  # a row, its first pixel, and the pixel up to which all is searched
    for i in range(len(bright) + 1):
        begin = bright[i] * lanes if i < len(bright) else n_all // lanes * lanes
        p = max(p, begin)
        end = min(begin + lanes, n_all)
        while p < end:
            value = pixels[np.uint64(p)]
            if value <= level:
                p += 1
                continue
            while p >= row + width:
                y += 1
                row += width
            if n_pixels + width > len(values):  # runs that go on beyond the words searched
                longer = np.empty(2 * len(values), np.int32)
                longer[:n_pixels] = values[:n_pixels]
                values = longer
            first, end_row, place = p, row + width, n_pixels
            while value > level:
                values[np.uint64(n_pixels)] = value
                n_pixels += 1
                p += 1
                if p >= end_row:
                    break
                value = pixels[np.uint64(p)]
            runs[n, ROW], runs[n, FIRST], runs[n, END], runs[n, PLACE] = y, first - row, p - row, place
            n += 1
    return runs[:n], values[:n_pixels]


@kernel
def scan_set(
    addresses: Array,
    like: Array,
    size: tuple[int, int],
    packing: Packing,
    level: int,
    boxes: Array,
    box_start: Array,
) -> tuple[Array, Array, Array, Array]:
    """Return the runs of pixels above ``level`` of all images of a frame set, or those within boxes.

    ``addresses`` (n,) uint64: where the images of ``size`` (H, W) and the type of ``like`` (0,) lie in memory.
    ``boxes`` (k, 4) int32 x0, y0, x1, y1, ends included, those of image i from ``box_start`` (n + 1) i on; where
    ``box_start`` is empty, all of each image is searched, and so it is where that is faster. Returns runs
    (m, 4), grey values, and where those of each image begin (n + 1).
    """
    n_images = len(addresses)
    height, width = size
    n_words = height * width * like.itemsize // 8
    whole = np.empty(0, np.uint64)
    run_start, value_start = np.zeros(n_images + 1, np.int64), np.zeros(n_images + 1, np.int64)
    runs, values = np.empty((0, 4), np.int32), np.empty(0, np.int32)
    for i in range(n_images):
        image = image_at(addresses[i], like, height, width)
        words = image_at(addresses[i], whole, 1, n_words).ravel()
        own = boxes[:0]
        rows = 0
        if len(box_start) > 0:
            own = boxes[box_start[i] : box_start[i + 1]]
            for k in range(len(own)):
                rows += own[k, 3] - own[k, 1] + 1
        if len(box_start) == 0 or ROW_COST * rows > n_words:
            bright = bright_words(words, packing)
        else:
            bright = bright_words_within(words, packing, width, height, own)
        more_runs, more_values = bright_runs(image, bright, 1 << packing.lane_shift, level)
        n, m = run_start[i], value_start[i]
        run_start[i + 1], value_start[i + 1] = n + len(more_runs), m + len(more_values)
        if run_start[i + 1] > len(runs):
            longer_runs = np.empty((max(n_images * len(more_runs), 2 * run_start[i + 1]), 4), np.int32)
            longer_runs[:n] = runs[:n]
            runs = longer_runs
        if value_start[i + 1] > len(values):
            longer_values = np.empty(max(n_images * len(more_values), 2 * value_start[i + 1]), np.int32)
            longer_values[:m] = values[:m]
            values = longer_values
        runs[n : run_start[i + 1]] = more_runs
        values[m : value_start[i + 1]] = more_values
    return runs[: run_start[-1]], values[: value_start[-1]], run_start, value_start


@kernel
def regions_within(runs: Array, regions: Array, boxes: Array, box_start: Array) -> Array:
    """Return the rows of ``regions`` that lie inside one of their image's boxes, off its outermost pixels."""
    kept = np.zeros(len(regions), np.bool_)
    for r in range(len(regions)):
        own = runs[regions[r, 1] : regions[r, 2]]
        top, bottom = own[0, 0], own[-1, 0]
        left, right = own[0, 1], own[0, 2]
        for i in range(1, len(own)):
            left, right = min(left, own[i, 1]), max(right, own[i, 2])
        for k in range(box_start[regions[r, 0]], box_start[regions[r, 0] + 1]):
            if boxes[k, 1] < top and boxes[k, 3] > bottom and boxes[k, 0] < left and boxes[k, 2] >= right:
                kept[r] = True
                break
    return regions[kept]
