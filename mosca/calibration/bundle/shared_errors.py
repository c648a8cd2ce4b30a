"""Systematic errors that all cameras share: the edge of a shadow shifts a mark on its plate, whoever looks at it.

Such a shift p in the mark's plane, of one mark in one stationary interval (a *cluster*), has the image J p in each
camera. Its variance is estimated by the method of moments (Searle, Casella and McCulloch 1992, ch. 5) from products
of residuals of different cameras: with u = Z^T W v the weighted residuals of the cells of ``systematic_errors``, D
their weights and P the products ``J_i J_k^T`` of cells i, k of one cluster, i and k different,

    u^T K u,   K = D^-1 P D^-1,   has the expectation   tr(K B V B) + sigma_p^2 tr(K B P B),

V the variances of cells by themselves, B = Z^T W Z - Z^T W A N^-1 A^T W Z. The first term is what the unknowns make
residuals of one cluster alike. B is never formed: it is D less a matrix of the rank of the unknowns, blocks included.
"""

import numpy as np
from scipy.sparse import block_diag, coo_array, csr_array, diags_array, hstack

from mosca.calibration.bundle.adjustment import Adjustment
from mosca.calibration.bundle.exposure_shake import ExposureShifts
from mosca.calibration.bundle.problem import Problem
from mosca.camera.projection import project_with_jacobians
from mosca.data.arrays import Array

LEAST_LEFT = 1e-9
"""Cells of which the adjustment leaves less than this share of their errors count nothing."""


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


def shared_error(cells: ExposureShifts, camera: Array, cluster: Array, slopes: Array) -> float:
    """Return how far marks are shifted in their planes for all cameras alike [m rms, an axis]; 0: nothing shows it.

    Of each cell (i,): its ``camera``, its ``cluster``, whose other cells are other cameras', and ``slopes`` (i, 2, 2)
    as ``slopes_in_planes`` has them.
    """
    beside = csr_array(hstack([cells.s, csr_array(cells.g)]))
    inverse = csr_array(block_diag([cells.v_inverse, cells.cofactors]))
    left = 1 - np.asarray((beside @ inverse).multiply(beside).sum(axis=1)).ravel() / np.maximum(cells.d, 1e-300)
    told = (cells.d > 0) & (left > LEAST_LEFT)
    by_weight = np.where(told, 1 / np.maximum(cells.d, 1e-300), 0.0)
    squares, count = (cells.u * by_weight) ** 2, np.where(told, left, 0.0)
    cameras = int(camera.max(initial=0)) + 1
    of = np.repeat(camera, 2)
    own = np.bincount(of, squares, cameras) / np.maximum(np.bincount(of, count, cameras), 1e-300)
    across = products(cluster, slopes) - products(np.arange(len(cluster)), slopes)
    kernel = csr_array(diags_array(by_weight) @ across @ diags_array(by_weight))
    inner = (beside.T @ kernel @ beside).toarray() @ inverse.toarray()

    def expected(variance: csr_array) -> float:
        weighed = csr_array(diags_array(cells.d) @ variance)
        total = (kernel @ weighed @ diags_array(cells.d)).trace()
        total -= 2 * ((beside.T @ (kernel @ weighed) @ beside) @ inverse).trace()
        return float(total + np.trace(inner @ ((beside.T @ variance @ beside) @ inverse).toarray()))

    by_shift = expected(across)
    if not by_shift > 0:
        return 0.0
    excess = float(cells.u @ (kernel @ cells.u)) - expected(csr_array(diags_array(own[of])))
    return float(np.sqrt(max(excess / by_shift, 0.0)))


def products(cluster: Array, slopes: Array) -> csr_array:
    """Return J_i J_k^T (2i, 2i) of all cells i, k of the same ``cluster`` (i,); ``slopes`` (i, 2, 2)."""
    of, cells = np.unique(cluster, return_inverse=True)[1].reshape(-1), len(cluster)
    row, column = (
        np.broadcast_to(x, slopes.shape).ravel()
        for x in ((2 * np.arange(cells))[:, None, None] + np.arange(2)[:, None], (2 * of)[:, None, None] + np.arange(2))
    )
    by_shift = csr_array(coo_array((slopes.ravel(), (row, column)), shape=(2 * cells, 2 * cells)))
    return csr_array(by_shift @ by_shift.T)


def _plane_axes(normals: Array) -> Array:
    """Return two perpendicular unit vectors (p, 3, 2) in the planes with ``normals`` (p, 3)."""
    # the last two right singular vectors of a row are perpendicular to it
    return np.swapaxes(np.linalg.svd(normals[:, None, :])[2][:, 1:], 1, 2).copy()
