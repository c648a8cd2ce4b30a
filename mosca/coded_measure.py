"""Centres of the dots of coded targets by the estimator of ``mosca.detect``, each dot with a region of its own.

The region is what exceeds half of the dot's contrast within its ellipse (and the pixels it touches); the mask
reaches 2 px beyond it where the gap to the ring is wide, else 1 or 0, so that no light of the ring enters.
"""

import math

import numba
import numpy as np

from mosca.coded_dots import AXX, AXY, AYY, CONTRAST_DN, PLATE_DN, X, Y
from mosca.coded_read import Readings, ellipses_of
from mosca.data.arrays import Array
from mosca.detect_measure import XX, XY, YY, Noise, measure_regions
from mosca.detect_measure import X as COLUMN
from mosca.detect_measure import Y as ROW

REACH = ((8.0, 2), (1.5, 1), (0.0, 0))
"""Shorter semi-axis from which on [px], and how far the mask reaches beyond the region [px]."""
RIM_PX = 1.0
"""How far beyond the dot's ellipse a pixel of its region may lie [px]."""


def measure_dots(
    image: Array, dots: Readings, dark_dn2: float, gain_dn: float, turned_dn: float | None = None
) -> tuple[Array, Array]:
    """Return centres (n, 2) [px] and covariances (n, 2, 2) [px^2] of ``dots``.

    ``image`` (H, W) shows them white. ``turned_dn``: the grey value that was black where the image's grey values
    were turned round: then photon noise grows with the plate's light. ``dark_dn2``, ``gain_dn``: see
    ``mosca.detect_measure.Noise``.
    """
    n = len(dots)
    xy, covariance = np.empty((n, 2)), np.empty((n, 2, 2))
    shorter = ellipses_of(dots.frames)[0][:, 1]
    reach = np.array([next(px for least, px in REACH if axis >= least) for axis in shorter], dtype=int)
    level = np.floor(dots.levels[:, PLATE_DN] + 0.5 * dots.levels[:, CONTRAST_DN]).astype(np.int32)
    batches = [np.flatnonzero(reach == px) for _, px in REACH]
    if turned_dn is not None:  # each plate has a noise of its own
        batches = [np.array([i]) for i in range(n)]
    for batch in batches:
        if not len(batch):
            continue
        noise = Noise(float(dark_dn2), float(gain_dn))
        if turned_dn is not None:
            light = float(turned_dn - dots.levels[batch[0], PLATE_DN])
            noise = Noise(float(dark_dn2 + gain_dn * light), -float(gain_dn))
        runs, regions = dot_regions(image, dots.frames[batch], level[batch])
        each = np.broadcast_to(image, (len(batch), *image.shape))
        rows, _ = measure_regions(each, runs, regions, level[batch], True, int(reach[batch[0]]), noise)
        xy[batch] = rows[:, [COLUMN, ROW]]
        covariance[batch] = rows[:, [XX, XY, XY, YY]].reshape(-1, 2, 2)
    return xy, covariance


@numba.njit(nogil=True, cache=True, error_model="numpy")
def dot_regions(image: Array, frames: Array, level: Array) -> tuple[Array, Array]:
    """Return runs (m, 3) and regions (n, 4) as ``find_regions_in_set`` does, each dot in an image of its own."""
    n_rows = 0
    for i in range(len(frames)):
        n_rows += 2 * int(math.hypot(frames[i, AXY], frames[i, AYY]) + RIM_PX) + 3
    runs, n = np.empty((n_rows, 3), np.int32), 0
    regions = np.empty((len(frames), 4), np.int32)
    for i in range(len(frames)):
        x, y, first_run = frames[i, X], frames[i, Y], n
        axx, axy, ayy = frames[i, AXX] + RIM_PX, frames[i, AXY], frames[i, AYY] + RIM_PX
        det = axx * ayy - axy * axy
        half_x, half_y = math.hypot(axx, axy), math.hypot(axy, ayy)
        left, right = max(int(x - half_x), 0), min(int(x + half_x) + 1, image.shape[1] - 1)
        for row in range(max(int(y - half_y), 0), min(int(y + half_y) + 1, image.shape[0] - 1) + 1):
            first, end, v = right + 1, left, row - y
            for column in range(left, right + 1):
                u = column - x
                inside = math.hypot(ayy * u - axy * v, axx * v - axy * u) <= det
                if inside and image[row, column] > level[i]:
                    first, end = min(first, column), column + 1
            if first < end:
                runs[n, 0], runs[n, 1], runs[n, 2] = row, first, end
                n += 1
        regions[i, 0], regions[i, 1], regions[i, 2], regions[i, 3] = i, first_run, n, level[i]
    return runs[:n], regions
