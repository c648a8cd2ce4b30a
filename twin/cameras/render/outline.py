"""The boundary of a target's image: traced through the exact lens, at three instants of each panel of time.

The outline of a ball is the circle where the viewing cone touches it, that of a flat target is its rim, and that of
a figure is the lines and arcs of its contours. Along a smooth closed curve the integrand of Green's theorem is
periodic, so that equal steps converge exponentially. Along pieces with corners, Gauss-Legendre nodes do.
"""

import math
from typing import Any

import numpy as np

from mosca.data.arrays import Array
from mosca.numba_support.decorators import bare_step, callable_bare_step, step
from twin.cameras.optics.lens import project
from twin.cameras.render.boundary_integral import MAX_NODES, NODE_AT, NODE_SHARE
from twin.cameras.render.inputs import ImageBox, TargetPose
from twin.scenes.figure import LINE

BALL, FLAT, FIGURE = 0, 1, 2
STEP_SIGMA, FEWEST_STEPS = 1.0, 20
"""Step along an outline over the blur's sigma: the error of equal steps is below 1e-6 of the light."""
BOX_RADII, OUTLINE_POINTS = 1.02, 24
"""Radius of the circle whose box is an image's, over the target's, and the number of its points that are looked at
where some are not imaged: between two of them the circle is 0.9 % farther out than they are."""
ELLIPTIC = 0.1
"""Sum of the shifts of opposite points of a circle's image from that of its centre, over its width, up to which it is
taken for an ellipse: its box is then right to 1 %. Half or twice of it gives the same boxes to that."""
PANEL_PX = 15.0
MOST_PANELS = 100


@callable_bare_step
def lagrange_weights(nodes: Array, t: float, out: Array) -> None:
    """Weights (K,) that interpolate values given at ``nodes`` (K,) at the instant t."""
    for k in range(nodes.shape[0]):
        product = 1.0
        for i in range(nodes.shape[0]):
            if i != k:
                product *= (t - nodes[i]) / (nodes[k] - nodes[i])
        out[k] = product


@bare_step
def position_at(path: Array, weights: Array) -> Any:
    """Interpolate a path (K, 3)."""
    x = y = z = 0.0
    for k in range(weights.shape[0]):
        x += weights[k] * path[k, 0]
        y += weights[k] * path[k, 1]
        z += weights[k] * path[k, 2]
    return x, y, z


@bare_step
def rotation_at(rotation: Array, weights: Array, out: Array) -> None:
    """Interpolate rotations (K, 3, 3): sums of matrices, error of second order in the angle between nodes."""
    for i in range(3):
        for j in range(3):
            value = 0.0
            for k in range(weights.shape[0]):
                value += weights[k] * rotation[k, i, j]
            out[i, j] = value


@bare_step
def perpendicular_axes(x: float, y: float, z: float) -> Any:
    """Two unit vectors at right angles to (x, y, z) and to each other, the first one as nearly along x as can be."""
    n = math.sqrt(x * x + y * y + z * z)
    x, y, z = x / n, y / n, z / n
    if abs(x) < 0.9:
        ax, ay, az = 1.0 - x * x, -x * y, -x * z
    else:
        ax, ay, az = -y * x, 1.0 - y * y, -y * z
    k = math.sqrt(ax * ax + ay * ay + az * az)
    ax, ay, az = ax / k, ay / k, az / k
    return ax, ay, az, y * az - z * ay, z * ax - x * az, x * ay - y * ax


@bare_step
def outline_circle(target: TargetPose, r: float) -> Any:
    """The outline circle of a target of radius ``r``: centre, and two radii at right angles (9 numbers)."""
    shape, rotation, x, y, z, _r = target
    if shape == BALL:
        # the touching circle: centre C (1 - r^2 / d^2), radius r sqrt(1 - r^2 / d^2)
        ax, ay, az, bx, by, bz = perpendicular_axes(x, y, z)
        q = 1.0 - r * r / (x * x + y * y + z * z)
        k = r * math.sqrt(q)
        return x * q, y * q, z * q, k * ax, k * ay, k * az, k * bx, k * by, k * bz
    return (
        x, y, z, r * rotation[0, 0], r * rotation[1, 0], r * rotation[2, 0],
        r * rotation[0, 1], r * rotation[1, 1], r * rotation[2, 1],
    )  # fmt: skip


@bare_step
def circle_point(circle: tuple[float, ...], angle: float) -> Any:
    """The direction to a point of the circle, and its derivative by the angle."""
    c, s = math.cos(angle), math.sin(angle)
    x, y, z, ax, ay, az, bx, by, bz = circle
    return (
        x + c * ax + s * bx, y + c * ay + s * by, z + c * az + s * bz,
        c * bx - s * ax, c * by - s * ay, c * bz - s * az,
    )  # fmt: skip


@bare_step
def image_box(lens: Array, target: TargetPose) -> Any:
    """Whether the lens images all of a target's outline, and the box of its image [px]."""
    circle = outline_circle(target, BOX_RADII * target.radius)
    found, box = _box_of_extremes(lens, circle)
    if found:
        return True, box
    left, right, top, bottom, whole = 1e9, -1e9, 1e9, -1e9, True
    for j in range(OUTLINE_POINTS):
        dx, dy, dz, _a, _b, _c = circle_point(circle, 2.0 * math.pi * j / OUTLINE_POINTS)
        u, v, _d, _e, _f, _g, _h, _i, ok = project(lens, dx, dy, dz)
        if ok:
            left, right = min(left, u), max(right, u)
            top, bottom = min(top, v), max(bottom, v)
        else:
            whole = False
    return whole, ImageBox(left, right, top, bottom)


@bare_step
def _box_of_extremes(lens: Array, circle: tuple[float, ...]) -> Any:
    """Return the box of a circle's image from its four outermost points, after whether that is possible.

    It is where all of the circle is imaged, and nearly as an ellipse about the image of its centre.
    """
    x, y, z, ax, ay, az, bx, by, bz = circle
    u0, v0, ux, uy, uz, vx, vy, vz, whole = project(lens, x, y, z)
    # the corners of a square around the circle: where all are imaged, so is all between them
    for sx, sy in ((1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)):
        if whole:
            corner = project(lens, x + sx * ax + sy * bx, y + sx * ay + sy * by, z + sx * az + sy * bz)
            whole = corner[8]
    left, right, top, bottom = u0, u0, v0, v0
    if not whole:
        return False, ImageBox(left, right, top, bottom)
    along_u = math.atan2(ux * bx + uy * by + uz * bz, ux * ax + uy * ay + uz * az)
    along_v = math.atan2(vx * bx + vy * by + vz * bz, vx * ax + vy * ay + vz * az)
    bent_u = bent_v = 0.0
    for axis in range(2):
        sum_u = sum_v = 0.0
        for half_turn in (0.0, math.pi):
            px, py, pz, ex, ey, ez = circle_point(circle, (along_u if axis == 0 else along_v) + half_turn)
            u, v, ux, uy, uz, vx, vy, vz, _ok = project(lens, px, py, pz)
            sum_u += u - u0
            sum_v += v - v0
            # near its farthest point a coordinate is a cosine of the angle, which value and slope determine
            if axis == 0:
                far = u0 + math.copysign(math.hypot(u - u0, ux * ex + uy * ey + uz * ez), u - u0)
                left, right = min(left, far), max(right, far)
            else:
                far = v0 + math.copysign(math.hypot(v - v0, vx * ex + vy * ey + vz * ez), v - v0)
                top, bottom = min(top, far), max(bottom, far)
        bent_u, bent_v = max(bent_u, abs(sum_u)), max(bent_v, abs(sum_v))
    elliptic = bent_u < ELLIPTIC * (right - left) and bent_v < ELLIPTIC * (bottom - top)
    return elliptic, ImageBox(left, right, top, bottom)


@bare_step
def outline_steps(diameter: float, sigma: float) -> Any:
    """Number of steps along an outline of this image diameter."""
    return max(FEWEST_STEPS, int(math.pi * diameter / (STEP_SIGMA * sigma)) + 1)


@bare_step
def trace(lens: Array, target: TargetPose, pieces: Array, n: int, sense: float, out: Array) -> None:
    """Write (u, v, dv) of the boundary into ``out`` (n, 3); ``sense``: +1 for contours oriented as the image."""
    shape, rotation, x, y, z, r = target
    if shape != FIGURE:
        circle = outline_circle(target, r)
        for j in range(n):
            dx, dy, dz, ex, ey, ez = circle_point(circle, 2.0 * math.pi * j / n)
            u, v, _ux, _uy, _uz, vx, vy, vz, _ok = project(lens, dx, dy, dz)
            out[j, 0], out[j, 1] = u, v
            out[j, 2] = sense * (vx * ex + vy * ey + vz * ez) * 2.0 * math.pi / n
        return
    row = 0
    for i in range(pieces.shape[0]):
        nodes = int(pieces[i, 7])
        panels = int(pieces[i, 8])
        for p in range(panels):
            for k in range(nodes):
                share = (p + 0.5 + 0.5 * NODE_AT[nodes, k]) / panels
                gx, gy, hx, hy = contour_point(pieces[i], share)
                dx = x + gx * rotation[0, 0] + gy * rotation[0, 1]
                dy = y + gx * rotation[1, 0] + gy * rotation[1, 1]
                dz = z + gx * rotation[2, 0] + gy * rotation[2, 1]
                u, v, _ux, _uy, _uz, vx, vy, vz, _ok = project(lens, dx, dy, dz)
                rise = (
                    vx * (hx * rotation[0, 0] + hy * rotation[0, 1])
                    + vy * (hx * rotation[1, 0] + hy * rotation[1, 1])
                    + vz * (hx * rotation[2, 0] + hy * rotation[2, 1])
                )
                out[row, 0], out[row, 1] = u, v
                out[row, 2] = sense * pieces[i, 6] * rise * NODE_SHARE[nodes, k] / panels
                row += 1


@bare_step
def contour_point(piece: Array, share: float) -> Any:
    """The point at a share of a piece of contour, and its derivative by the share."""
    if piece[0] == LINE:
        hx, hy = piece[3] - piece[1], piece[4] - piece[2]
        return piece[1] + share * hx, piece[2] + share * hy, hx, hy
    swing = piece[5] - piece[4]
    angle = piece[4] + share * swing
    c, s = piece[3] * math.cos(angle), piece[3] * math.sin(angle)
    return piece[1] + c, piece[2] + s, -s * swing, c * swing


@step
def cut_pieces(pieces: Array, px_per_m: float, sigma: float) -> Any:
    """Return pieces (n, 9) with the numbers of nodes and panels of each, and the total number of nodes."""
    out = np.empty((pieces.shape[0], 9))
    total = 0
    for i in range(pieces.shape[0]):
        for k in range(7):
            out[i, k] = pieces[i, k]
        if pieces[i, 0] == LINE:
            length = math.hypot(pieces[i, 3] - pieces[i, 1], pieces[i, 4] - pieces[i, 2])
        else:
            length = abs(pieces[i, 3] * (pieces[i, 5] - pieces[i, 4]))
        length *= px_per_m
        length *= 0.6 / sigma
        panels = 1 + int(length / 10.0)
        nodes = min(MAX_NODES, 3 + int(2.0 * length / panels))
        out[i, 7], out[i, 8] = nodes, panels
        total += nodes * panels
    return out, total


@step
def quadratics(first: Array, middle: Array, last: Array) -> Any:
    """Return points (n, 9): quadratics in tau through u, v and amount at tau = -1, 0, 1."""
    n = first.shape[0]
    out = np.empty((n, 9))
    for j in range(n):
        for i in range(3):
            a, b, c = first[j, i], middle[j, i], last[j, i]
            out[j, 3 * i], out[j, 3 * i + 1], out[j, 3 * i + 2] = b, 0.5 * (c - a), 0.5 * (a + c) - b
    return out
