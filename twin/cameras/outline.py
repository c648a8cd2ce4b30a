"""A marker that nothing hides: Green's theorem along its outline; the image's border cuts it by itself.

The outline (the circle where the viewing cone touches a ball, or a flat target's rim) is mapped through the exact
lens, and the integral of the pixel kernel over its inside becomes one along it. The integrand is smooth
and periodic, so that equal steps converge exponentially: steps of 0.45 px leave errors below 1e-6. Motion
during the exposure is integrated by Gauss-Legendre nodes in time.
"""

import math

import numpy as np
from numba import njit

from twin.cameras.kernel import share, weight
from twin.cameras.lens import land
from twin.cameras.marker_view import instants, place_at, rim

OUTLINE_STEP_PX = 0.45
LEAST_E = 1e-3
"""Light below a thousandth of an electron is left out, so that dark pixels stay exactly dark."""


@njit(nogil=True, cache=True)
def outline_lands(lens, path, normal, r, shape):  # type: ignore[no-untyped-def]
    """Whether the lens images the marker's outline, all of it and at all times, at most 4000 px large."""
    left, right, top, bottom = 1e9, -1e9, 1e9, -1e9
    for k in range(3):
        for j in range(24):
            angle = 2.0 * math.pi * j / 24
            dx, dy, dz, _a, _b, _c = rim(shape, normal, path[k, 0], path[k, 1], path[k, 2], 1.02 * r, angle)
            pu, pv, _d, _e, _f, _g, _h, _i, ok = land(lens, dx, dy, dz)
            if not ok:
                return False
            left, right = min(left, pu), max(right, pu)
            top, bottom = min(top, pv), max(bottom, pv)
    return max(right - left, bottom - top) <= 4000.0


@njit(nogil=True, cache=True)
def add_outline(light, lens, table, reach, path, normal, r, shape, electrons, u, v, diameter):  # type: ignore[no-untyped-def]
    """Add a marker that nothing hides: Green's theorem along its outline, at each instant of the exposure."""
    height, width = light.shape
    at, instant_share = instants(lens, path)
    nodes = at.shape[0]
    points = max(16, int(math.pi * diameter / OUTLINE_STEP_PX) + 1)
    outline = np.empty((nodes * points, 4))
    left, right, top, bottom = 1e9, -1e9, 1e9, -1e9
    for k in range(nodes):
        x, y, z = place_at(path, at[k])
        area = 0.0
        for j in range(points):
            dx, dy, dz, ex, ey, ez = rim(shape, normal, x, y, z, r, 2.0 * math.pi * j / points)
            pu, pv, _ux, _uy, _uz, vx, vy, vz, _ok = land(lens, dx, dy, dz)
            rise = vx * ex + vy * ey + vz * ez
            row = outline[k * points + j]
            row[0], row[1], row[2] = pu, pv, rise
            area += (pu - u) * rise
            left, right = min(left, pu), max(right, pu)
            top, bottom = min(top, pv), max(bottom, pv)
        # the sense of the outline's turn in the image decides the integral's sign
        factor = instant_share[k] * 2.0 * math.pi / points * (1.0 if area > 0.0 else -1.0)
        for j in range(points):
            outline[k * points + j, 3] = factor * outline[k * points + j, 2]
    x0, x1 = math.floor(left) - reach, math.ceil(right) + reach + 1
    y0, y1 = math.floor(top) - reach, math.ceil(bottom) + reach + 1
    # difference from pixel to pixel along the row: only pixels near the outline change
    change = np.zeros((y1 - y0 + 1, x1 - x0 + 2))
    step_x = np.empty(2 * reach + 4)
    for i in range(outline.shape[0]):
        pu, pv, amount = outline[i, 0], outline[i, 1], outline[i, 3]
        px0 = math.floor(pu) - reach
        previous = 1.0
        for q in range(2 * reach + 3):
            here = share(table, reach, pu - (px0 + q))
            step_x[q] = here - previous
            previous = here
        py0 = math.floor(pv) - reach
        for p in range(2 * reach + 2):
            w = weight(table, reach, (py0 + p) - pv)
            if w != 0.0:
                row = change[py0 + p - y0]
                w *= amount
                for q in range(2 * reach + 3):
                    row[px0 + q - x0] += w * step_x[q]
    for p in range(y1 - y0 + 1):
        if y0 + p < 0 or y0 + p >= height:
            continue
        collected = 0.0
        for q in range(x1 - x0 + 1):
            collected += change[p, q]
            if 0 <= x0 + q < width and electrons * collected > LEAST_E:
                light[y0 + p, x0 + q] += electrons * collected
