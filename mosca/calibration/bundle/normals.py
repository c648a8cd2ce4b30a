"""Normal equations of a bundle adjustment, summed batch by batch, compiled; the Jacobian is never stored.

The notation is that of ``kernels``, batches are those of ``jacobian_rows``. W^T of a run of blocks (``reduction``) is
stored transposed, with a row for each unknown of the run's groups. A row holds the first unknowns of all blocks, then
the second ones, and so on, so that consecutive points of a batch are consecutive in it.
"""

from typing import NamedTuple

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
from mosca.calibration.bundle.tables import (
    EliminatedBlocks,
    Known,
    LensColumns,
    Loss,
    NormalEquations,
    ParameterValues,
    SortedObservations,
)
from mosca.data.arrays import Array
from mosca.numba_support.decorators import kernel, step


class Batch(NamedTuple):
    """Up to LANES observations of one camera in one run of blocks, with their derivatives."""

    block: int
    """First block of the run."""
    blocks: int
    """Number of blocks in the run."""
    first: int
    """First observation."""
    number: int
    """Number of observations."""
    used: int
    """Number of the camera's unknowns, even (``jacobian_rows.derive``)."""
    work: Array
    """Work array of ``jacobian_rows``."""
    jacobian: Array
    """Derivatives by the camera's unknowns."""
    local: Array
    """(LANES,) work array: block of each observation, counted from the run's first."""


@kernel(fastmath=FAST)
def linearise(
    state: ParameterValues, see: SortedObservations, columns: LensColumns, blocks: EliminatedBlocks,
    known: Known, loss: Loss, normals: NormalEquations
) -> tuple[float, int]:  # fmt: skip
    """Write the normal equations at ``state`` into ``normals``; return the cost and the number of unseen points."""
    cameras = state.cameras
    camera_of, placement_of, offset = see.camera, see.placement, see.offset
    dim, first_observation, runs = blocks.size, blocks.first_observation, blocks.runs
    at_v, at_g, at_w = blocks.normals_at, blocks.slope_at, blocks.mixed_at
    group_normals, group_slope, mixed = normals.groups, normals.group_slope, normals.mixed
    group_normals[:] = 0
    normals.cross[:] = 0
    group_slope[:] = 0
    groups, width = group_slope.shape
    work, j, local = np.zeros(ROOM), np.zeros(2 * width * LANES), np.zeros(LANES, np.int64)
    out = np.zeros((2, IMAGED))
    cost, unseen = 0.0, 0
    for r in range(runs.size - 1):
        b, end = runs[r], runs[r + 1]
        n = dim[b]
        normals.blocks[at_v[b] : at_v[b] + (end - b) * n * n] = 0
        normals.block_slope[at_g[b] : at_g[b] + (end - b) * n] = 0
        mixed[at_w[b] : at_w[end]] = 0
        m, last = first_observation[r], first_observation[r + 1]
        while m < last:
            camera, count = camera_of[m], 1
            while count < LANES and m + count < last:
                if camera_of[m + count] != camera or offset[m + count] != offset[m]:
                    break
                count += 1
            # whole vectors only: padding repeats the last point, with the weight 0
            lanes = -(-count // VECTOR) * VECTOR
            gather(state, see, m, count, lanes, work)
            project(cameras[camera], lanes, work, out)
            rho, lost = weighted_residuals(m, count, lanes, see.weight, loss, work, normals.residuals_px)
            cost, unseen = cost + rho, unseen + lost
            used = derive(cameras[camera], camera, columns, lanes, work, j)
            _sum_camera(camera, used, lanes, work, j, group_normals, group_slope)
            if placement_of[m] >= 0:
                derive_placed(state, see, m, count, work)
            batch = Batch(b, end - b, m, count, used, work, j, local)
            if n:
                _sum_block(batch, see, blocks, normals)
            if groups > cameras.shape[0]:
                _sum_kept(batch, see, blocks, normals)
            m += count
        for one in range(b, end):
            for d in range(known.first_distance[one], known.first_distance[one + 1]):
                cost += _known_distance(state.points, known, d, n, at_v[one], at_g[one], normals)
    for camera in range(cameras.shape[0]):
        for i in range(width):
            for k in range(i):
                group_normals[camera, i, k] = group_normals[camera, k, i]
    return cost, unseen


@step(fastmath=FAST)
def _sum_camera(
    camera: int, used: int, lanes: int, w: Array, j: Array, group_normals: Array, group_slope: Array
) -> None:
    """Add a batch to its camera's normals (the upper triangle) and slope."""
    rows = 2 * LANES
    for i in range(0, used, 2):
        one, two = j[i * rows : (i + 1) * rows], j[(i + 1) * rows : (i + 2) * rows]
        s0 = s1 = 0.0
        for at in range(lanes):
            s0 += one[at] * w[E + at] + one[LANES + at] * w[E + LANES + at]
            s1 += two[at] * w[E + at] + two[LANES + at] * w[E + LANES + at]
        group_slope[camera, i] += s0
        group_slope[camera, i + 1] += s1
        # two lines by two at once: four products per load
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
def _sum_block(batch: Batch, see: SortedObservations, blocks: EliminatedBlocks, normals: NormalEquations) -> None:
    """Add a batch to its blocks' normals and slope, and to their mixed part with the camera."""
    b, size, m, count, used, w, j, local = batch
    offset, slot, block = see.offset[m], see.slot, see.block
    slot_first, at_v, at_g, at_w = blocks.first_slot, blocks.normals_at, blocks.slope_at, blocks.mixed_at
    mixed, block_normals, block_slope = normals.mixed, normals.blocks, normals.block_slope
    n, width = blocks.size[b], normals.group_slope.shape[1]
    together = True
    for i in range(count):
        local[i] = block[m + i] - b
        together &= local[i] == local[0] + i
    column = (slot[m] - slot_first[block[m]]) * width
    # a placement's block is a rotation and then a shift, a point's part of a block is one shift
    parts = 6 if see.placement[m] >= 0 else 3
    for first in range(0, parts, 3):
        for second in range(0, parts, 3):
            to = at_v[b] + (offset + first) * n + offset + second
            _sum_own(batch, BLOCK + 2 * first * LANES, BLOCK + 2 * second * LANES, to, n, block_normals)
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
def _sum_own(batch: Batch, x: int, y: int, to: int, n: int, block_normals: Array) -> None:
    """Add a batch's products of the three derivatives at ``x`` in ``work`` with the three at ``y`` to its blocks."""
    w, local = batch.work, batch.local
    for i in range(batch.number):
        p0, p1, p2 = w[x + i], w[x + 2 * LANES + i], w[x + 4 * LANES + i]
        q0, q1, q2 = w[x + LANES + i], w[x + 3 * LANES + i], w[x + 5 * LANES + i]
        at = to + n * n * local[i]
        for k in range(3):
            a, b = w[y + 2 * k * LANES + i], w[y + (2 * k + 1) * LANES + i]
            block_normals[at + k] += p0 * a + q0 * b
            block_normals[at + n + k] += p1 * a + q1 * b
            block_normals[at + 2 * n + k] += p2 * a + q2 * b


@step(fastmath=FAST)
def _sum_kept(batch: Batch, see: SortedObservations, blocks: EliminatedBlocks, normals: NormalEquations) -> None:
    """Add a batch to the kept points that it shows, and to their mixed parts with cameras and blocks."""
    b, size, m, count, used, w, j, _ = batch
    camera, placement, offset = see.camera[m], see.placement[m], see.offset[m]
    kept, kept_slot, block = see.kept_group, see.kept_slot, see.block
    slot_first, at_w = blocks.first_slot, blocks.mixed_at
    group_normals, cross, group_slope = normals.groups, normals.cross, normals.group_slope
    mixed, pair_of = normals.mixed, normals.pair_of
    n, width = blocks.size[b], group_slope.shape[1]
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
def _known_distance(points: Array, known: Known, d: int, n: int, v: int, g: int, normals: NormalEquations) -> float:
    """Add the known distance ``d`` between two points of a block, or to a held point (offset -1); return its cost."""
    one, two, at_one, at_two = known.distances[d]
    weight, block_normals, block_slope = known.distance_weight[d], normals.blocks, normals.block_slope
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
            for to, product in ((at_one, sign), (at_two, -sign)):
                if to >= 0:
                    for k in range(3):
                        block_normals[v + (at + i) * n + to + k] += product * by[i] * by[k]
    result: float = e * e
    return result
