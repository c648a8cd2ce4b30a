"""Colours by error on a stated scale, and trails, for the Rerun viewer."""

import math
from collections import deque

import numpy as np

from mosca.data.arrays import Array
from reports.plot_style import HEAT

FALSE_POINT, TRUE_POINT = (204, 121, 167), (120, 130, 140)
"""Colours of measured points that belong to no marker, and of true positions (Okabe and Ito's purple; grey)."""
TRAIL_S, TRAIL_STEPS = 0.5, 10
"""Length of a trail, and most points in it: each instant stores all its trails, which must not fill the disk."""
POINT_SHARE, TRUE_SHARE, LINE_SHARE = 0.006, 0.003, 0.0012
"""Radii of points, true points and lines as shares of the scene's diagonal: some pixels when all of it is in view.

A true point lies inside the measured one, and is visible where that is missing or far off."""


def scale_top(values: Array) -> float:
    """Return the upper end of a scale of ``values``: their 95 % quantile, rounded up to two digits; 1 without any."""
    values = np.asarray(values)[np.isfinite(values)]
    top = float(np.quantile(values, 0.95)) if len(values) else 0.0
    if not top > 0:
        return 1.0
    step = 10.0 ** (math.floor(math.log10(top)) - 1)
    return math.ceil(round(top / step, 6)) * step


def coloured(values: Array, top: float) -> Array:
    """Return a colour (n, 3) uint8 for each of ``values`` (n,), from 0 to ``top`` and above; NaN is a false point."""
    values = np.asarray(values, float)
    colours = np.round(255 * HEAT(np.clip(np.nan_to_num(values) / top, 0.0, 1.0))[:, :3]).astype(np.uint8)
    colours[np.isnan(values)] = FALSE_POINT
    result: Array = colours
    return result


class Trails:
    """The latest path of each track, cut where the track is missing for a step."""

    def __init__(self) -> None:
        self._paths: dict[int, deque[tuple[int, Array]]] = {}

    def step(self, time_ns: int, xyz: Array, ids: Array) -> list[Array]:
        """Return the paths (k, 3) of the tracks ``ids`` (n,) that are now at ``xyz`` (n, 3), one for each, k >= 1."""
        paths, spacing_ns = {}, 1e9 * TRAIL_S / TRAIL_STEPS
        for name, point in zip(np.asarray(ids).tolist(), np.asarray(xyz), strict=True):
            path = self._paths.get(name, deque())
            # the last point is moved until it is far enough from the one before
            if len(path) > 1 and path[-1][0] - path[-2][0] < spacing_ns:
                path.pop()
            path.append((time_ns, np.array(point)))
            while time_ns - path[0][0] > 1e9 * TRAIL_S:
                path.popleft()
            paths[name] = path
        self._paths = paths
        return [np.array([point for _, point in path]) for path in paths.values()]
