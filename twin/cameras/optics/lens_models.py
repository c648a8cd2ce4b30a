"""Kernels of the lens models, one pair each: light's direction to a position in the image, and back.

Written from the optics side; the pipeline has its own. ``project_...`` and ``_land_...`` give (u, v), their slopes
and whether the lens images the light; ``direction_...`` and ``_from_...`` give a direction, NaN where the pixel gets
no light.
"""

import math
from typing import Any

from mosca.data.arrays import Array
from mosca.numba_support.decorators import bare_step, inlined_step
from twin.cameras.optics.lens_vector import ENDS, OPENCV_PLANE, PRISM

STEPS = 20
BOUNDED_STEPS = 60
CONVERGED2 = 1e-28
SETTLED_MM2 = 1e-10
"""Squared error [mm^2] after which one more step of Newton's method is the last. It leaves an error of second order,
1e-12 mm for distortion that bends by 1 % a millimetre, and 1e-7 of the slopes. With 1e-16 a few pixels in a million
differ by 1 DN."""


@inlined_step
def project_collinearity(lens: Array, sx: float, sy: float) -> Any:
    """Image of the slopes (x / z, y / z): u, v, du and dv by the slopes, and whether it is imaged."""
    ix, iy = lens[1] * sx, -lens[1] * sy
    xb, yb = ix, iy
    ok = False
    a = b = c = d = det = 1.0
    for _ in range(STEPS):
        dx, dy, xx, xy, yx, yy = _collinearity_shift(lens, xb, yb)
        ex, ey = ix - xb - dx, iy - yb - dy
        a, b, c, d = 1.0 + xx, xy, yx, 1.0 + yy
        det = a * d - b * c
        if det <= 0.0 or a + d <= 0.0:
            break
        xb, yb = xb + (d * ex - b * ey) / det, yb + (a * ey - c * ex) / det
        if ex * ex + ey * ey < SETTLED_MM2:
            ok = True
            break
    ok = ok and xb * xb + yb * yb < lens[ENDS]
    # d measured / d ideal is the inverse of (a b; c d); ideal = c (sx, -sy)
    px, py = lens[1] / lens[4], lens[1] / lens[5]
    u1, u2 = px * d / det, px * b / det
    v1, v2 = py * c / det, py * a / det
    return lens[2] + xb / lens[4], lens[3] - yb / lens[5], u1, u2, v1, v2, ok


@inlined_step
def direction_collinearity(lens: Array, u: float, v: float) -> Any:
    """Direction (x, y, 1) of light on (u, v)."""
    right = lens[4] * (u - lens[2])
    down = lens[5] * (v - lens[3])
    dx, dy, xx, xy, yx, yy = _collinearity_shift(lens, right, -down)
    a, d = 1.0 + xx, 1.0 + yy
    if a * d - xy * yx > 0.0 and a + d > 0.0 and right * right + down * down < lens[ENDS]:
        return (right + dx) / lens[1], (down - dy) / lens[1], 1.0
    return math.nan, math.nan, math.nan


@inlined_step
def _collinearity_shift(lens: Array, xb: float, yb: float) -> Any:
    """The paper's correction (dx, dy) at a measured point [mm, y up] and its slopes (xx, xy, yx, yy)."""
    a, k1, k2, k3, p1, p2 = lens[6], lens[7], lens[8], lens[9], lens[10], lens[11]
    rr = xb * xb + yb * yb
    radial = ((k3 * rr + k2) * rr + k1) * rr
    growth = (3.0 * k3 * rr + 2.0 * k2) * rr + k1
    dx = a * yb + xb * radial + p1 * (3.0 * xb * xb + yb * yb) + 2.0 * p2 * xb * yb
    dy = a * xb + yb * radial + 2.0 * p1 * xb * yb + p2 * (xb * xb + 3.0 * yb * yb)
    xx = radial + 2.0 * xb * xb * growth + 6.0 * p1 * xb + 2.0 * p2 * yb
    xy = a + 2.0 * xb * yb * growth + 2.0 * p1 * yb + 2.0 * p2 * xb
    yy = radial + 2.0 * yb * yb * growth + 2.0 * p1 * xb + 6.0 * p2 * yb
    return dx, dy, xx, xy, xy, yy


@inlined_step
def project_pinhole(lens: Array, x: float, y: float) -> Any:
    """Image of the slopes (x / z, y / z): u, v, du and dv by the slopes, and whether it is imaged."""
    xd, yd, xx, xy, yy, rr = _bent(lens, x, y)
    fx, fy = lens[1], lens[2]
    if lens[PRISM] != 0.0:
        return _land_prism(lens, x, y, xd, yd, xx, xy, yy, rr)
    ok = xx * yy - xy * xy > 0.0 and xx + yy > 0.0 and rr < lens[ENDS]
    return lens[3] + fx * xd, lens[4] + fy * yd, fx * xx, fx * xy, fy * xy, fy * yy, ok


@inlined_step
def direction_pinhole(lens: Array, u: float, v: float) -> Any:
    """Direction (x, y, 1) of light on (u, v): Newton's method."""
    target_x, target_y = (u - lens[3]) / lens[1], (v - lens[4]) / lens[2]
    if lens[PRISM] != 0.0:
        return _from_prism(lens, target_x, target_y)
    sx, sy = target_x, target_y
    for _ in range(STEPS):
        xd, yd, xx, xy, yy, rr = _bent(lens, sx, sy)
        ex, ey = target_x - xd, target_y - yd
        det = xx * yy - xy * xy
        sx, sy = sx + (yy * ex - xy * ey) / det, sy + (xx * ey - xy * ex) / det
        if ex * ex + ey * ey < CONVERGED2:
            if det > 0.0 and xx + yy > 0.0 and rr < lens[ENDS]:
                return sx, sy, 1.0
            break
    return math.nan, math.nan, math.nan


@inlined_step
def _bent(lens: Array, x: float, y: float) -> Any:
    """The slopes after radial and tangential distortion: (xd, yd), derivatives (xx, xy = yx, yy), r^2."""
    k1, k2, p1, p2, k3, k4, k5, k6 = lens[5], lens[6], lens[7], lens[8], lens[9], lens[10], lens[11], lens[12]
    rr = x * x + y * y
    top = 1.0 + ((k3 * rr + k2) * rr + k1) * rr
    bottom = 1.0 + ((k6 * rr + k5) * rr + k4) * rr
    m = top / bottom
    dm = ((3.0 * k3 * rr + 2.0 * k2) * rr + k1 - m * ((3.0 * k6 * rr + 2.0 * k5) * rr + k4)) / bottom
    xd = m * x + 2.0 * p1 * x * y + p2 * (3.0 * x * x + y * y)
    yd = m * y + p1 * (x * x + 3.0 * y * y) + 2.0 * p2 * x * y
    xx = m + 2.0 * x * x * dm + 2.0 * p1 * y + 6.0 * p2 * x
    xy = 2.0 * x * y * dm + 2.0 * p1 * x + 2.0 * p2 * y
    yy = m + 2.0 * y * y * dm + 6.0 * p1 * y + 2.0 * p2 * x
    return xd, yd, xx, xy, yy, rr


@bare_step
def _land_prism(
    lens: Array, x: float, y: float, xd: float, yd: float, xx: float, xy: float, yy: float, rr: float
) -> Any:
    """As ``project_pinhole``, from the results of ``_bent``: thin prism, then OpenCV's tilted sensor."""
    xd, yd, xx, xy, yx, yy = _add_prism(lens, x, y, xd, yd, xx, xy, yy, rr)
    ok = xx * yy - xy * yx > 0.0 and xx + yy > 0.0 and rr < lens[ENDS]
    xd, yd, a, b, c, d, w = onto_plane(lens, OPENCV_PLANE, xd, yd)
    xx, xy, yx, yy = a * xx + b * yx, a * xy + b * yy, c * xx + d * yx, c * xy + d * yy
    fx, fy = lens[1], lens[2]
    return lens[3] + fx * xd, lens[4] + fy * yd, fx * xx, fx * xy, fy * yx, fy * yy, ok and w > 0.0


@bare_step
def _from_prism(lens: Array, p: float, q: float) -> Any:
    """As ``direction_pinhole``, from a position on the tilted sensor in units of the principal distance."""
    target_x, target_y = off_plane(lens, OPENCV_PLANE, p, q)
    sx, sy = target_x, target_y
    for _ in range(STEPS):
        xd, yd, xx, xy, yy, rr = _bent(lens, sx, sy)
        xd, yd, xx, xy, yx, yy = _add_prism(lens, sx, sy, xd, yd, xx, xy, yy, rr)
        ex, ey = target_x - xd, target_y - yd
        det = xx * yy - xy * yx
        sx, sy = sx + (yy * ex - xy * ey) / det, sy + (xx * ey - yx * ex) / det
        if ex * ex + ey * ey < CONVERGED2:
            if det > 0.0 and xx + yy > 0.0 and rr < lens[ENDS]:
                return sx, sy, 1.0
            break
    return math.nan, math.nan, math.nan


@bare_step
def _add_prism(
    lens: Array, x: float, y: float, xd: float, yd: float, xx: float, xy: float, yy: float, rr: float
) -> Any:
    """Add the thin prism to the results of ``_bent``: (xd, yd) and derivatives (xx, xy, yx, yy)."""
    s1, s2, s3, s4 = lens[PRISM + 1], lens[PRISM + 2], lens[PRISM + 3], lens[PRISM + 4]
    right, down = 2.0 * (s1 + 2.0 * s2 * rr), 2.0 * (s3 + 2.0 * s4 * rr)
    xd, yd = xd + rr * (s1 + s2 * rr), yd + rr * (s3 + s4 * rr)
    return xd, yd, xx + right * x, xy + right * y, xy + down * x, yy + down * y


@inlined_step
def project_fisheye(lens: Array, x: float, y: float, z: float) -> Any:
    """Image of the direction: u, v, du and dv by (x, y, z), and whether it is imaged; z may be negative."""
    s = math.sqrt(x * x + y * y)
    fx, fy = lens[1], lens[2]
    if s <= 1e-12 * abs(z):
        u, v = fx * x / z, fy * y / z
        return lens[3] + u, lens[4] + v, fx / z, 0.0, -u / z, 0.0, fy / z, -v / z, z > 0.0
    n2 = s * s + z * z
    angle = math.atan2(s, z)
    value, slope = _fisheye_radius(lens, angle)
    cx, cy, w = x / s, y / s, value / s
    along = slope * z / n2  # d radius / d s
    axial = -slope * s / n2  # d radius / d z
    ux, uy = fx * (cx * cx * along + cy * cy * w), fx * cx * cy * (along - w)
    vx, vy = fy * cx * cy * (along - w), fy * (cy * cy * along + cx * cx * w)
    u, v = lens[3] + fx * value * cx, lens[4] + fy * value * cy
    return u, v, ux, uy, fx * cx * axial, vx, vy, fy * cy * axial, slope > 0.0 and angle * angle < lens[ENDS]


@inlined_step
def direction_fisheye(lens: Array, u: float, v: float) -> Any:
    """Unit direction of light on (u, v): Newton's method between bounds, NaN outside the image circle."""
    a, b = (u - lens[3]) / lens[1], (v - lens[4]) / lens[2]
    radius = math.sqrt(a * a + b * b)
    if radius < 1e-12:
        return a, b, 1.0
    low, high = 0.0, math.sqrt(lens[ENDS])
    last = high
    angle = min(radius, last)
    for _ in range(BOUNDED_STEPS):
        value, slope = _fisheye_radius(lens, angle)
        if value < radius:
            low = angle
        else:
            high = angle
        moved = angle + (radius - value) / slope
        if not low <= moved <= high:
            moved = 0.5 * (low + high)
        step = moved - angle
        angle = moved
        if abs(step) < 1e-15:
            break
    value, slope = _fisheye_radius(lens, angle)
    if not (abs(radius - value) < 1e-10 and angle < last):
        return math.nan, math.nan, math.nan
    s = math.sin(angle) / radius
    return a * s, b * s, math.cos(angle)


@inlined_step
def _fisheye_radius(lens: Array, angle: float) -> Any:
    t = angle * angle
    k1, k2, k3, k4 = lens[5], lens[6], lens[7], lens[8]
    return (
        angle * ((((k4 * t + k3) * t + k2) * t + k1) * t + 1.0),
        (((9.0 * k4 * t + 7.0 * k3) * t + 5.0 * k2) * t + 3.0 * k1) * t + 1.0,
    )


@inlined_step
def onto_plane(lens: Array, at: int, x: float, y: float) -> Any:
    """Where light for (x, y) meets the tilted plane at ``at``, the derivatives (a, b, c, d), and its depth."""
    w = 1.0 + lens[at + 4] * x + lens[at + 5] * y
    p = (lens[at] * x + lens[at + 1] * y) / w
    q = (lens[at + 2] * x + lens[at + 3] * y) / w
    a, b = (lens[at] - p * lens[at + 4]) / w, (lens[at + 1] - p * lens[at + 5]) / w
    c, d = (lens[at + 2] - q * lens[at + 4]) / w, (lens[at + 3] - q * lens[at + 5]) / w
    return p, q, a, b, c, d, w


@inlined_step
def off_plane(lens: Array, at: int, p: float, q: float) -> Any:
    """Inverse of ``onto_plane`` by its two linear equations; NaN behind the lens."""
    a, b = lens[at] - p * lens[at + 4], lens[at + 1] - p * lens[at + 5]
    c, d = lens[at + 2] - q * lens[at + 4], lens[at + 3] - q * lens[at + 5]
    det = a * d - b * c
    x, y = (d * p - b * q) / det, (a * q - c * p) / det
    if 1.0 + lens[at + 4] * x + lens[at + 5] * y > 0.0:
        return x, y
    return math.nan, math.nan
