"""The Mosca paper's camera model (section 2.2): collinearity with affinity, K1-K3, P1, P2.

With ``xb = mx (x - xp)`` to the right and ``yb = -my (y - yp)`` up [mm], ``r^2 = xb^2 + yb^2``:

    dx = a yb + xb (K1 r^2 + K2 r^4 + K3 r^6) + (r^2 + 2 xb^2) P1 + 2 xb yb P2
    dy = a xb + yb (K1 r^2 + K2 r^4 + K3 r^6) + 2 xb yb P1 + (r^2 + 2 yb^2) P2

ideal = measured + (dx, dy), and the ideal point is c times the tangent of the ray's direction. The
correction is a function of the measured point: pixel -> ray is closed form, projection inverts it.
"""

from functools import lru_cache

import numpy as np

from mosca.camera.lens_models.monotonic_range import first_positive_root
from mosca.data.arrays import Array
from mosca.data.rig import MoscaLens

NEWTON_STEPS = 30
CONVERGED_MM = 1e-13


def directions(lens: MoscaLens, xy_px: Array) -> Array:
    """Pixel (n, 2) -> direction (n, 3) with z = 1, camera frame; closed form."""
    ideal = _ideal(lens, _measured(lens, xy_px))
    return np.column_stack([ideal[:, 0] / lens.c_mm, -ideal[:, 1] / lens.c_mm, np.ones(len(ideal))])


def pixels(lens: MoscaLens, directions: Array) -> tuple[Array, Array, Array]:
    """Direction (n, 3), camera frame -> pixel (n, 2), d pixel/d direction (n, 2, 3), d pixel/d lens (n, 2, 11).

    Inverts the correction by Newton's method from the ideal point. NaN for directions behind the
    camera and where the correction cannot be inverted (the polynomial folds back).
    """
    v = np.asarray(directions, dtype=float)
    front = v[:, 2] > 0
    z = np.where(front, v[:, 2], 1.0)
    tangent = np.column_stack([v[:, 0] / z, v[:, 1] / z])
    ideal = lens.c_mm * tangent * (1.0, -1.0)
    measured, invertible = _invert(lens, ideal)
    slope = np.linalg.inv(_ideal_slope(lens, measured))  # d measured / d ideal, (n, 2, 2)
    # d pixel / d measured: the y axis turns from up to down
    scale = np.array([1.0 / lens.mx_mm_per_px, -1.0 / lens.my_mm_per_px])
    xy = np.array([lens.xp_px, lens.yp_px]) + measured * scale
    pixel_by_ideal = scale[:, None] * slope

    ideal_by_direction = np.zeros((len(v), 2, 3))
    ideal_by_direction[:, 0, 0] = lens.c_mm / z
    ideal_by_direction[:, 0, 2] = -ideal[:, 0] / z
    ideal_by_direction[:, 1, 1] = -lens.c_mm / z
    ideal_by_direction[:, 1, 2] = -ideal[:, 1] / z

    # c moves the ideal point; a, K, P move the correction at a fixed measured point, so that the
    # measured point has to give way: d measured = -slope * d correction.
    by_lens = np.empty((len(v), 2, 11))
    by_lens[:, :, 0] = (pixel_by_ideal @ (ideal / lens.c_mm)[:, :, None])[:, :, 0]
    by_lens[:, :, 1:3] = np.eye(2)
    by_lens[:, 0, 3], by_lens[:, 1, 3] = -measured[:, 0] / lens.mx_mm_per_px**2, 0.0
    by_lens[:, 0, 4], by_lens[:, 1, 4] = 0.0, measured[:, 1] / lens.my_mm_per_px**2
    by_lens[:, :, 5:] = -pixel_by_ideal @ _correction_terms(measured)
    by_direction = pixel_by_ideal @ ideal_by_direction
    bad = ~(front & invertible)
    xy[bad], by_direction[bad], by_lens[bad] = np.nan, np.nan, np.nan
    return xy, by_direction, by_lens


@lru_cache(maxsize=256)
def fold_mm2(lens: MoscaLens) -> float:
    """Return the squared measured radius [mm^2] at which the ideal radius stops rising, or infinity.

    The slope of r + K1 r^3 + K2 r^5 + K3 r^7 by r, a polynomial in r^2.
    """
    return first_positive_root((1.0, 3 * lens.K1_per_mm2, 5 * lens.K2_per_mm4, 7 * lens.K3_per_mm6))


def _measured(lens: MoscaLens, xy_px: Array) -> Array:
    xy = np.asarray(xy_px, dtype=float)
    return np.column_stack(
        [lens.mx_mm_per_px * (xy[:, 0] - lens.xp_px), -lens.my_mm_per_px * (xy[:, 1] - lens.yp_px)]
    )


def _correction_terms(measured: Array) -> Array:
    """Return the factors (n, 2, 6) of a, K1, K2, K3, P1, P2 in (dx, dy)."""
    x, y = measured[:, 0], measured[:, 1]
    r2 = x * x + y * y
    terms = np.empty((len(x), 2, 6))
    terms[:, 0, 0], terms[:, 1, 0] = y, x
    for k, power in enumerate((r2, r2**2, r2**3), start=1):
        terms[:, 0, k], terms[:, 1, k] = x * power, y * power
    terms[:, 0, 4], terms[:, 1, 4] = r2 + 2 * x * x, 2 * x * y
    terms[:, 0, 5], terms[:, 1, 5] = 2 * x * y, r2 + 2 * y * y
    return terms


def _coefficients(lens: MoscaLens) -> Array:
    return np.array(
        [lens.a, lens.K1_per_mm2, lens.K2_per_mm4, lens.K3_per_mm6, lens.P1_per_mm, lens.P2_per_mm]
    )


def _ideal(lens: MoscaLens, measured: Array) -> Array:
    return measured + _correction_terms(measured) @ _coefficients(lens)


def _ideal_slope(lens: MoscaLens, measured: Array) -> Array:
    """Return d ideal / d measured (n, 2, 2)."""
    x, y = measured[:, 0], measured[:, 1]
    r2 = x * x + y * y
    a, k1, k2, k3, p1, p2 = _coefficients(lens)
    radial = r2 * (k1 + r2 * (k2 + r2 * k3))
    radial_slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))  # d radial / d r2, doubled: dr2/dx = 2 x
    slope = np.empty((len(x), 2, 2))
    slope[:, 0, 0] = 1 + radial + x * x * radial_slope + 6 * x * p1 + 2 * y * p2
    slope[:, 0, 1] = a + x * y * radial_slope + 2 * y * p1 + 2 * x * p2
    slope[:, 1, 0] = a + x * y * radial_slope + 2 * y * p1 + 2 * x * p2
    slope[:, 1, 1] = 1 + radial + y * y * radial_slope + 2 * x * p1 + 6 * y * p2
    return slope


def _invert(lens: MoscaLens, ideal: Array) -> tuple[Array, Array]:
    """Return measured points (n, 2) of ideal ones and which of them were found."""
    measured = ideal.copy()
    with np.errstate(all="ignore"):
        for _ in range(NEWTON_STEPS):
            slope = _ideal_slope(lens, measured)
            rest = ideal - _ideal(lens, measured)
            determinant = slope[:, 0, 0] * slope[:, 1, 1] - slope[:, 0, 1] * slope[:, 1, 0]
            step = np.column_stack(
                [
                    (slope[:, 1, 1] * rest[:, 0] - slope[:, 0, 1] * rest[:, 1]) / determinant,
                    (slope[:, 0, 0] * rest[:, 1] - slope[:, 1, 0] * rest[:, 0]) / determinant,
                ]
            )
            measured = measured + step
            if not np.any(np.abs(step) > CONVERGED_MM):
                break
        slope = _ideal_slope(lens, measured)
        determinant = slope[:, 0, 0] * slope[:, 1, 1] - slope[:, 0, 1] * slope[:, 1, 0]
        rest = np.abs(ideal - _ideal(lens, measured)).max(axis=1, initial=0.0)
        # both stretches turn negative beyond the fold, so the determinant alone does not tell; farther out
        # both may be positive again, so the slope alone does not tell either
        found = (rest < 1e-9) & (determinant > 0) & (slope[:, 0, 0] + slope[:, 1, 1] > 0)
        found &= (measured**2).sum(axis=1) < fold_mm2(lens)
    measured = np.where(found[:, None], measured, 0.0)
    return measured, found
