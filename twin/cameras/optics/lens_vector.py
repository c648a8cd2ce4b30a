"""A lens as a vector of numbers that kernels read: its layout, defined only here.

    0       KIND       COLLINEARITY, PINHOLE or FISHEYE
    1-12    the model's own numbers, in the order of the rig file:
            COLLINEARITY  c [mm], xp, yp [px], mx, my [mm/px], a, K1, K2, K3, P1, P2
            PINHOLE       fx, fy, cx, cy [px], k1, k2, p1, p2, k3, k4, k5, k6
            FISHEYE       fx, fy, cx, cy [px], k1, k2, k3, k4
    13      PRISM      1 where 14-23 hold anything
    14-17              thin prism s1, s2, s3, s4 (PINHOLE)
    18-23              sensor plane of OpenCV's tauX, tauY (PINHOLE), as 32-37
    24      ENDS       how far out the model is good: squared ideal slope, measured radius [mm^2] or angle [rad^2]
    25      GAP        amplitude of the radial gap [px]
    26-29              its centre [px], its radius [px], and the squared radius [px^2] beyond which nothing is imaged
    30      PUPIL      entrance-pupil shift at a field of 45 deg [m]
    31      RARE       1 where the pupil shifts or the sensor is tilted
    32-37   PLANE      the tilted sensor plane, see ``plane_of``
    38-41   PIVOT      pivot of that plane: distances of the exit pupil and principal point [px] (x, y; u, v)

Distances along the axis are in m, as the positions that ``twin.cameras.optics.lens.project`` takes.
"""

import math

import numpy as np

from mosca.data.arrays import Array
from mosca.data.rig import FisheyeLens, Lens, MoscaLens, OpenCVLens

COLLINEARITY, PINHOLE, FISHEYE = 0, 1, 2
KIND, OWN, PRISM, OPENCV_PLANE, ENDS, GAP, PUPIL, RARE, PLANE, PIVOT = 0, 1, 13, 18, 24, 25, 30, 31, 32, 38
SIZE = 42
GAP_ENDS_AT = 1.5
FISHEYE_EXIT_PUPIL = 6.0
"""Distance of a fisheye's exit pupil from its image, in principal distances. With 1 the chief ray at the rim of a
180 deg image would have 57 deg; with 6 it has 15 deg, which sensors accept. An assumption."""
FISHEYE_FIELD_RAD = math.radians(95.0)
"""Field angle at which the image circle of a real fisheye (one with a gap) ends, unless the sensor ends before."""


def vector_of(
    lens: Lens, width: int, height: int, gap_px: float, tilt_deg: tuple[float, float], pupil_shift_m: float
) -> Array:
    """Return the read-only vector (SIZE,) of a rig file's lens with the gap terms of a real lens."""
    vector = np.zeros(SIZE)
    if isinstance(lens, MoscaLens):
        fx, fy = lens.c_mm / lens.mx_mm_per_px, lens.c_mm / lens.my_mm_per_px
        principal = (fx, fy, lens.xp_px, lens.yp_px)
        kind, own = COLLINEARITY, [lens.c_mm, lens.xp_px, lens.yp_px, lens.mx_mm_per_px, lens.my_mm_per_px]
        own += [lens.a, lens.K1_per_mm2, lens.K2_per_mm4, lens.K3_per_mm6, lens.P1_per_mm, lens.P2_per_mm]
    else:
        principal = (lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px)
        own = list(principal)
        if isinstance(lens, OpenCVLens):
            kind = PINHOLE
            own += [lens.k1, lens.k2, lens.p1, lens.p2, lens.k3, lens.k4, lens.k5, lens.k6]
            prism = (lens.s1, lens.s2, lens.s3, lens.s4)
            vector[PRISM] = any((*prism, lens.tauX, lens.tauY))
            vector[PRISM + 1 : PRISM + 5] = prism
            vector[OPENCV_PLANE : OPENCV_PLANE + 6] = plane_of(lens.tauX, lens.tauY)
        elif isinstance(lens, FisheyeLens):
            kind = FISHEYE
            own += [lens.k1, lens.k2, lens.k3, lens.k4]
        else:
            raise TypeError(f"lens model {type(lens).__name__}: the virtual cameras have no formulas for it")
    vector[KIND] = kind
    vector[OWN : OWN + len(own)] = own
    vector[ENDS] = first_turn(lens)
    radius, reach = _gap_reach(lens, width, height)
    vector[GAP : GAP + 5] = gap_px, (width - 1) / 2, (height - 1) / 2, radius, reach * reach
    vector[PUPIL] = pupil_shift_m
    vector[RARE] = any((pupil_shift_m, *tilt_deg))
    vector[PLANE : PLANE + 6] = plane_of(math.radians(tilt_deg[0]), math.radians(tilt_deg[1]))
    far = FISHEYE_EXIT_PUPIL if kind == FISHEYE else 1.0
    vector[PIVOT : PIVOT + 4] = far * principal[0], far * principal[1], principal[2], principal[3]
    vector.setflags(write=False)
    return vector


def plane_of(tilt_x: float, tilt_y: float) -> tuple[float, float, float, float, float, float]:
    """Return a, b, c, d, g, h of a sensor plane rotated by ``tilt_x`` and then ``tilt_y`` about its axes [rad].

    The plane goes through the principal point, at distance 1 from the exit pupil. Light that would meet the upright
    plane at (x, y) meets the tilted plane at ((a x + b y) / w, (c x + d y) / w), w = 1 + g x + h y, in its own axes.
    With the rotation R (sensor from camera) the intersection is R33 / (R p)_3 * (R p) less its foot. A rotation's
    elements are their own cofactors, so that the numerators are (R22 x - R21 y) and (R11 y - R12 x). Signs and order
    are those of OpenCV's tauX and tauY.
    """
    cos_x, sin_x, cos_y, sin_y = math.cos(tilt_x), math.sin(tilt_x), math.cos(tilt_y), math.sin(tilt_y)
    r11, r12, r21, r22 = cos_y, sin_y * sin_x, 0.0, cos_x
    r31, r32, r33 = sin_y, -cos_y * sin_x, cos_y * cos_x
    return r22 / r33, -r21 / r33, -r12 / r33, r11 / r33, r31 / r33, r32 / r33


def _gap_reach(lens: Lens, width: int, height: int) -> tuple[float, float]:
    """Return the radius of the gap and the radius beyond which the lens images nothing [px].

    The polynomial is bounded within half the image's diagonal and diverges outside. For a fisheye whose image circle
    lies in the image, it is bounded within that circle.
    """
    half_diagonal = math.hypot(width, height) / 2
    if isinstance(lens, FisheyeLens):
        field = min(FISHEYE_FIELD_RAD, math.sqrt(first_turn(lens)))
        t = field * field
        rho = field * (1.0 + t * (lens.k1 + t * (lens.k2 + t * (lens.k3 + t * lens.k4))))
        circle = math.sqrt(lens.fx_px * lens.fy_px) * rho
        if circle < half_diagonal:
            return circle, circle
    return half_diagonal, GAP_ENDS_AT * half_diagonal


def first_turn(lens: Lens) -> float:
    """First maximum of the radial mapping (infinity: none), in the variable that the kernels test.

    The image of a real lens ends there, even where the polynomial rises again farther out. The image of a fisheye
    ends at the direction straight behind it at the latest.
    """
    if isinstance(lens, MoscaLens):
        return _first_zero([[7.0 * lens.K3_per_mm6, 5.0 * lens.K2_per_mm4, 3.0 * lens.K1_per_mm2, 1.0]])
    if isinstance(lens, FisheyeLens):
        slope = [9.0 * lens.k4, 7.0 * lens.k3, 5.0 * lens.k2, 3.0 * lens.k1, 1.0]
        return min(_first_zero([slope]), math.pi**2)
    # radius r T(s) / B(s), s = r^2: its slope vanishes with T B + 2 s (T' B - T B'), and B is its pole
    top, bottom = np.poly1d([lens.k3, lens.k2, lens.k1, 1.0]), np.poly1d([lens.k6, lens.k5, lens.k4, 1.0])
    twice_s = np.poly1d([2.0, 0.0])
    turning = top * bottom + twice_s * (top.deriv() * bottom - top * bottom.deriv())
    return _first_zero([list(turning.coeffs), list(bottom.coeffs)])


def _first_zero(polynomials: list[list[float]]) -> float:
    # in 1 / s, where the leading coefficient is 1 and vanishing ones put roots at zero, not at infinity
    inverse = np.concatenate([np.roots(polynomial[::-1]) for polynomial in polynomials])
    nearest = float(max((t.real for t in inverse if t.imag == 0.0), default=0.0))
    return 1.0 / nearest if nearest > 0.0 else math.inf
