"""Spatial indexes that find neighbours in constant time.

``mosca.correspondence.candidates`` and ``mosca.correspondence.selection`` use two of them. Buckets hold intervals on
a line: the rays of two cameras by the angle of their epipolar plane about the base, or tracks by one coordinate.
Cells of a plane hold the rays of a camera, by stereographic projection of their directions from the camera's axis. It
is finite for every direction but straight behind and maps circles to circles.
"""

from typing import Any, NamedTuple

import numpy as np

from mosca.data.rays import ROTATION, SPREAD
from mosca.numba_support.decorators import bare_step, step

MOST_BUCKETS = 16
"""An interval over more buckets than this is kept in a list that every search reads."""
CORNER, SCALE, CELLS, FIRST, FRAME = 0, 2, 4, 5, 6
"""Columns of a camera's frame of cells: its corner (2), cells per unit (2), cells per side, number of its first
cell."""


class Buckets(NamedTuple):
    """Intervals on a line, sorted into buckets."""

    low: float
    """Where the first bucket begins."""
    step: float
    """Width of a bucket."""
    first: Any
    """(n,) first bucket of each interval."""
    start: Any
    """Bucket k holds ``items[start[k]:start[k + 1]]``."""
    items: Any
    wide: Any
    """Intervals in no bucket: every search reads them."""


@step
def buckets(middle, half):
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


@bare_step
def bucket_of(value, low, step, n):
    """Return the bucket of a value: an end bucket for values beyond the ends, the first for NaN."""
    at = (value - low) / step
    return int(min(at, n + 0.0)) if at > 0.0 else 0


@bare_step
def within(line, middle, half, found):
    """Fill ``found`` (n,) with the intervals that may meet ``middle`` -+ ``half``, each once; returns how many."""
    low, step, first_of, start, items, wide = line
    n, count = first_of.shape[0], 0
    if not np.isfinite(half):
        for k in range(n):
            found[k] = k
        return n
    for k in wide:
        found[count] = k
        count += 1
    first = bucket_of(middle - half, low, step, n)
    last = bucket_of(middle + half, low, step, n)
    for b in range(first, last + 1):
        for at in range(start[b], start[b + 1]):
            k = items[at]
            # an interval in several of these buckets is reported in the first that it shares
            if b == max(first, first_of[k]):
                found[count] = k
                count += 1
    return count


@step
def cells(rays, views, start):
    """Sort the rays (n, COLUMNS) of all cameras into cells of about one ray; rays without a direction into none.

    Returns each camera's frame (c, FRAME), ``first`` and ``items``, and coordinates (n, 2) in the plane in the order
    of ``items``. Cell k holds ``items[first[k]:first[k + 1]]``.
    """
    cameras, n = views.shape[0], rays.shape[0]
    place, cell, frame = np.empty((n, 2)), np.full(n, -1, dtype=np.int64), np.zeros((cameras, FRAME))
    total = 0
    for c in range(cameras):
        for k in range(2):
            low, high = np.inf, -np.inf
            for i in range(start[c], start[c + 1]):
                across, along = 0.0, 1.0
                for p in range(3):
                    across += views[c, ROTATION + 3 * p + k] * rays[i, p]
                    along += views[c, ROTATION + 3 * p + 2] * rays[i, p]
                place[i, k] = across / along
                if np.isfinite(place[i, k]):
                    low, high = min(low, place[i, k]), max(high, place[i, k])
            side = max(1.0, np.floor(np.sqrt(start[c + 1] - start[c])))
            frame[c, CORNER + k] = low if high >= low else 0.0
            frame[c, SCALE + k] = side / (high - low) if high > low else 0.0
        frame[c, CELLS], frame[c, FIRST] = side, total
        total += int(side * side)
        for i in range(start[c], start[c + 1]):
            if np.isfinite(place[i, 0]) and np.isfinite(place[i, 1]):
                column = cell_of(place[i, 0], frame[c, CORNER], frame[c, SCALE], side)
                row = cell_of(place[i, 1], frame[c, CORNER + 1], frame[c, SCALE + 1], side)
                cell[i] = int(frame[c, FIRST] + row * side + column)
    first, items, sorted_place = (np.zeros(total + 2, dtype=np.int64), np.empty(n, dtype=np.int64), np.empty((n, 2)))
    for i in range(n):
        if cell[i] >= 0:
            first[cell[i] + 2] += 1
    for k in range(1, total + 2):
        first[k] += first[k - 1]
    for i in range(n):
        if cell[i] >= 0:
            at = first[cell[i] + 1]
            items[at], sorted_place[at, 0], sorted_place[at, 1] = i, place[i, 0], place[i, 1]
            first[cell[i] + 1] += 1
    return frame, first, items, sorted_place


@bare_step
def cell_of(value, corner, scale, side):
    """Return the row or column of a coordinate, clamped to the first and last; the first for NaN."""
    at = (value - corner) * scale
    return int(min(at, side - 1.0)) if at > 0.0 else 0


@bare_step
def plane_angles(rays, chosen, across, angle, variance):
    """Fill the angle (n,) of the epipolar planes of the rays ``chosen`` (n,) and its variance (n,) [rad^2].

    ``across`` (2, 3): unit vectors perpendicular to the base and to each other; angles count from the first to the
    second.
    """
    x, y, z, u, v, w = across[0, 0], across[0, 1], across[0, 2], across[1, 0], across[1, 1], across[1, 2]
    for n in range(chosen.shape[0]):
        i = chosen[n]
        p = rays[i, 0] * x + rays[i, 1] * y + rays[i, 2] * z
        q = rays[i, 0] * u + rays[i, 1] * v + rays[i, 2] * w
        square = p * p + q * q
        angle[n] = np.arctan2(q, p)
        # the plane's normal, times the sine of the ray's angle to the base
        a, b, c = p * u - q * x, p * v - q * y, p * w - q * z
        s = a * rays[i, SPREAD] + b * rays[i, SPREAD + 2] + c * rays[i, SPREAD + 4]
        t = a * rays[i, SPREAD + 1] + b * rays[i, SPREAD + 3] + c * rays[i, SPREAD + 5]
        variance[n] = (s * s + t * t) / (square * square)
