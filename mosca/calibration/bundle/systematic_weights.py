"""Weights of systematic errors: most marks are seen where they are, a few in shadow are off by ten times as much.

The mean residuals of the cells of ``systematic_errors`` follow a bivariate t-distribution (Lange, Little and Taylor
1989, "Robust statistical modeling using the t distribution"): normal, with a variance of each cell's own,

    w = (nu + 2) / (nu + q),   q = |mean residual|^2 / (rho s^2 b),

its weight w given what the residual tells, rho the redundancy. s of each camera and nu, one for all, have the largest
likelihood. Of normal errors nu is large and w is 1. b is how cells differ beforehand: the systematic variance of
their camera and the noise of their n exposures.
"""

from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.special import gammaln

from mosca.calibration.bundle.adjustment import Adjustment
from mosca.calibration.bundle.systematic_errors import LEAST_REDUNDANCY
from mosca.data.arrays import Array

MOST_TAILED, NORMAL = 1.0, 100.0
"""Degrees of freedom between which nu is looked for: a Cauchy distribution, and nearly a normal one."""
STEPS = 30
"""Of the scales' fixed point for a nu: at nu = 1 each leaves a half or less of the way."""


class CellWeights(NamedTuple):
    """``variance`` (i,) of the mean error of each cell, a coordinate [px^2]; ``excess``: factor by which the variance
    of estimates with these weights is above that of known variances.
    """

    variance: Array
    excess: float


def cell_weights(
    adjustment: Adjustment, camera: Array, cell: Array, sigma_px: Array, lasting_px: Array
) -> CellWeights:
    """Return the variances of cells (numbered from 0) from their mean residuals.

    ``adjustment``: with precision. Of each observation (n,): ``camera``, ``cell``, ``sigma_px`` of detection;
    ``lasting_px`` (c,) as ``systematic_errors`` has it, NaN: cells of this camera keep the variance of their noise.
    """
    assert adjustment.precision is not None
    used, cells = np.flatnonzero(adjustment.used), int(cell.max()) + 1
    count = np.bincount(cell[used], minlength=cells)
    left = 1 - np.bincount(cell[used], 1 - adjustment.precision.redundancy_numbers[used].mean(axis=1), cells)
    mean = np.column_stack([np.bincount(cell[used], adjustment.residuals_px[used, k], cells) for k in (0, 1)])
    of = np.zeros(cells, dtype=np.int64)
    of[cell] = camera
    noise = np.bincount(cell, sigma_px**2, cells) / np.maximum(np.bincount(cell, minlength=cells), 1)
    variance = np.nan_to_num(lasting_px)[of] ** 2 + noise / np.maximum(count, 1)
    told = np.flatnonzero((count > 0) & (left >= LEAST_REDUNDANCY) & np.isfinite(lasting_px)[of])
    if not len(told):
        return CellWeights(variance, 1.0)
    squares = (mean[told] ** 2).sum(axis=1) / count[told] ** 2 / left[told] / variance[told]
    nu, scale = _fitted(squares, of[told])
    seen = np.isfinite(lasting_px)
    variance *= np.where(seen, scale, 1.0)[of]
    variance[told] *= (nu + squares / scale[of[told]]) / (nu + 2)
    # Fisher information of a t-distribution's location, and the mean of w, which is 1
    return CellWeights(variance, (nu + 4) / (nu + 2))


def _fitted(squares: Array, camera: Array) -> tuple[float, Array]:
    """Return nu and the squared scale (c,) of each camera of cells' ``squares`` (i,) of both coordinates together."""
    cameras = int(camera.max()) + 1
    count = np.maximum(np.bincount(camera, minlength=cameras), 1)

    def scales(nu: float) -> Array:
        scale = np.maximum(np.bincount(camera, squares, cameras) / count / 2, 1e-12)
        for _ in range(STEPS):
            weighted = squares * (nu + 2) / (nu + squares / scale[camera])
            scale = np.maximum(np.bincount(camera, weighted, cameras) / count / 2, 1e-12)
        return scale

    def misfit(log_nu: float) -> float:
        nu = float(np.exp(log_nu))
        scale = scales(nu)[camera]
        each = gammaln(nu / 2 + 1) - gammaln(nu / 2) - np.log(nu) - np.log(scale)
        return -float((each - (nu / 2 + 1) * np.log1p(squares / scale / nu)).sum())

    bounds = (np.log(MOST_TAILED), np.log(NORMAL))
    nu = float(np.exp(minimize_scalar(misfit, bounds=bounds, method="bounded").x))
    return nu, scales(nu)
