"""Compiled search for targets: bright runs, blobs, accepted regions.

Called by ``mosca.detection.detect``, which defines what a target is and names the source. The kernels are free of the
GIL, run on one thread and use whole numbers only, so the same image always gives the same regions.

A *run* is a row of adjoining pixels: (row, first column, end column, place of its first pixel among the
``values``), where ``values`` holds the grey values of all bright pixels in raster order. A *blob* is an
8-connected set of runs at the lowest threshold; a *region* is an accepted target.
"""

from typing import Any, NamedTuple

import numpy as np

from mosca.data.arrays import Array
from mosca.numba_support.decorators import bare_step, kernel, step

ROW, FIRST, END, PLACE = range(4)

# Columns of the table of disjoint pixel sets while a blob is grown; all but PARENT and NEXT are of the roots.
PARENT, NEXT, LAST, SIZE, LEFT, RIGHT, TOP, BOTTOM, PEAK, DARKEST, N_TARGETS, REGION, CHECKED = range(13)


class Search(NamedTuple):
    """What is searched, in grey values of the image [DN] and pixels."""

    highest: int
    lowest: int
    step: int
    contrast: float
    smallest_px: float
    largest_px: float


@step
def threshold_sequence(values: Array, search: Search) -> Array:
    """Return the thresholds, falling. Grey values that the image lacks are stepped over (step 3)."""
    thresholds = np.empty((search.highest - search.lowest) // search.step + 1, np.int32)
    present = np.ones(search.highest + 1, np.uint8)
    if search.step > 1:  # in steps of 1 absent values only repeat a binary image
        present[:] = 0
        for value in values:
            if value <= search.highest:
                present[value] = 1
    n, threshold = 0, search.highest
    while threshold > search.lowest:
        thresholds[n] = threshold
        n += 1
        while threshold > search.lowest and not present[threshold]:
            threshold -= 1
        threshold -= search.step
    return thresholds[:n]


@step
def runs_above(runs: Array, values: Array, level: int) -> Array:
    """Return the runs of pixels above ``level`` within ``runs`` of a lower level."""
    above = np.empty((len(values), 4), np.int32)
    n = 0
    for i in range(len(runs)):
        x, end = runs[i, FIRST], runs[i, END]
        place = runs[i, PLACE] - x
        while x < end:
            if values[place + x] <= level:
                x += 1
                continue
            first = x
            while x < end and values[place + x] > level:
                x += 1
            above[n, ROW], above[n, FIRST], above[n, END] = runs[i, ROW], first, x
            above[n, PLACE] = place + first
            n += 1
    return above[:n]


@bare_step
def root_of(parent: Array, i: int) -> int:
    """Return the representative of the set of ``i``, shortening the way to it."""
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@step
def blobs_of(runs: Array) -> tuple[Array, Array]:
    """Return the runs sorted by 8-connected blob, and (n + 1) where each blob begins.

    Blobs are in the order of their first pixel, the runs of each in raster order.
    """
    n = len(runs)
    parent = np.empty(n, np.int32)
    above = 0  # the first run of the row above that may still touch
    for i in range(n):
        parent[i] = i
        y, first, end = runs[i, ROW], runs[i, FIRST], runs[i, END]
        while runs[above, ROW] < y - 1 or (runs[above, ROW] == y - 1 and runs[above, END] < first):
            above += 1
        j = above
        while runs[j, ROW] == y - 1 and runs[j, FIRST] <= end:
            a, b = root_of(parent, i), root_of(parent, j)
            parent[max(a, b)] = min(a, b)
            j += 1
    blob = np.empty(n, np.int32)
    start = np.zeros(n + 2, np.int32)
    n_blobs = 0
    for i in range(n):
        root = root_of(parent, i)
        if root == i:
            blob[i] = n_blobs
            n_blobs += 1
        else:
            blob[i] = blob[root]
        start[blob[i] + 2] += 1
    for k in range(2, n_blobs + 2):
        start[k] += start[k - 1]
    in_order = np.empty((n, 4), np.int32)
    for i in range(n):
        at = start[blob[i] + 1]
        start[blob[i] + 1] += 1
        for c in range(4):
            in_order[at, c] = runs[i, c]
    return in_order, start[: n_blobs + 1]


@bare_step
def survey(
    runs: Array, first_run: int, end_run: int, values: Array, lowest: int, column: int
) -> tuple[Any, Any, Any]:
    """Return the smallest and the largest grey value of a blob, and a bound of the dips between its summits.

    ``first_run``, ``end_run``: the blob's among the runs, not cut out of them: of each piece of an array that is
    handed on somebody counts the users, which takes longer than a small blob.

    From each pixel a path leads along its run to ``column`` and along that column to every other row; the
    bound is the deepest dip below both ends of such a path. Where a run does not reach the column, or the
    column leaves the blob, the path is taken to dip to ``lowest``.
    """
    darkest, peak, dip = np.int32(65535), np.int32(0), np.int32(0)
    low, last_row = np.int32(65535), runs[first_run, ROW] - 1
    for i in range(first_run, end_run):
        first, end, place = runs[i, FIRST], runs[i, END], runs[i, PLACE]
        if not first <= column < end:
            for k in range(place, place + end - first):
                darkest = min(darkest, values[k])
                peak = max(peak, values[k])
                dip = max(dip, values[k] - lowest)
            continue
        middle = place + column - first
        left = right = np.int32(0)
        for k in range(place, middle + 1):
            left = max(left, values[k])
            dip = max(dip, left - values[k])
            darkest = min(darkest, values[k])
        valley = values[middle]
        for k in range(middle + 1, place + end - first):
            right = max(right, values[k])
            valley = min(valley, values[k])
            dip = max(dip, values[k] - valley)
        darkest = min(darkest, valley)
        here = max(left, right)
        low = min(low, values[middle])
        if runs[i, ROW] != last_row + 1:
            low = min(low, np.int32(lowest))
        last_row = runs[i, ROW]
        dip = max(dip, min(here, peak) - low)
        if here > peak:
            peak, low = here, values[middle]
    return darkest, peak, dip


@bare_step
def falls_between(highest: Array, most: float) -> bool:
    """Tell whether a sequence falls by more than ``most`` and rises by as much again."""
    summit = valley = highest[0]
    for k in range(1, len(highest)):
        value = highest[k]
        valley = min(valley, value)
        if min(summit, value) - valley > most:
            return True
        if value > summit:
            summit = valley = value
    return False


@step
def passes_below(runs: Array, values: Array, box: tuple[int, int, int, int], most: float) -> bool:
    """Tell whether from the lower of two summits of a blob one must go down by more than ``most`` to reach the other.

    Exactly, by the best ways: pixels rise in the order of falling grey values, and where two hills meet, the pass
    between them is found. ``box``: left, end column, top, end row.
    """
    left, right, top, bottom = box
    width = right - left + 2
    n, darkest, peak = 0, values[runs[0, PLACE]], values[runs[0, PLACE]]
    # a whole row or column between two summits that no pixel of it comes near to settles it
    highest = np.zeros(bottom - top + right - left, np.int32)
    across, down = highest[: bottom - top], highest[bottom - top :]
    for i in range(len(runs)):
        row, place = runs[i, ROW] - top, runs[i, PLACE]
        for k in range(runs[i, END] - runs[i, FIRST]):
            value, column = values[place + k], runs[i, FIRST] - left + k
            darkest, peak = min(darkest, value), max(peak, value)
            across[row], down[column] = max(across[row], value), max(down[column], value)
            n += 1
    if falls_between(across, most) or falls_between(down, most):
        return True
    # a place in the box, with one pixel of rim, for each pixel; sorted by falling grey value
    start = np.zeros(peak - darkest + 2, np.int32)
    for i in range(len(runs)):
        for k in range(runs[i, PLACE], runs[i, PLACE] + runs[i, END] - runs[i, FIRST]):
            start[peak - values[k] + 1] += 1
    for level in range(1, len(start)):
        start[level] += start[level - 1]
    order = np.empty((n, 2), np.int32)
    for i in range(len(runs)):
        first = (runs[i, ROW] - top + 1) * width + runs[i, FIRST] - left + 1
        for k in range(runs[i, END] - runs[i, FIRST]):
            value = values[runs[i, PLACE] + k]
            at = start[peak - value]
            start[peak - value] += 1
            order[at, 0], order[at, 1] = first + k, value
    # a hill is named by its summit, the pixel of it that rose first
    hill = np.full((bottom - top + 2) * width, np.int32(-1), np.int32)
    height = np.empty(len(hill), np.int32)
    for i in range(n):
        place, value = np.int64(order[i, 0]), order[i, 1]
        mine = place
        hill[place] = place
        height[place] = value
        for beside in range(-1, 2):
            for other in range(place + beside * width - 1, place + beside * width + 2):
                if hill[other] < 0 or hill[other] == mine:
                    continue
                root = np.int64(root_of(hill, other))
                if root == mine:
                    continue
                if min(height[root], height[mine]) - value > most:
                    return True
                if height[root] >= height[mine]:
                    hill[mine] = root
                    mine = root
                else:
                    hill[root] = mine
    return False


@bare_step
def is_target(size_x: int, size_y: int, contrast: int, search: Search) -> bool:
    """Tell whether a region passes the limits of size and contrast (step 6)."""
    return (
        search.smallest_px < size_x < search.largest_px
        and search.smallest_px < size_y < search.largest_px
        and contrast > search.contrast
    )


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
    """Return the runs' pixels (n, 3), x, y and value, as they rise above falling thresholds.

    The second array (levels + 1) says where each level's pixels begin.
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
    """As ``root_of`` in the table of sets. A column cut out of it would have its users counted, at every step."""
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

    So the pixels of every earlier set stay an unbroken stretch of the list that starts at its root.
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
    sets[a, PEAK] = max(sets[a, PEAK], sets[b, PEAK])
    sets[a, DARKEST] = min(sets[a, DARKEST], sets[b, DARKEST])
    sets[a, N_TARGETS] += sets[b, N_TARGETS]
    sets[a, REGION] = max(sets[a, REGION], sets[b, REGION])
    return a


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
    sets = np.empty((len(pixels), 13), np.int32)
    # Which pixel stands where in the box, with a rim; -1 before it has risen. Unsigned: none counts from the end.
    width = np.int64(right - left + 2)
    standing = np.full((runs[-1, ROW] - top + 3) * width, np.int32(-1), np.int32)
    # An accepted region: its first pixel, number of pixels, box and threshold.
    found, n_found = np.empty((len(pixels), 7), np.int32), 0
    for level in range(len(thresholds)):
        for i in range(start[level], start[level + 1]):
            x, y, value = pixels[i, 0], pixels[i, 1], pixels[i, 2]
            sets[i, PARENT] = sets[i, LAST] = i
            sets[i, LEFT] = sets[i, RIGHT] = x
            sets[i, TOP] = sets[i, BOTTOM] = y
            sets[i, PEAK] = sets[i, DARKEST] = value
            sets[i, SIZE], sets[i, N_TARGETS], sets[i, REGION], sets[i, CHECKED] = 1, 0, -1, -1
            place = (y - top + 1) * width + x - left + 1
            standing[place] = i
            mine = np.uint64(i)
            for v in range(place - width, place + width + 1, width):
                for u in range(v - 1, v + 2):
                    beside = standing[np.uint64(u)]
                    # as whole numbers without a sign on both sides: others would be compared as floating point
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
            size_x = sets[root, RIGHT] - sets[root, LEFT] + 1
            size_y = sets[root, BOTTOM] - sets[root, TOP] + 1
            contrast = sets[root, PEAK] - sets[root, DARKEST]
            if sets[root, N_TARGETS] > 1 or not is_target(size_x, size_y, contrast, search):
                continue
            if sets[root, N_TARGETS] == 0:
                sets[root, N_TARGETS], sets[root, REGION] = 1, n_found
                n_found += 1
            t = sets[root, REGION]
            found[t, 0], found[t, 1], found[t, 2] = root, sets[root, SIZE], sets[root, LEFT]
            found[t, 3], found[t, 4] = sets[root, RIGHT], sets[root, TOP]
            found[t, 5], found[t, 6] = sets[root, BOTTOM], thresholds[level]

    # Mark each region's pixels in the box, then read them out row by row.
    standing[:] = -1
    for r in range(n_found):
        i = found[r, 0]
        for _ in range(found[r, 1]):
            standing[(pixels[i, 1] - top + 1) * width + pixels[i, 0] - left + 1] = r
            i = sets[i, NEXT]
    region_runs = np.empty((len(pixels), 4), np.int32)
    n = 0
    for r in range(n_found):
        for y in range(found[r, 4], found[r, 5] + 1):
            inside, place = False, (y - top + 1) * width - left + 1
            for x in range(found[r, 2], found[r, 3] + 2):
                if (standing[np.uint64(place + x)] == r) == inside:
                    continue
                inside = not inside
                if inside:
                    region_runs[n, 0], region_runs[n, 1], region_runs[n, 2] = r, y, x
                else:
                    region_runs[n, 3] = x
                    n += 1
    return found[:n_found, 6], region_runs[:n]


@step
def find_regions(
    runs: Array, values: Array, search: Search, image: int, found: Array, regions: Array, n: int, r: int
) -> tuple[int, int, int]:
    """Write the targets of one image, from run n and region r on; return where both end, and the lowest threshold.

    ``found`` (m, 3) and ``regions`` (k, 4): as ``find_regions_in_set`` returns them.
    """
    thresholds = threshold_sequence(values, search)
    lowest = thresholds[-1]
    if lowest > search.lowest + 1:
        runs = runs_above(runs, values, lowest)
    runs, blob_start = blobs_of(runs)
    for blob in range(len(blob_start) - 1):
        begin, end = np.int64(blob_start[blob]), np.int64(blob_start[blob + 1])
        left, right = runs[begin, FIRST], runs[begin, END]
        for i in range(begin + 1, end):
            left = min(left, runs[i, FIRST])
            right = max(right, runs[i, END])
        size_x, size_y = right - left, runs[end - 1, ROW] - runs[begin, ROW] + 1
        if min(size_x, size_y) <= search.smallest_px:
            continue  # and so is every region within
        darkest, peak, dip = survey(runs, begin, end, values, lowest, (left + right) // 2)
        if peak - darkest <= search.contrast:
            continue  # likewise
        whole = is_target(size_x, size_y, peak - darkest, search)
        if whole and dip > search.contrast + 1:
            # the noise of a bright target makes simple paths dip: look for the best
            box = (left, right, runs[begin, ROW], runs[end - 1, ROW] + 1)
            whole = not passes_below(runs[begin:end], values, box, search.contrast + 1)
        if whole:
            # Two disjoint regions are accepted only with a dip between their summits to the threshold of
            # one of them, that is by more than B + 1, since Bmax - Bmin > B and Bmin > threshold. No path
            # here dips as deep, so N < 2 at every threshold and the whole blob is the region.
            regions[r, 0], regions[r, 1], regions[r, 2], regions[r, 3] = image, n, n + end - begin, lowest
            r += 1
            for i in range(begin, end):
                found[n, 0], found[n, 1], found[n, 2] = runs[i, ROW], runs[i, FIRST], runs[i, END]
                n += 1
            continue
        grown_thresholds, grown_runs = grow_regions(runs[begin:end], values, thresholds, search)
        i = 0
        for k in range(len(grown_thresholds)):
            regions[r, 0], regions[r, 1], regions[r, 3] = image, n, grown_thresholds[k]
            while i < len(grown_runs) and grown_runs[i, 0] == k:
                found[n, 0], found[n, 1], found[n, 2] = grown_runs[i, 1], grown_runs[i, 2], grown_runs[i, 3]
                i += 1
                n += 1
            regions[r, 2] = n
            r += 1
    return n, r, lowest


@kernel
def find_regions_in_set(
    runs: Array, values: Array, run_start: Array, value_start: Array, search: Search
) -> tuple[Array, Array, Array]:
    """Find the targets of all images of a frame set.

    Takes what ``mosca.detection.bright_runs.scan_set`` returns. Returns the runs (m, 3) sorted by image and region;
    one row (r, 4) a region: image, first run, end run, threshold; and each image's lowest threshold (n).
    """
    n_images = len(run_start) - 1
    lowest = np.empty(n_images, np.int32)
    found, regions = np.empty((len(values), 3), np.int32), np.empty((len(values), 4), np.int32)
    n, r = 0, 0
    for i in range(n_images):
        n, r, lowest[i] = find_regions(
            runs[run_start[i] : run_start[i + 1]], values[value_start[i] : value_start[i + 1]], search, i,
            found, regions, n, r,
        )  # fmt: skip
    return found[:n], regions[:r], lowest
