"""A target sampled by rays: where a mesh may hide it, or the lens does not image all of it.

There are 24 samples a pixel in each direction (12 for images of 12 px and more). The blocked part, or the imaged
part, is returned as boundary points: two for each run of such samples in a row.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from mosca.data.arrays import Array
from mosca.numba_support.decorators import kernel
from twin.cameras.optics.lens import pixel_direction, point_at_distance, project
from twin.cameras.optics.lens_vector import PUPIL
from twin.cameras.render.inputs import TargetPose
from twin.cameras.render.outline import BALL, circle_point, outline_circle


class SampleGrid(NamedTuple):
    """A grid of samples over a target's image: its corner and step [px], and its size."""

    left: float
    top: float
    step: float
    columns: int
    rows: int


@kernel
def sample_rays(lens: Array, target: TargetPose, per_px: int) -> Any:
    """Return the rays through a fine grid over the target's image that meet the target (a figure: its disc).

    ``per_px``: samples per pixel and axis, 0: chosen by size. Returns directions (n, 3), the grid
    cell (n, 2) of each ray (column, row), and the grid.
    """
    shape, rotation, x, y, z, r = target
    circle = outline_circle(target, 1.02 * r)
    left, right, top, bottom = 1e9, -1e9, 1e9, -1e9
    for j in range(24):
        dx, dy, dz, _a, _b, _c = circle_point(circle, 2.0 * math.pi * j / 24)
        pu, pv, _d, _e, _f, _g, _h, _i, ok = project(lens, dx, dy, dz)
        if ok:
            left, right = min(left, pu), max(right, pu)
            top, bottom = min(top, pv), max(bottom, pv)
    size = max(right - left, bottom - top)
    if per_px == 0:
        per_px = 24 if size < 12.0 else 12
    step = 1.0 / per_px
    columns, rows = int((right - left) * per_px) + 2, int((bottom - top) * per_px) + 2
    if size < 0.0 or size > 4000.0:
        columns, rows = 0, 0
    directions = np.empty((columns * rows, 3))
    cell = np.empty((columns * rows, 2), dtype=np.int64)
    n = 0
    away = math.sqrt(x * x + y * y + z * z)
    nx, ny, nz = rotation[0, 2], rotation[1, 2], rotation[2, 2]
    for j in range(rows):
        pv = top + (j + 0.5) * step
        for i in range(columns):
            pu = left + (i + 0.5) * step
            dx, dy, dz = (
                point_at_distance(lens, pu, pv, away) if lens[PUPIL] != 0.0 else pixel_direction(lens, pu, pv)
            )
            # beyond the lens's last direction there is none that lands on the pixel
            lu, lv, _a, _b, _c, _d, _e, _f, ok = project(lens, dx, dy, dz)
            if not ok or abs(lu - pu) + abs(lv - pv) > 1e-3:
                continue
            if shape != BALL:
                towards = dx * nx + dy * ny + dz * nz
                if towards == 0.0:
                    continue
                t = (x * nx + y * ny + z * nz) / towards
                inside = t > 0.0 and (t * dx - x) ** 2 + (t * dy - y) ** 2 + (t * dz - z) ** 2 <= r * r
            else:
                b = dx * x + dy * y + dz * z
                inside = b > 0.0 and b * b >= (dx * dx + dy * dy + dz * dz) * (x * x + y * y + z * z - r * r)
            if inside:
                directions[n, 0], directions[n, 1], directions[n, 2] = dx, dy, dz
                cell[n, 0], cell[n, 1] = i, j
                n += 1
    return directions[:n], cell[:n], SampleGrid(left, top, step, columns, rows)


@kernel
def runs(cell: Array, grid: SampleGrid, chosen: Array, sign: float) -> Any:
    """Boundary points (n, 3) of the chosen cells, row by row: (u, v, dv), the area between them times ``sign``."""
    left, top, step = grid.left, grid.top, grid.step
    count = cell.shape[0]
    out = np.empty((2 * count, 3))
    n = 0
    i = 0
    while i < count:
        if not chosen[i]:
            i += 1
            continue
        last = i
        while (
            last + 1 < count
            and chosen[last + 1]
            and cell[last + 1, 1] == cell[i, 1]
            and cell[last + 1, 0] == cell[last, 0] + 1
        ):
            last += 1
        v = top + (cell[i, 1] + 0.5) * step
        out[n, 0], out[n, 1], out[n, 2] = left + cell[i, 0] * step, v, -sign * step
        out[n + 1, 0], out[n + 1, 1], out[n + 1, 2] = left + (cell[last, 0] + 1) * step, v, sign * step
        n += 2
        i = last + 1
    return out[:n]
