"""Elimination of the blocks of a bundle adjustment, and the way back; compiled. The names are ``bundle_kernels``'."""

import numpy as np
from numba import njit

from mosca.calibrate.bundle_kernels import SINGULAR_PIVOT
from mosca.calibrate.bundle_lenses import FAST


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def invert(matrix, at, n, damping, lower, inverse):  # type: ignore[no-untyped-def]
    """Invert the symmetric n x n block at ``matrix[at:]``, its diagonal times 1 + damping, by Cholesky's method.

    Writes the inverse to the same place of ``inverse``; ``lower`` is room to work. A direction that the block does
    not determine (SINGULAR_PIVOT) is held: its rows of the inverse are zero. Returns how many were held.
    """
    held = 0
    for i in range(n):
        diagonal = matrix[at + i * n + i] * (1 + damping)
        for k in range(i + 1):
            s = diagonal if k == i else matrix[at + i * n + k]
            for c in range(k):
                s -= lower[i, c] * lower[k, c]
            if k < i:
                lower[i, k] = s * lower[k, k]
            elif s > SINGULAR_PIVOT * diagonal:
                lower[i, i] = 1 / np.sqrt(s)
            else:
                lower[i, i] = 0.0
                held += 1
    # the inverse of the triangle in its own place (its diagonal already stands inverted)
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
    return held


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def reduce_to_groups(blocks, normals, damping, inverse, pairs, reduced_slope):  # type: ignore[no-untyped-def]
    """Eliminate the blocks: writes W V^-1 W^T into ``pairs`` and g - W V^-1 g_blocks into ``reduced_slope``.

    ``pairs`` (n_pairs, K, K) is by pairs of groups, the lower group first; ``inverse`` keeps the V^-1. Returns the
    number of directions in blocks that nothing determines.
    """
    dim, _, slot_first, slot_group, at_v, at_g, at_w, _ = blocks
    _, _, group_slope, mixed, block_normals, block_slope, pair_of = normals
    width = group_slope.shape[1]
    most = dim.max()
    lower, carried = np.zeros((most, most)), np.empty((most, width))
    pairs[:] = 0
    reduced_slope[:] = group_slope
    held = 0
    for b in range(dim.size):
        n, v, g = dim[b], at_v[b], at_g[b]
        if n == 0:
            continue
        held += invert(block_normals, v, n, damping, lower, inverse)
        for s in range(slot_first[b], slot_first[b + 1]):
            group, w = slot_group[s], at_w[s]
            for i in range(n):
                for k in range(width):
                    carried[i, k] = 0.0
                for c in range(0, n, 3):
                    f0, f1, f2 = (
                        inverse[v + i * n + c],
                        inverse[v + i * n + c + 1],
                        inverse[v + i * n + c + 2],
                    )
                    line = w + c * width
                    for k in range(width):
                        carried[i, k] += (
                            f0 * mixed[line + k]
                            + f1 * mixed[line + width + k]
                            + f2 * mixed[line + 2 * width + k]
                        )
                pull = block_slope[g + i]
                for k in range(width):
                    reduced_slope[group, k] -= carried[i, k] * pull
            for t in range(s, slot_first[b + 1]):
                pair, w2 = pairs[pair_of[group, slot_group[t]]], at_w[t]
                # block dimensions are multiples of three
                for c in range(0, n, 3):
                    line = w2 + c * width
                    for i in range(width):
                        f0, f1, f2 = carried[c, i], carried[c + 1, i], carried[c + 2, i]
                        for k in range(width):
                            pair[i, k] += (
                                f0 * mixed[line + k]
                                + f1 * mixed[line + width + k]
                                + f2 * mixed[line + 2 * width + k]
                            )
    return held


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def scatter(normals, pairs, index, damping, out):  # type: ignore[no-untyped-def]
    """Write the reduced normal matrix ``out`` (n, n); ``index`` (groups, K) holds each group's columns in it.

    ``pairs``: what the elimination takes away. Groups may share columns (a common lens).
    """
    group_normals, cross, _, _, _, _, pair_of = normals
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


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def back_substitute(blocks, normals, damping, inverse, group_step, block_step):  # type: ignore[no-untyped-def]
    """Write the step of every block, given that of the groups (groups, K); return the blocks' promised decrease."""
    dim, _, slot_first, slot_group, at_v, at_g, at_w, _ = blocks
    _, _, group_slope, mixed, block_normals, block_slope, _ = normals
    width = group_slope.shape[1]
    pull = np.empty(dim.max())
    promised = 0.0
    for b in range(dim.size):
        n, v, g = dim[b], at_v[b], at_g[b]
        for i in range(n):
            pull[i] = block_slope[g + i]
        for s in range(slot_first[b], slot_first[b + 1]):
            step = group_step[slot_group[s]]
            for i in range(n):
                line, x = at_w[s] + i * width, 0.0
                for k in range(width):
                    x += mixed[line + k] * step[k]
                pull[i] += x
        for i in range(n):
            x = 0.0
            for k in range(n):
                x -= inverse[v + i * n + k] * pull[k]
            block_step[g + i] = x
            promised += x * (damping * block_normals[v + i * n + i] * x - block_slope[g + i])
    return promised


@njit(nogil=True, cache=True, error_model="numpy")
def pair_table(blocks, kept, cameras, groups):  # type: ignore[no-untyped-def]
    """Number the pairs of groups (groups, groups), lower first, that some block or observation joins; -1 elsewhere."""
    _, _, slot_first, slot_group, _, _, _, _ = blocks
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
