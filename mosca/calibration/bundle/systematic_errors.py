"""Systematic image errors, which repeated exposures of a stationary target share and which do not average out.

A lens is not quite its model, and a mark's image is not quite where its light is. While a target is stationary, these
errors are the same in each exposure, but least squares treats them as independent. Repeats separate them from noise
(pure error and lack of fit: Draper and Smith 1998, section 2.1): the mean residual of a mark that a camera saw n
times has the variance rho (sigma_L^2 + sigma_n^2 / n). sigma_n is estimated from the scatter among the n residuals;
rho is the share that the adjustment leaves in the residuals (redundancy numbers, Baarda 1968). Both errors are in
a-priori standard deviations: a dim, thin or saturated mark also has larger systematic errors, and its weight is as
low here as in the adjustment. The systematic errors add to the covariance of the parameters p

    C_L = N^-1 (sum over cells of g^T sigma_L^2 (1 - 1/n) g) N^-1,   g = sum over the cell of A^T W,

the covariance of estimates with errors correlated within cells; a cell is a mark in one stationary interval and
camera (White 1980; Liang and Zeger 1986). The part 1/n is already in the covariance of independent errors.
"""

import numpy as np

from mosca.calibration.bundle.adjustment import Adjustment
from mosca.calibration.bundle.exposure_shake import shifts_of
from mosca.calibration.bundle.problem import Problem
from mosca.data.arrays import Array

FEWEST_CELLS = 20
"""Fewest cells that a camera must have seen repeatedly for its systematic error to be estimated."""
LEAST_REDUNDANCY = 0.1
"""Cells whose mean residual the adjustment fits nearly away are left out."""


def systematic_errors(adjustment: Adjustment, camera: Array, cell: Array, sigma_px: Array) -> Array:
    """Return the systematic image errors (c,), rms an axis over a-priori standard deviations; NaN without repeats.

    ``adjustment``: with precision; ``camera`` (n,) of each observation; ``cell`` (n,) the same for observations by
    one camera of one mark in one stationary interval; ``sigma_px`` (n,) a priori.
    """
    assert adjustment.precision is not None
    cameras = len(adjustment.cameras)
    found = np.full(cameras, np.nan)
    used = np.flatnonzero(adjustment.used)
    _, first, of, count = np.unique(cell[used], return_index=True, return_inverse=True, return_counts=True)
    of = of.reshape(-1)
    residual = adjustment.residuals_px[used] / sigma_px[used, None]
    mean = np.column_stack([np.bincount(of, residual[:, k]) for k in (0, 1)]) / count[:, None]
    scatter = np.bincount(of, ((residual - mean[of]) ** 2).sum(axis=1)) / np.maximum(2 * (count - 1), 1)
    left = 1 - np.bincount(of, 1 - adjustment.precision.redundancy_numbers[used].mean(axis=1))
    told = (count >= 2) & (left >= LEAST_REDUNDANCY)
    excess = (mean**2).mean(axis=1) - left * scatter / count
    for c in range(cameras):
        mine = told & (camera[used][first] == c)
        if mine.sum() >= FEWEST_CELLS:
            found[c] = np.sqrt(max(float(excess[mine].sum() / left[mine].sum()), 0.0))
    return found


def systematic_covariance(problem: Problem, adjustment: Adjustment, cell: Array, lasting: Array) -> Array:
    """Return the matrix (u, u) that systematic errors add to the covariance of ``adjustment.parameters``.

    ``cell`` as for ``systematic_errors``; ``lasting`` (c,): result of ``systematic_errors``; NaN counts as 0.
    """
    if len(adjustment.parameters) == 0 or not np.nansum(lasting) > 0:
        return np.zeros((len(adjustment.parameters),) * 2)
    cells = shifts_of(problem, adjustment, cell, even=True)
    camera = np.zeros(len(cells.count), dtype=np.int64)
    camera[cells.image_of] = problem.observations.camera
    repeated = 1 - 1 / np.maximum(cells.count, 1)
    # a-priori variance of each cell, from the sum of its weights
    variance = cells.count / np.maximum(cells.d[::2], 1e-300)
    sigma = np.nan_to_num(lasting)[camera] * np.sqrt(repeated * variance)
    by_cell = cells.cofactors @ cells.g.T * np.repeat(sigma, 2) * cells.scale[:, None]
    return np.asarray(by_cell @ by_cell.T)
