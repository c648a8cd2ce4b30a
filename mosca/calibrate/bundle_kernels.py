"""Normal equations of a bundle adjustment, block by block, compiled; nothing of the Jacobian is ever stored.

The unknowns fall into *groups* that stay (a camera's pose and lens; a kept point) and *blocks* that are eliminated
(the coordinates of one point, or of points joined by known distances; the pose of a placed thing). Each block
touches few groups: a *slot* is one block in one group. With group normals U, block normals V and the mixed
part W, a step solves (U - W V^-1 W^T) d_groups = -(g - W V^-1 g_blocks) and then each block by itself (Schur
complement; Brown 1958, Triggs et al. 1999).

Residuals are projected minus observed, in standard deviations.
"""

import numpy as np
from numba import njit

from mosca.calibrate.bundle_lenses import FAST, IMAGED, L, image

UNSEEN = 1e3
"""Residual, in standard deviations, of an image point that the trial camera cannot see: no perfect fit, no pull."""
LEAST_SQUARES, HUBER, CAUCHY = 0, 1, 2
SINGULAR_PIVOT = 1e-13
"""Share of its diagonal that a pivot of a block must keep; below it the direction is undetermined and stays."""


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def weigh(u, loss, scale2):  # type: ignore[no-untyped-def]
    """Robust loss and weight of the squared residual u (2-D, in standard deviations; Huber 1964, Cauchy)."""
    if loss == HUBER and u > scale2:
        root = np.sqrt(scale2 / u)
        return 2 * root * u - scale2, root
    if loss == CAUCHY:
        return scale2 * np.log1p(u / scale2), 1 / (1 + u / scale2)
    return u, 1.0


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST, inline="always")
def observe(m, state, see, columns, out, j, jb):  # type: ignore[no-untyped-def]
    """Project observation m's point, with Jacobians: j (2, K) by its camera, jb (3, 2, 3) by the
    point in the world, by the turn of its placement, by the point in its thing's frame. Writes the pixel too.

    Tells whether the point is imaged.
    """
    rotation, position, lenses, points, turned, moved = state
    camera, point, placement = see[0][m], see[1][m], see[2][m]
    lens, first, second, factor = columns
    p0, p1, p2 = points[point, 0], points[point, 1], points[point, 2]
    x, y, z = p0, p1, p2
    if placement >= 0:
        b = turned[placement]
        x = b[0, 0] * p0 + b[0, 1] * p1 + b[0, 2] * p2 + moved[placement, 0]
        y = b[1, 0] * p0 + b[1, 1] * p1 + b[1, 2] * p2 + moved[placement, 1]
        z = b[2, 0] * p0 + b[2, 1] * p1 + b[2, 2] * p2 + moved[placement, 2]
    r = rotation[camera]
    x, y, z = x - position[camera, 0], y - position[camera, 1], z - position[camera, 2]
    v0 = r[0, 0] * x + r[1, 0] * y + r[2, 0] * z
    v1 = r[0, 1] * x + r[1, 1] * y + r[2, 1] * z
    v2 = r[0, 2] * x + r[1, 2] * y + r[2, 2] * z
    own = lens[camera]
    if not image(lenses[own], v0, v1, v2, out):
        return False
    for k in range(2):
        a0, a1, a2 = out[k, 1], out[k, 2], out[k, 3]
        # v' = exp(-[w]x) v: dv/dw = [v]x
        j[k, 0], j[k, 1], j[k, 2] = a1 * v2 - a2 * v1, a2 * v0 - a0 * v2, a0 * v1 - a1 * v0
        b0 = a0 * r[0, 0] + a1 * r[0, 1] + a2 * r[0, 2]
        b1 = a0 * r[1, 0] + a1 * r[1, 1] + a2 * r[1, 2]
        b2 = a0 * r[2, 0] + a1 * r[2, 1] + a2 * r[2, 2]
        j[k, 3], j[k, 4], j[k, 5] = -b0, -b1, -b2
        jb[0, k, 0], jb[0, k, 1], jb[0, k, 2] = b0, b1, b2
        if placement >= 0:
            b = turned[placement]
            c0 = b0 * b[0, 0] + b1 * b[1, 0] + b2 * b[2, 0]
            c1 = b0 * b[0, 1] + b1 * b[1, 1] + b2 * b[2, 1]
            c2 = b0 * b[0, 2] + b1 * b[1, 2] + b2 * b[2, 2]
            jb[2, k, 0], jb[2, k, 1], jb[2, k, 2] = c0, c1, c2
            # x' = B exp([w]x) p: dx/dw = -B [p]x
            jb[1, k, 0], jb[1, k, 1], jb[1, k, 2] = c2 * p1 - c1 * p2, c0 * p2 - c2 * p0, c1 * p0 - c0 * p1
        else:
            jb[2, k, 0], jb[2, k, 1], jb[2, k, 2] = b0, b1, b2
        for i in range(first.shape[1]):
            one = first[own, i]
            if one < 0:
                j[k, 6 + i] = 0.0
            else:
                j[k, 6 + i] = out[k, L + one] + factor[own, i] * out[k, L + second[own, i]]
    return True


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def imaged(state, see, columns):  # type: ignore[no-untyped-def]
    """Return which observations (n,) their cameras image."""
    seen, out = np.empty(see[0].size, dtype=np.bool_), np.empty(IMAGED)
    j, jb = np.empty((2, 6 + columns[1].shape[1])), np.empty((3, 2, 3))
    for m in range(seen.size):
        seen[m] = observe(m, state, see, columns, out, j, jb)
    return seen


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def linearise(state, see, columns, blocks, known, robust, normals):  # type: ignore[no-untyped-def]
    """Write the normal equations at ``state`` into ``normals``; return the cost and the number of unseen points.

    The arguments are the tuples of arrays that ``bundle_layout`` makes, in its order.
    """
    _, _, _, points, turned, moved = state
    _, _, _, xy_px, weight, offset, slot, kept, kept_slot = see
    dim, first_observation, _, _, at_v, at_g, at_w, _ = blocks
    given, information, pose_block, given_turned, given_moved, pose_weight, rod_first, rods, rod_weight = (
        known
    )
    loss, scale2 = robust
    group_normals, cross, group_slope, mixed, block_normals, block_slope, pair_of = normals
    for array in (group_normals, cross):
        array[:] = 0
    group_slope[:] = 0
    mixed[:] = 0
    block_normals[:] = 0
    block_slope[:] = 0
    width = group_slope.shape[1]
    out = np.empty(IMAGED)
    j, jb, rod = np.zeros((2, width)), np.empty((3, 2, 3)), np.empty(3)
    cost, unseen = 0.0, 0
    for b in range(dim.size):
        n, v, g = dim[b], at_v[b], at_g[b]
        for m in range(first_observation[b], first_observation[b + 1]):
            if weight[m] == 0.0:
                continue
            if not observe(m, state, see, columns, out, j, jb):
                cost += weigh(2 * UNSEEN * UNSEEN, loss, scale2)[0]
                unseen += 1
                continue
            e0, e1 = (out[0, 0] - xy_px[m, 0]) * weight[m], (out[1, 0] - xy_px[m, 1]) * weight[m]
            rho, w = weigh(e0 * e0 + e1 * e1, loss, scale2)
            cost += rho
            f0, f1, w = w * e0 * weight[m], w * e1 * weight[m], w * weight[m] * weight[m]
            camera = see[0][m]
            own, slope = group_normals[camera], group_slope[camera]
            for i in range(width):
                p, q = w * j[0, i], w * j[1, i]
                slope[i] += j[0, i] * f0 + j[1, i] * f1
                for k in range(width):
                    own[i, k] += p * j[0, k] + q * j[1, k]
            point = kept[m]
            if point >= 0:
                across, other, slope = (
                    cross[pair_of[camera, point]],
                    group_normals[point],
                    group_slope[point],
                )
                for i in range(3):
                    p, q = jb[2, 0, i], jb[2, 1, i]
                    slope[i] += p * f0 + q * f1
                    for k in range(width):
                        across[k, i] += w * (p * j[0, k] + q * j[1, k])
                    for k in range(3):
                        other[i, k] += w * (p * jb[2, 0, k] + q * jb[2, 1, k])
            if n == 0:
                continue
            # a placement's block is its turn and then its shift, a point's block one shift
            parts = 2 if see[2][m] >= 0 else 1
            for part in range(parts):
                a = jb[1] if parts == 2 and part == 0 else jb[0]
                row = offset[m] + 3 * part
                for i in range(3):
                    p, q = w * a[0, i], w * a[1, i]
                    block_slope[g + row + i] += a[0, i] * f0 + a[1, i] * f1
                    line = at_w[slot[m]] + (row + i) * width
                    for k in range(width):
                        mixed[line + k] += p * j[0, k] + q * j[1, k]
                    for other_part in range(parts):
                        c = jb[1] if parts == 2 and other_part == 0 else jb[0]
                        line = v + (row + i) * n + offset[m] + 3 * other_part
                        for k in range(3):
                            block_normals[line + k] += p * c[0, k] + q * c[1, k]
                    if point >= 0:
                        line = at_w[kept_slot[m]] + (row + i) * width
                        for k in range(3):
                            mixed[line + k] += p * jb[2, 0, k] + q * jb[2, 1, k]
        # known distances between the points of this block, or to a held point (offset -1)
        for d in range(rod_first[b], rod_first[b + 1]):
            one, two, at_one, at_two = rods[d, 0], rods[d, 1], rods[d, 2], rods[d, 3]
            length = 0.0
            for i in range(3):
                rod[i] = points[one, i] - points[two, i]
                length += rod[i] * rod[i]
            length = max(np.sqrt(length), 1e-12)
            e, w = (length - rod_weight[d, 0]) * rod_weight[d, 1], rod_weight[d, 1] / length
            cost += e * e
            for i in range(3):
                p = rod[i] * w
                for at, sign in ((at_one, 1.0), (at_two, -1.0)):
                    if at < 0:
                        continue
                    block_slope[g + at + i] += sign * p * e
                    for to, turn in ((at_one, sign), (at_two, -sign)):
                        if to >= 0:
                            for k in range(3):
                                block_normals[v + (at + i) * n + to + k] += turn * p * rod[k] * w
    if information.size:
        cost += _weighted_points(points, given, information, blocks, known, block_normals, block_slope)
    if pose_weight.size:
        for f in range(pose_block.size):
            b = pose_block[f]
            if b >= 0:
                cost += weighted_pose(
                    turned[f], moved[f], given_turned[f], given_moved[f], pose_weight[f],
                    block_normals[at_v[b] : at_v[b] + 36].reshape(6, 6), block_slope[at_g[b] : at_g[b] + 6],
                )  # fmt: skip
    return cost, unseen


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def _weighted_points(points, given, information, blocks, known, block_normals, block_slope):  # type: ignore[no-untyped-def]
    """Add the observed coordinates of eliminated points; return their cost."""
    dim, _, _, _, at_v, at_g, _, member = blocks
    cost = 0.0
    for k in range(member.shape[0]):
        point, b, at = member[k, 0], member[k, 1], member[k, 2]
        for i in range(3):
            pull = 0.0
            for c in range(3):
                pull += information[point, i, c] * (points[point, c] - given[point, c])
                block_normals[at_v[b] + (at + i) * dim[b] + at + c] += information[point, i, c]
            block_slope[at_g[b] + at + i] += pull
            cost += pull * (points[point, i] - given[point, i])
    return cost


@njit(nogil=True, cache=True, error_model="numpy")
def weighted_pose(rotation, position, given_rotation, given_position, weight, normals, slope):  # type: ignore[no-untyped-def]
    """Add an observed pose to ``normals`` (6, 6), ``slope`` (6,); ``weight`` (6,) 1/sigma; return its cost.

    The turn's residual is log(R0^T R), whose derivative by a further turn is the inverse right Jacobian of SO(3)
    (Chirikjian 2011, eq. 10.86): I + [p]x / 2 + (1/a^2 - (1 + cos a) / (2 a sin a)) [p]x^2.
    """
    p = log_turn(given_rotation.T @ rotation)
    a2 = p[0] * p[0] + p[1] * p[1] + p[2] * p[2]
    a = np.sqrt(a2)
    c = 1 / 12.0 if a < 1e-4 else 1 / a2 - (1 + np.cos(a)) / (2 * a * np.sin(a))
    cross = np.array([[0.0, -p[2], p[1]], [p[2], 0.0, -p[0]], [-p[1], p[0], 0.0]])
    by = np.zeros((6, 6))
    by[:3, :3] = np.eye(3) + 0.5 * cross + c * (cross @ cross)
    by[3, 3] = by[4, 4] = by[5, 5] = 1.0
    cost = 0.0
    for i in range(6):
        e = weight[i] * (p[i] if i < 3 else position[i - 3] - given_position[i - 3])
        cost += e * e
        for k in range(6):
            slope[k] += weight[i] * by[i, k] * e
            for n in range(6):
                normals[k, n] += weight[i] ** 2 * by[i, k] * by[i, n]
    return cost


@njit(nogil=True, cache=True, error_model="numpy")
def log_turn(r):  # type: ignore[no-untyped-def]
    """Rotation matrix (3, 3) -> rotation vector (3,), for turns well below half a turn."""
    half = np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]]) / 2
    sine = np.sqrt(half[0] ** 2 + half[1] ** 2 + half[2] ** 2)
    angle = np.arctan2(sine, (r[0, 0] + r[1, 1] + r[2, 2] - 1) / 2)
    return half * (angle / sine if sine > 1e-9 else 1.0)


@njit(nogil=True, cache=True, error_model="numpy")
def turn_on(rotation, step):  # type: ignore[no-untyped-def]
    """Return rotations (n, 3, 3) turned about their own axes by vectors (n, 3): R exp([w]x) (Rodrigues)."""
    out = np.empty_like(rotation)
    e = np.empty((3, 3))
    for n in range(rotation.shape[0]):
        x, y, z = step[n, 0], step[n, 1], step[n, 2]
        a2 = x * x + y * y + z * z
        a = np.sqrt(a2)
        s, c = (1 - a2 / 6, 0.5 - a2 / 24) if a < 1e-4 else (np.sin(a) / a, (1 - np.cos(a)) / a2)
        e[0, 0], e[0, 1], e[0, 2] = 1 - c * (y * y + z * z), c * x * y - s * z, c * x * z + s * y
        e[1, 0], e[1, 1], e[1, 2] = c * x * y + s * z, 1 - c * (x * x + z * z), c * y * z - s * x
        e[2, 0], e[2, 1], e[2, 2] = c * x * z - s * y, c * y * z + s * x, 1 - c * (x * x + y * y)
        for i in range(3):
            for k in range(3):
                out[n, i, k] = (
                    rotation[n, i, 0] * e[0, k] + rotation[n, i, 1] * e[1, k] + rotation[n, i, 2] * e[2, k]
                )
    return out
