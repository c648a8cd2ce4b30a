"""The Mosca paper's camera model (section 2.2): collinearity with affinity, K1-K3, P1, P2.

With ``xb = mx (x - xp)`` to the right and ``yb = -my (y - yp)`` up [mm], ``r^2 = xb^2 + yb^2``:

    dx = a yb + xb (K1 r^2 + K2 r^4 + K3 r^6) + (r^2 + 2 xb^2) P1 + 2 xb yb P2
    dy = a xb + yb (K1 r^2 + K2 r^4 + K3 r^6) + 2 xb yb P1 + (r^2 + 2 yb^2) P2

ideal = measured + (dx, dy), and the ideal point is c times the tangent of the ray's direction. The correction is a
function of the measured point: pixel -> ray has a closed form, and projection inverts it.
"""

from functools import lru_cache

from mosca.camera.lens_models.monotonic_range import first_positive_root
from mosca.camera.lens_models.row import BY_LENS as L
from mosca.camera.lens_models.row import FAST, FOLD, NEWTON_STEPS, set_by_tangent
from mosca.data.rig import MoscaLens
from mosca.numba_support.decorators import inlined_step, step

CONVERGED_MM = 1e-13
"""Newton's method ends with a step below this: a few ulp of a sensor's coordinates."""
INVERTED_MM = 1e-9
"""Residual up to which a point counts as inverted."""


@inlined_step
def direction(q, u, v, d, g):
    """Fill the unit direction ``d`` (3,) of a pixel and d pixel / d direction ``g`` (2, 3), closed form.

    Returns whether the pixel lies before the fold, where light comes from that direction.
    """
    c, mx, my, a, k1, k2, k3, p1, p2 = q[0], q[3], q[4], q[5], q[6], q[7], q[8], q[9], q[10]
    x, y = mx * (u - q[1]), -my * (v - q[2])
    r2 = x * x + y * y
    radial = r2 * (k1 + r2 * (k2 + r2 * k3))
    rise = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3))
    ix = x + a * y + x * radial + (r2 + 2.0 * x * x) * p1 + 2.0 * x * y * p2
    iy = y + a * x + y * radial + 2.0 * x * y * p1 + (r2 + 2.0 * y * y) * p2
    s00 = 1.0 + radial + x * x * rise + 6.0 * x * p1 + 2.0 * y * p2
    s01 = a + x * y * rise + 2.0 * y * p1 + 2.0 * x * p2
    s11 = 1.0 + radial + y * y * rise + 2.0 * x * p1 + 6.0 * y * p2
    det = s00 * s11 - s01 * s01
    tx, ty = ix / c, -iy / c
    # pixel by tangent: scale (1/mx, -1/my), inverse slope, c (1, -1)
    across, down = c / (mx * det), c / (my * det)
    j00, j01 = across * s11, across * s01
    j10, j11 = down * s01, down * s00
    set_by_tangent(tx, ty, j00, j01, j10, j11, d, g)
    return det > 0.0 and s00 + s11 > 0.0 and r2 < q[FOLD]


def _image(q, v0, v1, v2, out):
    """Project a direction: fill ``out`` (2, IMAGED or more) and return whether the lens images it.

    Inverts the correction by Newton's method from the ideal point.
    """
    if not v2 > 0:
        return False
    c, mx, my, af, k1, k2, k3, p1, p2 = q[0], q[3], q[4], q[5], q[6], q[7], q[8], q[9], q[10]
    iz = 1 / v2
    # ideal point [mm], y up; Newton's method for the measured point that the correction maps to it
    ix, iy = c * v0 * iz, -c * v1 * iz
    x, y = ix, iy
    a = b = d = rx = ry = 0.0
    r2 = 0.0
    for iteration in range(NEWTON_STEPS + 1):
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
        if iteration == NEWTON_STEPS or (abs(dx) <= CONVERGED_MM and abs(dy) <= CONVERGED_MM):
            break
        x, y = x + dx, y + dy
    determinant = a * d - b * b
    if not (determinant > 0 and a + d > 0 and abs(rx) < INVERTED_MM and abs(ry) < INVERTED_MM and r2 < q[FOLD]):
        return False
    # pixel by ideal point: inverse of the slope, then the pitches; the y axis is flipped from up to down
    n00, n01 = d / determinant / mx, -b / determinant / mx
    n10, n11 = b / determinant / my, -a / determinant / my
    out[0, 0], out[1, 0] = q[1] + x / mx, q[2] - y / my
    c *= iz
    out[0, 1], out[0, 2] = n00 * c, -n01 * c
    out[1, 1], out[1, 2] = n10 * c, -n11 * c
    out[0, 3], out[1, 3] = -(n00 * ix + n01 * iy) * iz, -(n10 * ix + n11 * iy) * iz
    out[0, L], out[1, L] = (n00 * ix + n01 * iy) / q[0], (n10 * ix + n11 * iy) / q[0]
    out[0, L + 1], out[1, L + 1], out[0, L + 2], out[1, L + 2] = 1.0, 0.0, 0.0, 1.0
    out[0, L + 3], out[1, L + 3], out[0, L + 4], out[1, L + 4] = (-x / (mx * mx), 0.0, 0.0, y / (my * my))
    out[0, L + 5], out[1, L + 5] = -(n00 * y + n01 * x), -(n10 * y + n11 * x)
    u, w = -(n00 * x + n01 * y), -(n10 * x + n11 * y)
    out[0, L + 6], out[1, L + 6], out[0, L + 7], out[1, L + 7] = (u * r2, w * r2, u * r2 * r2, w * r2 * r2)
    out[0, L + 8], out[1, L + 8] = u * r2 * r2 * r2, w * r2 * r2 * r2
    s, t, e = r2 + 2 * x * x, r2 + 2 * y * y, 2 * x * y
    out[0, L + 9], out[1, L + 9] = -(n00 * s + n01 * e), -(n10 * s + n11 * e)
    out[0, L + 10], out[1, L + 10] = -(n00 * e + n01 * t), -(n10 * e + n11 * t)
    return True


image, fast_image = step(_image), step(fastmath=FAST)(_image)


@step
def radial_slope(q, s):
    """Return the slope of the radial mapping, ideal by measured radius, at the squared measured radius s [mm^2]."""
    return 1 + s * (3 * q[6] + s * (5 * q[7] + s * 7 * q[8]))


@lru_cache(maxsize=256)
def fold_mm2(lens: MoscaLens) -> float:
    """Return the squared measured radius [mm^2] at which the ideal radius stops rising, or infinity.

    There the slope of r + K1 r^3 + K2 r^5 + K3 r^7 by r, a polynomial in r^2, is zero.
    """
    return first_positive_root((1.0, 3 * lens.K1_per_mm2, 5 * lens.K2_per_mm4, 7 * lens.K3_per_mm6))
