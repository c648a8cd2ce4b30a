"""The part of an image row that a target lights: where the fan of rays ``a + s b`` meets it, in closed form."""

import math
from typing import Any

import numpy as np

from mosca.data.arrays import Array
from mosca.numba_support.decorators import bare_step
from twin.cameras.optics.lens import project
from twin.cameras.render.inputs import TargetPose
from twin.cameras.render.outline import BALL, contour_point
from twin.cameras.render.row_intervals import roots
from twin.scenes.figure import LINE


@bare_step
def lit_by_disc(target: TargetPose, a: Array, b: Array) -> Any:
    """Interval of s in which the rays a + s b meet a ball, or a flat round target."""
    shape, rotation, x, y, z, r = target
    if shape == BALL:
        k = x * x + y * y + z * z - r * r
        ca, cb = x * a[0] + y * a[1] + z * a[2], x * b[0] + y * b[1] + z * b[2]
        aa = a[0] * a[0] + a[1] * a[1] + a[2] * a[2]
        ab = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
        bb = b[0] * b[0] + b[1] * b[1] + b[2] * b[2]
        q2, q1, q0 = cb * cb - k * bb, ca * cb - k * ab, ca * ca - k * aa
    else:
        # P = t d with t = c.n / d.n; |t d - c|^2 <= r^2, times (d.n)^2
        nx, ny, nz = rotation[0, 2], rotation[1, 2], rotation[2, 2]
        cn = x * nx + y * ny + z * nz
        na, nb = a[0] * nx + a[1] * ny + a[2] * nz, b[0] * nx + b[1] * ny + b[2] * nz
        px, py, pz = cn * a[0] - na * x, cn * a[1] - na * y, cn * a[2] - na * z
        qx, qy, qz = cn * b[0] - nb * x, cn * b[1] - nb * y, cn * b[2] - nb * z
        q2 = r * r * nb * nb - qx * qx - qy * qy - qz * qz
        q1 = r * r * na * nb - px * qx - py * qy - pz * qz
        q0 = r * r * na * na - px * px - py * py - pz * pz
    low, high, some = roots(q2, q1, q0)
    if not some or q2 >= 0.0:
        return np.inf, -np.inf
    return low, high


@bare_step
def lit_by_figure(
    lens: Array, target: TargetPose, pieces: Array, a: Array, b: Array, lit_u: Array, lit_step: Array
) -> Any:
    """Write where the row crosses the contours and the rise of light there; return the number of crossings."""
    _shape, rotation, x, y, z, _r = target
    nx, ny, nz = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
    # the fan's plane in the figure's own coordinates: p + qx gx + qy gy = 0
    p = nx * x + ny * y + nz * z
    qx = nx * rotation[0, 0] + ny * rotation[1, 0] + nz * rotation[2, 0]
    qy = nx * rotation[0, 1] + ny * rotation[1, 1] + nz * rotation[2, 1]
    count = 0
    for i in range(pieces.shape[0]):
        tries = 0
        s0 = s1 = -1.0
        if pieces[i, 0] == LINE:
            begin = p + qx * pieces[i, 1] + qy * pieces[i, 2]
            end = p + qx * pieces[i, 3] + qy * pieces[i, 4]
            # half open, so that a corner on the row is crossed once
            if (begin > 0.0) != (end > 0.0):
                s0, tries = begin / (begin - end), 1
        else:
            size = pieces[i, 3] * math.hypot(qx, qy)
            here = p + qx * pieces[i, 1] + qy * pieces[i, 2]
            swing = pieces[i, 5] - pieces[i, 4]
            if abs(here) < size:
                middle, half = math.atan2(qy, qx), math.acos(-here / size)
                whole = 2.0 * math.pi
                s0 = _share_of_arc(middle + half, pieces[i, 4], swing, whole)
                s1 = _share_of_arc(middle - half, pieces[i, 4], swing, whole)
                tries = 2
        for k in range(tries):
            share = s0 if k == 0 else s1
            if share < 0.0 or share > 1.0:
                continue
            gx, gy, hx, hy = contour_point(pieces[i], share)
            u, _v, _a, _b, _c, _d, _e, _f, ok = project(
                lens,
                x + gx * rotation[0, 0] + gy * rotation[0, 1],
                y + gx * rotation[1, 0] + gy * rotation[1, 1],
                z + gx * rotation[2, 0] + gy * rotation[2, 1],
            )
            if ok and count < lit_u.shape[0]:
                # the fan's normal points down the image: a contour that goes down has its inside, on its
                # left, to the right in the image
                lit_u[count] = u
                lit_step[count] = pieces[i, 6] if qx * hx + qy * hy > 0.0 else -pieces[i, 6]
                count += 1
    return count


@bare_step
def _share_of_arc(angle: float, start: float, swing: float, whole: float) -> Any:
    """The share of an arc at an angle; -1 for angles outside the arc."""
    away = (angle - start) % whole if swing > 0.0 else (start - angle) % whole
    return away / abs(swing) if away <= abs(swing) else -1.0
