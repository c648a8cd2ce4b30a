"""Where to look: indexes that let ``mosca.match_search`` and ``mosca.match_choose`` find neighbours in no time.

Two of them. Intervals on a line in buckets: the rays of two cameras by the angle of their epipolar plane about the
base, or tracks by one coordinate. Rays of a camera in the cells of a plane: directions by stereographic projection from
the camera's axis, which is finite for every direction but straight behind and turns circles into circles.
"""

from typing import Any, NamedTuple

import numpy as np
from numba import njit

MOST_BUCKETS = 16
"""An interval over more buckets than this is kept in a list that every search reads."""


class Buckets(NamedTuple):
    """Intervals (n,) of a line: ``first`` (n,) bucket of each; bucket k holds ``items[start[k]:start[k + 1]]``;
    ``wide``: those in no bucket.
    """

    low: float
    step: float
    first: Any
    start: Any
    items: Any
    wide: Any


@njit(nogil=True, cache=True, error_model="numpy")
def buckets(middle, half):  # type: ignore[no-untyped-def]
    """Put intervals ``middle`` -+ ``half`` (n,) into about n buckets; infinite ones are wide."""
    n = middle.shape[0]
    low, high = np.inf, -np.inf
    for k in range(n):
        if np.isfinite(half[k]):
            low, high = min(low, middle[k]), max(high, middle[k])
    step = max((high - low) / (n + 1), 1e-300) if high >= low else 1.0
    first, last = np.zeros(n, dtype=np.int64), np.full(n, -1, dtype=np.int64)
    start, wide_count = np.zeros(n + 3, dtype=np.int64), 0
    for k in range(n):
        if np.isfinite(half[k]) and half[k] <= 0.5 * MOST_BUCKETS * step:
            first[k] = bucket_of(middle[k] - half[k], low, step, n)
            last[k] = bucket_of(middle[k] + half[k], low, step, n)
            for b in range(first[k], last[k] + 1):
                start[b + 2] += 1
        else:
            wide_count += 1
    for b in range(1, n + 3):
        start[b] += start[b - 1]
    items, wide = np.empty(start[n + 2], dtype=np.int64), np.empty(wide_count, dtype=np.int64)
    wide_count = 0
    for k in range(n):
        if last[k] < 0:
            wide[wide_count] = k
            wide_count += 1
        for b in range(first[k], last[k] + 1):
            items[start[b + 1]] = k
            start[b + 1] += 1
    return Buckets(low, step, first, start, items, wide)


@njit(nogil=True, cache=True, error_model="numpy")
def bucket_of(value, low, step, n):  # type: ignore[no-untyped-def]
    """Return the bucket of a value, the end ones for what lies beyond."""
    return int(min(max((value - low) / step, 0.0), n + 0.0))


@njit(nogil=True, cache=True, error_model="numpy")
def within(index, middle, half, found):  # type: ignore[no-untyped-def]
    """Fill ``found`` (n,) with the intervals that may meet ``middle`` -+ ``half``, each once; returns how many."""
    n, count = index.first.shape[0], 0
    if not np.isfinite(half):
        for k in range(n):
            found[k] = k
        return n
    for k in index.wide:
        found[count] = k
        count += 1
    first = bucket_of(middle - half, index.low, index.step, n)
    last = bucket_of(middle + half, index.low, index.step, n)
    for b in range(first, last + 1):
        for at in range(index.start[b], index.start[b + 1]):
            k = index.items[at]
            # an interval in several of these buckets is reported in the first that it shares
            if b == max(first, index.first[k]):
                found[count] = k
                count += 1
    return count


class Cells(NamedTuple):
    """Rays in the cells of their images: ``place`` (n, 2) stereographic; for each camera ``corner`` (c, 2) and
    ``scale`` (c, 2) cells a unit, ``side`` (c,) cells a side, ``offset`` (c,) of its first cell; ``start``, ``items``.
    """

    place: Any
    corner: Any
    scale: Any
    side: Any
    offset: Any
    start: Any
    items: Any


@njit(nogil=True, cache=True, error_model="numpy")
def cells(direction, rotation, start):  # type: ignore[no-untyped-def]
    """Sort all rays (n, 3) into cells of about one ray; rays without a direction into none."""
    cameras, n = rotation.shape[0], direction.shape[0]
    place, cell = np.empty((n, 2)), np.full(n, -1, dtype=np.int64)
    corner, scale = np.zeros((cameras, 2)), np.zeros((cameras, 2))
    side, offset = np.ones(cameras, dtype=np.int64), np.zeros(cameras, dtype=np.int64)
    total = 0
    for c in range(cameras):
        r = rotation[c]
        low, high = np.full(2, np.inf), np.full(2, -np.inf)
        for i in range(start[c], start[c + 1]):
            d = direction[i]
            z = 1.0 + r[0, 2] * d[0] + r[1, 2] * d[1] + r[2, 2] * d[2]
            for k in range(2):
                place[i, k] = (r[0, k] * d[0] + r[1, k] * d[1] + r[2, k] * d[2]) / z
                if np.isfinite(place[i, k]):
                    low[k], high[k] = min(low[k], place[i, k]), max(high[k], place[i, k])
        side[c] = max(1, int(np.sqrt(start[c + 1] - start[c])))
        offset[c] = total
        total += side[c] * side[c]
        for k in range(2):
            corner[c, k] = low[k]
            scale[c, k] = side[c] / (high[k] - low[k]) if high[k] > low[k] else 0.0
        for i in range(start[c], start[c + 1]):
            if np.isfinite(place[i, 0]) and np.isfinite(place[i, 1]):
                x = cell_of(place[i, 0], corner[c, 0], scale[c, 0], side[c])
                y = cell_of(place[i, 1], corner[c, 1], scale[c, 1], side[c])
                cell[i] = offset[c] + y * side[c] + x
    first, items = np.zeros(total + 2, dtype=np.int64), np.empty(n, dtype=np.int64)
    for i in range(n):
        if cell[i] >= 0:
            first[cell[i] + 2] += 1
    for k in range(1, total + 2):
        first[k] += first[k - 1]
    for i in range(n):
        if cell[i] >= 0:
            items[first[cell[i] + 1]] = i
            first[cell[i] + 1] += 1
    return Cells(place, corner, scale, side, offset, first, items)


@njit(nogil=True, cache=True, error_model="numpy")
def cell_of(value, corner, scale, side):  # type: ignore[no-untyped-def]
    """Return the row or column of a place, the end ones for what lies beyond."""
    return int(min(max((value - corner) * scale, 0.0), side - 1.0))


@njit(nogil=True, cache=True, error_model="numpy")
def plane_angles(rays, chosen, up, out, angle, variance):  # type: ignore[no-untyped-def]
    """Fill the angle (n,) of the epipolar planes of the rays ``chosen`` (n,) and its variance (n,) [rad^2].

    ``up`` and ``out``: unit vectors across the base and each other, from which angles count.
    """
    for n in range(chosen.shape[0]):
        d, spread = rays.direction[chosen[n]], rays.spread[chosen[n]]
        p = d[0] * up[0] + d[1] * up[1] + d[2] * up[2]
        q = d[0] * out[0] + d[1] * out[1] + d[2] * out[2]
        across2 = p * p + q * q
        angle[n] = np.arctan2(q, p)
        # the plane's normal, times the sine of the ray's angle to the base
        x, y, z = p * out[0] - q * up[0], p * out[1] - q * up[1], p * out[2] - q * up[2]
        s = x * spread[0, 0] + y * spread[1, 0] + z * spread[2, 0]
        t = x * spread[0, 1] + y * spread[1, 1] + z * spread[2, 1]
        variance[n] = (s * s + t * t) / (across2 * across2)
