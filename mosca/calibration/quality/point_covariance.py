"""The calibration's share in the covariance of triangulated points, apart from the measurement's.

A point follows from its images by N = sum J_c^T S_c^-1 J_c, so that the calibration's parameters p move it by
G = -N^-1 sum J_c^T S_c^-1 dx_c/dp and give it G C_pp G^T (``mosca.calibration.quality.accuracy_map`` shows it on a
grid). It is common to all points and frames and does not average out: it is never added to the measurement's.
"""

import numpy as np

from mosca.calibration.quality.jacobian import sensitivity
from mosca.data.arrays import Array
from mosca.data.calibration import Calibration


def calibration_covariance(calibration: Calibration, xyz: Array, seen: Array) -> Array:
    """Return the covariance (n, 3, 3) [m^2] that the calibration's own error gives to points ``xyz`` (n, 3) [m].

    ``seen`` (n, c): which cameras measured each point (``points.rays >= 0``),
    all equally well. NaN where fewer than two cameras saw a point.
    """
    shift = calibration_shift(calibration, xyz, seen)
    return np.asarray(shift @ calibration.covariance @ np.swapaxes(shift, 1, 2))


def calibration_shift(calibration: Calibration, xyz: Array, seen: Array) -> Array:
    """Return how far (n, 3, u) the true points lie from measured ones for each unit that a parameter is told too
    large; arguments as of ``calibration_covariance``, NaN likewise.
    """
    xyz, seen = np.asarray(xyz, dtype=float).reshape(-1, 3), np.asarray(seen, dtype=bool)
    total = np.zeros((len(xyz), 3, 3))
    pull = np.zeros((len(xyz), 3, len(calibration.parameters)))
    for c in range(len(calibration.rig.cameras)):
        rows = np.flatnonzero(seen[:, c])
        one = sensitivity(calibration.rig, c, calibration.parameters, xyz[rows])
        weighted = np.swapaxes(one.by_point, 1, 2)
        total[rows] += weighted @ one.by_point
        pull[np.ix_(rows, np.arange(3), one.columns)] += weighted @ one.by_parameter
    good = seen.sum(axis=1) >= 2
    shift = np.full(pull.shape, np.nan)
    shift[good] = np.linalg.solve(total[good], pull[good])
    return shift
