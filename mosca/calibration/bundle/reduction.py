"""Elimination of the blocks of a bundle adjustment, and back-substitution; compiled. Notation as in ``kernels``.

Blocks of one size that touch the same groups are consecutive. A *run* of them is one matrix, W^T of all these blocks
(rows by unknowns of the blocks, columns by slots), laid out as in ``normals``.
"""

import numpy as np

from mosca.calibration.bundle.lenses import FAST
from mosca.calibration.bundle.tables import EliminatedBlocks, NormalEquations
from mosca.data.arrays import Array
from mosca.numba_support.decorators import kernel, step

SINGULAR_PIVOT = 1e-13
"""Share of its diagonal that a pivot of a block must keep; below it the direction is undetermined and is held."""
MOST_ROWS = 384
"""Largest number of unknowns of a run, so that its matrices stay in the processor's cache."""


@step(fastmath=FAST)
def invert(matrix: Array, at: int, n: int, damping: float, lower: Array, inverse: Array) -> None:
    """Invert the symmetric n x n block at ``matrix[at:]``, its diagonal times 1 + damping, by Cholesky's method.

    Writes the inverse to the same offset of ``inverse``; ``lower`` is a work array. A direction that the block
    does not determine (SINGULAR_PIVOT) is held: its rows of the inverse are zero.
    """
    for i in range(n):
        diagonal = matrix[at + i * n + i] * (1 + damping)
        for k in range(i + 1):
            s = diagonal if k == i else matrix[at + i * n + k]
            for c in range(k):
                s -= lower[i, c] * lower[k, c]
            if k < i:
                lower[i, k] = s * lower[k, k]
            else:
                lower[i, i] = 1 / np.sqrt(s) if s > SINGULAR_PIVOT * diagonal else 0.0
    # the inverse of the triangle in place (its diagonal is inverted already)
    for i in range(n):
        for k in range(i):
            s = 0.0
            for c in range(k, i):
                s -= lower[i, c] * lower[c, k]
            lower[i, k] = s * lower[i, i]
    for i in range(n):
        for k in range(i + 1):
            s = 0.0
            for c in range(i, n):
                s += lower[c, i] * lower[c, k]
            inverse[at + i * n + k] = s
            inverse[at + k * n + i] = s


@step(fastmath=FAST)
def invert_three(m: Array, at: int, damping: float, out: Array) -> None:
    """``invert`` for a 3 x 3 block, written out: most blocks are one point."""
    d0, d1, d2 = m[at] * (1 + damping), m[at + 4] * (1 + damping), m[at + 8] * (1 + damping)
    p0 = 1 / d0 if d0 > 0 else 0.0
    l1, l2 = m[at + 3] * p0, m[at + 6] * p0
    s1, s12 = d1 - l1 * m[at + 3], m[at + 7] - l1 * m[at + 6]
    p1 = 1 / s1 if s1 > SINGULAR_PIVOT * d1 else 0.0
    l12 = s12 * p1
    s2 = d2 - l2 * m[at + 6] - l12 * s12
    p2 = 1 / s2 if s2 > SINGULAR_PIVOT * d2 else 0.0
    # a held direction is also left out of the others
    l2, l12 = (l2, l12) if p2 > 0 else (0.0, 0.0)
    l1 = l1 if p1 > 0 else 0.0
    k2 = l1 * l12 - l2
    out[at], out[at + 4], out[at + 8] = p0 + l1 * l1 * p1 + k2 * k2 * p2, p1 + l12 * l12 * p2, p2
    out[at + 1] = out[at + 3] = -l1 * p1 - k2 * l12 * p2
    out[at + 2] = out[at + 6] = k2 * p2
    out[at + 5] = out[at + 7] = -l12 * p2


@step(fastmath=FAST)
def _carry(inverse: Array, at: int, n: int, size: int, own: Array, each: Array, out: Array) -> None:
    """Write W V^-1 of a run (columns, n size) into ``out``.

    ``own``: its W; ``each`` (n n, size): work array for its V^-1, element by element.
    """
    for one in range(size):
        for i in range(n * n):
            each[i, one] = inverse[at + one * n * n + i]
    for column in range(own.shape[0]):
        line, to = own[column], out[column]
        for i in range(n):
            row = i * size
            # block sizes are multiples of three
            for k in range(0, n, 3):
                f0, f1, f2 = each[i * n + k], each[i * n + k + 1], each[i * n + k + 2]
                x, y, z = line[k * size :], line[(k + 1) * size :], line[(k + 2) * size :]
                if k == 0:
                    for one in range(size):
                        to[row + one] = f0[one] * x[one] + f1[one] * y[one] + f2[one] * z[one]
                else:
                    for one in range(size):
                        to[row + one] += f0[one] * x[one] + f1[one] * y[one] + f2[one] * z[one]


@step(fastmath=FAST)
def _products(own: Array, carried: Array, out: Array) -> None:
    """Write own carried^T (columns, columns), which is symmetric: half of it, two lines by two at once, is summed.

    Columns are even (``layout.LANE``). For these sizes about twice as fast as a general matrix product.
    """
    columns, rows = own.shape
    for i in range(0, columns, 2):
        one, two = own[i], own[i + 1]
        for k in range(i, columns, 2):
            three, four = carried[k], carried[k + 1]
            s0 = s1 = s2 = s3 = 0.0
            for r in range(rows):
                s0 += one[r] * three[r]
                s1 += one[r] * four[r]
                s2 += two[r] * three[r]
                s3 += two[r] * four[r]
            out[i, k], out[i, k + 1], out[i + 1, k], out[i + 1, k + 1] = s0, s1, s2, s3
            out[k, i], out[k + 1, i], out[k, i + 1], out[k + 1, i + 1] = s0, s1, s2, s3


@kernel(fastmath=FAST)
def reduce_to_groups(
    blocks: EliminatedBlocks,
    normals: NormalEquations,
    damping: float,
    inverse: Array,
    pairs: Array,
    reduced_slope: Array,
) -> None:
    """Eliminate the blocks: writes W V^-1 W^T into ``pairs`` and g - W V^-1 g_blocks into ``reduced_slope``.

    ``pairs`` (n_pairs, K, K) is by pairs of groups, the lower group first; ``inverse`` keeps the V^-1.
    """
    dim, runs, slot_first, slot_group = blocks.size, blocks.runs, blocks.first_slot, blocks.slot_group
    at_v, at_g, at_w = blocks.normals_at, blocks.slope_at, blocks.mixed_at
    group_slope, mixed, pair_of = normals.group_slope, normals.mixed, normals.pair_of
    block_normals, block_slope = normals.blocks, normals.block_slope
    width = group_slope.shape[1]
    lower = np.zeros((dim.max(), dim.max()))
    pairs[:] = 0
    for a in range(group_slope.shape[0]):
        for i in range(width):
            reduced_slope[a, i] = group_slope[a, i]
    for r in range(runs.size - 1):
        b, size = runs[r], runs[r + 1] - runs[r]
        n, first = dim[b], slot_first[b]
        slots = slot_first[b + 1] - first
        for one in range(b, b + size):
            if n == 3:
                invert_three(block_normals, at_v[one], damping, inverse)
            else:
                invert(block_normals, at_v[one], n, damping, lower, inverse)
        if slots == 0:
            continue
        rows, columns = size * n, slots * width
        own = mixed[at_w[b] : at_w[b] + rows * columns].reshape(columns, rows)
        carried = np.empty((columns, rows))
        _carry(inverse, at_v[b], n, size, own, np.empty((n * n, size)), carried)
        product = np.empty((columns, columns))
        _products(own, carried, product)
        slope = np.empty(rows)
        for one in range(size):
            for i in range(n):
                slope[i * size + one] = block_slope[at_g[b] + one * n + i]
        pull = np.dot(carried, slope)
        for s in range(slots):
            for i in range(width):
                reduced_slope[slot_group[first + s], i] -= pull[s * width + i]
            for t in range(s, slots):
                pair = pairs[pair_of[slot_group[first + s], slot_group[first + t]]]
                for i in range(width):
                    for k in range(width):
                        pair[i, k] += product[s * width + i, t * width + k]


@kernel(fastmath=FAST)
def scatter(normals: NormalEquations, pairs: Array, index: Array, damping: float, out: Array) -> None:
    """Write the reduced normal matrix ``out`` (n, n); ``index`` (groups, K) holds each group's columns in it.

    ``pairs``: matrices that the elimination subtracts. Groups may share columns (a common lens).
    """
    group_normals, cross, pair_of = normals.groups, normals.cross, normals.pair_of
    groups, width = index.shape
    out[:] = 0
    for a in range(groups):
        for b in range(a, groups):
            pair = pair_of[a, b]
            if pair < 0:
                continue
            for i in range(width):
                row = index[a, i]
                if row < 0:
                    continue
                for k in range(width):
                    column = index[b, k]
                    if column < 0:
                        continue
                    x = cross[pair, i, k] - pairs[pair, i, k]
                    if a == b:
                        x += group_normals[a, i, k] * (1 + damping if i == k else 1.0)
                    else:
                        out[column, row] += x
                    out[row, column] += x


@kernel(fastmath=FAST)
def back_substitute(
    blocks: EliminatedBlocks,
    normals: NormalEquations,
    damping: float,
    inverse: Array,
    group_step: Array,
    block_step: Array,
) -> float:
    """Write the step of every block, given that of the groups (groups, K); return the blocks' predicted decrease."""
    dim, runs, slot_first, slot_group = blocks.size, blocks.runs, blocks.first_slot, blocks.slot_group
    at_v, at_g, at_w = blocks.normals_at, blocks.slope_at, blocks.mixed_at
    mixed, block_normals, block_slope = normals.mixed, normals.blocks, normals.block_slope
    width = normals.group_slope.shape[1]
    promised = 0.0
    for r in range(runs.size - 1):
        b, size = runs[r], runs[r + 1] - runs[r]
        n, first, g = dim[b], slot_first[b], at_g[b]
        slots = slot_first[b + 1] - first
        rows, columns = size * n, slots * width
        pull = np.zeros(rows)
        if slots:
            step = np.empty(columns)
            for s in range(slots):
                for i in range(width):
                    step[s * width + i] = group_step[slot_group[first + s], i]
            pull = np.dot(step, mixed[at_w[b] : at_w[b] + rows * columns].reshape(columns, rows))
        for one in range(size):
            v, own = at_v[b + one], g + one * n
            for i in range(n):
                x = 0.0
                for k in range(n):
                    x -= inverse[v + i * n + k] * (block_slope[own + k] + pull[k * size + one])
                block_step[own + i] = x
                promised += x * (damping * block_normals[v + i * n + i] * x - block_slope[own + i])
    return promised


@kernel
def sorted_by(key: Array, size: int, before: Array) -> Array:
    """Return the order ``before`` (n,) sorted by ``key`` (n,), whole numbers below ``size``, by counting: equal ones
    keep their order.
    """
    order, first = np.empty(before.size, np.int64), np.zeros(size + 1, np.int64)
    for m in range(key.size):
        first[key[m] + 1] += 1
    for k in range(size):
        first[k + 1] += first[k]
    for m in before:
        order[first[key[m]]] = m
        first[key[m]] += 1
    return order


@kernel
def find_runs(dim: Array, slot_first: Array, slot_group: Array) -> Array:
    """Return where the runs of blocks begin, and their end: same size, same groups, at most MOST_ROWS unknowns."""
    starts = np.empty(dim.size + 1, dtype=np.int64)
    count = 0
    # block 0 has no unknowns and stays by itself
    for b in range(dim.size):
        if count:
            before = starts[count - 1]
            same = dim[b] == dim[before] and (b - before + 1) * dim[b] <= MOST_ROWS
            s, t = slot_first[b], slot_first[before]
            slots = slot_first[b + 1] - s
            same = same and slots == slot_first[before + 1] - t
            k = 0
            while same and k < slots:
                same = slot_group[s + k] == slot_group[t + k]
                k += 1
            if same:
                continue
        starts[count] = b
        count += 1
    starts[count] = dim.size
    return starts[: count + 1].copy()


@kernel
def pair_table(slot_first: Array, slot_group: Array, kept: Array, cameras: Array, groups: int) -> tuple[Array, int]:
    """Number the pairs of groups (groups, groups), lower first, that a block or observation joins; -1 elsewhere."""
    pair_of = np.full((groups, groups), -1, dtype=np.int64)
    for a in range(groups):
        pair_of[a, a] = a
    count = groups
    for m in range(kept.size):
        if kept[m] >= 0 and pair_of[cameras[m], kept[m]] < 0:
            pair_of[cameras[m], kept[m]] = count
            count += 1
    for b in range(slot_first.size - 1):
        for s in range(slot_first[b], slot_first[b + 1]):
            for t in range(s, slot_first[b + 1]):
                if pair_of[slot_group[s], slot_group[t]] < 0:
                    pair_of[slot_group[s], slot_group[t]] = count
                    count += 1
    return pair_of, count
