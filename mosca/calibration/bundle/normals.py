"""Normal equations of a bundle adjustment, summed strip by strip, compiled; the Jacobian is never stored.

The names are ``kernels``', strips are ``strips``'. W^T of a run of blocks (``reduction``) stands turned over: a line
for each unknown of the run's groups, in it first the first unknowns of all its blocks, then the second ones: points
that follow each other in a strip follow each other there.
"""

import numpy as np

from mosca.calibration.bundle.jacobian_rows import (
    BLOCK,
    LANES,
    OWN,
    ROOM,
    VECTOR,
    E,
    derive,
    derive_placed,
    gather,
    project,
    weighted_residuals,
)
from mosca.calibration.bundle.lenses import FAST, IMAGED
from mosca.numba_support.decorators import kernel, step


@kernel(fastmath=FAST)
def linearise(state, see, columns, blocks, known, robust, normals):  # type: ignore[no-untyped-def]
    """Write the normal equations at ``state`` into ``normals``; return the cost and the number of unseen
    points.

    The arguments are the tuples of arrays that ``layout`` makes, in its order.
    """
    cameras, points, _ = state
    camera_of, placement_of, offset = see[0], see[2], see[5]
    dim, first_observation, _, _, at_v, at_g, at_w, runs, _ = blocks
    rod_first, rods, rod_weight = known[-3], known[-2], known[-1]
    group_normals, cross, group_slope, mixed, block_normals, block_slope, _, _ = normals
    group_normals[:] = 0
    cross[:] = 0
    group_slope[:] = 0
    groups, width = group_slope.shape
    work, j, local = np.zeros(ROOM), np.zeros(2 * width * LANES), np.zeros(LANES, np.int64)
    out = np.zeros((2, IMAGED))
    cost, unseen = 0.0, 0
    for r in range(runs.size - 1):
        b, end = runs[r], runs[r + 1]
        n = dim[b]
        block_normals[at_v[b] : at_v[b] + (end - b) * n * n] = 0
        block_slope[at_g[b] : at_g[b] + (end - b) * n] = 0
        mixed[at_w[b] : at_w[end]] = 0
        m, last = first_observation[r], first_observation[r + 1]
        while m < last:
            camera, count = camera_of[m], 1
            while count < LANES and m + count < last:
                if camera_of[m + count] != camera or offset[m + count] != offset[m]:
                    break
                count += 1
            # whole vectors only: what is too many repeats the last point, with the weight 0
            lanes = -(-count // VECTOR) * VECTOR
            gather(state, see, m, count, lanes, work)
            project(cameras[camera], lanes, work, out)
            rho, lost = weighted_residuals(m, count, lanes, see[4], robust, work, normals[-1])
            cost, unseen = cost + rho, unseen + lost
            used = derive(cameras[camera], camera, columns, lanes, work, j)
            _sum_camera(camera, used, lanes, work, j, group_normals, group_slope)
            if placement_of[m] >= 0:
                derive_placed(state, see, m, count, work)
            if n:
                _sum_block(b, end - b, m, count, used, see, blocks, work, j, local, normals)
            if groups > cameras.shape[0]:
                _sum_kept(b, end - b, m, count, used, see, blocks, work, j, normals)
            m += count
        for one in range(b, end):
            for d in range(rod_first[one], rod_first[one + 1]):
                v, g = at_v[one], at_g[one]
                cost += _known_distance(points, rods[d], rod_weight[d], n, v, g, block_normals, block_slope)
    for camera in range(cameras.shape[0]):
        for i in range(width):
            for k in range(i):
                group_normals[camera, i, k] = group_normals[camera, k, i]
    return cost, unseen


@step(fastmath=FAST)
def _sum_camera(camera, used, lanes, w, j, group_normals, group_slope):  # type: ignore[no-untyped-def]
    """Add a strip to its camera's normals (the upper triangle) and slope."""
    rows = 2 * LANES
    for i in range(0, used, 2):
        one, two = j[i * rows : (i + 1) * rows], j[(i + 1) * rows : (i + 2) * rows]
        s0 = s1 = 0.0
        for at in range(lanes):
            s0 += one[at] * w[E + at] + one[LANES + at] * w[E + LANES + at]
            s1 += two[at] * w[E + at] + two[LANES + at] * w[E + LANES + at]
        group_slope[camera, i] += s0
        group_slope[camera, i + 1] += s1
        # two lines by two at once: four products of what is fetched once
        for k in range(i, used, 2):
            three, four = j[k * rows : (k + 1) * rows], j[(k + 1) * rows : (k + 2) * rows]
            s0 = s1 = s2 = s3 = 0.0
            for at in range(lanes):
                a, b, c, d = one[at], one[LANES + at], two[at], two[LANES + at]
                e, f, g, h = three[at], three[LANES + at], four[at], four[LANES + at]
                s0 += a * e + b * f
                s1 += a * g + b * h
                s2 += c * e + d * f
                s3 += c * g + d * h
            group_normals[camera, i, k] += s0
            group_normals[camera, i, k + 1] += s1
            group_normals[camera, i + 1, k] += s2
            group_normals[camera, i + 1, k + 1] += s3


@step(fastmath=FAST)
def _sum_block(b, size, m, count, used, see, blocks, w, j, local, normals):  # type: ignore[no-untyped-def]
    """Add a strip to its blocks' normals and slope, and to what these have in common with the camera.

    ``b``, ``size``: the first block of the run and their number; ``local``: room for LANES numbers.
    """
    offset, slot, block = see[5][m], see[6], see[9]
    dim, _, slot_first, _, at_v, at_g, at_w, _, _ = blocks
    _, _, group_slope, mixed, block_normals, block_slope, _, _ = normals
    n, width = dim[b], group_slope.shape[1]
    together = True
    for i in range(count):
        local[i] = block[m + i] - b
        together &= local[i] == local[0] + i
    column = (slot[m] - slot_first[block[m]]) * width
    # a placement's block is its turn and then its shift, a point's part of a block one shift
    parts = 6 if see[2][m] >= 0 else 3
    for first in range(0, parts, 3):
        for second in range(0, parts, 3):
            to = at_v[b] + (offset + first) * n + offset + second
            _sum_own(
                BLOCK + 2 * first * LANES, BLOCK + 2 * second * LANES, to, n, count, local, w, block_normals
            )
    for a in range(parts):
        x, to = BLOCK + 2 * a * LANES, at_g[b] + offset + a
        one, two = w[x : x + LANES], w[x + LANES : x + 2 * LANES]
        for i in range(count):
            block_slope[to + n * local[i]] += one[i] * w[E + i] + two[i] * w[E + LANES + i]
        for k in range(used):
            to = at_w[b] + ((column + k) * n + offset + a) * size
            by_x, by_y = j[2 * k * LANES : (2 * k + 1) * LANES], j[(2 * k + 1) * LANES : (2 * k + 2) * LANES]
            if together:
                line = mixed[to + local[0] : to + local[0] + count]
                for i in range(count):
                    line[i] += one[i] * by_x[i] + two[i] * by_y[i]
            else:
                for i in range(count):
                    mixed[to + local[i]] += one[i] * by_x[i] + two[i] * by_y[i]


@step(fastmath=FAST)
def _sum_own(x, y, to, n, count, local, w, block_normals):  # type: ignore[no-untyped-def]
    """Add the products of three derivatives, at ``x`` in ``w``, and three, at ``y``, of a strip to its blocks."""
    for i in range(count):
        p0, p1, p2 = w[x + i], w[x + 2 * LANES + i], w[x + 4 * LANES + i]
        q0, q1, q2 = w[x + LANES + i], w[x + 3 * LANES + i], w[x + 5 * LANES + i]
        at = to + n * n * local[i]
        for k in range(3):
            a, b = w[y + 2 * k * LANES + i], w[y + (2 * k + 1) * LANES + i]
            block_normals[at + k] += p0 * a + q0 * b
            block_normals[at + n + k] += p1 * a + q1 * b
            block_normals[at + 2 * n + k] += p2 * a + q2 * b


@step(fastmath=FAST)
def _sum_kept(b, size, m, count, used, see, blocks, w, j, normals):  # type: ignore[no-untyped-def]
    """Add a strip to the kept points that it shows, and to what these have in common with cameras and blocks."""
    camera, placement, offset, kept, kept_slot, block = (
        see[0][m],
        see[2][m],
        see[5][m],
        see[7],
        see[8],
        see[9],
    )
    dim, _, slot_first, _, _, _, at_w, _, _ = blocks
    group_normals, cross, group_slope, mixed, _, _, pair_of, _ = normals
    n, width = dim[b], group_slope.shape[1]
    parts = 0 if n == 0 else (6 if placement >= 0 else 3)
    first = OWN if placement >= 0 else BLOCK
    for i in range(count):
        point = kept[m + i]
        if point < 0:
            continue
        across = cross[pair_of[camera, point]]
        for a in range(3):
            x, y = w[first + 2 * a * LANES + i], w[first + (2 * a + 1) * LANES + i]
            group_slope[point, a] += x * w[E + i] + y * w[E + LANES + i]
            for k in range(used):
                across[k, a] += x * j[2 * k * LANES + i] + y * j[(2 * k + 1) * LANES + i]
            for c in range(3):
                at = first + 2 * c * LANES + i
                group_normals[point, a, c] += x * w[at] + y * w[at + LANES]
            if parts:
                column = (kept_slot[m + i] - slot_first[block[m + i]]) * width + a
                to = at_w[b] + (column * n + offset) * size + block[m + i] - b
                for c in range(parts):
                    at = BLOCK + 2 * c * LANES + i
                    mixed[to + c * size] += x * w[at] + y * w[at + LANES]


@step(fastmath=FAST)
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
