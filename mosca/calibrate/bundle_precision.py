"""Precision and reliability of a bundle adjustment, block by block, compiled. The names are ``bundle_kernels``'."""

import numpy as np
from numba import njit

from mosca.calibrate.bundle_kernels import observe, weigh
from mosca.calibrate.bundle_lenses import FAST, IMAGED

LEAST_REDUNDANCY_NUMBER = 1e-6
"""An image point with less says nothing about itself: it cannot be tested."""


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def gather_pairs(cofactors, index, pair_of, out):  # type: ignore[no-untyped-def]
    """Write the cofactors (u, u) by pairs of groups (pairs, K, K), zero where an unknown is held."""
    out[:] = 0
    groups, width = index.shape
    for a in range(groups):
        for b in range(a, groups):
            pair = pair_of[a, b]
            if pair < 0:
                continue
            for i in range(width):
                for k in range(width):
                    if index[a, i] >= 0 and index[b, k] >= 0:
                        out[pair, i, k] = cofactors[index[a, i], index[b, k]]


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def precise(
    state, see, base_weight, columns, blocks, robust, normals, inverse, pairs, block_cofactors, tests
):  # type: ignore[no-untyped-def]
    """Write cofactors of the blocks and, of each image point, its residual and how it stands out.

    ``pairs``: cofactors of the groups by pairs; ``inverse``: V^-1; ``block_cofactors`` (as V): V^-1 W^T Q W V^-1 +
    V^-1. ``tests`` (n, 7): residual projected minus observed x, y [px]; the projection's cofactors xx, xy, yy over those of
    the image point a priori; v^T Q_vv^-1 v, of points left out e^T Q_ee^-1 e, NaN where it cannot be tested; and the
    robust weight.
    """
    dim, first_observation, slot_first, slot_group, at_v, at_g, at_w, _ = blocks
    camera_of, _, placement_of, xy_px, weight, offset, slot, kept, kept_slot = see
    _, _, group_slope, mixed, _, _, pair_of = normals
    loss, scale2 = robust
    width = group_slope.shape[1]
    most_slots, most = 1, max(dim.max(), 1)
    for b in range(dim.size):
        most_slots = max(most_slots, slot_first[b + 1] - slot_first[b])
    carried, spread = np.empty((most_slots, most, width)), np.empty((most_slots, most, width))
    out = np.empty(IMAGED)
    j, jb, jn = np.zeros((2, width)), np.empty((3, 2, 3)), np.empty((2, 6))
    for b in range(dim.size):
        n, v, first = dim[b], at_v[b], slot_first[b]
        slots = slot_first[b + 1] - first if n else 0
        # carried: V^-1 W^T (d block / d group, up to sign); spread: the same times Q
        for s in range(slots):
            for i in range(n):
                for k in range(width):
                    carried[s, i, k] = 0.0
                    spread[s, i, k] = 0.0
                for c in range(n):
                    f, line = inverse[v + i * n + c], at_w[first + s] + c * width
                    for k in range(width):
                        carried[s, i, k] += f * mixed[line + k]
        for s in range(slots):
            for t in range(s, slots):
                q = pairs[pair_of[slot_group[first + s], slot_group[first + t]]]
                for i in range(n):
                    for c in range(width):
                        f = carried[s, i, c]
                        for k in range(width):
                            spread[t, i, k] += f * q[c, k]
                    if s != t:
                        for c in range(width):
                            x = 0.0
                            for k in range(width):
                                x += q[c, k] * carried[t, i, k]
                            spread[s, i, c] += x
        for i in range(n):
            for k in range(n):
                x = inverse[v + i * n + k]
                for s in range(slots):
                    for c in range(width):
                        x += spread[s, i, c] * carried[s, k, c]
                block_cofactors[v + i * n + k] = x
        for m in range(first_observation[b], first_observation[b + 1]):
            seen = observe(m, state, see, columns, out, j, jb)
            if not seen:
                tests[m, :] = np.nan
                continue
            e0, e1 = out[0, 0] - xy_px[m, 0], out[1, 0] - xy_px[m, 1]
            camera, point = camera_of[m], kept[m]
            size = 0
            if n > 0:
                size = 6 if placement_of[m] >= 0 else 3
                for k in range(2):
                    for i in range(3):
                        if size == 6:
                            jn[k, i], jn[k, 3 + i] = jb[1, k, i], jb[0, k, i]
                        else:
                            jn[k, i] = jb[0, k, i]
            q00 = q01 = q11 = 0.0
            own = pairs[pair_of[camera, camera]]
            for i in range(width):
                f0 = f1 = 0.0
                for k in range(width):
                    f0 += own[i, k] * j[0, k]
                    f1 += own[i, k] * j[1, k]
                if point >= 0:
                    across = pairs[pair_of[camera, point]]
                    for k in range(3):
                        f0 += 2 * across[i, k] * jb[2, 0, k]
                        f1 += 2 * across[i, k] * jb[2, 1, k]
                if size:
                    s = slot[m] - first
                    for k in range(size):
                        f0 -= 2 * spread[s, offset[m] + k, i] * jn[0, k]
                        f1 -= 2 * spread[s, offset[m] + k, i] * jn[1, k]
                q00 += j[0, i] * f0
                q01 += (j[0, i] * f1 + j[1, i] * f0) / 2
                q11 += j[1, i] * f1
            if point >= 0:
                own = pairs[pair_of[point, point]]
                for i in range(3):
                    f0 = f1 = 0.0
                    for k in range(3):
                        f0 += own[i, k] * jb[2, 0, k]
                        f1 += own[i, k] * jb[2, 1, k]
                    if size:
                        s = kept_slot[m] - first
                        for k in range(size):
                            f0 -= 2 * spread[s, offset[m] + k, i] * jn[0, k]
                            f1 -= 2 * spread[s, offset[m] + k, i] * jn[1, k]
                    q00 += jb[2, 0, i] * f0
                    q01 += (jb[2, 0, i] * f1 + jb[2, 1, i] * f0) / 2
                    q11 += jb[2, 1, i] * f1
            for i in range(size):
                f0 = f1 = 0.0
                for k in range(size):
                    x = block_cofactors[v + (offset[m] + i) * n + offset[m] + k]
                    f0 += x * jn[0, k]
                    f1 += x * jn[1, k]
                q00 += jn[0, i] * f0
                q01 += jn[0, i] * f1
                q11 += jn[1, i] * f1
            base = base_weight[m] * base_weight[m]
            robust_weight = weigh((e0 * e0 + e1 * e1) * base, loss, scale2)[1]
            factor = base * robust_weight if weight[m] > 0 else base
            q00, q01, q11 = q00 * factor, q01 * factor, q11 * factor
            # residuals of points that take part vary less than the image points, of those left out more
            sign = -1.0 if weight[m] > 0 else 1.0
            v00, v01, v11 = 1 + sign * q00, sign * q01, 1 + sign * q11
            determinant = v00 * v11 - v01 * v01
            least = (v00 + v11) / 2 - np.sqrt(((v00 - v11) / 2) ** 2 + v01 * v01)
            tests[m, 0], tests[m, 1], tests[m, 2], tests[m, 3], tests[m, 4] = e0, e1, q00, q01, q11
            tests[m, 5] = np.nan
            if least > LEAST_REDUNDANCY_NUMBER:
                tests[m, 5] = factor * (e0 * e0 * v11 - 2 * e0 * e1 * v01 + e1 * e1 * v00) / determinant
            tests[m, 6] = robust_weight


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def carry_down(blocks, normals, inverse, index, z):  # type: ignore[no-untyped-def]
    """Return V^-1 W^T z of all blocks (all their unknowns, q), for z (u, q) of the reduced system."""
    dim, _, slot_first, slot_group, at_v, at_g, at_w, _ = blocks
    mixed, width, columns = normals[3], index.shape[1], z.shape[1]
    out = np.zeros((dim.sum(), columns))
    pull = np.empty((max(dim.max(), 1), columns))
    for b in range(dim.size):
        n = dim[b]
        pull[:n] = 0
        for s in range(slot_first[b], slot_first[b + 1]):
            for k in range(width):
                row = index[slot_group[s], k]
                if row >= 0:
                    for i in range(n):
                        for c in range(columns):
                            pull[i, c] += mixed[at_w[s] + i * width + k] * z[row, c]
        for i in range(n):
            for k in range(n):
                for c in range(columns):
                    out[at_g[b] + i, c] += inverse[at_v[b] + i * n + k] * pull[k, c]
    return out


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def carry_up(blocks, normals, inverse, index, unknowns, z):  # type: ignore[no-untyped-def]
    """Return W V^-1 z (u, q) and the sum of z^T V^-1 z (q, q), for z (all unknowns of the blocks, q)."""
    dim, _, slot_first, slot_group, at_v, at_g, at_w, _ = blocks
    mixed, width, columns = normals[3], index.shape[1], z.shape[1]
    out, square = np.zeros((unknowns, columns)), np.zeros((columns, columns))
    pull = np.empty((max(dim.max(), 1), columns))
    for b in range(dim.size):
        n = dim[b]
        pull[:n] = 0
        for i in range(n):
            for k in range(n):
                for c in range(columns):
                    pull[i, c] += inverse[at_v[b] + i * n + k] * z[at_g[b] + k, c]
        for i in range(n):
            for c in range(columns):
                for d in range(columns):
                    square[c, d] += z[at_g[b] + i, c] * pull[i, d]
        for s in range(slot_first[b], slot_first[b + 1]):
            for k in range(width):
                row = index[slot_group[s], k]
                if row >= 0:
                    for i in range(n):
                        for c in range(columns):
                            out[row, c] += mixed[at_w[s] + i * width + k] * pull[i, c]
    return out, square
