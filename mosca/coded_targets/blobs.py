"""Bright patches of an image: 8-connected pixels above the middle of their surroundings, as sums over each patch.

A part of ``mosca.coded_targets.detect``, which describes the method. Patches are built of runs (unbroken rows of
bright pixels), so that the dark part of an image, nearly all of it, is tested eight pixels at a time.
"""

import cv2
import numpy as np

from mosca.data.arrays import Array
from mosca.numba_support.decorators import kernel, step

NEIGHBOURHOOD_PX = 15
COUNT, SUM_X, SUM_Y, SUM_XX, SUM_XY, SUM_YY, LEFT, RIGHT, TOP, BOTTOM = range(10)
N_SUMS = 10
LANES = 8  # pixels a word


def bright_patches(image: Array, contrast_dn: float, noise_dn: float) -> Array:
    """Return (n, N_SUMS) int64 number of pixels, sums of x, y, xx, xy, yy, and first and last column and row.

    There is a row for each patch of an image (H, W), in the order of their first pixels. A pixel is bright when it
    exceeds the middle between the smallest and the largest grey value around it and these differ by more than
    ``contrast_dn``.
    """
    if noise_dn > contrast_dn / 12:
        image = cv2.GaussianBlur(image, (3, 3), 0.6)
    window = np.ones((NEIGHBOURHOOD_PX, NEIGHBOURHOOD_PX), np.uint8)
    low, high = cv2.erode(image, window), cv2.dilate(image, window)
    bright = image > np.asarray(cv2.addWeighted(low, 0.5, high, 0.5, 0.0))
    bright &= np.asarray(cv2.subtract(high, low)) > contrast_dn
    flat = np.zeros(-(-bright.size // LANES) * LANES, np.uint8)
    flat[: bright.size] = bright.ravel()
    result: Array = patch_sums(flat, flat.view(np.uint64), image.shape[1])
    return result


@kernel
def patch_sums(flat: Array, words: Array, width: int) -> Array:
    """Return the table of ``bright_patches`` from the pixels of an image row by row, as bytes and as words of 8."""
    n, end = 0, -1
    for w in range(len(words)):  # how many runs there are
        if words[w]:
            for p in range(LANES * w, LANES * (w + 1)):
                if flat[p]:
                    n += p != end or p % width == 0
                    end = p + 1
    runs, parent = np.empty((n, 3), np.int64), np.arange(n)
    n, end = 0, -1
    for w in range(len(words)):
        if words[w]:
            for p in range(LANES * w, LANES * (w + 1)):
                if flat[p]:
                    if p != end or p % width == 0:
                        runs[n, 0], runs[n, 1] = p // width, p % width
                        n += 1
                    runs[n - 1, 2] = p % width
                    end = p + 1
    above = 0
    for k in range(n):
        while runs[above, 0] < runs[k, 0] - 1:
            above += 1
        j = above
        while runs[j, 0] < runs[k, 0] and runs[j, 1] <= runs[k, 2] + 1:  # corners touch
            if runs[j, 2] + 1 >= runs[k, 1]:
                a, b = root(parent, j), root(parent, k)
                parent[max(a, b)] = min(a, b)
            j += 1
    number, n_patches = np.empty(n, np.int64), 0
    for k in range(n):
        if parent[k] == k:
            number[k] = n_patches
            n_patches += 1
        else:
            parent[k] = root(parent, k)
            number[k] = number[parent[k]]
    sums = np.zeros((n_patches, N_SUMS), np.int64)
    sums[:, LEFT], sums[:, TOP] = width, len(flat)
    for k in range(n):
        y, first, last, own = runs[k, 0], runs[k, 1], runs[k, 2], sums[number[k]]
        count, along = last - first + 1, (last - first + 1) * (first + last) // 2
        own[COUNT] += count
        own[SUM_X] += along
        own[SUM_Y] += y * count
        own[SUM_XX] += squares_to(last) - squares_to(first - 1)
        own[SUM_XY] += y * along
        own[SUM_YY] += y * y * count
        own[LEFT], own[RIGHT] = min(own[LEFT], first), max(own[RIGHT], last)
        own[TOP], own[BOTTOM] = min(own[TOP], y), max(own[BOTTOM], y)
    return sums


@step
def squares_to(n: int) -> int:
    """Return 1 + 4 + ... + n^2."""
    return n * (n + 1) * (2 * n + 1) // 6


@step
def root(parent: Array, k: int) -> int:
    """Return the first run of the patch of run ``k``, shortening the way there."""
    while parent[k] != k:
        parent[k] = parent[parent[k]]
        k = parent[k]
    return k
