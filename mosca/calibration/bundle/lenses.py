"""The lens models compiled, one direction at a time: the same formulas as ``mosca.camera.lens_models``, which tests
compare.

A lens is a row of numbers: its parameters in the order of the dataclass's fields, then the squared radius
(fisheye: angle) where the mapping folds back, then which model it is.
"""

from dataclasses import fields

import numpy as np

from mosca.data.arrays import Array
from mosca.data.rig import Lens
from mosca.numba_support.decorators import kernel, step

ROW = 20
FOLD, MODEL = 18, 19
MOSCA, OPENCV_PLAIN, OPENCV_FULL, FISHEYE = 0.0, 1.0, 2.0, 3.0
# what ``image`` writes of x and y: the pixel, its derivative by the direction (3) and, from L on, by the lens (18)
L, IMAGED = 4, 22
# compiled arithmetic may be reordered, but numbers that are none must stay noticeable
FAST = {"contract", "reassoc", "nsz", "arcp"}

NEWTON_STEPS = 30
CONVERGED_MM = 1e-13
NEAR_AXIS = 1e-9
FOLD_SAMPLES = 256


def lens_row(lens: Lens, free: tuple[str, ...]) -> Array:
    """Return a lens as a row (20,); ``free`` tells whether OpenCV's seldom used coefficients can differ from
    0.
    """
    row = np.zeros(ROW)
    values = [getattr(lens, one.name) for one in fields(lens)]
    row[: len(values)] = values
    if lens.model == "opencv":
        seldom = {"k4", "k5", "k6", "s1", "s2", "s3", "s4", "tauX", "tauY"}
        row[MODEL] = OPENCV_FULL if row[9:18].any() or seldom & set(free) else OPENCV_PLAIN
    else:
        row[MODEL] = MOSCA if lens.model == "mosca" else FISHEYE
    set_fold(row)
    return row


def lens_of(row: Array, like: Lens) -> Lens:
    """Return the lens of a row (20,), of the model of ``like``."""
    return type(like)(*(float(x) for x in row[: len(fields(like))]))


@step
def _rise(q, s):  # type: ignore[no-untyped-def]
    """Slope of the radial mapping at the squared radius or angle s; its first zero is the fold (lenses.fold)."""
    if q[MODEL] == MOSCA:
        return 1 + s * (3 * q[6] + s * (5 * q[7] + s * 7 * q[8]))
    if q[MODEL] == FISHEYE:
        return 1 + s * (3 * q[4] + s * (5 * q[5] + s * (7 * q[6] + s * 9 * q[7])))
    above = 1 + s * (q[4] + s * (q[5] + s * q[8]))
    below = 1 + s * (q[9] + s * (q[10] + s * q[11]))
    if below <= 0:
        return -1.0
    above_slope = q[4] + s * (2 * q[5] + s * 3 * q[8])
    below_slope = q[9] + s * (2 * q[10] + s * 3 * q[11])
    return (above + 2 * s * (above_slope - above / below * below_slope)) / below


@kernel
def set_fold(q):  # type: ignore[no-untyped-def]
    """Write where the mapping of lens row q folds back: bracketed by steps of a third of a degree, then
    halved.
    """
    q[FOLD] = np.inf
    last = np.pi if q[MODEL] == FISHEYE else np.pi / 2 - 1e-3
    unit = q[0] if q[MODEL] == MOSCA else 1.0
    low = 0.0
    for k in range(1, FOLD_SAMPLES + 1):
        angle = last * k / FOLD_SAMPLES
        r = angle if q[MODEL] == FISHEYE else unit * np.tan(angle)
        if _rise(q, r * r) <= 0:
            high = r * r
            for _ in range(60):
                middle = (low + high) / 2
                if _rise(q, middle) > 0:
                    low = middle
                else:
                    high = middle
            q[FOLD] = high
            return
        low = r * r


@kernel
def set_folds(rows):  # type: ignore[no-untyped-def]
    """Write the folds of lens rows (n, 20); tell whether all have scales above 0, as a lens must."""
    for n in range(rows.shape[0]):
        q = rows[n]
        if not (q[0] > 0 and (q[3] > 0 and q[4] > 0 if q[MODEL] == MOSCA else q[1] > 0)):
            return False
        set_fold(q)
    return True


@kernel(fastmath=FAST)
def image(q, v0, v1, v2, out):  # type: ignore[no-untyped-def]
    """Project a direction, camera frame, by lens row q; tells whether it is imaged.

    Writes ``out`` (2, 22 or more): of x and y the pixel, its derivative by the direction (3) and by the lens
    parameters (18). One array, since each array handed over costs as much as some ten numbers.
    """
    model = q[MODEL]
    if model in (OPENCV_PLAIN, OPENCV_FULL):
        return _opencv(q, v0, v1, v2, out)
    if model == MOSCA:
        return _mosca(q, v0, v1, v2, out)
    return _fisheye(q, v0, v1, v2, out)


@step(fastmath=FAST)
def _opencv(q, v0, v1, v2, out):  # type: ignore[no-untyped-def]
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
        out[0, L + 12], out[1, L + 12], out[0, L + 13], out[1, L + 13] = (
            m00 * r2,
            m10 * r2,
            m00 * r4,
            m10 * r4,
        )
        out[0, L + 14], out[1, L + 14], out[0, L + 15], out[1, L + 15] = (
            m01 * r2,
            m11 * r2,
            m01 * r4,
            m11 * r4,
        )
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


@step(fastmath=FAST)
def _mosca(q, v0, v1, v2, out):  # type: ignore[no-untyped-def]
    if not v2 > 0:
        return False
    c, mx, my, af, k1, k2, k3, p1, p2 = q[0], q[3], q[4], q[5], q[6], q[7], q[8], q[9], q[10]
    iz = 1 / v2
    # ideal point [mm], y up; Newton's method for the measured point that the correction carries there
    ix, iy = c * v0 * iz, -c * v1 * iz
    x, y = ix, iy
    a = b = d = rx = ry = 0.0
    r2 = 0.0
    for turn in range(NEWTON_STEPS + 1):
        r2 = x * x + y * y
        radial = r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))
        rx = ix - (x + af * y + x * radial + (r2 + 2 * x * x) * p1 + 2 * x * y * p2)
        ry = iy - (y + af * x + y * radial + 2 * x * y * p1 + (r2 + 2 * y * y) * p2)
        a = 1 + radial + x * x * slope + 6 * x * p1 + 2 * y * p2
        b = af + x * y * slope + 2 * y * p1 + 2 * x * p2
        d = 1 + radial + y * y * slope + 2 * x * p1 + 6 * y * p2
        determinant = a * d - b * b
        dx, dy = (d * rx - b * ry) / determinant, (a * ry - b * rx) / determinant
        if turn == NEWTON_STEPS or (abs(dx) <= CONVERGED_MM and abs(dy) <= CONVERGED_MM):
            break
        x, y = x + dx, y + dy
    determinant = a * d - b * b
    if not (determinant > 0 and a + d > 0 and abs(rx) < 1e-9 and abs(ry) < 1e-9 and r2 < q[FOLD]):
        return False
    # pixel by ideal point: inverse of the slope, then the pitches; the y axis turns from up to down
    n00, n01 = d / determinant / mx, -b / determinant / mx
    n10, n11 = b / determinant / my, -a / determinant / my
    out[0, 0], out[1, 0] = q[1] + x / mx, q[2] - y / my
    c *= iz
    out[0, 1], out[0, 2] = n00 * c, -n01 * c
    out[1, 1], out[1, 2] = n10 * c, -n11 * c
    out[0, 3], out[1, 3] = -(n00 * ix + n01 * iy) * iz, -(n10 * ix + n11 * iy) * iz
    out[0, L], out[1, L] = (n00 * ix + n01 * iy) / q[0], (n10 * ix + n11 * iy) / q[0]
    out[0, L + 1], out[1, L + 1], out[0, L + 2], out[1, L + 2] = 1.0, 0.0, 0.0, 1.0
    out[0, L + 3], out[1, L + 3], out[0, L + 4], out[1, L + 4] = -x / (mx * mx), 0.0, 0.0, y / (my * my)
    out[0, L + 5], out[1, L + 5] = -(n00 * y + n01 * x), -(n10 * y + n11 * x)
    u, w = -(n00 * x + n01 * y), -(n10 * x + n11 * y)
    out[0, L + 6], out[1, L + 6], out[0, L + 7], out[1, L + 7] = u * r2, w * r2, u * r2 * r2, w * r2 * r2
    out[0, L + 8], out[1, L + 8] = u * r2 * r2 * r2, w * r2 * r2 * r2
    s, t, e = r2 + 2 * x * x, r2 + 2 * y * y, 2 * x * y
    out[0, L + 9], out[1, L + 9] = -(n00 * s + n01 * e), -(n10 * s + n11 * e)
    out[0, L + 10], out[1, L + 10] = -(n00 * e + n01 * t), -(n10 * e + n11 * t)
    return True


@step(fastmath=FAST)
def _fisheye(q, v0, v1, v2, out):  # type: ignore[no-untyped-def]
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


@kernel
def influence(q, reach_px):  # type: ignore[no-untyped-def]
    """Return how far, at most, each lens parameter (18,) moves image points ``reach_px`` off the axis, per
    unit.

    Points that the lens does not image count half as far out, and so on.
    """
    most, out = np.zeros(18), np.zeros((2, IMAGED))
    focal = q[0] / q[3] if q[MODEL] == MOSCA else q[0]
    for k in range(8):
        angle = reach_px / focal if q[MODEL] == FISHEYE else np.arctan(reach_px / focal)
        a = k * np.pi / 4
        for _ in range(6):
            s = np.sin(angle)
            out[:] = 0.0
            if image(q, s * np.cos(a), s * np.sin(a), np.cos(angle), out):
                for i in range(18):
                    most[i] = max(most[i], np.hypot(out[0, L + i], out[1, L + i]))
                break
            angle /= 2
    return most
