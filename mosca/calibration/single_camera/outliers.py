"""Blunders among measured points: gross ones by a robust fit, the rest by data snooping.

Data snooping after Baarda (1968), with the standard deviation estimated without the point under test, so that the
test is exact also for few points. The point with the largest standardised residual is rejected and the adjustment is
repeated; at the end the points that fit are readmitted.
"""

from collections.abc import Sequence

import numpy as np

from mosca.calibration.common.robust_fit import SIGMA_BY_MEDIAN_2D
from mosca.calibration.single_camera.least_squares import (
    ROUGHLY_CONVERGED,
    CameraFit,
    fit_camera,
    linearised,
    residuals_of,
)
from mosca.data.arrays import Array
from mosca.data.distributions import f as f_distribution
from mosca.data.rig import Camera

# Tukey's biweight: 95 % efficient for normal residuals
TUKEY = 4.685
ROBUST_ROUNDS = 8
GROSS_SIGMAS = 6.0
"""Robust standard deviations from which an image is a gross error."""
# residuals below this are rounding, whatever their ratio to each other
ROUNDING_PX = 1e-6
LEAST_REDUNDANCY = 3
PASSES = 10


def robust_points(
    start: Camera, nested: Sequence[tuple[str, ...]], xy_px: Array, xyz: Array, inliers: Array
) -> Array:
    """Return which points (n,) are no gross blunders, by redescending weights that start from ``inliers`` (n,).

    ``nested``: sets of free lens parameters, each richer than the one before. The last one that the points determine
    is used, since a lens term left out appears as blunders in the corners.
    """
    free, camera = nested[0], start
    for richer in nested:
        fit = fit_camera(camera, richer, xy_px[inliers], xyz[inliers], tolerance=ROUGHLY_CONVERGED)
        if fit.cofactors is None:
            break
        free, camera = richer, fit.camera
    near = inliers
    for _ in range(ROBUST_ROUNDS):
        distance = np.linalg.norm(residuals_of(camera, xy_px, xyz), axis=1)
        sigma = max(SIGMA_BY_MEDIAN_2D * float(np.median(distance)), ROUNDING_PX)
        before, near = near, distance < GROSS_SIGMAS * sigma
        if (near == before).all():
            break
        weights = np.clip(1 - (distance / (TUKEY * sigma)) ** 2, 0, 1) ** 2
        camera = fit_camera(camera, free, xy_px, xyz, weights, ROUGHLY_CONVERGED).camera
    return near


def snoop(fit: CameraFit, xy_px: Array, xyz: Array, used: Array, significance: float) -> tuple[CameraFit, Array]:
    """Return the fit without blunders and the points (n,) used; the free parameters stay those of ``fit``.

    ``significance``: chance that any point is rejected where there are no blunders.
    """
    level = significance / len(xy_px)
    for _ in range(PASSES):
        fit, used = _without_worst(fit, xy_px, xyz, used, level)
        back = _fitting_after_all(fit, xy_px, xyz, used, level)
        if not back.any():
            break
        used = used | back
        fit = fit_camera(fit.camera, fit.free, xy_px[used], xyz[used])
    return fit, used


def _without_worst(fit: CameraFit, xy_px: Array, xyz: Array, used: Array, level: float) -> tuple[CameraFit, Array]:
    """Reject the worst point and adjust again, until no point's residual is improbable."""
    used = used.copy()
    for _ in range(len(xy_px)):
        redundancy = 2 * int(used.sum()) - len(fit.parameters)
        if fit.cost < 2 * len(xy_px) * ROUNDING_PX**2 or redundancy - 2 < LEAST_REDUNDANCY:
            break
        statistic = _standardised(fit)
        worst = int(np.argmax(statistic))
        # variance from the other points, so that a blunder does not mask itself
        variance = max(fit.cost - statistic[worst], 1e-300) / (redundancy - 2)
        if f_distribution.sf(statistic[worst] / 2 / variance, 2, redundancy - 2) >= level:
            break
        used[np.flatnonzero(used)[worst]] = False
        fit = fit_camera(fit.camera, fit.free, xy_px[used], xyz[used])
    return fit, used


def _fitting_after_all(fit: CameraFit, xy_px: Array, xyz: Array, used: Array, level: float) -> Array:
    """Return which rejected points (n,) lie where the fit to the others predicts them."""
    back = np.zeros(len(used), dtype=bool)
    if used.all():
        return back
    residuals, slope = linearised(fit.camera, fit.free, xy_px[~used], xyz[~used])
    assert fit.cofactors is not None
    spread = np.eye(2) + slope @ fit.cofactors @ np.swapaxes(slope, 1, 2)
    squared = np.einsum("ni,nij,nj->n", residuals, np.linalg.inv(spread), residuals)
    redundancy = 2 * int(used.sum()) - len(fit.parameters)
    variance = max(fit.cost / redundancy, ROUNDING_PX**2)
    back[~used] = f_distribution.sf(squared / 2 / variance, 2, redundancy) >= level
    return back


def _standardised(fit: CameraFit) -> Array:
    """Return v^T Q_vv^-1 v of each point (n,), v its residual (2,) and Q_vv the cofactors of v."""
    assert fit.cofactors is not None
    cofactors = np.eye(2) - fit.jacobian @ fit.cofactors @ np.swapaxes(fit.jacobian, 1, 2)
    # a point that alone determines a parameter has no redundancy and cannot be tested
    testable = np.linalg.eigvalsh(cofactors)[:, 0] > 1e-6
    inverse = np.linalg.inv(np.where(testable[:, None, None], cofactors, np.eye(2)))
    squared = np.einsum("ni,nij,nj->n", fit.residuals, inverse, fit.residuals)
    return np.where(testable, squared, 0.0)
