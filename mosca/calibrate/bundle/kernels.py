"""Normal equations of a bundle adjustment, block by block, compiled; the Jacobian is never stored.

The unknowns fall into *groups* that stay (a camera's pose and lens; a kept point) and *blocks* that are
eliminated (the coordinates of one point, or of points joined by known distances; the pose of a placed thing).
Each block touches few groups: a *slot* is one block in one group. With group normals U, block normals V and
the mixed part W, a step solves (U - W V^-1 W^T) d_groups = -(g - W V^-1 g_blocks) and then each block by
itself (Schur complement; Brown 1958, Triggs et al. 1999).

Residuals are projected minus observed, in standard deviations. A state is three tables: cameras (c, 32) with
rotation (9), position (3) and lens row (20); points (p, 3); placements (f, 12) with rotation (9) and position
(3).
"""

import numpy as np
from numba import njit

from mosca.calibrate.bundle.lenses import FAST, IMAGED, L, image

UNSEEN = 1e3
"""Residual, in standard deviations, of an image point that the trial camera cannot see: no perfect fit, no
pull."""
LEAST_SQUARES, HUBER, CAUCHY = 0, 1, 2
LENS = 12
"""Where a camera's lens row begins in the table of cameras."""
# derivatives of the pixel by the camera's pose (6), the point in the world, its placement's turn, the point on it
BY_POSE, BY_WORLD, BY_TURN, BY_OWN, OBSERVED = IMAGED, IMAGED + 6, IMAGED + 9, IMAGED + 12, IMAGED + 15
WAITING = 60
"""Image points of a camera whose products are summed at once (a power of two would crowd the cache)."""


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def weigh(u, loss, scale2):  # type: ignore[no-untyped-def]
    """Robust loss and weight of the squared residual u (2-D, in standard deviations; Huber 1964, Cauchy)."""
    if loss == HUBER and u > scale2:
        root = np.sqrt(scale2 / u)
        return 2 * root * u - scale2, root
    if loss == CAUCHY:
        return scale2 * np.log1p(u / scale2), 1 / (1 + u / scale2)
    return u, 1.0


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def observe(cameras, camera, points, point, placements, placement, out):  # type: ignore[no-untyped-def]
    """Project a point; tells whether it is imaged.

    Writes ``out`` (2, 37): of x and y the pixel and its derivatives, at the places named above.
    """
    p0, p1, p2 = points[point, 0], points[point, 1], points[point, 2]
    x, y, z = p0, p1, p2
    if placement >= 0:
        b = placements[placement]
        x = b[0] * p0 + b[1] * p1 + b[2] * p2 + b[9]
        y = b[3] * p0 + b[4] * p1 + b[5] * p2 + b[10]
        z = b[6] * p0 + b[7] * p1 + b[8] * p2 + b[11]
    r = cameras[camera]
    x, y, z = x - r[9], y - r[10], z - r[11]
    v0 = r[0] * x + r[3] * y + r[6] * z
    v1 = r[1] * x + r[4] * y + r[7] * z
    v2 = r[2] * x + r[5] * y + r[8] * z
    if not image(r[LENS:], v0, v1, v2, out):
        return False
    for k in range(2):
        a0, a1, a2 = out[k, 1], out[k, 2], out[k, 3]
        # v' = exp(-[w]x) v: dv/dw = [v]x
        out[k, BY_POSE], out[k, BY_POSE + 1] = a1 * v2 - a2 * v1, a2 * v0 - a0 * v2
        out[k, BY_POSE + 2] = a0 * v1 - a1 * v0
        b0 = a0 * r[0] + a1 * r[1] + a2 * r[2]
        b1 = a0 * r[3] + a1 * r[4] + a2 * r[5]
        b2 = a0 * r[6] + a1 * r[7] + a2 * r[8]
        out[k, BY_POSE + 3], out[k, BY_POSE + 4], out[k, BY_POSE + 5] = -b0, -b1, -b2
        out[k, BY_WORLD], out[k, BY_WORLD + 1], out[k, BY_WORLD + 2] = b0, b1, b2
        if placement >= 0:
            b = placements[placement]
            c0 = b0 * b[0] + b1 * b[3] + b2 * b[6]
            c1 = b0 * b[1] + b1 * b[4] + b2 * b[7]
            c2 = b0 * b[2] + b1 * b[5] + b2 * b[8]
            # x' = B exp([w]x) p: dx/dw = -B [p]x
            out[k, BY_TURN], out[k, BY_TURN + 1] = c2 * p1 - c1 * p2, c0 * p2 - c2 * p0
            out[k, BY_TURN + 2] = c1 * p0 - c0 * p1
            b0, b1, b2 = c0, c1, c2
        out[k, BY_OWN], out[k, BY_OWN + 1], out[k, BY_OWN + 2] = b0, b1, b2
    return True


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def linearise(state, see, columns, blocks, known, robust, normals):  # type: ignore[no-untyped-def]
    """Write the normal equations at ``state`` into ``normals``; return the cost and the number of unseen
    points.

    The arguments are the tuples of arrays that ``layout`` makes, in its order.
    """
    cameras, points, placements = state
    camera_of, point_of, placement_of, xy_px, weight, offset, slot, kept, kept_slot = see
    dim, first_observation, slot_first, _, at_v, at_g, at_w, _, _ = blocks
    rod_first, rods, rod_weight = known[-3], known[-2], known[-1]
    lens, count, first, second, factor = columns
    loss, scale2 = robust
    group_normals, cross, group_slope, mixed, block_normals, block_slope, pair_of, residual = normals
    group_normals[:] = 0
    cross[:] = 0
    group_slope[:] = 0
    mixed[:] = 0
    block_normals[:] = 0
    block_slope[:] = 0
    groups, width = group_slope.shape
    out, j = np.empty((2, OBSERVED)), np.zeros((2, width))
    # [J, residual] of each camera, column by column, wait for their products to be summed over long columns
    waiting, rows = np.empty((cameras.shape[0], width + 1, 2 * WAITING)), np.zeros(groups, np.int64)
    cost, unseen = 0.0, 0
    for b in range(dim.size):
        n, v, g = dim[b], at_v[b], at_g[b]
        stride = (slot_first[b + 1] - slot_first[b]) * width
        for m in range(first_observation[b], first_observation[b + 1]):
            residual[m, 0] = residual[m, 1] = np.nan
            if weight[m] == 0.0:
                continue
            camera, placement = camera_of[m], placement_of[m]
            if not observe(cameras, camera, points, point_of[m], placements, placement, out):
                cost += weigh(2 * UNSEEN * UNSEEN, loss, scale2)[0]
                unseen += 1
                continue
            e0, e1 = out[0, 0] - xy_px[m, 0], out[1, 0] - xy_px[m, 1]
            residual[m, 0], residual[m, 1] = e0, e1
            e0, e1 = e0 * weight[m], e1 * weight[m]
            rho, w = weigh(e0 * e0 + e1 * e1, loss, scale2)
            cost += rho
            root = np.sqrt(w)
            e0, e1, root = e0 * root, e1 * root, root * weight[m]
            row, line, own = rows[camera], waiting[camera], lens[camera]
            for i in range(6):
                x, y = root * out[0, BY_POSE + i], root * out[1, BY_POSE + i]
                j[0, i], j[1, i], line[i, row], line[i, row + 1] = x, y, x, y
            for i in range(count[own]):
                a, c, f = L + first[own, i], L + second[own, i], factor[own, i]
                x, y = root * (out[0, a] + f * out[0, c]), root * (out[1, a] + f * out[1, c])
                j[0, 6 + i], j[1, 6 + i], line[6 + i, row], line[6 + i, row + 1] = x, y, x, y
            for i in range(6 + count[own], width):
                j[0, i], j[1, i], line[i, row], line[i, row + 1] = 0.0, 0.0, 0.0, 0.0
            line[width, row], line[width, row + 1] = e0, e1
            rows[camera] = row + 2
            if row + 2 == 2 * WAITING:
                _sum_up(waiting, rows, camera, group_normals, group_slope)
            point = kept[m]
            if point >= 0:
                across, other = cross[pair_of[camera, point]], group_normals[point]
                for i in range(3):
                    p, q = root * out[0, BY_OWN + i], root * out[1, BY_OWN + i]
                    group_slope[point, i] += p * e0 + q * e1
                    for k in range(width):
                        across[k, i] += p * j[0, k] + q * j[1, k]
                    for k in range(3):
                        other[i, k] += root * (p * out[0, BY_OWN + k] + q * out[1, BY_OWN + k])
            # a placement's block is its turn and then its shift, a point's block one shift
            parts = 0 if n == 0 else (2 if placement >= 0 else 1)
            for part in range(parts):
                row, by = offset[m] + 3 * part, BY_TURN if part < parts - 1 else BY_WORLD
                p0, p1, p2 = root * out[0, by], root * out[0, by + 1], root * out[0, by + 2]
                q0, q1, q2 = root * out[1, by], root * out[1, by + 1], root * out[1, by + 2]
                to = g + row
                block_slope[to] += p0 * e0 + q0 * e1
                block_slope[to + 1] += p1 * e0 + q1 * e1
                block_slope[to + 2] += p2 * e0 + q2 * e1
                to = at_w[slot[m]] + row * stride
                for k in range(width):
                    x, y = j[0, k], j[1, k]
                    mixed[to + k] += p0 * x + q0 * y
                    mixed[to + stride + k] += p1 * x + q1 * y
                    mixed[to + 2 * stride + k] += p2 * x + q2 * y
                for other in range(parts):
                    by = BY_TURN if other < parts - 1 else BY_WORLD
                    to = v + row * n + offset[m] + 3 * other
                    for k in range(3):
                        x, y = root * out[0, by + k], root * out[1, by + k]
                        block_normals[to + k] += p0 * x + q0 * y
                        block_normals[to + n + k] += p1 * x + q1 * y
                        block_normals[to + 2 * n + k] += p2 * x + q2 * y
                if point >= 0:
                    to = at_w[kept_slot[m]] + row * stride
                    for k in range(3):
                        x, y = root * out[0, BY_OWN + k], root * out[1, BY_OWN + k]
                        mixed[to + k] += p0 * x + q0 * y
                        mixed[to + stride + k] += p1 * x + q1 * y
                        mixed[to + 2 * stride + k] += p2 * x + q2 * y
        for d in range(rod_first[b], rod_first[b + 1]):
            cost += _known_distance(points, rods[d], rod_weight[d], n, v, g, block_normals, block_slope)
    for camera in range(cameras.shape[0]):
        _sum_up(waiting, rows, camera, group_normals, group_slope)
    return cost, unseen


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def _sum_up(waiting, rows, camera, group_normals, group_slope):  # type: ignore[no-untyped-def]
    """Add the waiting rows of a camera to its normals and slope."""
    mine, width, count = waiting[camera], group_slope.shape[1], rows[camera]
    for i in range(width):
        for k in range(i, width + 1):
            x = 0.0
            for r in range(count):
                x += mine[i, r] * mine[k, r]
            if k == width:
                group_slope[camera, i] += x
            else:
                group_normals[camera, i, k] += x
                if i != k:
                    group_normals[camera, k, i] += x
    rows[camera] = 0


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def _known_distance(points, rod, weight, n, v, g, block_normals, block_slope):  # type: ignore[no-untyped-def]
    """Add a known distance between two points of a block, or to a held point (offset -1); return its cost."""
    one, two, at_one, at_two = rod
    x = points[one, 0] - points[two, 0]
    y = points[one, 1] - points[two, 1]
    z = points[one, 2] - points[two, 2]
    length = max(np.sqrt(x * x + y * y + z * z), 1e-12)
    e, w = (length - weight[0]) * weight[1], weight[1] / length
    by = (x * w, y * w, z * w)
    for i in range(3):
        for at, sign in ((at_one, 1.0), (at_two, -1.0)):
            if at < 0:
                continue
            block_slope[g + at + i] += sign * by[i] * e
            for to, turn in ((at_one, sign), (at_two, -sign)):
                if to >= 0:
                    for k in range(3):
                        block_normals[v + (at + i) * n + to + k] += turn * by[i] * by[k]
    return e * e


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def imaged(state, see, out):  # type: ignore[no-untyped-def]
    """Write the residuals ``out`` (n, 2), projected minus observed [px]; NaN where a camera does not image
    its point.
    """
    cameras, points, placements = state
    work = np.empty((2, OBSERVED))
    for m in range(out.shape[0]):
        if observe(cameras, see[0][m], points, see[1][m], placements, see[2][m], work):
            out[m, 0], out[m, 1] = work[0, 0] - see[3][m, 0], work[1, 0] - see[3][m, 1]
        else:
            out[m, 0] = out[m, 1] = np.nan
