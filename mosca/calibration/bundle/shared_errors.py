"""Systematic errors that all cameras share: the edge of a shadow shifts a mark on its plate, whoever looks at it.

Such a shift p in the mark's plane, of one mark in one stationary interval (a *cluster*), has the image J p in each
camera. Its variance is estimated by the method of moments (Searle, Casella and McCulloch 1992, ch. 5) from products
of residuals of different cameras: with u = Z^T W v the weighted residuals of the cells of ``systematic_errors`` and P
the products ``J_i J_k^T`` of cells i, k of one cluster, i and k different,

    u^T P u   has the expectation   tr(P B V B) + sigma_p^2 tr(P B P B),

V the variances of cells by themselves, B = Z^T W Z - Z^T W A N^-1 A^T W Z. The first term is what the unknowns make
residuals of one cluster alike. B is never formed: it is diagonal less a matrix of the rank of the unknowns, blocks
included.
"""

import numpy as np
from scipy.sparse import block_diag, coo_array, csr_array, diags_array, hstack

from mosca.calibration.bundle.adjustment import Adjustment
from mosca.calibration.bundle.exposure_shake import ExposureShifts
from mosca.calibration.bundle.problem import Problem
from mosca.camera.projection import project_with_jacobians
from mosca.data.arrays import Array


def slopes_in_planes(problem: Problem, adjustment: Adjustment, normals: Array) -> Array:
    """Return how image points move with their marks (n, 2, 2) [px/m], by two perpendicular axes in the marks' planes.

    ``normals`` (p, 3) of the object points, any length, in their own frames.
    """
    see = problem.observations
    point, placement = np.asarray(see.point), np.asarray(see.placement)
    at, axes = np.asarray(adjustment.points)[point], _plane_axes(np.asarray(normals))[point]
    placed = np.flatnonzero(placement >= 0)
    rotation = adjustment.placements.rotation[placement[placed]]
    at[placed] = np.einsum("nij,nj->ni", rotation, at[placed]) + adjustment.placements.translation[placement[placed]]
    axes[placed] = rotation @ axes[placed]
    slopes = np.zeros((len(point), 2, 2))
    for k, camera in enumerate(adjustment.cameras):
        mine = np.flatnonzero(see.camera == k)
        slopes[mine] = np.nan_to_num(project_with_jacobians(camera, at[mine]).by_point @ axes[mine])
    return slopes


def shared_error(cells: ExposureShifts, variance: Array, cluster: Array, slopes: Array) -> float:
    """Return how far marks are shifted in their planes for all cameras alike [rms, an axis]; 0: nothing shows it.

    Of each cell (i,): the ``variance`` of its mean error [px^2], its ``cluster``, whose other cells are other
    cameras', and ``slopes`` (i, 2, 2) by the shift.
    """
    beside = csr_array(hstack([cells.s, csr_array(cells.g)]))
    inverse = csr_array(block_diag([cells.v_inverse, cells.cofactors]))
    kernel = csr_array(products(cluster, slopes) - products(np.arange(len(cluster)), slopes))
    inner = (beside.T @ kernel @ beside).toarray() @ inverse.toarray()

    def expected(errors: csr_array) -> float:
        weighed = csr_array(diags_array(cells.d) @ errors)
        total = (kernel @ weighed @ diags_array(cells.d)).trace()
        total -= 2 * ((beside.T @ (kernel @ weighed) @ beside) @ inverse).trace()
        return float(total + np.trace(inner @ ((beside.T @ errors @ beside) @ inverse).toarray()))

    by_shift = expected(kernel)
    if not by_shift > 0:
        return 0.0
    alone = expected(csr_array(diags_array(np.repeat(variance, 2))))
    return float(np.sqrt(max((float(cells.u @ (kernel @ cells.u)) - alone) / by_shift, 0.0)))


def products(cluster: Array, slopes: Array) -> csr_array:
    """Return J_i J_k^T (2i, 2i) of all cells i, k of the same ``cluster`` (i,); ``slopes`` (i, 2, 2)."""
    of, cells = np.unique(cluster, return_inverse=True)[1].reshape(-1), len(cluster)
    row, column = (
        np.broadcast_to(x, slopes.shape).ravel()
        for x in (
            (2 * np.arange(cells))[:, None, None] + np.arange(2)[:, None],
            (2 * of)[:, None, None] + np.arange(2),
        )
    )
    by_shift = csr_array(coo_array((slopes.ravel(), (row, column)), shape=(2 * cells, 2 * cells)))
    return csr_array(by_shift @ by_shift.T)


def _plane_axes(normals: Array) -> Array:
    """Return two perpendicular unit vectors (p, 3, 2) in the planes with ``normals`` (p, 3)."""
    # the last two right singular vectors of a row are perpendicular to it
    return np.swapaxes(np.linalg.svd(normals[:, None, :])[2][:, 1:], 1, 2).copy()
