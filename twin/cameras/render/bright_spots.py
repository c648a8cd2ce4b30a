"""The deviation of a disc's brightness from 1 as spots of light: limb darkening, a gradient, a tape's end."""

import math
from typing import Any

from mosca.data.arrays import Array
from mosca.numba_support.decorators import bare_step
from twin.cameras.optics.lens import project
from twin.cameras.render.boundary_integral import MOST_NODES, NODE_AT, NODE_SHARE
from twin.cameras.render.inputs import TargetPose
from twin.cameras.render.outline import circle_point, outline_circle

STEP_PX = 0.7
"""Distance of spots around the disc."""


@bare_step
def fading(profile: Array, sine: float) -> Any:
    """Brightness of a tape at an angle of this ``sine`` off the normal: 1, then a smooth step, then nothing."""
    if profile[4] >= 0.5 * math.pi:
        return 1.0
    rise = (profile[5] - math.asin(min(sine, 1.0))) / (profile[5] - profile[4])
    rise = min(1.0, max(0.0, rise))
    return rise * rise * (3.0 - 2.0 * rise)


@bare_step
def _rings(diameter: float) -> Any:
    """Number of rings of spots for a disc of this image diameter."""
    return min(MOST_NODES, 4 + int(diameter))


@bare_step
def _ring(diameter: float, rings: int, i: int) -> Any:
    """Radius of ring ``i`` over the disc's, its share of the radial integral, and the number of its spots."""
    angle = 0.25 * math.pi * (NODE_AT[rings, i] + 1.0)
    q = math.sin(angle)
    return q, 0.5 * math.pi * NODE_SHARE[rings, i] * math.cos(angle), 12 + int(math.pi * q * diameter / STEP_PX)


@bare_step
def spot_count(diameter: float) -> Any:
    """Number of spots of a disc of this image diameter."""
    rings, count = _rings(diameter), 0
    for i in range(rings):
        count += _ring(diameter, rings, i)[2]
    return count


@bare_step
def spots(lens: Array, target: TargetPose, profile: Array, diameter: float, out: Array) -> None:
    """Write spots (u, v, amount) for a disc's brightness minus 1: Gauss nodes in the radius, equal angles.

    The radius is the sine of the quadrature's variable; in that variable limb darkening is smooth.
    """
    rings = _rings(diameter)
    circle = outline_circle(target, target.radius)
    cx, cy, cz = circle[0], circle[1], circle[2]
    n = 0
    for i in range(rings):
        q, dq, around = _ring(diameter, rings, i)
        for k in range(around):
            dx, dy, dz, ex, ey, ez = circle_point(circle, 2.0 * math.pi * (k + 0.5 * (i % 2)) / around)
            gx, gy, gz = dx - cx, dy - cy, dz - cz
            u, v, ux, uy, uz, vx, vy, vz, _ok = project(lens, cx + q * gx, cy + q * gy, cz + q * gz)
            u_q, v_q = ux * gx + uy * gy + uz * gz, vx * gx + vy * gy + vz * gz
            u_a, v_a = q * (ux * ex + uy * ey + uz * ez), q * (vx * ex + vy * ey + vz * ez)
            area = abs(u_q * v_a - v_q * u_a) * dq * 2.0 * math.pi / around
            size = math.sqrt(gx * gx + gy * gy + gz * gz)
            shine = 1.0 - profile[0] * (1.0 - math.sqrt(1.0 - q * q))
            shine += q * (profile[1] * gx + profile[2] * gy + profile[3] * gz) / size
            shine *= fading(profile, q)
            out[n, 0], out[n, 1], out[n, 2] = u, v, area * (shine - 1.0)
            n += 1
