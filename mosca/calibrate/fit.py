"""Least squares for one camera: Levenberg-Marquardt with the analytic Jacobians of ``mosca.camera``.

Unknowns are the camera's turn about its own axes (3), its position in the world (3) and the free lens
parameters, in that order. The turn is applied to the rotation after each step, so no angle has a
singular place. A shift of the principal point and a turn look nearly alike, which makes a long curved valley of the
sum of squares: a step therefore turns the camera along with its lens so that the ray of the points' middle
pixel stays where it is, and the unknown turn is what comes on top.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from scipy.spatial.transform import Rotation

from mosca.camera import lens_directions, project, project_with_jacobians
from mosca.data.arrays import Array
from mosca.data.rig import Camera, Lens, Pose

POSE_PARAMETERS = ("turn_x_rad", "turn_y_rad", "turn_z_rad", "X_m", "Y_m", "Z_m")
STEPS = 100
# residual of a point that the trial camera cannot image: it must not look like a perfect fit
UNSEEN_PX = 1e3
# share of the sum of squares that a step must promise and bring
CONVERGED = 1e-8
# for fits that only compare models or find outliers
ROUGHLY_CONVERGED = 1e-5
# scaled parameters; principal point and turn are nearly one, so that heavy damping crawls
FIRST_DAMPING = 1e-8
WORST_DAMPING = 1e8
# the least eigenvalue of the normal matrix scaled to a unit diagonal; below it two parameters are one
LEAST_EIGENVALUE = 1e-11


@dataclass(frozen=True, eq=False)
class Fit:
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
) -> Fit:
    """Fit pose and the ``free`` lens parameters to pixels (n, 2) of points (n, 3) [m].

    ``weights`` (n,) of the points (default 1); ``tolerance`` the share of the sum of squares by which a step
    must lower it to be followed by another. The other lens parameters stay as ``start`` has them.
    """
    columns = _columns(start.lens, free)
    root = np.ones(len(xyz)) if weights is None else np.sqrt(weights)
    camera, damping = start, FIRST_DAMPING
    pivot = np.median(xy_px, axis=0)
    residuals, jacobian = linearised(camera, free, xy_px, xyz)
    cost = _cost(residuals, root)
    for _ in range(STEPS):
        turning = _turn_by_lens(camera.lens, columns, pivot)
        along = jacobian.copy()
        along[:, :, 6:] += jacobian[:, :, :3] @ turning
        design = (along * root[:, None, None]).reshape(-1, along.shape[2])
        normal, slope = design.T @ design, design.T @ (residuals * root[:, None]).ravel()
        scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
        scaled, slope = normal / np.outer(scale, scale), slope / scale
        trial = None
        while damping < WORST_DAMPING:
            step = np.linalg.solve(scaled + damping * np.eye(len(scale)), slope)
            if step @ slope <= tolerance * cost:
                break  # not even the linear model promises a gain
            trial = _moved(camera, free, step / scale, pivot)
            if trial is not None:
                trial_residuals, trial_jacobian = linearised(trial, free, xy_px, xyz)
                trial_cost = _cost(trial_residuals, root)
                if trial_cost < cost:
                    break
            trial, damping = None, damping * 10
        if trial is None:
            break
        gained = cost - trial_cost
        camera, residuals, jacobian, cost = trial, trial_residuals, trial_jacobian, trial_cost
        damping = max(damping / 100, FIRST_DAMPING)
        if gained <= tolerance * cost:
            break
    return Fit(camera, tuple(free), residuals, jacobian, _cofactors(jacobian, root), cost)


def linearised(camera: Camera, free: Sequence[str], xy_px: Array, xyz: Array) -> tuple[Array, Array]:
    """Return the residuals (n, 2) of ``residuals_of`` and the projection's Jacobian (n, 2, p) as in ``Fit``."""
    projection = project_with_jacobians(camera, xyz)
    rest = np.nan_to_num(xy_px - projection.xy_px, nan=UNSEEN_PX)
    by_lens = projection.by_lens[:, :, _columns(camera.lens, free)]
    return rest, np.nan_to_num(np.concatenate([projection.by_pose, by_lens], axis=2))


def residuals_of(camera: Camera, xy_px: Array, xyz: Array) -> Array:
    """Return observed minus projected pixels (n, 2), UNSEEN_PX where a point is not imaged."""
    return np.nan_to_num(xy_px - project(camera, xyz), nan=UNSEEN_PX)


def _columns(lens: Lens, free: Sequence[str]) -> list[int]:
    names = [field.name for field in fields(lens)]
    return [names.index(name) for name in free]


def _cost(residuals: Array, root: Array) -> float:
    return float(np.sum((residuals * root[:, None]) ** 2))


def _turn_by_lens(lens: Lens, columns: Sequence[int], pivot_px: Array) -> Array:
    """Return d turn / d lens parameter (3, q) that keeps the ray of a pixel in the world."""
    ray = lens_directions(lens, pivot_px[None])
    if not np.isfinite(ray).all():
        return np.zeros((3, len(columns)))
    at_ray = project_with_jacobians(Camera("", 0, 0, lens, Pose(np.eye(3), np.zeros(3))), ray)
    moved = -np.linalg.pinv(at_ray.by_point[0]) @ at_ray.by_lens[0][:, list(columns)]
    return np.cross(moved.T, ray[0]).T


def _moved(camera: Camera, free: Sequence[str], step: Array, pivot_px: Array) -> Camera | None:
    """Return the camera after a step; None where the step leads to a lens that cannot be."""
    values = {name: getattr(camera.lens, name) + float(d) for name, d in zip(free, step[6:], strict=True)}
    if any(values.get(name, 1.0) <= 0 for name in ("c_mm", "my_mm_per_px", "fx_px", "fy_px")):
        return None
    lens: Lens = replace(camera.lens, **values)
    before, after = (lens_directions(one, pivot_px[None])[0] for one in (camera.lens, lens))
    along = _shortest_turn(after, before) if np.isfinite([before, after]).all() else Rotation.identity()
    old = camera.world_from_camera
    rotation = (Rotation.from_matrix(old.rotation) * along * Rotation.from_rotvec(step[:3])).as_matrix()
    return replace(camera, lens=lens, world_from_camera=Pose(rotation, old.translation + step[3:6]))


def _shortest_turn(start: Array, end: Array) -> Rotation:
    """Return the turn about the common normal that carries unit vector ``start`` to ``end``."""
    axis = np.cross(start, end)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-15:
        return Rotation.identity()
    return Rotation.from_rotvec(axis / sine * np.arctan2(sine, float(start @ end)))


def _cofactors(jacobian: Array, root: Array) -> Array | None:
    design = (jacobian * root[:, None, None]).reshape(-1, jacobian.shape[2])
    normal = design.T @ design
    scale = np.sqrt(np.diag(normal))
    if (scale == 0).any() or not np.isfinite(scale).all():
        return None
    values, vectors = np.linalg.eigh(normal / np.outer(scale, scale))
    if values[0] < LEAST_EIGENVALUE:
        return None
    return (vectors / values) @ vectors.T / np.outer(scale, scale)
