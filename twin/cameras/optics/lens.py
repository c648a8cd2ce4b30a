"""The twin's lenses, written from the optics side: light comes from a point in space and falls on a pixel.

Parameter numbers are those of the rig file; the formulas are written here anew (the pipeline has its own). The *gap*,
which the pipeline's models cannot express, is added to the model in the order in which light meets it:

1. Entrance-pupil shift. Chief rays at a field angle theta cross the axis at ``z = shift * 2 sin^2 theta`` and not in
   one centre; at 45 deg that is ``shift``. This is even and smooth in theta, like the series of Gennery (2006,
   "Generalized camera calibration including fish-eye lenses"), and bounded behind the camera. So near and far points
   on one ray from the centre land on different pixels, and ``project`` must be given points in metres.
2. The lens model of the rig file.
3. Higher radial orders: ``gap_px * T9(s)`` along the radius. s is the distance from the image's centre over half its
   diagonal, T9 the Chebyshev polynomial of order 9, which the odd powers up to the 7th cannot follow. The fisheye has
   odd powers up to the 9th: there it is T11, and s = 1 is the image circle of 190 deg where that lies in the image.
   Both polynomials diverge outside: light that the model puts beyond s = 1.5 (with that circle: s = 1) is not imaged.
4. Tilt. The sensor plane is rotated about x and then y (signs as OpenCV's tauX and tauY) through the principal point,
   as seen from the exit pupil.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from mosca.data.arrays import Array
from mosca.data.rig import Lens
from mosca.numba_support.decorators import bare_step, callable_bare_step, inlined_step, kernel
from twin.cameras.optics.blur_parameters import Optics
from twin.cameras.optics.lens_models import (
    direction_collinearity,
    direction_fisheye,
    direction_pinhole,
    off_plane,
    onto_plane,
    project_collinearity,
    project_fisheye,
    project_pinhole,
)
from twin.cameras.optics.lens_vector import (
    COLLINEARITY,
    FISHEYE,
    GAP,
    KIND,
    OWN,
    PIVOT,
    PLANE,
    PUPIL,
    RARE,
    vector_of,
)

STEPS = 20
SETTLED_M = 1e-13
"""Shift times the square of a step over that of the distance [m], after which Newton's method for the shift ends: at
most twice as much is left. With 1e-18 of the distance a few pixels in a million differ by 1 DN."""


@dataclass(frozen=True)
class GapTerms:
    """Terms that no pipeline model expresses, as in ``Optics``: ``gap_px``, ``tilt_deg`` and ``pupil_shift_m``."""

    gap_px: float = 0.0
    tilt_deg: tuple[float, float] = (0.0, 0.0)
    pupil_shift_m: float = 0.0


GAPS: Mapping[str, GapTerms] = MappingProxyType(
    {
        "none": GapTerms(),
        "measured": GapTerms(0.05, (0.006, -0.004), 0.0001),
        "stress": GapTerms(0.25, (0.03, -0.02), 0.0005),
    }
)
"""Terms of each ``model_gap``.

Residuals over an image and 2.5-7 m after the best fit of the pipeline's model of the same kind, rms px
(measured / stress): 656 x 491 at 7.5 mm 0.028 / 0.14, 2 MP at 8 mm 0.031 / 0.16, 12 MP at 12 mm 0.035 / 0.17, 16 MP
at 12.5 mm 0.039 / 0.20, fisheyes at 1-7 m 0.034 / 0.17. Tilt and pupil shift grow with the principal distance in px
and the field; most of a tilt is a rotation of the camera, so that with a free pose about 0.03 / 0.14 remain.
"""


@dataclass(frozen=True, eq=False)
class TwinLens:
    """A lens ready for the kernels: ``vector`` has the layout of ``twin.cameras.optics.lens_vector``."""

    vector: Array

    @classmethod
    def of(cls, lens: Lens, width: int, height: int, optics: Optics | GapTerms = GAPS["none"]) -> "TwinLens":
        """Return the lens with a rig file's numbers and the gap of ``optics``; cold (see ``warmed``)."""
        return cls(vector_of(lens, width, height, optics.gap_px, optics.tilt_deg, optics.pupil_shift_m))

    def pixels(self, points: Array) -> Array:
        """Point (n, 3) in the camera frame [m] -> pixel (n, 2); NaN where the lens does not image it.

        Without a pupil shift the distance does not matter and directions of any length will do.
        """
        result: Array = many_pixels(self.vector, np.ascontiguousarray(points, dtype=float).reshape(-1, 3))
        return result

    def directions(self, xy_px: Array, distance_m: float = math.inf) -> Array:
        """Pixel (n, 2) -> unit direction (n, 3) from the camera's centre to the point seen at ``distance_m``.

        NaN where no light reaches the pixel. The distance matters with a pupil shift only, see ``pixel_direction``.
        """
        xy = np.ascontiguousarray(xy_px, dtype=float).reshape(-1, 2)
        result: Array = _many_directions(self.vector, xy, distance_m)
        return result


def warmed(vector: Array, optics: Optics, time_s: float) -> Array:
    """Return the lens vector ``time_s`` after the session's start, with the drift rates of ``optics``.

    The principal distance grows by ``principal_distance_ppm_per_s``, the principal point moves by
    ``principal_point_px_per_s``, both linear in time; distortion and gap do not change. Read-only, like ``vector``.
    """
    ppm, (right, down) = optics.principal_distance_ppm_per_s, optics.principal_point_px_per_s
    if time_s == 0.0 or (ppm == 0.0 and right == 0.0 and down == 0.0):
        return vector
    scale = 1.0 + 1e-6 * ppm * time_s
    warm = vector.copy()
    distances = _distances(vector)
    warm[OWN : OWN + distances] *= scale
    warm[PIVOT : PIVOT + 2] *= scale
    _move(warm, right * time_s, down * time_s)
    warm.setflags(write=False)
    return warm


def moved(vector: Array, right_px: float, down_px: float) -> Array:
    """Return the lens vector (read-only) with its principal point moved, and with it the whole image."""
    other = vector.copy()
    _move(other, right_px, down_px)
    other.setflags(write=False)
    return other


def _distances(vector: Array) -> int:
    """Return the number of principal distances at the beginning of a lens vector."""
    return 1 if vector[KIND] == COLLINEARITY else 2


def _move(vector: Array, right_px: float, down_px: float) -> None:
    at = OWN + _distances(vector)
    vector[at : at + 2] += right_px, down_px
    vector[PIVOT + 2 : PIVOT + 4] += right_px, down_px


@callable_bare_step
def project(lens: Array, x: float, y: float, z: float) -> Any:
    """Project a point (x, y, z): u, v, then du and dv by (x, y, z), and whether the lens images it.

    The point is in the camera frame, in metres (any length will do without a pupil shift).
    Returns (u, v, ux, uy, uz, vx, vy, vz, ok).
    """
    if lens[RARE] != 0.0:
        return _project_with_rare_terms(lens, x, y, z)
    return _project_with_gap(lens, x, y, z)


@inlined_step
def _project_with_gap(lens: Array, x: float, y: float, z: float) -> Any:
    """As ``project``, by the lens model and the higher radial orders."""
    if lens[KIND] == FISHEYE:
        u, v, ux, uy, uz, vx, vy, vz, ok = project_fisheye(lens, x, y, z)
    else:
        if not z > 0.0:
            return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, False
        slope_x, slope_y = x / z, y / z
        if lens[KIND] == COLLINEARITY:
            u, v, u1, u2, v1, v2, ok = project_collinearity(lens, slope_x, slope_y)
        else:
            u, v, u1, u2, v1, v2, ok = project_pinhole(lens, slope_x, slope_y)
        ux, uy, uz = u1 / z, u2 / z, -(u1 * slope_x + u2 * slope_y) / z
        vx, vy, vz = v1 / z, v2 / z, -(v1 * slope_x + v2 * slope_y) / z
    if lens[GAP] != 0.0 and ok:
        if (u - lens[GAP + 1]) ** 2 + (v - lens[GAP + 2]) ** 2 > lens[GAP + 4]:
            return u, v, ux, uy, uz, vx, vy, vz, False
        du, dv, g11, g12, g22 = _gap(lens, u, v)
        ok = (1.0 + g11) * (1.0 + g22) > g12 * g12  # a negative gap folds the image back outside it
        a, b, c = ux, uy, uz
        ux, uy, uz = a + g11 * a + g12 * vx, b + g11 * b + g12 * vy, c + g11 * c + g12 * vz
        vx, vy, vz = vx + g12 * a + g22 * vx, vy + g12 * b + g22 * vy, vz + g12 * c + g22 * vz
        u, v = u + du, v + dv
    return u, v, ux, uy, uz, vx, vy, vz, ok


@bare_step
def _project_with_rare_terms(lens: Array, x: float, y: float, z: float) -> Any:
    """As ``project``, with pupil shift before and tilt behind."""
    w, wx, wy, wz, seen = _above_pupil(lens[PUPIL], x, y, z)
    u, v, ux, uy, uz, vx, vy, vz, ok = _project_with_gap(lens, x, y, w)
    ux, uy, uz = ux + uz * wx, uy + uz * wy, uz * wz
    vx, vy, vz = vx + vz * wx, vy + vz * wy, vz * wz
    fx, fy, u0, v0 = lens[PIVOT], lens[PIVOT + 1], lens[PIVOT + 2], lens[PIVOT + 3]
    p, q, pa, pb, qa, qb, depth = onto_plane(lens, PLANE, (u - u0) / fx, (v - v0) / fy)
    pb, qa = pb * fx / fy, qa * fy / fx
    return (
        u0 + fx * p, v0 + fy * q,
        pa * ux + pb * vx, pa * uy + pb * vy, pa * uz + pb * vz,
        qa * ux + qb * vx, qa * uy + qb * vy, qa * uz + qb * vz,
        ok and seen and depth > 0.0,
    )  # fmt: skip


@bare_step
def pixel_direction(lens: Array, u: float, v: float) -> Any:
    """The direction (x, y, z) from which light falls on pixel (u, v); not normalised for pinhole kinds.

    NaN where no light reaches the pixel. With a pupil shift the ray does not start in the camera's centre. The
    direction is then right for points infinitely far away; for points at a distance D, ``point_at_distance`` is. The
    parallax between the two is ``shift * 2 sin^2 theta * sin theta / D`` rad: 0.06 mrad for 1 mm at 30 deg and 4 m.
    """
    if lens[RARE] != 0.0:
        fx, fy, u0, v0 = lens[PIVOT], lens[PIVOT + 1], lens[PIVOT + 2], lens[PIVOT + 3]
        p, q = off_plane(lens, PLANE, (u - u0) / fx, (v - v0) / fy)
        u, v = u0 + fx * p, v0 + fy * q
    if lens[GAP] != 0.0:
        u, v = _before_gap(lens, u, v)
    if lens[KIND] == COLLINEARITY:
        return direction_collinearity(lens, u, v)
    if lens[KIND] == FISHEYE:
        return direction_fisheye(lens, u, v)
    return direction_pinhole(lens, u, v)


@callable_bare_step
def point_at_distance(lens: Array, u: float, v: float, distance: float) -> Any:
    """The point (x, y, z) [m] at ``distance`` from the camera's centre from which light falls on pixel (u, v)."""
    x, y, z = pixel_direction(lens, u, v)
    s2, z2 = x * x + y * y, z * z
    n = math.sqrt(s2 + z2)
    x, y, z = x / n, y / n, z / n
    # the ray leaves the axis at ``start``; in front, one point on it has the wanted distance from the centre
    start = 2.0 * lens[PUPIL] * s2 / (s2 + z2)
    along = math.sqrt(distance * distance - start * start * (1.0 - z * z)) - start * z
    return along * x, along * y, along * z + start


@inlined_step
def _above_pupil(shift: float, x: float, y: float, z: float) -> Any:
    """Axial distance w of a point from where its chief ray meets the axis, dw by (x, y, z), and whether it exists.

    ``w + 2 shift s^2 / (s^2 + w^2) = z``, by Newton's method. Points so near that several rays reach them are not
    imaged: the equation's slope has to stay above a half.
    """
    q = x * x + y * y
    w, slope, found = z, 1.0, False
    for _ in range(STEPS):
        n = q + w * w
        slope = 1.0 - 4.0 * shift * q * w / (n * n)
        step = (w + 2.0 * shift * q / n - z) / slope
        w -= step
        if abs(shift) * step * step <= SETTLED_M * n:
            found = slope > 0.5
            break
    n = q + w * w
    across = -4.0 * shift * w * w / (n * n * slope)
    return w, across * x, across * y, 1.0 / slope, found


@inlined_step
def _gap(lens: Array, u: float, v: float) -> Any:
    """Displacement (du, dv) of the gap at (u, v) and its symmetric slope (g11, g12, g22)."""
    x, y, radius = u - lens[GAP + 1], v - lens[GAP + 2], lens[GAP + 3]
    s2 = (x * x + y * y) / (radius * radius)
    # T9(s) / s and T11(s) / s and their derivatives by s^2
    if lens[KIND] == FISHEYE:
        q = -11.0 + s2 * (220.0 + s2 * (-1232.0 + s2 * (2816.0 + s2 * (-2816.0 + s2 * 1024.0))))
        dq = 220.0 + s2 * (-2464.0 + s2 * (8448.0 + s2 * (-11264.0 + s2 * 5120.0)))
    else:
        q = 9.0 + s2 * (-120.0 + s2 * (432.0 + s2 * (-576.0 + s2 * 256.0)))
        dq = -120.0 + s2 * (864.0 + s2 * (-1728.0 + s2 * 1024.0))
    f = lens[GAP] / radius
    d = f * dq * 2.0 / (radius * radius)
    return f * q * x, f * q * y, f * q + d * x * x, d * x * y, f * q + d * y * y


@bare_step
def _before_gap(lens: Array, u: float, v: float) -> Any:
    """The model's position, before the gap, of light that lands at (u, v): Newton's method, NaN outside its reach."""
    a, b = u - lens[GAP + 1], v - lens[GAP + 2]
    # Newton's steps are small far outside, and light comes from within the gap's reach: start there
    near = min(1.0, math.sqrt(lens[GAP + 4] / max(a * a + b * b, 1e-300)))
    a, b = lens[GAP + 1] + near * a, lens[GAP + 2] + near * b
    for _ in range(STEPS):
        du, dv, g11, g12, g22 = _gap(lens, a, b)
        eu, ev = u - a - du, v - b - dv
        g11, g22 = 1.0 + g11, 1.0 + g22
        det = g11 * g22 - g12 * g12
        a, b = a + (g22 * eu - g12 * ev) / det, b + (g11 * ev - g12 * eu) / det
        if eu * eu + ev * ev < 1e-20:
            if det > 0.0 and (a - lens[GAP + 1]) ** 2 + (b - lens[GAP + 2]) ** 2 <= lens[GAP + 4]:
                return a, b
            break
    return math.nan, math.nan


@kernel
def many_pixels(lens: Array, points: Array) -> Array:
    """Point (n, 3) -> pixel (n, 2) of a lens vector; NaN where it is not imaged."""
    out = np.empty((points.shape[0], 2))
    for i in range(points.shape[0]):
        u, v, _a, _b, _c, _d, _e, _f, ok = project(lens, points[i, 0], points[i, 1], points[i, 2])
        out[i, 0], out[i, 1] = (u, v) if ok else (np.nan, np.nan)
    return out


@kernel
def _many_directions(lens: Array, xy: Array, distance: float) -> Array:
    out = np.empty((xy.shape[0], 3))
    for i in range(xy.shape[0]):
        if lens[PUPIL] != 0.0 and distance < math.inf:
            x, y, z = point_at_distance(lens, xy[i, 0], xy[i, 1], distance)
        else:
            x, y, z = pixel_direction(lens, xy[i, 0], xy[i, 1])
        n = math.sqrt(x * x + y * y + z * z)
        out[i, 0], out[i, 1], out[i, 2] = x / n, y / n, z / n
    return out
