"""Equidistant fisheye with a polynomial in the angle (Kannala-Brandt).

With theta the angle from the optical axis and rho(theta) = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 +
k4 theta^8): u = cx + fx rho cos(phi), v = cy + fy rho sin(phi). The model also images directions beyond 90 degrees
from the axis, where z is negative, up to the image circle: there rho stops rising or theta reaches 180 degrees.
Source: Kannala and Brandt 2006; the parameters are those of OpenCV's ``fisheye`` with zero skew.
"""

from functools import lru_cache

import numpy as np

from mosca.camera.lens_models.monotonic_range import first_positive_root
from mosca.camera.lens_models.row import BY_LENS as L
from mosca.camera.lens_models.row import FAST, FOLD
from mosca.data.rig import FisheyeLens
from mosca.numba_support.decorators import bare_step, step

STEPS = 60
"""Bisection alone halves pi down to the last bit in 52 steps."""
CONVERGED_RAD = 1e-14
"""Newton's method ends with a step below this: a few ulp."""
INVERTED = 1e-10
"""Residual up to which an image radius counts as inverted [rad]."""
NEAR_AXIS = 1e-9
"""Distance from the axis, over the depth, below which a direction counts as on it: sin(theta) / rho -> 1."""


@bare_step
def direction(q, u, v, d, g):
    """Fill the unit direction ``d`` (3,) of a pixel and d pixel / d direction ``g`` (2, 3), camera frame.

    Newton's method finds the angle between bounds. Bisection, possible since rho rises up to the image circle, takes
    over where a step leaves them (just inside the fold the slope is nearly zero). Returns whether the pixel has a
    direction.
    """
    fx, fy, k1, k2, k3, k4 = q[0], q[1], q[4], q[5], q[6], q[7]
    wx, wy = (u - q[2]) / fx, (v - q[3]) / fy
    rho = np.sqrt(wx * wx + wy * wy)
    low, last = 0.0, min(np.pi, np.sqrt(q[FOLD]))
    high = last
    theta = min(rho, high)
    value = slope = 0.0
    for _step in range(STEPS):
        t2 = theta * theta
        value = theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
        slope = 1.0 + t2 * (3.0 * k1 + t2 * (5.0 * k2 + t2 * (7.0 * k3 + t2 * 9.0 * k4)))
        if value < rho:
            low = theta
        else:
            high = theta
        tried = theta + (rho - value) / slope
        moved = tried if low <= tried <= high else 0.5 * (low + high)
        done = abs(moved - theta) <= CONVERGED_RAD
        theta = moved
        if done:
            break
    if not (abs(rho - value) < INVERTED and theta < last and slope > 0.0):
        return False
    s, z = np.sin(theta), np.cos(theta)
    cx, cy = (wx / rho, wy / rho) if rho > NEAR_AXIS else (1.0, 0.0)
    stretch = rho / s if rho > NEAR_AXIS else 1.0
    d[0], d[1], d[2] = s * cx, s * cy, z
    for k in range(3):
        along = (z * cx, z * cy, -s)[k] * slope
        beside = (-cy, cx, 0.0)[k] * stretch
        g[0, k] = fx * (cx * along - cy * beside)
        g[1, k] = fy * (cy * along + cx * beside)
    return True


def _image(q, v0, v1, v2, out):
    """Project a direction: fill ``out`` (2, IMAGED or more) and return whether the lens images it."""
    fx, fy = q[0], q[1]
    s2 = v0 * v0 + v1 * v1
    norm2 = s2 + v2 * v2
    s = np.sqrt(s2)
    near = s <= NEAR_AXIS * abs(v2)
    if not norm2 > 0 or (near and v2 < 0):
        return False
    theta = np.arctan2(s, v2)
    t2 = theta * theta
    rho = theta * (1 + t2 * (q[4] + t2 * (q[5] + t2 * (q[6] + t2 * q[7]))))
    slope = 1 + t2 * (3 * q[4] + t2 * (5 * q[5] + t2 * (7 * q[6] + t2 * 9 * q[7])))
    if not (slope > 0 and t2 < q[FOLD]):
        return False
    # unit vector across the axis, and rho / s, which is 1 / z on the axis
    a0, a1, scale = 0.0, 0.0, 1 / v2
    ix, iy = v0 * scale, v1 * scale
    if not near:
        a0, a1, scale = v0 / s, v1 / s, rho / s
        ix, iy = a0 * rho, a1 * rho
    out[0, 0], out[1, 0] = q[2] + fx * ix, q[3] + fy * iy
    t0, t1, t3 = a0 * v2 / norm2 * slope, a1 * v2 / norm2 * slope, -s / norm2 * slope
    out[0, 1] = fx * (a0 * t0 + (1 - a0 * a0) * scale)
    out[0, 2] = fx * (a0 * t1 - a0 * a1 * scale)
    out[1, 1] = fy * (a1 * t0 - a0 * a1 * scale)
    out[1, 2] = fy * (a1 * t1 + (1 - a1 * a1) * scale)
    out[0, 3], out[1, 3] = fx * a0 * t3, fy * a1 * t3
    if near:
        out[0, 3], out[1, 3] = -fx * ix / v2, -fy * iy / v2
    out[0, L], out[1, L], out[0, L + 1], out[1, L + 1] = ix, 0.0, 0.0, iy
    out[0, L + 2], out[1, L + 2], out[0, L + 3], out[1, L + 3] = 1.0, 0.0, 0.0, 1.0
    power = theta * t2
    for k in range(4):
        out[0, L + 4 + k], out[1, L + 4 + k] = fx * a0 * power, fy * a1 * power
        power *= t2
    return True


image, fast_image = step(_image), step(fastmath=FAST)(_image)


@step
def radial_slope(q, s):
    """Return the slope of rho(theta) at the squared angle s."""
    return 1 + s * (3 * q[4] + s * (5 * q[5] + s * (7 * q[6] + s * 9 * q[7])))


@lru_cache(maxsize=256)
def fold_rad2(lens: FisheyeLens) -> float:
    """Return the squared angle [rad^2] at which rho stops rising, or infinity."""
    return first_positive_root((1.0, 3 * lens.k1, 5 * lens.k2, 7 * lens.k3, 9 * lens.k4))
