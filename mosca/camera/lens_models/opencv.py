"""OpenCV's pinhole model: ideal -> distorted, rational radial, tangential and thin prism distortion, tilted sensor.

With x = X/Z, y = Y/Z, r^2 = x^2 + y^2 and q = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6):

    xd = x q + 2 p1 x y + p2 (r^2 + 2 x^2) + s1 r^2 + s2 r^4      u = cx + fx xt
    yd = y q + p1 (r^2 + 2 y^2) + 2 p2 x y + s3 r^2 + s4 r^4      v = cy + fy yt

(xt, yt) is (xd, yd) projected onto a sensor rotated by R = R_y(tauY) R_x(tauX):

    (xt, yt, 1) ~ [[R33, 0, -R13], [0, R33, -R23], [0, 0, 1]] R (xd, yd, 1)

Source: OpenCV documentation, calib3d, "Detailed Description".
"""

from functools import lru_cache

import numpy as np

from mosca.camera.lens_models.monotonic_range import first_positive_root
from mosca.camera.lens_models.row import BY_LENS as L
from mosca.camera.lens_models.row import (
    FAST,
    FOLD,
    MODEL,
    NEWTON_STEPS,
    OPENCV_FULL,
    TILT,
    TILTED,
    UNTILT,
    set_by_tangent,
)
from mosca.data.arrays import Array
from mosca.data.rig import OpenCVLens
from mosca.numba_support.decorators import bare_step, step

CONVERGED = 1e-14
"""Newton's method ends with a residual below this [tangent]."""
INVERTED = 1e-10
"""Residual up to which a point counts as inverted [tangent]."""


@bare_step
def direction(q, u, v, d, g):
    """Fill the unit direction ``d`` (3,) of a pixel and d pixel / d direction ``g`` (2, 3), camera frame.

    Newton's method for the ideal point. Returns whether the pixel has a direction.
    """
    fx, fy, k1, k2, p1, p2, k3 = q[0], q[1], q[4], q[5], q[6], q[7], q[8]
    wx, wy = (u - q[2]) / fx, (v - q[3]) / fy
    if q[TILTED] > 0.0:
        depth = q[UNTILT + 6] * wx + q[UNTILT + 7] * wy + q[UNTILT + 8]
        if not depth > 0.0:
            return False
        wx, wy = (
            (q[UNTILT] * wx + q[UNTILT + 1] * wy + q[UNTILT + 2]) / depth,
            (q[UNTILT + 3] * wx + q[UNTILT + 4] * wy + q[UNTILT + 5]) / depth,
        )
    x, y = wx, wy
    for iteration in range(NEWTON_STEPS + 1):
        r2 = x * x + y * y
        above = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        below = 1.0 + r2 * (q[9] + r2 * (q[10] + r2 * q[11]))
        ratio = above / below
        rise = k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3) - ratio * (q[9] + r2 * (2.0 * q[10] + r2 * 3.0 * q[11]))
        rise /= below
        ex = wx - (x * ratio + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) + r2 * (q[12] + r2 * q[13]))
        ey = wy - (y * ratio + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y + r2 * (q[14] + r2 * q[15]))
        prism_x, prism_y = 2.0 * (q[12] + 2.0 * r2 * q[13]), 2.0 * (q[14] + 2.0 * r2 * q[15])
        across = 2.0 * x * y * rise + 2.0 * p1 * x + 2.0 * p2 * y
        s00 = ratio + 2.0 * x * x * rise + 2.0 * p1 * y + 6.0 * p2 * x + prism_x * x
        s01, s10 = across + prism_x * y, across + prism_y * x
        s11 = ratio + 2.0 * y * y * rise + 6.0 * p1 * y + 2.0 * p2 * x + prism_y * y
        det = s00 * s11 - s01 * s10
        near = abs(ex) < CONVERGED and abs(ey) < CONVERGED
        if near or iteration == NEWTON_STEPS or not np.isfinite(det):
            break
        x, y = x + (s11 * ex - s01 * ey) / det, y + (s00 * ey - s10 * ex) / det
    if not (abs(ex) < INVERTED and abs(ey) < INVERTED and det > 0.0 and s00 + s11 > 0.0 and r2 < q[FOLD]):
        return False
    if q[TILTED] > 0.0:
        s00, s01, s10, s11 = _tilted(q, wx, wy, s00, s01, s10, s11)
    set_by_tangent(x, y, fx * s00, fx * s01, fy * s10, fy * s11, d, g)
    return True


@bare_step
def _tilted(q, wx, wy, s00, s01, s10, s11):
    """Transform a Jacobian on the sensor without tilt to the tilted sensor."""
    depth = q[TILT + 6] * wx + q[TILT + 7] * wy + q[TILT + 8]
    x = (q[TILT] * wx + q[TILT + 1] * wy + q[TILT + 2]) / depth
    y = (q[TILT + 3] * wx + q[TILT + 4] * wy + q[TILT + 5]) / depth
    c00, c01 = (q[TILT] - x * q[TILT + 6]) / depth, (q[TILT + 1] - x * q[TILT + 7]) / depth
    c10, c11 = (q[TILT + 3] - y * q[TILT + 6]) / depth, (q[TILT + 4] - y * q[TILT + 7]) / depth
    return c00 * s00 + c01 * s10, c00 * s01 + c01 * s11, c10 * s00 + c11 * s10, c10 * s01 + c11 * s11


def _image(q, v0, v1, v2, out):
    """Project a direction: fill ``out`` (2, IMAGED or more) and return whether the lens images it."""
    if not v2 > 0:
        return False
    fx, fy, k1, k2, p1, p2, k3 = q[0], q[1], q[4], q[5], q[6], q[7], q[8]
    iz = 1 / v2
    x, y = v0 * iz, v1 * iz
    xx, yy, xy2 = x * x, y * y, 2 * x * y
    r2 = xx + yy
    if not r2 < q[FOLD]:
        return False
    r4 = r2 * r2
    g, gs, below = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), k1 + r2 * (2 * k2 + r2 * 3 * k3), 1.0
    if q[MODEL] == OPENCV_FULL:
        below = 1 + r2 * (q[9] + r2 * (q[10] + r2 * q[11]))
        g /= below
        gs = (gs - g * (q[9] + r2 * (2 * q[10] + r2 * 3 * q[11]))) / below
    xd = x * g + p1 * xy2 + p2 * (r2 + 2 * xx)
    yd = y * g + p1 * (r2 + 2 * yy) + p2 * xy2
    a = g + 2 * xx * gs + 2 * p1 * y + 6 * p2 * x
    b = xy2 * gs + 2 * p1 * x + 2 * p2 * y
    c, d = b, g + 2 * yy * gs + 6 * p1 * y + 2 * p2 * x
    # pixel by distorted point: focal lengths, then the tilt of the sensor
    m00, m01, m10, m11 = fx, 0.0, 0.0, fy
    xt, yt = xd, yd
    if q[MODEL] == OPENCV_FULL:
        xd += r2 * (q[12] + r2 * q[13])
        yd += r2 * (q[14] + r2 * q[15])
        e, f = 2 * q[12] + 4 * r2 * q[13], 2 * q[14] + 4 * r2 * q[15]
        a, b, c, d = a + e * x, b + e * y, c + f * x, d + f * y
        # the homography of the tilt in closed form: (cx, 0, 0), (-sx sy, cy, 0), (sy, -cy sx, cy cx)
        cx, sx, cy, sy = np.cos(q[16]), np.sin(q[16]), np.cos(q[17]), np.sin(q[17])
        w = sy * xd - cy * sx * yd + cy * cx
        if not w > 0:
            return False
        iw = 1 / w
        xt, yt = cx * xd * iw, (cy * yd - sx * sy * xd) * iw
        m00, m01 = fx * (cx - xt * sy) * iw, fx * xt * cy * sx * iw
        m10, m11 = fy * (-sx * sy - yt * sy) * iw, fy * (cy + yt * cy * sx) * iw
        wx, wy = -cy * cx * yd - cy * sx, cy * xd + sy * sx * yd - sy * cx
        out[0, L + 16] = fx * (-sx * xd - xt * wx) * iw
        out[1, L + 16] = fy * (-cx * sy * xd - yt * wx) * iw
        out[0, L + 17] = -fx * xt * wy * iw
        out[1, L + 17] = fy * (-sx * cy * xd - sy * yd - yt * wy) * iw
        for k, r in ((9, r2), (10, r4), (11, r4 * r2)):
            out[0, L + k] = -(m00 * x + m01 * y) * g * r / below
            out[1, L + k] = -(m10 * x + m11 * y) * g * r / below
        out[0, L + 12], out[1, L + 12], out[0, L + 13], out[1, L + 13] = (m00 * r2, m10 * r2, m00 * r4, m10 * r4)
        out[0, L + 14], out[1, L + 14], out[0, L + 15], out[1, L + 15] = (m01 * r2, m11 * r2, m01 * r4, m11 * r4)
    if not (a * d - b * c > 0 and a + d > 0):
        return False
    out[0, 0], out[1, 0] = q[2] + fx * xt, q[3] + fy * yt
    # stretches by the ideal point, and by the direction
    n00, n01 = (m00 * a + m01 * c) * iz, (m00 * b + m01 * d) * iz
    n10, n11 = (m10 * a + m11 * c) * iz, (m10 * b + m11 * d) * iz
    out[0, 1], out[0, 2], out[0, 3] = n00, n01, -(n00 * x + n01 * y)
    out[1, 1], out[1, 2], out[1, 3] = n10, n11, -(n10 * x + n11 * y)
    out[0, L], out[1, L], out[0, L + 1], out[1, L + 1] = xt, 0.0, 0.0, yt
    out[0, L + 2], out[1, L + 2], out[0, L + 3], out[1, L + 3] = 1.0, 0.0, 0.0, 1.0
    u, w = fx * x, fy * y
    if q[MODEL] == OPENCV_FULL:
        u, w = (m00 * x + m01 * y) / below, (m10 * x + m11 * y) / below
    out[0, L + 4], out[1, L + 4], out[0, L + 5], out[1, L + 5] = u * r2, w * r2, u * r4, w * r4
    s, t = r2 + 2 * yy, r2 + 2 * xx
    out[0, L + 6], out[1, L + 6] = m00 * xy2 + m01 * s, m10 * xy2 + m11 * s
    out[0, L + 7], out[1, L + 7] = m00 * t + m01 * xy2, m10 * t + m11 * xy2
    out[0, L + 8], out[1, L + 8] = u * r4 * r2, w * r4 * r2
    return True


image, fast_image = step(_image), step(fastmath=FAST)(_image)


@step
def radial_slope(q, s):
    """Return the slope of the radial mapping r q(r^2) at the squared ideal radius s; negative beyond a pole."""
    above = 1 + s * (q[4] + s * (q[5] + s * q[8]))
    below = 1 + s * (q[9] + s * (q[10] + s * q[11]))
    if below <= 0:
        return -1.0
    above_slope = q[4] + s * (2 * q[5] + s * 3 * q[8])
    below_slope = q[9] + s * (2 * q[10] + s * 3 * q[11])
    return (above + 2 * s * (above_slope - above / below * below_slope)) / below


@lru_cache(maxsize=256)
def fold_r2(lens: OpenCVLens) -> float:
    """Return the squared ideal radius at which the radial distortion r q(r^2) stops rising, or infinity.

    With q = N / D in s = r^2 the slope by r is (N D + 2 s (N' D - N D')) / D^2; a pole (D = 0) also ends the mapping.
    """
    above = np.array([1.0, lens.k1, lens.k2, lens.k3])
    below = np.array([1.0, lens.k4, lens.k5, lens.k6])
    order = np.arange(4)
    # 2 s N' has the coefficients 2 k n_k, so the slope's numerator is a sum of products of the two
    rising = np.convolve(above * (1 + 2 * order), below) - np.convolve(above, 2 * order * below)
    return min(first_positive_root(rising), first_positive_root(below))


def tilt(tau_x: float, tau_y: float) -> Array:
    """Return the homography (3, 3) of a sensor rotated by R = R_y(tauY) R_x(tauX) (OpenCV, calib3d)."""
    cx, sx, cy, sy = np.cos(tau_x), np.sin(tau_x), np.cos(tau_y), np.sin(tau_y)
    rotation = np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]]) @ np.array([[1, 0, 0], [0, cx, sx], [0, -sx, cx]])
    result: Array = (
        np.array([[rotation[2, 2], 0, -rotation[0, 2]], [0, rotation[2, 2], -rotation[1, 2]], [0, 0, 1.0]]) @ rotation
    )
    return result
