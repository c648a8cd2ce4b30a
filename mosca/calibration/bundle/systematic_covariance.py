"""Covariance of parameters where systematic errors do not average out.

Exposures of one mark in one stationary interval and camera, a *cell*, are replaced by their mean, with the variance
that ``systematic_weights`` has found: what they share is counted once. On top come what all marks of an interval
share in one camera (uneven light, a body that has moved; the mixed model of ``exposure_shake``), and what all cameras
share of one mark (``shared_errors``).
"""

from dataclasses import replace

import numpy as np
from scipy.sparse import diags_array

from mosca.calibration.bundle.adjustment import Adjustment
from mosca.calibration.bundle.exposure_shake import body_shake, shaken_covariance, shifts_of
from mosca.calibration.bundle.problem import Observations, Problem
from mosca.calibration.bundle.shared_errors import products, shared_error, slopes_in_planes
from mosca.calibration.bundle.solver import BundleSettings, solve
from mosca.calibration.bundle.systematic_weights import CellWeights
from mosca.data.arrays import Array


def systematic_covariance(
    problem: Problem, adjustment: Adjustment, cell: Array, weights: CellWeights, normals: Array | None
) -> Array:
    """Return the covariance (u, u) of ``adjustment.parameters``.

    ``cell`` (n,) of each observation, numbered from 0, ``weights`` of the cells; ``normals`` (p, 3) of the object
    points, in their own frames, in whose planes cameras share shifts; None: they share none.
    """
    means = _of_means(problem, adjustment, cell, weights.variance)
    found = solve(means, BundleSettings(), adjustment)
    interval = np.asarray(means.observations.placement) + 1
    alone = shaken_covariance(means, found, interval, body_shake(means, found, interval))
    if normals is None or len(alone) == 0:
        return weights.excess * alone
    cells = shifts_of(means, found, np.arange(len(interval)), even=True)
    row = np.empty(len(interval), dtype=np.int64)
    row[cells.image_of] = np.arange(len(interval))
    variance = np.asarray(means.observations.sigma_px)[row] ** 2
    # marks that are less certain are shifted farther
    slopes = slopes_in_planes(means, found, normals)[row] * np.sqrt(variance)[:, None, None]
    cluster = np.column_stack([interval, means.observations.point])[row]
    cluster = np.unique(cluster, axis=0, return_inverse=True)[1].reshape(-1)
    shared = products(cluster, slopes * shared_error(cells, variance, cluster, slopes))
    # on the average of all cells both parts are what there is
    part = min(float((shared.diagonal() / np.repeat(variance, 2)).mean()), 1.0)
    between = shared - part * diags_array(np.repeat(variance, 2))
    by_cell = cells.cofactors @ cells.g.T * cells.scale[:, None]
    return np.asarray(weights.excess * (alone + by_cell @ (between @ by_cell.T)))


def _of_means(problem: Problem, adjustment: Adjustment, cell: Array, variance: Array) -> Problem:
    """Return the problem with one observation for each cell, the mean of those used, of a ``variance`` (i,)."""
    see, used = problem.observations, np.flatnonzero(adjustment.used)
    cells, first, of, count = np.unique(cell[used], return_index=True, return_inverse=True, return_counts=True)
    of, first = of.reshape(-1), used[first]
    xy = np.column_stack([np.bincount(of, np.asarray(see.xy_px)[used, k]) for k in (0, 1)]) / count[:, None]
    camera, point, placement = (np.asarray(x)[first] for x in (see.camera, see.point, see.placement))
    return replace(problem, observations=Observations(camera, point, xy, placement, np.sqrt(variance[cells])))
