"""Least squares for one camera and known points, by the bundle solver.

Unknowns are the camera's rotation about its own axes (3), its position in the world (3) and the free lens
parameters, in that order.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from mosca.calibration.bundle.solver import BundleSettings, CameraUnknowns, ObjectPoints, Observations, Problem, solve
from mosca.camera.projection import project, project_with_jacobians
from mosca.data.arrays import Array
from mosca.data.rig import Camera
from mosca.errors import CalibrationError

POSE_PARAMETERS = ("turn_x_rad", "turn_y_rad", "turn_z_rad", "X_m", "Y_m", "Z_m")
# residual of a point that the trial camera cannot image, so that it is not taken for a perfect fit
UNSEEN_PX = 1e3
# share of its standard deviation by which an unknown may still move
CONVERGED = 1e-3
# for fits that only compare models or find outliers
ROUGHLY_CONVERGED = 0.03
# least eigenvalue of the normal matrix scaled to a unit diagonal; below it two parameters cannot be separated
LEAST_EIGENVALUE = 1e-11


@dataclass(frozen=True, eq=False)
class CameraFit:
    """A camera fitted to points.

    ``free`` lens parameters; ``residuals`` (n, 2) observed minus projected [px], UNSEEN_PX where not imaged;
    ``jacobian`` (n, 2, p) of the projection; ``cofactors`` (p, p) inverse of the (weighted) normal matrix, None
    where the points do not determine all parameters; ``cost`` weighted sum of squares [px^2].
    """

    camera: Camera
    free: tuple[str, ...]
    residuals: Array
    jacobian: Array
    cofactors: Array | None
    cost: float

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the p unknowns."""
        return POSE_PARAMETERS + self.free


def fit_camera(
    start: Camera,
    free: Sequence[str],
    xy_px: Array,
    xyz: Array,
    weights: Array | None = None,
    tolerance: float = CONVERGED,
) -> CameraFit:
    """Fit the pose and the ``free`` lens parameters to pixels (n, 2) of points (n, 3) [m].

    ``weights`` (n,) of the points (default 1); ``tolerance`` the share of its standard deviation by which an
    unknown may still move. The other lens parameters stay as ``start`` has them; if the points do not determine an
    unknown, all stay.
    """
    weights = np.ones(len(xyz)) if weights is None else weights
    there = np.flatnonzero(weights > 0)
    seen = Observations(np.zeros(len(there)), there, xy_px[there], sigma_px=1 / np.sqrt(weights[there]))
    problem = Problem((CameraUnknowns(start, tuple(free)),), seen, ObjectPoints.fixed(xyz))
    settings = BundleSettings(tolerance=tolerance, hold_weak=False, precision=False)
    try:
        camera, determined = solve(problem, settings).cameras[0], True
    except CalibrationError:  # the caller handles a fit whose parameters are undetermined
        camera, determined = start, False
    residuals, jacobian = linearised(camera, free, xy_px, xyz)
    root = np.sqrt(weights)
    cofactors = _cofactors(jacobian, root) if determined else None
    cost = float(np.sum((residuals * root[:, None]) ** 2))
    return CameraFit(camera, tuple(free), residuals, jacobian, cofactors, cost)


def linearised(camera: Camera, free: Sequence[str], xy_px: Array, xyz: Array) -> tuple[Array, Array]:
    """Return the residuals (n, 2) of ``residuals_of`` and the projection's Jacobian (n, 2, p) as in ``CameraFit``."""
    projection = project_with_jacobians(camera, xyz)
    rest = np.nan_to_num(xy_px - projection.xy_px, nan=UNSEEN_PX)
    names = [field.name for field in fields(camera.lens)]
    by_lens = projection.by_lens[:, :, [names.index(name) for name in free]]
    return rest, np.nan_to_num(np.concatenate([projection.by_pose, by_lens], axis=2))


def residuals_of(camera: Camera, xy_px: Array, xyz: Array) -> Array:
    """Return observed minus projected pixels (n, 2), UNSEEN_PX where a point is not imaged."""
    result: Array = np.nan_to_num(xy_px - project(camera, xyz), nan=UNSEEN_PX)
    return result


def _cofactors(jacobian: Array, root: Array) -> Array | None:
    design = (jacobian * root[:, None, None]).reshape(-1, jacobian.shape[2])
    normal = design.T @ design
    scale = np.sqrt(np.diag(normal))
    if (scale == 0).any() or not np.isfinite(scale).all():
        return None
    values, vectors = np.linalg.eigh(normal / np.outer(scale, scale))
    if values[0] < LEAST_EIGENVALUE:
        return None
    result: Array | None = (vectors / values) @ vectors.T / np.outer(scale, scale)
    return result
