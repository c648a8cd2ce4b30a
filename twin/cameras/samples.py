"""A marker partly hidden: rays through a fine grid over its image, spread by the pixel kernel.

16 samples a pixel each way (large images: 8) ask what is in front at mid-exposure; the visible ones are spread
along the marker's image motion.
"""

import math

import numpy as np
from numba import njit

from twin.cameras.kernel import weight
from twin.cameras.lens import land, origin
from twin.cameras.marker_view import FLAT, instants, place_at, rim
from twin.cameras.outline import LEAST_E


@njit(nogil=True, cache=True)
def sample_rays(lens, centre, normal, r, shape):  # type: ignore[no-untyped-def]
    """Rays through a fine grid over the marker's image, those that meet the marker.

    Returns directions (n, 3), the grid cell (n, 2) that each goes through (column, row), and the grid
    (left, top, step, columns, rows) [px].
    """
    x, y, z = centre[0], centre[1], centre[2]
    left, right, top, bottom = 1e9, -1e9, 1e9, -1e9
    for j in range(24):
        dx, dy, dz, _a, _b, _c = rim(shape, normal, x, y, z, 1.02 * r, 2.0 * math.pi * j / 24)
        pu, pv, _d, _e, _f, _g, _h, _i, ok = land(lens, dx, dy, dz)
        if ok:
            left, right = min(left, pu), max(right, pu)
            top, bottom = min(top, pv), max(bottom, pv)
    size = max(right - left, bottom - top)
    per_px = 16 if size < 12.0 else 8
    step = 1.0 / per_px
    columns, rows = int((right - left) * per_px) + 2, int((bottom - top) * per_px) + 2
    if size < 0.0 or size > 4000.0:
        columns, rows = 0, 0
    directions = np.empty((columns * rows, 3))
    cell = np.empty((columns * rows, 2), dtype=np.int64)
    n = 0
    for j in range(rows):
        pv = top + (j + 0.5) * step
        for i in range(columns):
            pu = left + (i + 0.5) * step
            dx, dy, dz = origin(lens, pu, pv)
            if shape == FLAT:
                across = dx * normal[0] + dy * normal[1] + dz * normal[2]
                if across == 0.0:
                    continue
                t = (x * normal[0] + y * normal[1] + z * normal[2]) / across
                inside = t > 0.0 and (t * dx - x) ** 2 + (t * dy - y) ** 2 + (t * dz - z) ** 2 <= r * r
            else:
                b = dx * x + dy * y + dz * z
                inside = b > 0.0 and b * b >= (dx * dx + dy * dy + dz * dz) * (x * x + y * y + z * z - r * r)
            if inside:
                directions[n, 0], directions[n, 1], directions[n, 2] = dx, dy, dz
                cell[n, 0], cell[n, 1] = i, j
                n += 1
    return directions[:n], cell[:n], (left, top, step, columns, rows)


@njit(nogil=True, cache=True)
def share_seen(height, width, cell, grid, free):  # type: ignore[no-untyped-def]
    """Share of a marker's samples that nothing hides and that lie inside the image."""
    left, top, step, _columns, _rows = grid
    count, seen = cell.shape[0], 0.0
    for n in range(count):
        pu, pv = left + (cell[n, 0] + 0.5) * step, top + (cell[n, 1] + 0.5) * step
        if free[n] and -0.5 <= pu <= width - 0.5 and -0.5 <= pv <= height - 0.5:
            seen += 1.0
    return seen / count if count > 0 else 0.0


@njit(nogil=True, cache=True)
def spread_samples(light, lens, table, reach, path, electrons, cell, grid, free):  # type: ignore[no-untyped-def]
    """Add a marker's visible samples, spread by the pixel kernel along its motion."""
    height, width = light.shape
    left, top, step, columns, rows = grid
    count = cell.shape[0]
    if count == 0:
        return
    at, instant_share = instants(lens, path)
    mu, mv, _a, _b, _c, _d, _e, _f, _ok = land(lens, path[1, 0], path[1, 1], path[1, 2])
    lit = np.zeros((rows, columns))
    for n in range(count):
        if free[n]:
            lit[cell[n, 1], cell[n, 0]] = step * step
    wide = int(columns * step) + 2 * reach + 4
    by_column = np.empty((columns, 2 * reach + 2))
    line = np.empty(wide)
    for k in range(at.shape[0]):
        x, y, z = place_at(path, at[k])
        u, v, _a, _b, _c, _d, _e, _f, ok = land(lens, x, y, z)
        if not ok:
            continue
        x_first, y_first = left + u - mu + 0.5 * step, top + v - mv + 0.5 * step
        px0 = math.floor(x_first) - reach
        for i in range(columns):
            start = math.floor(x_first + i * step) - reach
            for q in range(2 * reach + 2):
                by_column[i, q] = weight(table, reach, start + q - x_first - i * step)
        for j in range(rows):
            line[:] = 0.0
            for i in range(columns):
                if lit[j, i] != 0.0:
                    start = math.floor(x_first + i * step) - reach - px0
                    for q in range(2 * reach + 2):
                        line[start + q] += lit[j, i] * by_column[i, q]
            y_here = y_first + j * step
            py0 = math.floor(y_here) - reach
            for p in range(2 * reach + 2):
                if 0 <= py0 + p < height:
                    w = weight(table, reach, py0 + p - y_here) * electrons * instant_share[k]
                    if w != 0.0:
                        for q in range(wide):
                            if 0 <= px0 + q < width and w * line[q] > 1e-2 * LEAST_E:
                                light[py0 + p, px0 + q] += w * line[q]
