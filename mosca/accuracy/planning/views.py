"""Information of cameras on points: matrices weighted by the visibility of each point, and their derivatives.

A point X lies at v = (x, y, z) = R' (X - O) in a camera's frame (right, down, ahead). Its image (f x / z, f y / z)
has the Jacobian J = f / z [right - x / z ahead; down - y / z ahead]. A camera adds w J'J / sigma^2 to the information
on X, with

    sigma^2 = 1 / J_disc(R / s) + extra,   R = f D / (2 |X - O|),   s^2 = blur^2 + 1/12 + (b / 4)^2,
    b = defocus | 1 / |centre - O| - 1 / |X - O| |,   defocus = focal length^2 / (f-number pitch)

(``mosca.accuracy.planning.image_noise``; b is the diameter of the blur circle of a thin lens focused on the volume's
centre; the standard deviation of the circle, an axis, is a quarter of b). The weight w is 1 where the camera sees the
point and 0 elsewhere. For optimisers it is smooth: a product of logistic functions of the distance from the image's
border, of the clearance of the sight line from obstacles, and of the cosine between a marker's normal and the sight
line. A marker on a convex body is seen from the half space before its tangent plane.
"""

from dataclasses import dataclass

import numpy as np

from mosca.accuracy.planning.image_noise import TABLE_RATIOS
from mosca.accuracy.planning.obstacles import clearance
from mosca.data.arrays import Array, read_only
from mosca.numba_support.decorators import kernel, step

PLACE, PAN, TILT, SCALE, HALF_WIDTH, HALF_HEIGHT, DEFOCUS, BLUR, TABLE, EXTRA = 0, 3, 4, 5, 6, 7, 8, 9, 10, 11
COLUMNS = 12
"""Length of a camera's row: place (3) [m], pan and tilt [rad], principal distance [px], half width and height [px],
defocus [px m], variance of its blur, the pixel's included [px^2], its information table, variance besides pixel noise
[px^2]."""
DEGREES = 5
"""Degrees of freedom of a camera: place, pan, tilt."""
FIRST_RATIO = float(np.log(TABLE_RATIOS[0]))
RATIO_STEP = float(np.log(TABLE_RATIOS[1] / TABLE_RATIOS[0]))
LEAST_DEPTH_M = 1e-3
"""A point with less depth in front of a camera, or behind it, is not seen."""
LEAST_WEIGHT = 1e-9
"""A camera does not see a point whose weight is below this."""
SCRATCH = 21


@dataclass(frozen=True, eq=False)
class MarkerRoom:
    """Points, their normals, and the obstacles that hide them."""

    points: Array
    """(n, 3) in the volume [m]."""
    normals: Array
    """(k, 3) unit normals of a marker on the subject; (0, 3): markers are not hidden by their own subject."""
    center: Array
    """(3,) centre of the volume [m], on which lenses are focused."""
    diameter_m: float
    """Diameter of the markers."""
    obstacles: Array
    """(b, 9), ``mosca.accuracy.planning.obstacles.obstacle_rows``."""
    tables: Array
    """(t, 161), ``mosca.accuracy.planning.image_noise.information_table`` of each kind of camera."""

    def __post_init__(self) -> None:
        for name, shape in (
            ("points", (None, 3)),
            ("normals", (None, 3)),
            ("center", (3,)),
            ("obstacles", (None, 9)),
        ):
            object.__setattr__(self, name, read_only(getattr(self, name), shape, name))
        object.__setattr__(self, "tables", read_only(self.tables, (None, len(TABLE_RATIOS)), "tables"))


@dataclass(frozen=True)
class Softness:
    """Widths of the logistic functions that replace the borders of a view; all 0: hard borders."""

    image: float = 0.0
    """Share of the image's half width."""
    sight_m: float = 0.0
    facing: float = 0.0
    """In terms of the cosine."""

    @property
    def row(self) -> Array:
        """The three widths."""
        return np.array([self.image, self.sight_m, self.facing])


@step
def _logistic(value, width):
    """Return the weight of a border at ``value`` and its slope; a step where the width is 0."""
    if width <= 0.0:
        return (1.0, 0.0) if value > 0.0 else (0.0, 0.0)
    t = value / width
    if t < -40.0:
        return 0.0, 0.0
    one = 1.0 / (1.0 + np.exp(-t))
    return one, one * (1.0 - one) / width


@step
def _log_information(table, log_ratio):
    """Return log J and its slope by log (R / s), by linear interpolation."""
    at = (log_ratio - FIRST_RATIO) / RATIO_STEP
    k = min(max(int(at), 0), len(table) - 2)
    slope = (table[k + 1] - table[k]) / RATIO_STEP
    return table[k] + slope * (log_ratio - FIRST_RATIO - k * RATIO_STEP), slope


@step
def axes_of(camera, axes):
    """Fill ``axes`` (3, 3): right, down, ahead; the derivatives follow from the angles."""
    cp, sp, ct, st = np.cos(camera[3]), np.sin(camera[3]), np.cos(camera[4]), np.sin(camera[4])
    axes[0, 0], axes[0, 1], axes[0, 2] = sp, -cp, 0.0
    axes[1, 0], axes[1, 1], axes[1, 2] = cp * st, sp * st, -ct
    axes[2, 0], axes[2, 1], axes[2, 2] = ct * cp, ct * sp, st


@step
def _look(camera, axes, x, obstacles, center, diameter, table, soft, out):
    """Fill ``out`` (SCRATCH) for a camera and the point ``x``; return whether the weight is above 0.

    ``out``: weight, information (6) unweighted, unit vector from point to camera (3); then values for ``_slopes``:
    relative slopes of the weight by u and v, its relative gradient by the camera's place (3), u, v, 1 / depth,
    distance, slope of log J by log (R / s).
    """
    d0, d1, d2 = x[0] - camera[0], x[1] - camera[1], x[2] - camera[2]
    depth = axes[2, 0] * d0 + axes[2, 1] * d1 + axes[2, 2] * d2
    if depth < LEAST_DEPTH_M:
        return False
    u = (axes[0, 0] * d0 + axes[0, 1] * d1 + axes[0, 2] * d2) / depth
    v = (axes[1, 0] * d0 + axes[1, 1] * d1 + axes[1, 2] * d2) / depth
    f, wide, high = camera[SCALE], camera[HALF_WIDTH], camera[HALF_HEIGHT]
    wu, su = _logistic((wide - abs(f * u)) / wide, soft[0])
    wv, sv = _logistic((high - abs(f * v)) / wide, soft[0])
    weight = wu * wv
    if weight <= LEAST_WEIGHT:
        return False
    g0 = g1 = g2 = 0.0
    for k in range(len(obstacles)):
        near, n0, n1, n2 = clearance(
            obstacles[k], x[0], x[1], x[2], camera[0], camera[1], camera[2], 20.0 * soft[1] + 1e-6
        )
        one, slope = _logistic(near, soft[1])
        weight *= one
        if weight <= LEAST_WEIGHT:
            return False
        g0, g1, g2 = g0 + slope / one * n0, g1 + slope / one * n1, g2 + slope / one * n2
    away = np.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
    e0, e1, e2 = center[0] - camera[0], center[1] - camera[1], center[2] - camera[2]
    circle = camera[DEFOCUS] * (1.0 / np.sqrt(e0 * e0 + e1 * e1 + e2 * e2) - 1.0 / away)
    log_ratio = np.log(f * diameter / (2.0 * away)) - 0.5 * np.log(camera[BLUR] + circle * circle / 16.0)
    log_j, by_ratio = _log_information(table, log_ratio)
    scale = f * f / (depth * depth * (np.exp(-log_j) + camera[EXTRA]))
    a0, a1, a2 = axes[0, 0] - u * axes[2, 0], axes[0, 1] - u * axes[2, 1], axes[0, 2] - u * axes[2, 2]
    b0, b1, b2 = axes[1, 0] - v * axes[2, 0], axes[1, 1] - v * axes[2, 1], axes[1, 2] - v * axes[2, 2]
    out[0] = weight
    out[1], out[2], out[3] = (a0 * a0 + b0 * b0) * scale, (a0 * a1 + b0 * b1) * scale, (a0 * a2 + b0 * b2) * scale
    out[4], out[5], out[6] = (a1 * a1 + b1 * b1) * scale, (a1 * a2 + b1 * b2) * scale, (a2 * a2 + b2 * b2) * scale
    out[7], out[8], out[9] = -d0 / away, -d1 / away, -d2 / away
    out[10], out[11] = -su / wu * np.sign(u) * f / wide, -sv / wv * np.sign(v) * f / wide
    out[12], out[13], out[14] = g0, g1, g2
    out[15], out[16], out[17], out[18], out[19], out[20] = u, v, 1.0 / depth, away, by_ratio, np.exp(-log_j)
    return True


@step
def _slopes(camera, axes, center, out, slopes):
    """Fill ``slopes`` (5, 10): derivatives of the first ten of ``out`` by place, pan and tilt."""
    u, v, inverse, away, by_ratio, noise2 = out[15], out[16], out[17], out[18], out[19], out[20]
    d0, d1, d2 = -out[7] * away, -out[8] * away, -out[9] * away
    e0, e1, e2 = center[0] - camera[0], center[1] - camera[1], center[2] - camera[2]
    focus = np.sqrt(e0 * e0 + e1 * e1 + e2 * e2)
    circle = camera[DEFOCUS] * (1.0 / focus - 1.0 / away)
    blur2 = camera[BLUR] + circle * circle / 16.0
    variance = noise2 + camera[EXTRA]
    scale = (camera[SCALE] * inverse) ** 2 / variance
    a0, a1, a2 = axes[0, 0] - u * axes[2, 0], axes[0, 1] - u * axes[2, 1], axes[0, 2] - u * axes[2, 2]
    b0, b1, b2 = axes[1, 0] - v * axes[2, 0], axes[1, 1] - v * axes[2, 1], axes[1, 2] - v * axes[2, 2]
    cp, sp, ct, st = np.cos(camera[PAN]), np.sin(camera[PAN]), np.cos(camera[TILT]), np.sin(camera[TILT])
    for k in range(DEGREES):
        # derivatives of right r, down w and ahead h, and of the place o
        r0 = r1 = w0 = w1 = w2 = h0 = h1 = h2 = o0 = o1 = o2 = 0.0
        if k == 0:
            o0 = 1.0
        elif k == 1:
            o1 = 1.0
        elif k == 2:
            o2 = 1.0
        elif k == 3:
            r0, r1 = cp, sp
            w0, w1 = -sp * st, cp * st
            h0, h1 = -ct * sp, ct * cp
        else:
            w0, w1, w2 = cp * ct, sp * ct, st
            h0, h1, h2 = -st * cp, -st * sp, ct
        p = r0 * d0 + r1 * d1 - axes[0, 0] * o0 - axes[0, 1] * o1 - axes[0, 2] * o2
        q = w0 * d0 + w1 * d1 + w2 * d2 - axes[1, 0] * o0 - axes[1, 1] * o1 - axes[1, 2] * o2
        t = h0 * d0 + h1 * d1 + h2 * d2 - axes[2, 0] * o0 - axes[2, 1] * o1 - axes[2, 2] * o2
        du, dv = (p - u * t) * inverse, (q - v * t) * inverse
        slopes[k, 0] = out[0] * (out[10] * du + out[11] * dv + out[12] * o0 + out[13] * o1 + out[14] * o2)
        da = -(d0 * o0 + d1 * o1 + d2 * o2) / away
        df = -(e0 * o0 + e1 * o1 + e2 * o2) / focus
        dcircle = camera[DEFOCUS] * (da / (away * away) - df / (focus * focus))
        dlog = -da / away - circle * dcircle / (16.0 * blur2)
        grown = -2.0 * t * inverse + noise2 * by_ratio * dlog / variance
        m0, m1, m2 = r0 - u * h0 - du * axes[2, 0], r1 - u * h1 - du * axes[2, 1], -u * h2 - du * axes[2, 2]
        n0, n1, n2 = w0 - v * h0 - dv * axes[2, 0], w1 - v * h1 - dv * axes[2, 1], w2 - v * h2 - dv * axes[2, 2]
        slopes[k, 1] = grown * out[1] + scale * 2.0 * (a0 * m0 + b0 * n0)
        slopes[k, 2] = grown * out[2] + scale * (a0 * m1 + m0 * a1 + b0 * n1 + n0 * b1)
        slopes[k, 3] = grown * out[3] + scale * (a0 * m2 + m0 * a2 + b0 * n2 + n0 * b2)
        slopes[k, 4] = grown * out[4] + scale * 2.0 * (a1 * m1 + b1 * n1)
        slopes[k, 5] = grown * out[5] + scale * (a1 * m2 + m1 * a2 + b1 * n2 + n1 * b2)
        slopes[k, 6] = grown * out[6] + scale * 2.0 * (a2 * m2 + b2 * n2)
        slopes[k, 7], slopes[k, 8] = (o0 + d0 * da / away) / away, (o1 + d1 * da / away) / away
        slopes[k, 9] = (o2 + d2 * da / away) / away


@step
def _facing(normals, k, out, width):
    """Return the weight, 0 to 1, of a marker with normal ``k`` for facing the camera, and its slope by the cosine.

    ``out``: of ``_look``; without normals all markers face the camera.
    """
    if len(normals) == 0:
        return 1.0, 0.0
    return _logistic(normals[k, 0] * out[7] + normals[k, 1] * out[8] + normals[k, 2] * out[9], width)


@kernel
def gather(cameras, points, normals, obstacles, center, diameter, tables, soft):
    """Return the information (n, k, 6), upper triangles [1/m^2], and the number of cameras per marker (n, k).

    Arguments: rows of cameras (c, COLUMNS), then the fields of ``MarkerRoom``, ``Softness``. Without normals k = 1.
    """
    kinds = max(1, len(normals))
    total, count = np.zeros((len(points), kinds, 6)), np.zeros((len(points), kinds))
    axes, out = np.empty((3, 3)), np.empty(SCRATCH)
    for c in range(len(cameras)):
        axes_of(cameras[c], axes)
        table = tables[int(cameras[c, TABLE])]
        for p in range(len(points)):
            if not _look(cameras[c], axes, points[p], obstacles, center, diameter, table, soft, out):
                continue
            for k in range(kinds):
                weight = out[0] * _facing(normals, k, out, soft[2])[0]
                count[p, k] += weight
                for j in range(6):
                    total[p, k, j] += weight * out[1 + j]
    return total, count


@kernel
def pull_back(cameras, points, normals, obstacles, center, diameter, tables, soft, by_information, by_count):
    """Return the slope (c, DEGREES) of a function of ``gather``'s results, given its slopes by these results.

    ``by_information`` (n, k, 6): by the elements of the upper triangles; ``by_count`` (n, k): by the counts.
    """
    kinds = max(1, len(normals))
    slope = np.zeros((len(cameras), DEGREES))
    axes, out, slopes = np.empty((3, 3)), np.empty(SCRATCH), np.empty((DEGREES, 10))
    for c in range(len(cameras)):
        axes_of(cameras[c], axes)
        table = tables[int(cameras[c, TABLE])]
        for p in range(len(points)):
            if not _look(cameras[c], axes, points[p], obstacles, center, diameter, table, soft, out):
                continue
            _slopes(cameras[c], axes, center, out, slopes)
            for k in range(kinds):
                facing, by_cosine = _facing(normals, k, out, soft[2])
                if facing <= 0.0:
                    continue
                by_weight = by_count[p, k]
                for j in range(6):
                    by_weight += by_information[p, k, j] * out[1 + j]
                for d in range(DEGREES):
                    weight = slopes[d, 0] * facing
                    if by_cosine > 0.0:
                        turned = (
                            normals[k, 0] * slopes[d, 7] + normals[k, 1] * slopes[d, 8] + normals[k, 2] * slopes[d, 9]
                        )
                        weight += out[0] * by_cosine * turned
                    value = by_weight * weight
                    for j in range(6):
                        value += out[0] * facing * by_information[p, k, j] * slopes[d, 1 + j]
                    slope[c, d] += value
    return slope


@kernel
def view_table(cameras, points, normals, obstacles, center, diameter, tables, soft):
    """Return each camera's weight of each marker (c, n, k) and the variance of its image (c, n) [px^2], 0 unseen.

    Arguments as of ``gather``.
    """
    kinds = max(1, len(normals))
    seen, variance = np.zeros((len(cameras), len(points), kinds)), np.zeros((len(cameras), len(points)))
    axes, out = np.empty((3, 3)), np.empty(SCRATCH)
    for c in range(len(cameras)):
        axes_of(cameras[c], axes)
        table = tables[int(cameras[c, TABLE])]
        for p in range(len(points)):
            if not _look(cameras[c], axes, points[p], obstacles, center, diameter, table, soft, out):
                continue
            variance[c, p] = out[20] + cameras[c, EXTRA]
            for k in range(kinds):
                seen[c, p, k] = out[0] * _facing(normals, k, out, soft[2])[0]
    return seen, variance
