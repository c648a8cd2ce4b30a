"""The interval of an image line that a solid covers, in closed form for each of MuJoCo's primitives.

A short piece of an image row is the fan of rays ``a + s b`` from the camera, s in pixels. A convex solid meets
the fan in one interval of s. Its ends are rays that touch the solid: roots of quadratics for round surfaces,
crossings of the fan's plane with the edges of a box. (Spheres and ellipsoids: discriminant of the ray's
quadratic; cylinders: the same in the plane across the axis, where the touching point lies between the caps, and
the caps' rims; capsules: their two spheres and their side.)
"""

import math
from typing import Any, NamedTuple

import numpy as np

from mosca.data.arrays import Array
from mosca.numba_support.decorators import bare_step
from twin.cameras.render.inputs import Solid
from twin.cameras.render.occluders import CAPSULE, CYLINDER, ELLIPSOID, SPHERE

NOWHERE = (np.inf, -np.inf)


class Fan(NamedTuple):
    """Rays a + s b that start in o, in a solid's own axes."""

    ox: float
    oy: float
    oz: float
    ax: float
    ay: float
    az: float
    bx: float
    by: float
    bz: float


@bare_step
def covered(solid: Solid, a: Array, b: Array) -> Any:
    """Interval (low, high) of s in which the rays ``a + s b`` (3,), camera frame, meet a solid; low > high: none."""
    kind, size, centre, rotation = solid
    ox = -(rotation[0, 0] * centre[0] + rotation[1, 0] * centre[1] + rotation[2, 0] * centre[2])
    oy = -(rotation[0, 1] * centre[0] + rotation[1, 1] * centre[1] + rotation[2, 1] * centre[2])
    oz = -(rotation[0, 2] * centre[0] + rotation[1, 2] * centre[1] + rotation[2, 2] * centre[2])
    ax = rotation[0, 0] * a[0] + rotation[1, 0] * a[1] + rotation[2, 0] * a[2]
    ay = rotation[0, 1] * a[0] + rotation[1, 1] * a[1] + rotation[2, 1] * a[2]
    az = rotation[0, 2] * a[0] + rotation[1, 2] * a[1] + rotation[2, 2] * a[2]
    bx = rotation[0, 0] * b[0] + rotation[1, 0] * b[1] + rotation[2, 0] * b[2]
    by = rotation[0, 1] * b[0] + rotation[1, 1] * b[1] + rotation[2, 1] * b[2]
    bz = rotation[0, 2] * b[0] + rotation[1, 2] * b[1] + rotation[2, 2] * b[2]
    fan = Fan(ox, oy, oz, ax, ay, az, bx, by, bz)
    if kind == SPHERE:
        return _sphere(fan, 0.0, size[0], size[0], size[0])
    if kind == ELLIPSOID:
        return _sphere(fan, 0.0, size[0], size[1], size[2])
    if kind == CAPSULE:
        r, h = size[0], size[1]
        low, high = _sphere(fan, -h, r, r, r)
        one, two = _sphere(fan, h, r, r, r)
        low, high = min(low, one), max(high, two)
        one, two = _side(fan, r, h)
        return min(low, one), max(high, two)
    if kind == CYLINDER:
        r, h = size[0], size[1]
        low, high = _side(fan, r, h)
        for cap in (-h, h):
            one, two = _cap(fan, cap - oz, r)
            low, high = min(low, one), max(high, two)
        return low, high
    return _box(fan, size)


@bare_step
def roots(q2: float, q1: float, q0: float) -> Any:
    """Real roots (low, high) of q2 s^2 + 2 q1 s + q0, and whether there are any."""
    if q2 == 0.0:
        if q1 == 0.0:
            return 0.0, 0.0, False
        s = -0.5 * q0 / q1
        return s, s, True
    d = q1 * q1 - q2 * q0
    if d < 0.0:
        return 0.0, 0.0, False
    # a sum of terms of like sign loses no digits
    t = -(q1 + math.copysign(math.sqrt(d), q1))
    one = t / q2
    two = q0 / t if t != 0.0 else one
    return min(one, two), max(one, two), True


@bare_step
def _sphere(fan: Fan, height: float, p: float, q: float, r: float) -> Any:
    """Rays that touch an ellipsoid of half axes p, q, r about the point (0, 0, height), scaled to the unit sphere."""
    ox, oy, oz = fan.ox / p, fan.oy / q, (fan.oz - height) / r
    ax, ay, az, bx, by, bz = fan.ax / p, fan.ay / q, fan.az / r, fan.bx / p, fan.by / q, fan.bz / r
    k = ox * ox + oy * oy + oz * oz - 1.0
    if k <= 0.0:
        return NOWHERE
    oa, ob = ox * ax + oy * ay + oz * az, ox * bx + oy * by + oz * bz
    aa, ab, bb = ax * ax + ay * ay + az * az, ax * bx + ay * by + az * bz, bx * bx + by * by + bz * bz
    q2, q1, q0 = ob * ob - k * bb, oa * ob - k * ab, oa * oa - k * aa
    low, high, some = roots(q2, q1, q0)
    if q2 < 0.0:
        return (low, high) if some and oa + 0.5 * (low + high) * ob < 0.0 else NOWHERE
    # the fan's plane cuts the sphere beyond its own horizon: a half line, or all of it
    if not some:
        return (-np.inf, np.inf) if oa < 0.0 else NOWHERE
    if ob < 0.0:
        return high, np.inf
    return -np.inf, low


@bare_step
def _side(fan: Fan, r: float, h: float) -> Any:
    """Rays that touch the side of a cylinder about z between its caps."""
    ox, oy, oz, ax, ay, az, bx, by, bz = fan
    low, high = NOWHERE
    k = ox * ox + oy * oy - r * r
    if k <= 0.0:
        return low, high
    oa, ob = ox * ax + oy * ay, ox * bx + oy * by
    aa, ab, bb = ax * ax + ay * ay, ax * bx + ay * by, bx * bx + by * by
    one, two, some = roots(ob * ob - k * bb, oa * ob - k * ab, oa * oa - k * aa)
    if some:
        for s in (one, two):
            t = -(oa + s * ob) / (aa + s * (2.0 * ab + s * bb))
            if t > 0.0 and abs(oz + t * (az + s * bz)) <= h:
                low, high = min(low, s), max(high, s)
    return low, high


@bare_step
def _cap(fan: Fan, z: float, r: float) -> Any:
    """Rays through the rim of a disc at height z above the camera."""
    ox, oy, _oz, ax, ay, az, bx, by, bz = fan
    low, high = NOWHERE
    px, py = ox * az + z * ax, oy * az + z * ay
    qx, qy = ox * bz + z * bx, oy * bz + z * by
    one, two, some = roots(
        qx * qx + qy * qy - r * r * bz * bz, px * qx + py * qy - r * r * az * bz, px * px + py * py - r * r * az * az
    )
    if some:
        for s in (one, two):
            down = az + s * bz
            if down * z > 0.0:
                low, high = min(low, s), max(high, s)
    return low, high


@bare_step
def _box(fan: Fan, size: Array) -> Any:
    """Crossings of the fan's plane with the twelve edges."""
    ox, oy, oz, ax, ay, az, bx, by, bz = fan
    low, high = NOWHERE
    nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    aa, ab, bb = ax * ax + ay * ay + az * az, ax * bx + ay * by + az * bz, bx * bx + by * by + bz * bz
    det = aa * bb - ab * ab
    for axis in range(3):
        for one in (-1.0, 1.0):
            for two in (-1.0, 1.0):
                if axis == 0:
                    x, y, z, ex, ey, ez = -size[0], one * size[1], two * size[2], 2.0 * size[0], 0.0, 0.0
                elif axis == 1:
                    x, y, z, ex, ey, ez = one * size[0], -size[1], two * size[2], 0.0, 2.0 * size[1], 0.0
                else:
                    x, y, z, ex, ey, ez = one * size[0], two * size[1], -size[2], 0.0, 0.0, 2.0 * size[2]
                x, y, z = x - ox, y - oy, z - oz
                above = nx * x + ny * y + nz * z
                rise = nx * ex + ny * ey + nz * ez
                if above * (above + rise) > 0.0 or rise == 0.0:
                    continue
                f = -above / rise
                x, y, z = x + f * ex, y + f * ey, z + f * ez
                ra, rb = x * ax + y * ay + z * az, x * bx + y * by + z * bz
                alpha = (ra * bb - rb * ab) / det
                if alpha > 0.0:
                    s = (rb * aa - ra * ab) / det / alpha
                    low, high = min(low, s), max(high, s)
    return low, high
