"""Common layout of the compiled lens models: a lens as a row of numbers, and the columns of their results."""

import numpy as np

from mosca.numba_support.decorators import inlined_step

FOLD, MODEL, ROW = 18, 19, 20
"""Indices in a lens row. The first 18 hold the parameters in the order of the dataclass's fields; FOLD the squared
radius (fisheye: angle) at which the radial mapping stops rising (``monotonic_range``); MODEL one of those below."""
MOSCA, OPENCV_PLAIN, OPENCV_FULL, FISHEYE = 0.0, 1.0, 2.0, 3.0
"""Models; OPENCV_PLAIN leaves out k4-k6, s1-s4 and the tilt, whose derivatives it does not write either."""
TILTED, TILT, UNTILT, RAY_ROW = 20, 21, 30, 39
"""Further indices in rows for ``direction``: whether OpenCV's sensor is tilted, the tilt's homography (3 x 3) and its
inverse."""
BY_DIRECTION, BY_LENS, IMAGED = 1, 4, 22
"""Columns of what ``image`` writes of x and of y: the pixel, its derivatives by the direction (3) and by the lens
(18)."""
FAST = {"contract", "reassoc", "nsz", "arcp"}
"""Freedom that ``fast_image`` gives the compiler: arithmetic in another order, which depends on the surrounding code;
infinities and NaN are kept. Bundle adjustment, which iterates until it converges, uses it; projection does not."""
NEWTON_STEPS = 30
"""Newton's method doubles the digits with each step; a point that takes more has no solution."""


@inlined_step
def set_by_tangent(tx, ty, j00, j01, j10, j11, d, g):
    """Fill the unit direction ``d`` (3,) and d pixel / d direction ``g`` (2, 3) from a tangent (x/z, y/z).

    ``j00`` ... ``j11``: the pixel's derivatives by the tangent.
    """
    length = np.sqrt(tx * tx + ty * ty + 1.0)
    inverse = 1.0 / length
    d[0], d[1], d[2] = tx * inverse, ty * inverse, inverse
    g[0, 0], g[0, 1], g[0, 2] = j00 * length, j01 * length, -(j00 * tx + j01 * ty) * length
    g[1, 0], g[1, 1], g[1, 2] = j10 * length, j11 * length, -(j10 * tx + j11 * ty) * length
