"""Gating in the image: the ray of a camera nearest to a point, among those that the covariances admit."""

from typing import Any, NamedTuple

import numpy as np

from mosca.correspondence.hypothesis import NONE, ONCE, trust2_of
from mosca.correspondence.spatial_index import CELLS, CORNER, FIRST, SCALE, cell_of
from mosca.data.rays import ANGLE, DENSITY, SIGMA, WHITE
from mosca.numba_support.decorators import bare_step, inlined_step

FEW_CELLS = 2
"""More cells than these besides the first are searched only where the error ellipse itself covers them, not merely
its bound."""
FIRST_ORDER = 1.01
"""Factor on gates that are computed to first order in the errors."""
SAME_SIDE = 0.9995
"""Cosine of a ray's angle to a point below which it is far outside any gate: a thousandth of a radian squared."""
NEAREST_CHI2 = 0.05
"""Lower limit of the squared distance up to which chance rays are counted, so that a perfect hit is not infinitely
unlikely."""


class RayIndex(NamedTuple):
    """Spatial index of each camera's rays, and the largest widths of their gates."""

    cells: Any
    """``mosca.correspondence.spatial_index.cells``."""
    reach: Any
    """(c,) largest variance of a ray's direction [rad^2], if its target were mostly hidden."""


@inlined_step
def nearest_ray(c, whole, index, solved, data):
    """Return the ray of camera c nearest to the hypothesis's point among those that the covariances admit (-1: none).

    Further values: its trust, the expected number of equally near chance rays, and how many rays were admitted.
    """
    rays, views, rules = data.rays, data.views, data.rules[0]
    frame, first_in_cell, in_cell, place = index.cells
    reach, gate2 = index.reach[c], rules.gate_sigma**2
    x, y, z = solved[0] - views[c, 0], solved[1] - views[c, 1], solved[2] - views[c, 2]
    distance = np.sqrt(x * x + y * y + z * z)
    w = distance + views[c, 5] * x + views[c, 8] * y + views[c, 11] * z
    if not w > 1e-9 * distance:
        return -1, 1.0, 0.0, 0
    inverse = 1.0 / w
    u = (views[c, 3] * x + views[c, 6] * y + views[c, 9] * z) * inverse
    v = (views[c, 4] * x + views[c, 7] * y + views[c, 10] * z) * inverse
    v00, v01, v02, v11, v12, v22 = solved[3], solved[4], solved[5], solved[7], solved[8], solved[11]
    # the plane scales an angle by (1 + |place|^2) / 2; a point's variance in any direction is at most the trace
    scale = 0.5 * (1.0 + u * u + v * v)
    side = FIRST_ORDER * rules.gate_sigma * scale * np.sqrt(reach + (v00 + v11 + v22) / (distance * distance))
    beside, above = side, side
    left, right = _cells_beside(c, NONE, u, side, frame)
    top, bottom = _cells_beside(c, ONCE, v, side, frame)
    if (right - left) * (bottom - top) > FEW_CELLS:
        own = scale * scale * reach
        ray = x / distance, y / distance, z / distance
        beside = _side(c, NONE, u, ray, w, own, solved, data)
        left, right = _cells_beside(c, NONE, u, beside, frame)
        above = _side(c, ONCE, v, ray, w, own, solved, data)
        top, bottom = _cells_beside(c, ONCE, v, above, frame)
    nearest, at, trust2, det_there, admitted = np.inf, -1, 1.0, 0.0, 0
    for row in range(top, bottom + 1):
        first = int(frame[c, FIRST] + row * frame[c, CELLS])
        for n in range(first_in_cell[first + left], first_in_cell[first + right + 1]):
            if abs(place[n, 0] - u) > beside or abs(place[n, 1] - v) > above:
                continue
            k = in_cell[n]
            depth = rays[k, 0] * x + rays[k, 1] * y + rays[k, 2] * z
            if depth < SAME_SIDE * distance:
                continue
            inverse = 1.0 / depth
            m00, m01, m02 = (rays[k, WHITE + 0] * inverse, rays[k, WHITE + 1] * inverse, rays[k, WHITE + 2] * inverse)
            m10, m11, m12 = (rays[k, WHITE + 3] * inverse, rays[k, WHITE + 4] * inverse, rays[k, WHITE + 5] * inverse)
            e0, e1 = m00 * x + m01 * y + m02 * z, m10 * x + m11 * y + m12 * z
            t2 = trust2_of(k, rays[k, ANGLE] * distance, whole, rays, rules.judge, rules)
            # the point's covariance carried into the ray's whitened image
            g0, g1, g2 = (
                v00 * m00 + v01 * m01 + v02 * m02,
                v01 * m00 + v11 * m01 + v12 * m02,
                v02 * m00 + v12 * m01 + v22 * m02,
            )
            h0, h1, h2 = (
                v00 * m10 + v01 * m11 + v02 * m12,
                v01 * m10 + v11 * m11 + v12 * m12,
                v02 * m10 + v12 * m11 + v22 * m12,
            )
            s00 = 1.0 + t2 * (m00 * g0 + m01 * g1 + m02 * g2)
            s01 = t2 * (m10 * g0 + m11 * g1 + m12 * g2)
            s11 = 1.0 + t2 * (m10 * h0 + m11 * h1 + m12 * h2)
            det = s00 * s11 - s01 * s01
            away = (s11 * e0 * e0 - 2.0 * s01 * e0 * e1 + s00 * e1 * e1) / det
            if t2 * away < gate2:
                admitted += 1
                # the admitted ray nearest in the image is taken: low trust must not favour a ray
                if away < nearest:
                    nearest, at, trust2, det_there = away, k, t2, det
    if at < 0:
        return -1, 1.0, 0.0, 0
    area = np.pi * max(trust2 * nearest, NEAREST_CHI2) * np.sqrt(det_there) * rays[at, SIGMA] ** 2 / trust2
    return at, np.sqrt(trust2), views[c, DENSITY] * area, admitted


@bare_step
def _cells_beside(c, axis, place, side, frame):
    """Return the first and last row or column of cells within ``place`` -+ ``side``."""
    corner, scale, count = frame[c, CORNER + axis], frame[c, SCALE + axis], frame[c, CELLS]
    return cell_of(place - side, corner, scale, count), cell_of(place + side, corner, scale, count)


@bare_step
def _side(c, axis, place, direction, w, own, solved, data):
    """Return half the gate's width along one axis of the stereographic plane, about a point's image ``place``.

    ``direction``: unit vector from the camera to the point; ``own``: variance of the rays themselves.
    """
    views, (x, y, z) = data.views, direction
    # derivative of the image by the point, and so its variance
    j0 = (views[c, 3 + axis] - place * (x + views[c, 5])) / w
    j1 = (views[c, 6 + axis] - place * (y + views[c, 8])) / w
    j2 = (views[c, 9 + axis] - place * (z + views[c, 11])) / w
    variance = j0 * (j0 * solved[3] + 2.0 * (j1 * solved[4] + j2 * solved[5]))
    variance += j1 * (j1 * solved[7] + 2.0 * j2 * solved[8]) + j2 * j2 * solved[11]
    return FIRST_ORDER * data.rules[0].gate_sigma * np.sqrt(variance + own)
