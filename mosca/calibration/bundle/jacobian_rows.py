"""Image points of a bundle adjustment and their derivatives, batch by batch, compiled.

A *batch* is up to LANES consecutive image points of one camera. They have the same lens, so that each formula runs
over the whole batch before the next one, on several points at once in the processor's vectors. Intermediate results
are in ``work``, in rows of LANES numbers. The derivatives by the camera's unknowns are in ``j``, two rows (x, y) a
column. Both arrays are flat and the offsets of rows are constants, since the compiler must see that no row overlaps
another. The formulas are those of ``kernels.observe`` and ``lenses``, which treat one point at a time.
"""

import numpy as np

from mosca.calibration.bundle.kernels import LEAST_SQUARES, LENS, UNSEEN, weigh
from mosca.calibration.bundle.lenses import FAST, FOLD, MODEL, OPENCV_PLAIN, L, image
from mosca.calibration.bundle.tables import LensColumns, Loss, ParameterValues, SortedObservations
from mosca.data.arrays import Array
from mosca.numba_support.decorators import step

LANES, VECTOR = 64, 8
"""Largest number of image points of a batch, and the vector width to multiples of which a batch is padded."""
# offsets in ``work``: direction in the camera's frame (3), observed pixel (2), 1/sigma, whether imaged, then residual
# (2), derivatives of x and y by the direction (3 + 3) and by the lens parameters (18 + 18), by the block's unknowns
# (x, y of 6) and by the point where it is kept (x, y of 3)
V, SEEN, WEIGHT, THERE, E, A, LX, LY, BLOCK, OWN, ROOM = (LANES * k for k in (0, 3, 5, 6, 7, 9, 15, 33, 51, 63, 69))


@step(fastmath=FAST)
def gather(state: ParameterValues, see: SortedObservations, m: int, count: int, lanes: int, work: Array) -> None:
    """Write the direction of each point in the world from the camera, its pixel and its weight."""
    cameras, points, placements = state
    point_of, placement_of, xy_px, weight = see.point, see.placement, see.xy_px, see.weight
    c = cameras[see.camera[m]]
    for i in range(lanes):
        k = m + min(i, count - 1)
        p, f = points[point_of[k]], placement_of[k]
        x, y, z = p[0], p[1], p[2]
        if f >= 0:
            b = placements[f]
            x, y, z = (
                b[0] * p[0] + b[1] * p[1] + b[2] * p[2] + b[9],
                b[3] * p[0] + b[4] * p[1] + b[5] * p[2] + b[10],
                b[6] * p[0] + b[7] * p[1] + b[8] * p[2] + b[11],
            )
        work[V + i], work[V + LANES + i], work[V + 2 * LANES + i] = x - c[9], y - c[10], z - c[11]
        work[SEEN + i], work[SEEN + LANES + i] = xy_px[k, 0], xy_px[k, 1]
        work[WEIGHT + i] = weight[k] if i < count else 0.0


@step(fastmath=FAST)
def project(c: Array, lanes: int, w: Array, out: Array) -> None:
    """Rotate the directions into the camera's frame; write pixel (at E), derivatives and whether it is imaged."""
    r0, r1, r2, r3, r4, r5, r6, r7, r8 = c[0], c[1], c[2], c[3], c[4], c[5], c[6], c[7], c[8]
    for i in range(lanes):
        x, y, z = w[V + i], w[V + LANES + i], w[V + 2 * LANES + i]
        w[V + i], w[V + LANES + i] = r0 * x + r3 * y + r6 * z, r1 * x + r4 * y + r7 * z
        w[V + 2 * LANES + i] = r2 * x + r5 * y + r8 * z
    q, missing = c[LENS:], 0.0
    if q[MODEL] == OPENCV_PLAIN:
        missing = _opencv_plain(q, lanes, w)
    else:
        for i in range(lanes):
            there = image(q, w[V + i], w[V + LANES + i], w[V + 2 * LANES + i], out)
            w[THERE + i] = 1.0 if there else 0.0
            missing += 1 - w[THERE + i]
            w[E + i], w[E + LANES + i] = out[0, 0], out[1, 0]
            for k in range(3):
                w[A + k * LANES + i], w[A + (3 + k) * LANES + i] = out[0, 1 + k], out[1, 1 + k]
            for k in range(18):
                w[LX + k * LANES + i], w[LY + k * LANES + i] = out[0, L + k], out[1, L + k]
    if missing == 0:
        return
    # points that are not imaged have no derivatives: the computed ones may be NaN
    for i in range(lanes):
        if w[THERE + i] == 0.0:
            for k in range(0, 3 * LANES, LANES):
                w[V + k + i] = 0.0
            for k in range(E, BLOCK, LANES):
                w[k + i] = 0.0


@step(fastmath=FAST)
def _opencv_plain(q: Array, lanes: int, w: Array) -> float:
    """Apply ``lenses``' OpenCV model without rarely used coefficients to a batch; return how many are not imaged."""
    fx, fy, cx, cy, k1, k2, p1, p2, k3, fold = q[0], q[1], q[2], q[3], q[4], q[5], q[6], q[7], q[8], q[FOLD]
    missing = 0.0
    for i in range(lanes):
        v2 = w[V + 2 * LANES + i]
        iz = 1 / v2
        x, y = w[V + i] * iz, w[V + LANES + i] * iz
        xx, yy, xy2 = x * x, y * y, 2 * x * y
        r2 = xx + yy
        r4 = r2 * r2
        g, gs = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), k1 + r2 * (2 * k2 + r2 * 3 * k3)
        s, t = r2 + 2 * yy, r2 + 2 * xx
        xd, yd = x * g + p1 * xy2 + p2 * t, y * g + p1 * s + p2 * xy2
        a = g + 2 * xx * gs + 2 * p1 * y + 6 * p2 * x
        b = xy2 * gs + 2 * p1 * x + 2 * p2 * y
        d = g + 2 * yy * gs + 6 * p1 * y + 2 * p2 * x
        there = (v2 > 0) & (r2 < fold) & (a * d - b * b > 0) & (a + d > 0)
        w[THERE + i] = 1.0 if there else 0.0
        missing += 1 - w[THERE + i]
        w[E + i], w[E + LANES + i] = cx + fx * xd, cy + fy * yd
        n00, n01, n10, n11 = fx * a * iz, fx * b * iz, fy * b * iz, fy * d * iz
        w[A + i], w[A + LANES + i], w[A + 2 * LANES + i] = n00, n01, -(n00 * x + n01 * y)
        w[A + 3 * LANES + i], w[A + 4 * LANES + i], w[A + 5 * LANES + i] = n10, n11, -(n10 * x + n11 * y)
        u, v = fx * x, fy * y
        w[LX + i], w[LY + i], w[LX + LANES + i], w[LY + LANES + i] = xd, 0.0, 0.0, yd
        w[LX + 2 * LANES + i], w[LY + 2 * LANES + i] = 1.0, 0.0
        w[LX + 3 * LANES + i], w[LY + 3 * LANES + i] = 0.0, 1.0
        w[LX + 4 * LANES + i], w[LY + 4 * LANES + i] = u * r2, v * r2
        w[LX + 5 * LANES + i], w[LY + 5 * LANES + i] = u * r4, v * r4
        w[LX + 6 * LANES + i], w[LY + 6 * LANES + i] = fx * xy2, fy * s
        w[LX + 7 * LANES + i], w[LY + 7 * LANES + i] = fx * t, fy * xy2
        w[LX + 8 * LANES + i], w[LY + 8 * LANES + i] = u * r4 * r2, v * r4 * r2
    return missing


@step(fastmath=FAST)
def weighted_residuals(
    m: int, count: int, lanes: int, weight: Array, loss: Loss, w: Array, residual: Array
) -> tuple[float, int]:
    """Write the residuals, then weighted ones at E and their weights; return the cost and how many are unseen."""
    cost, unseen = 0.0, 0
    for i in range(lanes):
        x, y = w[E + i] - w[SEEN + i], w[E + LANES + i] - w[SEEN + LANES + i]
        w[SEEN + i], w[SEEN + LANES + i] = x, y
        w[WEIGHT + i] *= w[THERE + i]
        x, y = x * w[WEIGHT + i], y * w[WEIGHT + i]
        w[E + i], w[E + LANES + i] = x, y
        cost += x * x + y * y
    for i in range(count):
        if w[WEIGHT + i] > 0:
            residual[m + i, 0], residual[m + i, 1] = w[SEEN + i], w[SEEN + LANES + i]
        else:
            residual[m + i, 0] = residual[m + i, 1] = np.nan
            unseen += weight[m + i] > 0
    if loss.kind != LEAST_SQUARES:
        cost = 0.0
        for i in range(lanes):
            x, y = w[E + i], w[E + LANES + i]
            rho, factor = weigh(x * x + y * y, loss)
            root = np.sqrt(factor)
            cost += rho
            w[E + i], w[E + LANES + i], w[WEIGHT + i] = root * x, root * y, root * w[WEIGHT + i]
    return cost + unseen * weigh(2 * UNSEEN * UNSEEN, loss)[0], unseen


@step(fastmath=FAST)
def derive(c: Array, camera: int, columns: LensColumns, lanes: int, w: Array, j: Array) -> int:
    """Write the weighted derivatives by the camera's unknowns into ``j`` and by the point in the world at
    BLOCK; return the number of unknowns, made even by one without effect.
    """
    count, first, second, factor = columns
    r0, r1, r2, r3, r4, r5, r6, r7, r8 = c[0], c[1], c[2], c[3], c[4], c[5], c[6], c[7], c[8]
    for axis in range(2):
        to, by, block = axis * LANES, A + 3 * axis * LANES, BLOCK + axis * LANES
        for i in range(lanes):
            v0, v1, v2, root = w[V + i], w[V + LANES + i], w[V + 2 * LANES + i], w[WEIGHT + i]
            a0, a1, a2 = root * w[by + i], root * w[by + LANES + i], root * w[by + 2 * LANES + i]
            # v' = exp(-[w]x) v: dv/dw = [v]x
            j[to + i], j[to + 2 * LANES + i] = a1 * v2 - a2 * v1, a2 * v0 - a0 * v2
            j[to + 4 * LANES + i] = a0 * v1 - a1 * v0
            b0, b1, b2 = a0 * r0 + a1 * r1 + a2 * r2, a0 * r3 + a1 * r4 + a2 * r5, a0 * r6 + a1 * r7 + a2 * r8
            j[to + 6 * LANES + i], j[to + 8 * LANES + i], j[to + 10 * LANES + i] = -b0, -b1, -b2
            w[block + i], w[block + 2 * LANES + i], w[block + 4 * LANES + i] = b0, b1, b2
    for k in range(count[camera]):
        f = factor[camera, k]
        for axis in range(2):
            to, lens_rows = (2 * (6 + k) + axis) * LANES, LY if axis else LX
            one, two = lens_rows + first[camera, k] * LANES, lens_rows + second[camera, k] * LANES
            for i in range(lanes):
                j[to + i] = w[WEIGHT + i] * (w[one + i] + f * w[two + i])
    used = 6 + count[camera]
    if used % 2:
        j[2 * used * LANES : 2 * (used + 1) * LANES] = 0
        used += 1
    result: int = used
    return result


@step(fastmath=FAST)
def derive_placed(state: ParameterValues, see: SortedObservations, m: int, count: int, w: Array) -> None:
    """Convert the derivatives by the point in the world at BLOCK: write those by the rotation and the shift of the
    point's placement at BLOCK, and those by the point on its thing at OWN.
    """
    _, points, placements = state
    point_of, placement_of = see.point, see.placement
    for i in range(count):
        p, b = points[point_of[m + i]], placements[placement_of[m + i]]
        for axis in range(0, 2 * LANES, LANES):
            at, to = BLOCK + axis + i, OWN + axis + i
            b0, b1, b2 = w[at], w[at + 2 * LANES], w[at + 4 * LANES]
            w[at + 6 * LANES], w[at + 8 * LANES], w[at + 10 * LANES] = b0, b1, b2
            c0 = b0 * b[0] + b1 * b[3] + b2 * b[6]
            c1 = b0 * b[1] + b1 * b[4] + b2 * b[7]
            c2 = b0 * b[2] + b1 * b[5] + b2 * b[8]
            # x' = B exp([w]x) p: dx/dw = -B [p]x
            w[at], w[at + 2 * LANES], w[at + 4 * LANES] = (
                c2 * p[1] - c1 * p[2],
                c0 * p[2] - c2 * p[0],
                c1 * p[0] - c0 * p[1],
            )
            w[to], w[to + 2 * LANES], w[to + 4 * LANES] = c0, c1, c2
