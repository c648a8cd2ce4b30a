"""The calibration's contribution to the covariance of triangulated points, apart from the measurement's.

With the normal matrix N = sum J_c^T S_c^-1 J_c of a point, the calibration's parameters p move the point by
G = -N^-1 sum J_c^T S_c^-1 dx_c/dp and give it the covariance G C_pp G^T (``mosca.calibration.quality.accuracy_map``
shows it on a grid). It is common to all points and frames and does not average out, so it is never added to the
measurement's.
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
    good, shift, columns = _shift(calibration, xyz, seen)
    # one large product instead of one for each point
    moved = shift.reshape(-1, len(columns)) @ calibration.covariance[np.ix_(columns, columns)]
    covariance = np.full((len(good), 3, 3), np.nan)
    covariance[good] = moved.reshape(shift.shape) @ np.swapaxes(shift, 1, 2)
    return covariance


def calibration_shift(calibration: Calibration, xyz: Array, seen: Array) -> Array:
    """Return the shifts (n, 3, u) of the true points against the measured ones for each unit by which a parameter is
    stated too large; arguments and NaN as for ``calibration_covariance``.
    """
    good, shift, columns = _shift(calibration, xyz, seen)
    every = np.full((len(good), 3, len(calibration.parameters)), np.nan)
    every[good] = 0.0 * shift.sum(axis=(1, 2), keepdims=True)  # NaN where a lens images nothing
    every[np.ix_(good, np.arange(3), columns)] = shift
    return every


def _shift(calibration: Calibration, xyz: Array, seen: Array) -> tuple[Array, Array, Array]:
    """Return which points (n,) two cameras or more see, their shift (m, 3, k) by the k parameters of the cameras, and
    the indices of these parameters. The others, most of a session's, are those of the target's points and poses; they
    move no point that the cameras measure.
    """
    xyz, seen = np.asarray(xyz, dtype=float).reshape(-1, 3), np.asarray(seen, dtype=bool)
    good = seen.sum(axis=1) >= 2
    xyz, rows = xyz[good], [np.flatnonzero(one) for one in seen[good].T]
    derivatives = [
        sensitivity(calibration.rig, c, calibration.parameters, xyz[chosen]) for c, chosen in enumerate(rows)
    ]
    columns = np.unique(np.concatenate([one.columns for one in derivatives]))
    total, pull = np.zeros((len(xyz), 3, 3)), np.zeros((len(xyz), 3, len(columns)))
    for chosen, one in zip(rows, derivatives, strict=True):
        weighted = np.swapaxes(one.by_point, 1, 2)
        total[chosen] += weighted @ one.by_point
        pull[np.ix_(chosen, np.arange(3), np.searchsorted(columns, one.columns))] += weighted @ one.by_parameter
    return good, np.linalg.solve(total, pull), columns
