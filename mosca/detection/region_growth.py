"""Compiled growth of regions from a blob's brightest pixels down, threshold by threshold.

Compiled into ``mosca.detection.threshold_regions``, for blobs that may hold several targets.
"""

from typing import Any

import numpy as np

from mosca.data.arrays import Array
from mosca.detection.search import END, FIRST, PLACE, ROW, Search, is_compact, is_target
from mosca.numba_support.copying import copy_row
from mosca.numba_support.decorators import bare_step, step

# Columns of the table of disjoint pixel sets while a blob is grown; all but PARENT and NEXT hold for roots only.
PARENT, NEXT, LAST, SIZE, LEFT, RIGHT, TOP, BOTTOM, PEAK, DARKEST, N_TARGETS, REGION, CHECKED, CORE = range(14)
FINAL = 14


@bare_step
def level_of(value: int, thresholds: Array) -> int:
    """Return the index of the first of the falling thresholds that ``value`` exceeds."""
    low, high = 0, len(thresholds) - 1
    if thresholds[0] - thresholds[high] == high:  # in steps of 1
        return max(0, int(thresholds[0]) - value + 1)
    while low < high:
        middle = (low + high) // 2
        if value > thresholds[middle]:
            high = middle
        else:
            low = middle + 1
    return low


@step
def pixels_by_level(runs: Array, values: Array, thresholds: Array) -> tuple[Array, Array]:
    """Return the runs' pixels (n, 3), x, y and value, in the order in which they exceed falling thresholds.

    The second array (levels + 1,) holds where each level's pixels begin.
    """
    n_pixels = 0
    for i in range(len(runs)):
        n_pixels += runs[i, END] - runs[i, FIRST]
    start = np.zeros(len(thresholds) + 2, np.int32)
    levels = np.empty(n_pixels, np.int32)
    n = 0
    for i in range(len(runs)):
        for k in range(runs[i, END] - runs[i, FIRST]):
            levels[n] = level_of(values[runs[i, PLACE] + k], thresholds)
            start[levels[n] + 2] += 1
            n += 1
    for level in range(2, len(start)):
        start[level] += start[level - 1]
    pixels = np.empty((n_pixels, 3), np.int32)
    n = 0
    for i in range(len(runs)):
        for k in range(runs[i, END] - runs[i, FIRST]):
            at = start[levels[n] + 1]
            start[levels[n] + 1] += 1
            pixels[at, 0], pixels[at, 1] = runs[i, FIRST] + k, runs[i, ROW]
            pixels[at, 2] = values[runs[i, PLACE] + k]
            n += 1
    return pixels, start[: len(thresholds) + 1]


@bare_step
def root_in(sets: Array, i: Any) -> Any:
    """Return the root of set ``i`` in the table of sets, shortening the path to it."""
    while True:
        parent = np.uint64(sets[i, PARENT])
        if parent == i:
            return i
        above = sets[parent, PARENT]
        sets[i, PARENT] = above
        i = np.uint64(above)


@bare_step
def join(sets: Array, a: Any, b: Any) -> Any:
    """Unite the sets of two roots and return the root: the smaller one's pixels follow the larger one's.

    Thus the pixels of every earlier set stay an unbroken stretch of the list that starts at its root.
    """
    if sets[a, SIZE] < sets[b, SIZE]:
        a, b = b, a
    sets[b, PARENT] = a
    sets[np.uint64(sets[a, LAST]), NEXT] = b
    sets[a, LAST] = sets[b, LAST]
    sets[a, SIZE] += sets[b, SIZE]
    sets[a, LEFT] = min(sets[a, LEFT], sets[b, LEFT])
    sets[a, RIGHT] = max(sets[a, RIGHT], sets[b, RIGHT])
    sets[a, TOP] = min(sets[a, TOP], sets[b, TOP])
    sets[a, BOTTOM] = max(sets[a, BOTTOM], sets[b, BOTTOM])
    if sets[a, PEAK] == sets[b, PEAK]:
        sets[a, CORE] += sets[b, CORE]
    elif sets[a, PEAK] < sets[b, PEAK]:
        sets[a, CORE] = sets[b, CORE]
    sets[a, PEAK] = max(sets[a, PEAK], sets[b, PEAK])
    sets[a, DARKEST] = min(sets[a, DARKEST], sets[b, DARKEST])
    sets[a, N_TARGETS] += sets[b, N_TARGETS]
    sets[a, REGION] = max(sets[a, REGION], sets[b, REGION])
    return a


@bare_step
def keep_core(found: Array, t: Any) -> None:
    """Reset region t to its state at half of its contrast: the pixels that it took in since are not its own."""
    copy_row(found[t, 7:FINAL], found[t])
    found[t, FINAL] = 1


@step
def grow_regions(runs: Array, values: Array, thresholds: Array, search: Search) -> tuple[Array, Array]:
    """Find the accepted regions of one blob by growing it from its brightest pixels down.

    After each threshold every region that changed is judged with the number N of separate targets that it holds so
    far. Returns the regions' thresholds (n) and their runs (m, 4): region, row, first and end column, by region.
    """
    pixels, start = pixels_by_level(runs, values, thresholds)
    left, right, top = runs[0, FIRST], runs[0, END], runs[0, ROW]
    for i in range(len(runs)):
        left = min(left, runs[i, FIRST])
        right = max(right, runs[i, END])
    sets = np.empty((len(pixels), 14), np.int32)
    # Index of the pixel at each position of the box, with a rim; -1 before it is reached.
    width = np.int64(right - left + 2)
    index_at = np.full((runs[-1, ROW] - top + 3) * width, np.int32(-1), np.int32)
    # An accepted region: its first pixel, number of pixels, box and threshold; the same at half of its contrast (or
    # when it was first accepted); whether that is final.
    found, n_found = np.empty((len(pixels), 15), np.int32), 0
    for level in range(len(thresholds)):
        for i in range(start[level], start[level + 1]):
            x, y, value = pixels[i, 0], pixels[i, 1], pixels[i, 2]
            sets[i, PARENT] = sets[i, LAST] = i
            sets[i, LEFT] = sets[i, RIGHT] = x
            sets[i, TOP] = sets[i, BOTTOM] = y
            sets[i, PEAK] = sets[i, DARKEST] = value
            sets[i, SIZE], sets[i, N_TARGETS], sets[i, REGION], sets[i, CHECKED], sets[i, CORE] = 1, 0, -1, -1, 0
            place = (y - top + 1) * width + x - left + 1
            index_at[place] = i
            mine = np.uint64(i)
            for v in range(place - width, place + width + 1, width):
                for u in range(v - 1, v + 2):
                    beside = index_at[np.uint64(u)]
                    # both unsigned: Numba compares signed with unsigned integers as floating point
                    if beside < 0 or np.uint64(sets[np.uint64(beside), PARENT]) == mine:
                        continue
                    other = root_in(sets, np.uint64(beside))
                    if other != mine:
                        mine = join(sets, mine, other)
        for i in range(start[level], start[level + 1]):
            root = root_in(sets, np.uint64(i))
            if sets[root, CHECKED] == level:
                continue
            sets[root, CHECKED] = level
            is_core = thresholds[level] >= 0.5 * (sets[root, PEAK] + search.level)
            if sets[root, CORE] == 0 or is_core:
                sets[root, CORE] = sets[root, SIZE]
            size_x = sets[root, RIGHT] - sets[root, LEFT] + 1
            size_y = sets[root, BOTTOM] - sets[root, TOP] + 1
            contrast = sets[root, PEAK] - sets[root, DARKEST]
            if sets[root, N_TARGETS] > 1 or not is_target(size_x, size_y, contrast, search):
                continue
            if search.level >= 0.0 and not is_compact(sets[root, SIZE], sets[root, CORE]):
                if sets[root, N_TARGETS] == 1:
                    keep_core(found, sets[root, REGION])
                continue
            is_new = sets[root, N_TARGETS] == 0
            if is_new:
                sets[root, N_TARGETS], sets[root, REGION] = 1, n_found
                found[n_found, FINAL] = 0
                n_found += 1
            t = sets[root, REGION]
            if found[t, FINAL] == 1:
                continue
            found[t, 0], found[t, 1], found[t, 2] = root, sets[root, SIZE], sets[root, LEFT]
            found[t, 3], found[t, 4] = sets[root, RIGHT], sets[root, TOP]
            found[t, 5], found[t, 6] = sets[root, BOTTOM], thresholds[level]
            if is_new or is_core:
                copy_row(found[t, :7], found[t, 7:])
    return found[:n_found, 6], runs_of(found[:n_found], pixels, sets, index_at, (left, top, width))


@step
def runs_of(found: Array, pixels: Array, sets: Array, index_at: Array, box: tuple[int, int, int]) -> Array:
    """Return the runs (m, 4) of regions: region, row, first and end column; ``index_at`` is overwritten.

    ``box``: left column, top row, and width with its rim, of ``index_at``.
    """
    left, top, width = box
    # Mark each region's pixels in the box, then read them out row by row.
    index_at[:] = -1
    for r in range(len(found)):
        i = found[r, 0]
        for _ in range(found[r, 1]):
            index_at[(pixels[i, 1] - top + 1) * width + pixels[i, 0] - left + 1] = r
            i = sets[i, NEXT]
    region_runs = np.empty((len(pixels), 4), np.int32)
    n = 0
    for r in range(len(found)):
        for y in range(found[r, 4], found[r, 5] + 1):
            inside, place = False, (y - top + 1) * width - left + 1
            for x in range(found[r, 2], found[r, 3] + 2):
                if (index_at[np.uint64(place + x)] == r) == inside:
                    continue
                inside = not inside
                if inside:
                    region_runs[n, 0], region_runs[n, 1], region_runs[n, 2] = r, y, x
                else:
                    region_runs[n, 3] = x
                    n += 1
    return region_runs[:n]
