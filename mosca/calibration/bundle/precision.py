"""Precision and reliability of a bundle adjustment, run by run, compiled. Notation as in ``kernels``."""

from typing import NamedTuple

import numpy as np

from mosca.calibration.bundle.kernels import BY_OWN, BY_POSE, BY_ROTATION, BY_WORLD, OBSERVED, observe, weigh
from mosca.calibration.bundle.lenses import FAST, L
from mosca.calibration.bundle.tables import (
    EliminatedBlocks,
    LensColumns,
    Loss,
    ParameterValues,
    ReducedInverse,
    SortedObservations,
)
from mosca.data.arrays import Array
from mosca.numba_support.decorators import kernel, step

LEAST_REDUNDANCY_NUMBER = 1e-6
"""An image point with a smaller redundancy number cannot be tested."""


class BlockCofactors(NamedTuple):
    """Cofactors of one block (``precise``)."""

    own: Array
    """(n, n) cofactors of its unknowns."""
    with_groups: Array
    """(n, wide) V^-1 W^T Q."""
    size: int
    """Number n of unknowns."""
    first_slot: int


@kernel(fastmath=FAST)
def precise(
    state: ParameterValues, see: SortedObservations, base_weight: Array, columns: LensColumns,
    blocks: EliminatedBlocks, loss: Loss, mixed: Array, inverse: ReducedInverse, block_cofactors: Array, tests: Array
) -> None:  # fmt: skip
    """Write cofactors of the blocks and the residual and test statistic of each image point.

    ``base_weight`` (n,): 1 / sigma a priori of the sorted image points, also of those left out; ``mixed``: W^T
    (``NormalEquations``). Written are ``block_cofactors`` (laid out as V): V^-1 W^T Q W V^-1 + V^-1; and ``tests``
    (n, 7): residuals x, y, projected minus observed [px]; cofactors xx, xy, yy of the projection over the a-priori
    ones of the image point; v^T Q_vv^-1 v, for points left out e^T Q_ee^-1 e, NaN where a point cannot be tested; the
    robust weight.
    """
    dim, slot_first, slot_group, at_v = blocks.size, blocks.first_slot, blocks.slot_group, blocks.normals_at
    cofactors, index, runs = inverse.cofactors, inverse.group_columns, blocks.runs
    width = index.shape[1]
    work = (np.empty((2, OBSERVED)), np.zeros((2, width)), np.empty((2, width + 9)), np.empty(width + 9, np.int64))
    for r in range(runs.size - 1):
        b, count = runs[r], runs[r + 1] - runs[r]
        n, first = dim[b], slot_first[b]
        slots = slot_first[b + 1] - first
        rows, wide = count * n, slots * width
        own = _block_by_block(mixed, blocks.mixed_at[b], n, count, wide)
        # carried: V^-1 W^T (d block / d group, up to sign); spread: the same times Q
        carried = np.empty((rows, wide))
        _times_inverse(inverse.blocks, at_v[b], n, count, own, carried)
        q = np.empty((wide, wide))
        for i in range(wide):
            row = index[slot_group[first + i // width], i % width]
            for k in range(wide):
                q[i, k] = cofactors[row, index[slot_group[first + k // width], k % width]]
        spread = np.dot(carried, q) if slots else carried
        for one in range(count):
            v, top = at_v[b + one], one * n
            own_cofactors = block_cofactors[v : v + n * n].reshape(n, n)
            for i in range(n):
                for k in range(n):
                    x = inverse.blocks[v + i * n + k]
                    for c in range(wide):
                        x += spread[top + i, c] * carried[top + k, c]
                    own_cofactors[i, k] = x
        for m in range(blocks.first_observation[r], blocks.first_observation[r + 1]):
            # the block's part in the covariance with the groups, at the columns of this block's slots
            one = see.block[m]
            v, top = at_v[one], (one - b) * n
            part = BlockCofactors(
                block_cofactors[v : v + n * n].reshape(n, n), spread[top : top + n], n, slot_first[one]
            )
            _test(m, state, see, base_weight, columns, loss, inverse, work, part, tests)


@step(fastmath=FAST)
def _block_by_block(mixed: Array, at: int, n: int, count: int, wide: int) -> Array:
    """Return W^T of a run (count n, wide), the unknowns of each block together."""
    out = np.empty((count * n, wide))
    for c in range(wide):
        for i in range(n):
            row = at + (c * n + i) * count
            for one in range(count):
                out[one * n + i, c] = mixed[row + one]
    return out


@step(fastmath=FAST)
def _times_inverse(inverse: Array, at: int, n: int, blocks: int, matrix: Array, out: Array) -> None:
    """Write V^-1 times the rows of ``matrix`` (blocks n, q), block by block from ``inverse[at:]``, to ``out``."""
    width = matrix.shape[1]
    for b in range(blocks):
        for i in range(n):
            line, to = at + (b * n + i) * n, out[b * n + i]
            # block sizes are multiples of three
            for c in range(0, n, 3):
                f0, f1, f2 = inverse[line + c], inverse[line + c + 1], inverse[line + c + 2]
                x, y, z = matrix[b * n + c], matrix[b * n + c + 1], matrix[b * n + c + 2]
                if c == 0:
                    for k in range(width):
                        to[k] = f0 * x[k] + f1 * y[k] + f2 * z[k]
                else:
                    for k in range(width):
                        to[k] += f0 * x[k] + f1 * y[k] + f2 * z[k]


@step(fastmath=FAST)
def _test(
    m: int, state: ParameterValues, see: SortedObservations, base_weight: Array, columns: LensColumns, loss: Loss,
    inverse: ReducedInverse, work: tuple[Array, Array, Array, Array], part: BlockCofactors, tests: Array
) -> None:  # fmt: skip
    """Write the tests of one image point; ``part``: cofactors of its block."""
    block, spread, n, first = part
    cofactors, index = inverse.cofactors, inverse.group_columns
    xy_px, weight, offset, slot, kept_slot = see.xy_px, see.weight, see.offset, see.slot, see.kept_slot
    out, j, by, place = work
    width = index.shape[1]
    camera, point, placement = see.camera[m], see.kept_group[m], see.placement[m]
    if not observe(state, see, m, out):
        tests[m, :] = np.nan
        return
    by_unknowns(out, columns, camera, j)
    # derivatives by the unknowns of the groups, and their indices among all
    size = width
    for k in range(2):
        for i in range(width):
            by[k, i] = j[k, i]
    for i in range(width):
        place[i] = index[camera, i]
    if point >= 0:
        for i in range(3):
            by[0, width + i], by[1, width + i] = out[0, BY_OWN + i], out[1, BY_OWN + i]
            place[width + i] = index[point, i]
        size = width + 3
    q00 = q01 = q11 = 0.0
    for i in range(size):
        f0 = f1 = 0.0
        for k in range(size):
            x = cofactors[place[i], place[k]]
            f0 += x * by[0, k]
            f1 += x * by[1, k]
        q00 += by[0, i] * f0
        q01 += by[0, i] * f1
        q11 += by[1, i] * f1
    own = 0 if n == 0 else (6 if placement >= 0 else 3)
    for i in range(own):
        row = offset[m] + i
        unknown = BY_ROTATION + i if own == 6 and i < 3 else (BY_WORLD + i - 3 if own == 6 else BY_WORLD + i)
        d0, d1 = out[0, unknown], out[1, unknown]
        f0 = f1 = 0.0
        for k in range(own):
            other = BY_ROTATION + k if own == 6 and k < 3 else (BY_WORLD + k - 3 if own == 6 else BY_WORLD + k)
            x = block[row, offset[m] + k]
            f0 += x * out[0, other]
            f1 += x * out[1, other]
        g0 = g1 = 0.0
        for k in range(size):
            at = (slot[m] - first) * width + k if k < width else (kept_slot[m] - first) * width + k - width
            g0 += spread[row, at] * by[0, k]
            g1 += spread[row, at] * by[1, k]
        q00 += d0 * (f0 - 2 * g0)
        q01 += d0 * (f1 - g1) - d1 * g0
        q11 += d1 * (f1 - 2 * g1)
    e0, e1 = out[0, 0] - xy_px[m, 0], out[1, 0] - xy_px[m, 1]
    base = base_weight[m] * base_weight[m]
    robust_weight = weigh((e0 * e0 + e1 * e1) * base, loss)[1]
    factor = base * robust_weight if weight[m] > 0 else base
    q00, q01, q11 = q00 * factor, q01 * factor, q11 * factor
    # residuals of used image points vary less than the image points, residuals of those left out vary more
    sign = -1.0 if weight[m] > 0 else 1.0
    v00, v01, v11 = 1 + sign * q00, sign * q01, 1 + sign * q11
    least = (v00 + v11) / 2 - np.sqrt(((v00 - v11) / 2) ** 2 + v01 * v01)
    tests[m, 0], tests[m, 1], tests[m, 2], tests[m, 3], tests[m, 4] = e0, e1, q00, q01, q11
    tests[m, 5], tests[m, 6] = np.nan, robust_weight
    if least > LEAST_REDUNDANCY_NUMBER:
        determinant = v00 * v11 - v01 * v01
        tests[m, 5] = factor * (e0 * e0 * v11 - 2 * e0 * e1 * v01 + e1 * e1 * v00) / determinant


@step(fastmath=FAST)
def by_unknowns(out: Array, columns: LensColumns, camera: int, j: Array) -> None:
    """Write the pixel's derivative by the unknowns of its camera's group (2, K): pose, then free lens parameters."""
    count, first, second, factor = columns
    free = count[camera]
    for k in range(2):
        for i in range(6):
            j[k, i] = out[k, BY_POSE + i]
        for i in range(free):
            j[k, 6 + i] = out[k, L + first[camera, i]] + factor[camera, i] * out[k, L + second[camera, i]]
        for i in range(6 + free, j.shape[1]):
            j[k, i] = 0.0


@kernel(fastmath=FAST)
def carry_down(blocks: EliminatedBlocks, mixed: Array, inverse: Array, index: Array, z: Array) -> Array:
    """Return V^-1 W^T z of all blocks (all their unknowns, q), for z (u + 1, q) of the reduced system, last row 0."""
    dim, runs, slot_first, slot_group = blocks.size, blocks.runs, blocks.first_slot, blocks.slot_group
    at_v, at_g, at_w, width = blocks.normals_at, blocks.slope_at, blocks.mixed_at, index.shape[1]
    out = np.zeros((dim.sum(), z.shape[1]))
    for r in range(runs.size - 1):
        b, count = runs[r], runs[r + 1] - runs[r]
        n, first = dim[b], slot_first[b]
        slots = slot_first[b + 1] - first
        wide = slots * width
        if slots == 0:
            continue
        own = _block_by_block(mixed, at_w[b], n, count, wide)
        gathered = np.empty((wide, z.shape[1]))
        for i in range(wide):
            row = index[slot_group[first + i // width], i % width]
            for k in range(z.shape[1]):
                gathered[i, k] = z[row, k]
        _times_inverse(inverse, at_v[b], n, count, np.dot(own, gathered), out[at_g[b] :])
    return out


@kernel(fastmath=FAST)
def carry_up(
    blocks: EliminatedBlocks, mixed: Array, inverse: Array, index: Array, unknowns: int, z: Array
) -> tuple[Array, Array, Array]:
    """Return W V^-1 z (u, q), V^-1 z and the sum of z^T V^-1 z (q, q), for z (all unknowns of the blocks, q)."""
    dim, runs, slot_first, slot_group = blocks.size, blocks.runs, blocks.first_slot, blocks.slot_group
    at_v, at_g, at_w = blocks.normals_at, blocks.slope_at, blocks.mixed_at
    width, columns = index.shape[1], z.shape[1]
    out, square, every = np.zeros((unknowns, columns)), np.zeros((columns, columns)), np.zeros_like(z)
    for r in range(runs.size - 1):
        b, count = runs[r], runs[r + 1] - runs[r]
        n, first, g = dim[b], slot_first[b], at_g[b]
        slots = slot_first[b + 1] - first
        rows, wide = count * n, slots * width
        if n == 0:
            continue
        pull = every[g : g + rows]
        _times_inverse(inverse, at_v[b], n, count, z[g : g + rows], pull)
        added = np.dot(z[g : g + rows].T, pull)
        for i in range(columns):
            for k in range(columns):
                square[i, k] += added[i, k]
        if slots == 0:
            continue
        own = _block_by_block(mixed, at_w[b], n, count, wide)
        up = np.dot(own.T, pull)
        for i in range(wide):
            row = index[slot_group[first + i // width], i % width]
            if row >= 0:
                for k in range(columns):
                    out[row, k] += up[i, k]
    return out, every, square
