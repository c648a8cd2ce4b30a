"""The twin's lenses, written from the optics side: a direction of light comes in and lands on a pixel.

Parameter numbers are those of the rig file; the formulas are written here anew (the pipeline has its own).
On top of the model comes what the pipeline's models cannot express, the *gap*: a radial displacement
``g(s) = gap_px * T9(s)`` with s the distance from the image's centre over half its diagonal and T9 the
Chebyshev polynomial of order 9, which the odd powers up to the 7th cannot follow. T9 explodes outside the
image: light that the model puts beyond s = 1.5 is not imaged.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit

from mosca.data.arrays import Array
from mosca.data.rig import FisheyeLens, Lens, MoscaLens, OpenCVLens

COLLINEARITY, PINHOLE, FISHEYE = 0, 1, 2
# layout of the parameter vector: 0 kind, 1-12 the model's own, 13 gap, 14-15 its centre, 16 its radius,
# 17 how far out the model is good: squared ideal slope, measured radius [mm^2] or angle [rad^2]
SIZE = 18
GAP_ENDS_AT = 1.5
STEPS = 20


@dataclass(frozen=True, eq=False)
class TwinLens:
    """A lens ready for the kernels: ``vector`` holds kind, parameters and gap."""

    vector: Array

    @classmethod
    def of(cls, lens: Lens, width: int, height: int, gap_px: float = 0.0) -> "TwinLens":
        """Return the lens of a rig file's numbers, with a gap of amplitude ``gap_px``."""
        vector = np.zeros(SIZE)
        if isinstance(lens, MoscaLens):
            numbers = [COLLINEARITY, lens.c_mm, lens.xp_px, lens.yp_px, lens.mx_mm_per_px, lens.my_mm_per_px]
            numbers += [
                lens.a,
                lens.K1_per_mm2,
                lens.K2_per_mm4,
                lens.K3_per_mm6,
                lens.P1_per_mm,
                lens.P2_per_mm,
            ]
        elif isinstance(lens, OpenCVLens):
            numbers = [PINHOLE, lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px, lens.k1, lens.k2, lens.p1]
            numbers += [lens.p2, lens.k3, lens.k4, lens.k5, lens.k6]
        elif isinstance(lens, FisheyeLens):
            numbers = [
                FISHEYE,
                lens.fx_px,
                lens.fy_px,
                lens.cx_px,
                lens.cy_px,
                lens.k1,
                lens.k2,
                lens.k3,
                lens.k4,
            ]
        vector[: len(numbers)] = numbers
        vector[13:17] = gap_px, (width - 1) / 2, (height - 1) / 2, math.hypot(width, height) / 2
        vector[17] = _first_turn(lens)
        vector.setflags(write=False)
        return cls(vector)

    def pixels(self, directions: Array) -> Array:
        """Direction (n, 3), camera frame -> pixel (n, 2); NaN where the lens does not image it."""
        return _many_pixels(self.vector, np.ascontiguousarray(directions, dtype=float).reshape(-1, 3))

    def directions(self, xy_px: Array) -> Array:
        """Pixel (n, 2) -> unit direction (n, 3), camera frame."""
        return _many_directions(self.vector, np.ascontiguousarray(xy_px, dtype=float).reshape(-1, 2))


def _first_turn(lens: Lens) -> float:
    """Where the radial mapping first turns back (infinity: never), in the variable that the kernels test.

    A real lens's image ends there, even where the polynomial rises again farther out.
    """
    if isinstance(lens, MoscaLens):
        slopes = [[7.0 * lens.K3_per_mm6, 5.0 * lens.K2_per_mm4, 3.0 * lens.K1_per_mm2, 1.0]]
    elif isinstance(lens, FisheyeLens):
        slopes = [[9.0 * lens.k4, 7.0 * lens.k3, 5.0 * lens.k2, 3.0 * lens.k1, 1.0]]
    else:
        # radius r T(s) / B(s), s = r^2: its slope vanishes with T B + 2 s (T' B - T B'), and B is its pole
        top, bottom = np.poly1d([lens.k3, lens.k2, lens.k1, 1.0]), np.poly1d([lens.k6, lens.k5, lens.k4, 1.0])
        twice_s = np.poly1d([2.0, 0.0])
        turning = top * bottom + twice_s * (top.deriv() * bottom - top * bottom.deriv())
        slopes = [list(turning.coeffs), list(bottom.coeffs)]
    # in 1 / s, where the leading coefficient is 1 and vanishing ones put roots at zero, not at infinity
    inverse = np.concatenate([np.roots(slope[::-1]) for slope in slopes])
    nearest = float(max((t.real for t in inverse if t.imag == 0.0), default=0.0))
    return 1.0 / nearest if nearest > 0.0 else math.inf


@njit(nogil=True, cache=True)
def land(lens: Array, x: float, y: float, z: float) -> Any:
    """Where light from direction (x, y, z) lands: u, v, then du and dv by (x, y, z), and whether it does.

    Returns (u, v, ux, uy, uz, vx, vy, vz, ok).
    """
    if lens[0] == FISHEYE:
        u, v, ux, uy, uz, vx, vy, vz, ok = _land_fisheye(lens, x, y, z)
    else:
        if z <= 0.0:
            return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, False
        slope_x, slope_y = x / z, y / z
        if lens[0] == COLLINEARITY:
            u, v, u1, u2, v1, v2, ok = _land_collinearity(lens, slope_x, slope_y)
        else:
            u, v, u1, u2, v1, v2, ok = _land_pinhole(lens, slope_x, slope_y)
        ux, uy, uz = u1 / z, u2 / z, -(u1 * slope_x + u2 * slope_y) / z
        vx, vy, vz = v1 / z, v2 / z, -(v1 * slope_x + v2 * slope_y) / z
    if lens[13] != 0.0 and ok:
        if (u - lens[14]) ** 2 + (v - lens[15]) ** 2 > (GAP_ENDS_AT * lens[16]) ** 2:
            return u, v, ux, uy, uz, vx, vy, vz, False
        du, dv, g11, g12, g22 = _gap(lens, u, v)
        a, b, c = ux, uy, uz
        ux, uy, uz = a + g11 * a + g12 * vx, b + g11 * b + g12 * vy, c + g11 * c + g12 * vz
        vx, vy, vz = vx + g12 * a + g22 * vx, vy + g12 * b + g22 * vy, vz + g12 * c + g22 * vz
        u, v = u + du, v + dv
    return u, v, ux, uy, uz, vx, vy, vz, ok


@njit(nogil=True, cache=True)
def origin(lens: Array, u: float, v: float) -> Any:
    """The direction (x, y, z) that light on pixel (u, v) comes from; not normalised for pinhole kinds."""
    if lens[13] != 0.0:
        # the gap's slope is below 0.05 for 0.25 px, so each substitution gains a factor of 20
        a, b = u, v
        for _ in range(10):
            du, dv, _g11, _g12, _g22 = _gap(lens, a, b)
            a, b = u - du, v - dv
        u, v = a, b
    if lens[0] == COLLINEARITY:
        right = lens[4] * (u - lens[2])
        down = lens[5] * (v - lens[3])
        dx, dy, _a, _b, _c, _d = _collinearity_shift(lens, right, -down)
        return (right + dx) / lens[1], (down - dy) / lens[1], 1.0
    if lens[0] == PINHOLE:
        target_u, target_v = (u - lens[3]) / lens[1], (v - lens[4]) / lens[2]
        sx, sy = target_u, target_v
        for _ in range(STEPS):
            pu, pv, u1, u2, v1, v2, _ok = _land_pinhole(lens, sx, sy)
            eu, ev = u - pu, v - pv
            det = u1 * v2 - u2 * v1
            sx, sy = sx + (v2 * eu - u2 * ev) / det, sy + (u1 * ev - v1 * eu) / det
            if eu * eu + ev * ev < 1e-24:
                break
        return sx, sy, 1.0
    a, b = (u - lens[3]) / lens[1], (v - lens[4]) / lens[2]
    radius = math.sqrt(a * a + b * b)
    if radius < 1e-12:
        return a, b, 1.0
    angle = radius
    for _ in range(STEPS):
        value, slope = _fisheye_radius(lens, angle)
        step = (radius - value) / slope
        angle += step
        if abs(step) < 1e-15:
            break
    s = math.sin(angle) / radius
    return a * s, b * s, math.cos(angle)


@njit(nogil=True, cache=True)
def _gap(lens: Array, u: float, v: float) -> Any:
    """Displacement (du, dv) of the gap at (u, v) and its symmetric slope (g11, g12, g22)."""
    x, y, radius = u - lens[14], v - lens[15], lens[16]
    s2 = (x * x + y * y) / (radius * radius)
    # T9(s) / s and its derivative by s^2
    q = 9.0 + s2 * (-120.0 + s2 * (432.0 + s2 * (-576.0 + s2 * 256.0)))
    dq = -120.0 + s2 * (864.0 + s2 * (-1728.0 + s2 * 1024.0))
    f = lens[13] / radius
    d = f * dq * 2.0 / (radius * radius)
    return f * q * x, f * q * y, f * q + d * x * x, d * x * y, f * q + d * y * y


@njit(nogil=True, cache=True)
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


@njit(nogil=True, cache=True)
def _land_collinearity(lens: Array, sx: float, sy: float) -> Any:
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
        if ex * ex + ey * ey < 1e-26:
            ok = True
            break
    ok = ok and xb * xb + yb * yb < lens[17]
    # d measured / d ideal is the inverse of (a b; c d); ideal = c (sx, -sy)
    px, py = lens[1] / lens[4], lens[1] / lens[5]
    u1, u2 = px * d / det, px * b / det
    v1, v2 = py * c / det, py * a / det
    return lens[2] + xb / lens[4], lens[3] - yb / lens[5], u1, u2, v1, v2, ok


@njit(nogil=True, cache=True)
def _land_pinhole(lens: Array, x: float, y: float) -> Any:
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
    ok = xx * yy - xy * xy > 0.0 and xx + yy > 0.0 and rr < lens[17]
    fx, fy = lens[1], lens[2]
    return lens[3] + fx * xd, lens[4] + fy * yd, fx * xx, fx * xy, fy * xy, fy * yy, ok


@njit(nogil=True, cache=True)
def _fisheye_radius(lens: Array, angle: float) -> Any:
    t = angle * angle
    k1, k2, k3, k4 = lens[5], lens[6], lens[7], lens[8]
    return (
        angle * ((((k4 * t + k3) * t + k2) * t + k1) * t + 1.0),
        (((9.0 * k4 * t + 7.0 * k3) * t + 5.0 * k2) * t + 3.0 * k1) * t + 1.0,
    )


@njit(nogil=True, cache=True)
def _land_fisheye(lens: Array, x: float, y: float, z: float) -> Any:
    s = math.sqrt(x * x + y * y)
    n2 = s * s + z * z
    fx, fy = lens[1], lens[2]
    if s < 1e-12 * abs(z):
        return lens[3] + fx * x / z, lens[4] + fy * y / z, fx / z, 0.0, 0.0, 0.0, fy / z, 0.0, z > 0.0
    angle = math.atan2(s, z)
    value, slope = _fisheye_radius(lens, angle)
    cx, cy, w = x / s, y / s, value / s
    along = slope * z / n2  # d radius / d s
    axial = -slope * s / n2  # d radius / d z
    ux, uy = fx * (cx * cx * along + cy * cy * w), fx * cx * cy * (along - w)
    vx, vy = fy * cx * cy * (along - w), fy * (cy * cy * along + cx * cx * w)
    u, v = lens[3] + fx * value * cx, lens[4] + fy * value * cy
    return u, v, ux, uy, fx * cx * axial, vx, vy, fy * cy * axial, slope > 0.0 and angle * angle < lens[17]


@njit(nogil=True, cache=True)
def _many_pixels(lens: Array, directions: Array) -> Array:
    out = np.empty((directions.shape[0], 2))
    for i in range(directions.shape[0]):
        u, v, _a, _b, _c, _d, _e, _f, ok = land(lens, directions[i, 0], directions[i, 1], directions[i, 2])
        out[i, 0], out[i, 1] = (u, v) if ok else (np.nan, np.nan)
    return out


@njit(nogil=True, cache=True)
def _many_directions(lens: Array, xy: Array) -> Array:
    out = np.empty((xy.shape[0], 3))
    for i in range(xy.shape[0]):
        x, y, z = origin(lens, xy[i, 0], xy[i, 1])
        n = math.sqrt(x * x + y * y + z * z)
        out[i, 0], out[i, 1], out[i, 2] = x / n, y / n, z / n
    return out
