"""Signed distances of sight lines from obstacles: boxes and cylinders, upright, turned about the vertical.

The signed distance from a convex body is a convex function, also along a line. Its least value between camera and
point is found by golden section. The derivative of this value by the end of the line does not need the derivative of
the place of the minimum (envelope theorem).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from mosca.data.arrays import Array
from mosca.numba_support.decorators import kernel, step

GOLDEN = 0.6180339887498949
"""(sqrt(5) - 1) / 2."""
ITERATIONS = 48
"""0.618^48 = 1e-10 of the line's length."""
KINK = 1e-7
"""Share of the line's length on both sides of its least distance at which gradients are compared."""
BOX, CYLINDER = 0.0, 1.0
"""Kinds, in the first column of an obstacle's row."""


@dataclass(frozen=True)
class Obstacle:
    """An upright box or cylinder that hides points behind it.

    ``center_m`` (3,); ``size_m`` (3,): edges of a box, or diameter, diameter and height of a cylinder; ``yaw_deg``:
    rotation about the vertical.
    """

    kind: Literal["box", "cylinder"]
    center_m: tuple[float, float, float]
    size_m: tuple[float, float, float]
    yaw_deg: float = 0.0


def obstacle_rows(obstacles: Sequence[Obstacle]) -> Array:
    """Return obstacles as rows (n, 9): kind, centre (3), half sizes (3), cosine and sine of the yaw."""
    rows = [
        (
            BOX if one.kind == "box" else CYLINDER, *one.center_m, *(0.5 * edge for edge in one.size_m),
            np.cos(np.deg2rad(one.yaw_deg)), np.sin(np.deg2rad(one.yaw_deg)),
        )
        for one in obstacles
    ]  # fmt: skip
    return np.array(rows, dtype=float).reshape(-1, 9)


@step
def signed_distance(row, x, y, z):
    """Return the signed distance [m] of a point from an obstacle, below 0 inside, and its gradient (3 numbers)."""
    dx, dy, dz = x - row[1], y - row[2], z - row[3]
    c, s = row[7], row[8]
    u, v = c * dx + s * dy, -s * dx + c * dy
    su, sv, sz = np.sign(u), np.sign(v), np.sign(dz)
    if row[0] == CYLINDER:
        around = np.sqrt(u * u + v * v)
        su, sv = (u / around, v / around) if around > 0.0 else (1.0, 0.0)
        q, w, t = around - row[4], -1e30, abs(dz) - row[6]
    else:
        q, w, t = abs(u) - row[4], abs(v) - row[5], abs(dz) - row[6]
    outside = np.sqrt(max(q, 0.0) ** 2 + max(w, 0.0) ** 2 + max(t, 0.0) ** 2)
    gu = gv = gz = 0.0
    if outside > 0.0:
        distance = outside
        gq, gw, gz = max(q, 0.0) / outside, max(w, 0.0) / outside, sz * max(t, 0.0) / outside
    else:
        distance = max(q, w, t)
        gq, gw, gz = 0.0, 0.0, 0.0
        if t == distance:
            gz = sz
        elif q == distance:
            gq = 1.0
        else:
            gw = 1.0
    if row[0] == CYLINDER:
        gu, gv = gq * su, gq * sv
    else:
        gu, gv = gq * su, gw * sv
    return distance, c * gu - s * gv, s * gu + c * gv, gz


@step
def clearance(row, x, y, z, ox, oy, oz, enough):
    """Return the least signed distance [m] of the line from (x, y, z) to (ox, oy, oz) and its gradient by the latter.

    Where the line passes farther away than ``enough``, a lower bound of the distance is returned, with gradient 0.
    """
    px, py, pz = ox - x, oy - y, oz - z
    length2 = px * px + py * py + pz * pz
    cx, cy, cz = row[1] - x, row[2] - y, row[3] - z
    t = min(max((px * cx + py * cy + pz * cz) / max(length2, 1e-12), 0.0), 1.0)
    apart = np.sqrt((cx - t * px) ** 2 + (cy - t * py) ** 2 + (cz - t * pz) ** 2)
    around = np.sqrt(row[4] ** 2 + row[5] ** 2 + row[6] ** 2)
    if apart - around > enough:
        return apart - around, 0.0, 0.0, 0.0
    low, high = 0.0, 1.0
    a, b = high - GOLDEN, GOLDEN
    fa = signed_distance(row, x + a * px, y + a * py, z + a * pz)[0]
    fb = signed_distance(row, x + b * px, y + b * py, z + b * pz)[0]
    for _ in range(ITERATIONS):
        if fa <= fb:
            high, b, fb = b, a, fa
            a = high - GOLDEN * (high - low)
            fa = signed_distance(row, x + a * px, y + a * py, z + a * pz)[0]
        else:
            low, a, fa = a, b, fb
            b = low + GOLDEN * (high - low)
            fb = signed_distance(row, x + b * px, y + b * py, z + b * pz)[0]
    t = 0.5 * (low + high)
    distance, gx, gy, gz = signed_distance(row, x + t * px, y + t * py, z + t * pz)
    if KINK < t < 1.0 - KINK:
        # inside a body the nearest face changes at the minimum: the gradients on both sides are mixed so that the
        # mixture has no component along the line
        a, b = t - KINK, t + KINK
        _, ax, ay, az = signed_distance(row, x + a * px, y + a * py, z + a * pz)
        _, bx, by, bz = signed_distance(row, x + b * px, y + b * py, z + b * pz)
        before, after = ax * px + ay * py + az * pz, bx * px + by * py + bz * pz
        if before < 0.0 < after:
            share = after / (after - before)
            gx, gy, gz = bx + share * (ax - bx), by + share * (ay - by), bz + share * (az - bz)
    return distance, t * gx, t * gy, t * gz


@kernel
def sight_clearance(rows, points, places):
    """Return the least signed distance (c, n) [m] of the lines from ``points`` (n, 3) to ``places`` (c, 3).

    The least distance is over all obstacles and above zero where nothing is between; 1e9 without any obstacle.
    """
    found = np.full((len(places), len(points)), 1e9)
    for c in range(len(places)):
        for p in range(len(points)):
            for k in range(len(rows)):
                one = clearance(
                    rows[k], points[p, 0], points[p, 1], points[p, 2], places[c, 0], places[c, 1], places[c, 2], 1e9
                )
                found[c, p] = min(found[c, p], one[0])
    return found


@kernel
def distances_to(rows, points):
    """Return the least signed distance (n,) [m] of ``points`` (n, 3) from the obstacles; 1e9 without any."""
    found = np.full(len(points), 1e9)
    for p in range(len(points)):
        for k in range(len(rows)):
            found[p] = min(found[p], signed_distance(rows[k], points[p, 0], points[p, 1], points[p, 2])[0])
    return found
