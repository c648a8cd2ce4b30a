"""Compiled search for targets: thresholds, blobs, accepted regions.

Called by ``mosca.detection.frame_set_kernel``; ``mosca.detection.detect`` defines what a target is and names the
source. It runs without the GIL, on one thread, in whole numbers only, so the same image always gives the same
regions. A *blob* is an 8-connected set of runs at the lowest threshold.
"""

from typing import Any

import numpy as np

from mosca.data.arrays import Array
from mosca.detection.bright_runs import BrightPixels
from mosca.detection.region_growth import grow_regions
from mosca.detection.search import END, FIRST, PLACE, ROW, FoundRegions, Search, is_target
from mosca.numba_support.decorators import bare_step, step
from mosca.numba_support.union_find import root_of, unite


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
    room = 0
    for i in range(len(runs)):
        room += (runs[i, END] - runs[i, FIRST] + 1) // 2
    above = np.empty((room, 4), np.int32)
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
            unite(parent, i, j)
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
    in_order = np.empty((n, runs.shape[1]), np.int32)
    for i in range(n):
        at = start[blob[i] + 1]
        start[blob[i] + 1] += 1
        for c in range(runs.shape[1]):
            in_order[at, c] = runs[i, c]
    return in_order, start[: n_blobs + 1]


@bare_step
def link_to(runs: Array, i: int, j: int, x: int, values: Array, column: int) -> Any:
    """Return the least grey value on the way from pixel x of run i through run j to ``column``, -1 without a way."""
    first, end = runs[j, FIRST], runs[j, END]
    touches = abs(runs[i, ROW] - runs[j, ROW]) == 1 and runs[i, FIRST] <= end and first <= runs[i, END]
    if not touches or not first <= column < end:
        return np.int32(-1)
    start = min(max(x, first), end - 1)
    least = np.int32(65535)
    for k in range(runs[j, PLACE] + min(start, column) - first, runs[j, PLACE] + max(start, column) - first + 1):
        least = min(least, values[k])
    return least


@bare_step
def survey(
    runs: Array, first_run: int, end_run: int, values: Array, lowest: int, column: int
) -> tuple[Any, Any, Any]:
    """Return the smallest and the largest grey value of a blob, and an upper bound of the dips between its summits.

    ``first_run``, ``end_run``: index of the blob's first run and of the one after its last.

    From each pixel a path leads along its run to ``column`` and along that column to every other row. The bound is
    the deepest dip below both ends of such a path. Where the first or the last run does not reach the column, the
    path goes on in the next run. Where another run does not reach it, or the column leaves the blob, the path is
    taken to dip to ``lowest``.
    """
    darkest, peak, dip = np.int32(65535), np.int32(0), np.int32(0)
    low, last_row = np.int32(65535), runs[first_run, ROW] - 1
    for i in range(first_run, end_run):
        first, end, place = runs[i, FIRST], runs[i, END], runs[i, PLACE]
        nearest = min(max(column, first), end - 1)
        passed = np.int32(65535)
        if nearest != column:
            if i == first_run < end_run - 1:
                passed = link_to(runs, i, i + 1, nearest, values, column)
            elif first_run < i == end_run - 1:
                passed = link_to(runs, i, i - 1, nearest, values, column)
            else:
                passed = np.int32(-1)
        if passed < 0:
            for k in range(place, place + end - first):
                darkest = min(darkest, values[k])
                peak = max(peak, values[k])
                dip = max(dip, values[k] - lowest)
            continue
        middle = place + nearest - first
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
        passed = min(passed, values[middle])
        low = min(low, passed)
        if runs[i, ROW] != last_row + 1:
            low = min(low, np.int32(lowest))
        last_row = runs[i, ROW]
        dip = max(dip, min(here, peak) - low)
        if here > peak:
            peak, low = here, passed
    return darkest, peak, dip


@bare_step
def falls_between(highest: Array, most: float) -> bool:
    """Return whether a sequence falls by more than ``most`` and rises by as much again."""
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
    """Return whether two summits of a blob are parted by a dip of more than ``most`` below the lower one.

    The dip is exact: it is that of the highest pass between the summits. Pixels are added in the order of falling
    grey values, and the pixel at which two components meet is the pass between their summits. ``box``: left, end
    column, top, end row.
    """
    left, right, top, bottom = box
    width = right - left + 2
    n, darkest, peak = 0, values[runs[0, PLACE]], values[runs[0, PLACE]]
    # shortcut: a row or column between two summits, all of it far below both, proves the dip
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
    # index of each pixel in the box, with one pixel of rim; sorted by falling grey value
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
    # union-find: a component is represented by its brightest pixel, the first that was added
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
def write_whole(
    runs: Array, begin: int, end: int, told: tuple[int, int, int], found: Array, regions: Array, n: int, r: int
) -> tuple[int, int]:
    """Write a blob as a target, from run n and region r on; return where both end.

    ``told``: image, threshold, floor.
    """
    regions[r, 0], regions[r, 1], regions[r, 2], regions[r, 3], regions[r, 4] = (
        told[0],
        n,
        n + end - begin,
        told[1],
        told[2],
    )
    for i in range(begin, end):
        found[n, 0], found[n, 1], found[n, 2] = runs[i, ROW], runs[i, FIRST], runs[i, END]
        n += 1
    return n, r + 1


@bare_step
def write_grown(
    thresholds: Array, runs: Array, told: tuple[int, int], found: Array, regions: Array, n: int, r: int
) -> tuple[int, int]:
    """Write the targets that ``grow_regions`` returns, as ``write_whole``. ``told``: image, floor."""
    i = 0
    for k in range(len(thresholds)):
        regions[r, 0], regions[r, 1], regions[r, 3], regions[r, 4] = told[0], n, thresholds[k], told[1]
        while i < len(runs) and runs[i, 0] == k:
            found[n, 0], found[n, 1], found[n, 2] = runs[i, 1], runs[i, 2], runs[i, 3]
            i += 1
            n += 1
        regions[r, 2] = n
        r += 1
    return n, r


@step
def find_regions(
    runs: Array, values: Array, search: Search, image: int, found: Array, regions: Array, n: int, r: int
) -> tuple[int, int]:
    """Write the targets of one image, from run n and region r on; return where both end.

    ``found`` (m, 3) and ``regions`` (k, 5): as ``find_regions_in_set`` returns them.
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
            continue  # too small, and so is every region within
        darkest, peak, dip = survey(runs, begin, end, values, lowest, (left + right) // 2)
        if peak - darkest <= search.contrast:
            continue  # too faint, and so is every region within
        whole = is_target(size_x, size_y, peak - darkest, search)
        if whole and dip > search.contrast + 1:
            # the noise of a bright target makes simple paths dip: find the best path
            box = (left, right, runs[begin, ROW], runs[end - 1, ROW] + 1)
            whole = not passes_below(runs[begin:end], values, box, search.contrast + 1)
        if whole:
            # Two disjoint regions are accepted only with a dip between their summits to the threshold of
            # one of them, that is by more than B + 1, since Bmax - Bmin > B and Bmin > threshold. No path
            # here dips as deep, so N < 2 at every threshold and the whole blob is the region.
            n, r = write_whole(runs, begin, end, (image, lowest, lowest), found, regions, n, r)
            continue
        grown_thresholds, grown_runs = grow_regions(runs[begin:end], values, thresholds, search)
        n, r = write_grown(grown_thresholds, grown_runs, (image, lowest), found, regions, n, r)
    return n, r


@step
def find_regions_in_set(bright: BrightPixels, search: Search) -> FoundRegions:
    """Find the targets of all images of a frame set among the pixels above the lowest threshold."""
    values, run_start, value_start = bright.values, bright.run_start, bright.value_start
    n_images = len(run_start) - 1
    found, regions = np.empty((len(values), 3), np.int32), np.empty((len(values), 5), np.int32)
    n, r = np.int64(0), np.int64(0)
    for i in range(n_images):
        own_runs = bright.runs[run_start[i] : run_start[i + 1]]
        own_values = values[value_start[i] : value_start[i + 1]]
        n, r = find_regions(own_runs, own_values, search, i, found, regions, n, r)
    return FoundRegions(found[:n], regions[:r], np.empty((r, 4)))
