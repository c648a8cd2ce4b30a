"""Compiled solution of the normal equations of a disc: for a centre apart from the rest, and for all at once."""

import math
from typing import Any

from mosca.data.arrays import Array
from mosca.detection.disc_fit.disc_image import FAST
from mosca.numba_support.decorators import bare_step


@bare_step(fastmath=FAST)
def solve_shape(h: Any, c: Any, prior: float, pull: float) -> tuple[float, float, float, float, float, float, float]:
    """Solve for amplitude, background, radius and blur; the blur is held by a prior of this information.

    ``pull``: prior mean less the present blur. Returns the four corrections; the blur's variance from the data alone,
    or infinity; the radius' variance; and the determinant's sign (0 where there is no solution).
    """
    haa, hab, har, has, hbb, hbr, hbs, hrr, hrs, hss = h
    ca, cb, cr, cs = c
    # L D L' in the order amplitude, background, radius, blur; in float64
    d0 = haa + 1e-9
    l1, l2, l3 = hab / d0, har / d0, has / d0
    d1 = hbb - l1 * hab + 1e-12
    m2, m3 = (hbr - l1 * har) / d1, (hbs - l1 * has) / d1
    d2 = hrr - l2 * har - m2 * m2 * d1 + 1e-9
    n3 = (hrs - l2 * has - m2 * m3 * d1) / d2
    data = hss - l3 * has - m3 * m3 * d1 - n3 * n3 * d2
    if not (d0 > 0.0 and d1 > 0.0 and d2 > 0.0 and data + prior > 0.0):
        return 0.0, 0.0, 0.0, 0.0, math.inf, math.inf, 0.0
    z1 = cb - l1 * ca
    z2 = cr - l2 * ca - m2 * z1
    z3 = cs - l3 * ca - m3 * z1 - n3 * z2
    s = (z3 + prior * pull) / (data + prior)
    r = z2 / d2 - n3 * s
    b = z1 / d1 - m2 * r - m3 * s
    a = ca / d0 - l1 * b - l2 * r - l3 * s
    return a, b, r, s, 1.0 / max(data, 1e-12), 1.0 / d2 + n3 * n3 / (data + prior), 1.0


@bare_step(fastmath=FAST)
def factor_all(
    place: Any, h: Any, cross: Any, c: Any, prior: tuple[float, float], peak: tuple[float, float], work: Array
) -> bool:
    """Factor the normal equations of all six unknowns, for a window that is not symmetric about the target.

    The order is amplitude, background, radius, blur, x, y. ``prior``: information on the blur, and prior mean less
    the present one; ``peak``: the same for the amplitude, which is nearly collinear with the radius where a side is
    missing or pixels are coarse. ``work`` (6, 8): Cholesky factor of the matrix scaled to a unit diagonal, the right
    side divided by it, and the scales. Returns whether the matrix is regular.
    """
    k = 0
    for j in range(4):
        for i in range(j, 4):
            work[i, j] = h[k]
            k += 1
        work[4, j], work[5, j], work[j, 6] = cross[j], cross[4 + j], c[j]
    work[4, 4], work[5, 4], work[5, 5] = place[0], place[1], place[2]
    work[4, 6], work[5, 6] = place[3], place[4]
    work[3, 3] += prior[0]
    work[3, 6] += prior[0] * prior[1]
    work[0, 0] += peak[0]
    work[0, 6] += peak[0] * peak[1]
    for i in range(6):
        work[i, 7] = 1.0 / math.sqrt(max(work[i, i], 1e-12))
        work[i, 6] *= work[i, 7]
        for j in range(i):
            work[i, j] *= work[i, 7] * work[j, 7]
    for i in range(6):
        for j in range(i):
            rest = work[i, j]
            for q in range(j):
                rest -= work[i, q] * work[j, q]
            work[i, j] = rest / work[j, j]
            work[i, 6] -= work[i, j] * work[j, 6]
        rest = 1.0 + 1e-7
        for q in range(i):
            rest -= work[i, q] * work[i, q]
        if not rest > 1e-9:
            return False
        work[i, i] = math.sqrt(rest)
        work[i, 6] /= work[i, i]
    return True


@bare_step(fastmath=FAST)
def solve_all(work: Array, blur_information: float) -> tuple[Any, ...]:
    """Solve the equations that ``factor_all`` left in ``work``.

    Returns the corrections (x, y, amplitude, background, radius, blur), the centre's covariance (xx, xy, yy), the
    variance of the blur less its prior's information, and those of amplitude and radius.
    """
    # the last three columns of the inverse factor
    u3, u4, u5 = 1.0 / work[3, 3], 1.0 / work[4, 4], 1.0 / work[5, 5]
    u43, u54 = -work[4, 3] * u3 * u4, -work[5, 4] * u4 * u5
    u53 = -(work[5, 3] * u3 + work[5, 4] * u43) * u5
    own = (u3 * u3 + u43 * u43 + u53 * u53) * work[3, 7] * work[3, 7]
    # the squares of its first column add up to the variance of the amplitude
    a0 = 1.0 / work[0, 0]
    a1 = -work[1, 0] * a0 / work[1, 1]
    a2 = -(work[2, 0] * a0 + work[2, 1] * a1) / work[2, 2]
    a3 = -(work[3, 0] * a0 + work[3, 1] * a1 + work[3, 2] * a2) * u3
    a4 = -(work[4, 0] * a0 + work[4, 1] * a1 + work[4, 2] * a2 + work[4, 3] * a3) * u4
    a5 = -(work[5, 0] * a0 + work[5, 1] * a1 + work[5, 2] * a2 + work[5, 3] * a3 + work[5, 4] * a4) * u5
    of_amplitude = (a0 * a0 + a1 * a1 + a2 * a2 + a3 * a3 + a4 * a4 + a5 * a5) * work[0, 7] * work[0, 7]
    r2 = 1.0 / work[2, 2]
    r3 = -work[3, 2] * r2 * u3
    r4 = -(work[4, 2] * r2 + work[4, 3] * r3) * u4
    r5 = -(work[5, 2] * r2 + work[5, 3] * r3 + work[5, 4] * r4) * u5
    of_radius = (r2 * r2 + r3 * r3 + r4 * r4 + r5 * r5) * work[2, 7] * work[2, 7]
    for i in range(5, -1, -1):
        for q in range(i + 1, 6):
            work[i, 6] -= work[q, i] * work[q, 6]
        work[i, 6] /= work[i, i]
    s4, s5 = work[4, 7], work[5, 7]
    return (
        work[4, 6] * s4, work[5, 6] * s5, work[0, 6] * work[0, 7], work[1, 6] * work[1, 7], work[2, 6] * work[2, 7],
        work[3, 6] * work[3, 7], (u4 * u4 + u54 * u54) * s4 * s4, u54 * u5 * s4 * s5, u5 * u5 * s5 * s5,
        1.0 / max(1.0 / own - blur_information, 1e-12), of_amplitude, of_radius,
    )  # fmt: skip
