"""Normal equations of a bundle adjustment, block by block, compiled; the Jacobian is never stored.

The unknowns fall into *groups* that stay (a camera's pose and lens; a kept point) and *blocks* that are eliminated
(the coordinates of one point, or of points joined by known distances; the pose of a placed thing). Each block touches
few groups: a *slot* is one block in one group. With group normals U, block normals V and the mixed part W, a step
solves (U - W V^-1 W^T) d_groups = -(g - W V^-1 g_blocks) and then each block separately (Schur complement; Brown
1958, Triggs et al. 1999).

Residuals are projected minus observed, in standard deviations. The arrays are described in ``tables``.
"""

import numpy as np

from mosca.calibration.bundle.lenses import FAST, IMAGED, image
from mosca.calibration.bundle.tables import Loss, ParameterValues, SortedObservations
from mosca.data.arrays import Array
from mosca.numba_support.decorators import kernel, step

UNSEEN = 1e3
"""Residual, in standard deviations, of an image point that the trial camera cannot see: a misfit without gradient."""
LEAST_SQUARES, HUBER, CAUCHY = 0, 1, 2
LENS = 12
"""First column of a camera's lens row in the table of cameras."""
# derivatives of the pixel by the camera's pose (6), the point in the world, its placement's rotation, the point on it
BY_POSE, BY_WORLD, BY_ROTATION, BY_OWN, OBSERVED = IMAGED, IMAGED + 6, IMAGED + 9, IMAGED + 12, IMAGED + 15


@kernel(fastmath=FAST)
def weigh(u: float, loss: Loss) -> tuple[float, float]:
    """Robust loss and weight of the squared residual u (2-D, in standard deviations; Huber 1964, Cauchy)."""
    scale2 = loss.scale2
    if loss.kind == HUBER and u > scale2:
        root = np.sqrt(scale2 / u)
        return 2 * root * u - scale2, root
    if loss.kind == CAUCHY:
        return scale2 * np.log1p(u / scale2), 1 / (1 + u / scale2)
    return u, 1.0


@step(fastmath=FAST)
def observe(state: ParameterValues, see: SortedObservations, m: int, out: Array) -> bool:
    """Project the point of observation ``m``; return whether it is imaged.

    Writes ``out`` (2, 37): of x and y the pixel and its derivatives, at the indices named above.
    """
    cameras, points, placements = state
    camera, point, placement = see.camera[m], see.point[m], see.placement[m]
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
            out[k, BY_ROTATION], out[k, BY_ROTATION + 1] = c2 * p1 - c1 * p2, c0 * p2 - c2 * p0
            out[k, BY_ROTATION + 2] = c1 * p0 - c0 * p1
            b0, b1, b2 = c0, c1, c2
        out[k, BY_OWN], out[k, BY_OWN + 1], out[k, BY_OWN + 2] = b0, b1, b2
    return True


@kernel(fastmath=FAST)
def imaged(state: ParameterValues, see: SortedObservations, out: Array) -> None:
    """Write the residuals ``out`` (n, 2), projected minus observed [px]; NaN where the point is not imaged."""
    work = np.empty((2, OBSERVED))
    for m in range(out.shape[0]):
        if observe(state, see, m, work):
            out[m, 0], out[m, 1] = work[0, 0] - see.xy_px[m, 0], work[1, 0] - see.xy_px[m, 1]
        else:
            out[m, 0] = out[m, 1] = np.nan
