"""Pose of a known rigid target in the frame of a calibrated camera: linear initial values, refined; two for a plane.

If a target's projection is nearly parallel, its image hardly changes when the target's relief is inverted along the
line of sight. For a solid target the two images differ. For a plane only perspective distinguishes them (Oberkampf,
DeMenthon and Davis 1996), so that both poses are returned, the better-fitting one first.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from mosca.calibration.common.robust_fit import SIGMA_BY_MEDIAN_2D
from mosca.camera.projection import cross_matrices
from mosca.data.arrays import Array
from mosca.data.rig import Pose
from mosca.data.rotations import nearest_rotation

FEWEST_POINTS = 4
FEWEST_SOLID = 6
LEAST_RELIEF = 0.05
"""Ratio of the third to the first extent of points below which they are treated as a plane with some relief."""
FLAT = 1e-6
"""Ratio of the least to the largest singular value below which points lie in a plane."""
STEPS = 30
SAME_RAD = 1e-3
"""Angle below which two poses are one solution [rad]."""
TUKEY = 4.685
"""Tuning constant of Tukey's biweight: 95 % efficiency for normal errors (Huber 1981)."""


@dataclass(frozen=True, eq=False)
class TargetPoseFit:
    """A pose ``camera_from_target`` and its fit: ``rms_rad`` is the root mean square distance of the rays, without
    the points that do not fit (``used`` (n,) bool).
    """

    camera_from_target: Pose
    rms_rad: float
    used: Array


def poses_of(directions: Array, points: Array, *, robust: bool = True) -> tuple[TargetPoseFit, ...]:
    """Return the poses (best first, one or two) of target points (n, 3) [m] seen along unit rays (n, 3).

    The result is empty where fewer than four points are seen or no pose has all of them before the camera.
    """
    good = np.asarray(np.isfinite(directions).all(axis=1))
    if good.sum() < FEWEST_POINTS:
        return ()
    rays, there = directions[good], points[good]
    found: list[TargetPoseFit] = []
    for start in _starts(rays, there):
        fit = _refined(start, rays, there, robust)
        if fit is not None and not any(_same(fit, other) for other in found):
            found.append(fit)
    found.sort(key=lambda fit: fit.rms_rad)
    return tuple(_widened(fit, good) for fit in found[:2])


def homography(plane: Array, image: Array) -> Array:
    """Return H (3, 3), of norm 1, with image (n, 2) ~ H plane (n, 2), by the normalised linear solution."""
    a, b = _normaliser(plane), _normaliser(image)
    p = np.column_stack([plane, np.ones(len(plane))]) @ a.T
    q = np.column_stack([image, np.ones(len(image))]) @ b.T
    none = np.zeros_like(p)
    rows = np.concatenate([np.hstack([p, none, -q[:, :1] * p]), np.hstack([none, p, -q[:, 1:2] * p])])
    matrix = np.linalg.inv(b) @ np.linalg.svd(rows)[2][-1].reshape(3, 3) @ a
    return np.asarray(matrix / np.linalg.norm(matrix))


def plane_of(points: Array) -> tuple[Array, Array, float]:
    """Return middle (3,) and axes (3, 3; columns, the last one normal) of the best plane, and the relative relief."""
    middle = points.mean(axis=0)
    sizes, axes = np.linalg.svd(points - middle, full_matrices=False)[1:]
    axes = axes.T if np.linalg.det(axes) > 0 else axes.T * [1, 1, -1]
    return middle, axes, float(sizes[2] / max(sizes[0], 1e-300))


def _starts(rays: Array, points: Array) -> list[Pose]:
    middle, axes, relief = plane_of(points)
    starts = []
    if len(points) >= FEWEST_SOLID and relief > LEAST_RELIEF:
        solid = _solid_start(rays, points)
        starts += [] if solid is None else [solid]
    # view along the mean ray, so that wide views also have a plane image
    view = rays.mean(axis=0)
    view /= np.linalg.norm(view)
    turn = _rotated_to(view)
    seen = rays @ turn
    if (seen[:, 2] > 1e-3).all():
        local = (points - middle) @ axes
        flat = _plane_start(local[:, :2], seen[:, :2] / seen[:, 2:])
        if flat is not None:
            for one in (flat, _mirrored(flat)):
                rotation = turn @ one.rotation @ axes.T
                starts.append(Pose(rotation, turn @ one.translation - rotation @ middle))
    return starts


def _rotated_to(z: Array) -> Array:
    side = np.array([1.0, 0.0, 0.0]) if abs(z[0]) < 0.7 else np.array([0.0, 1.0, 0.0])
    y = np.cross(z, side)
    y /= np.linalg.norm(y)
    return np.column_stack([np.cross(y, z), y, z])


def _plane_start(plane: Array, image: Array) -> Pose | None:
    """Return the pose of plane points (n, 2), z = 0, from their normalised image (n, 2)."""
    matrix = homography(plane, image)
    if matrix[2, 2] < 0:
        matrix = -matrix
    size = (np.linalg.norm(matrix[:, 0]) + np.linalg.norm(matrix[:, 1])) / 2
    if not size > 0 or not matrix[2, 2] > 0:
        return None
    matrix = matrix / size
    first, second = matrix[:, 0], matrix[:, 1]
    rotation = nearest_rotation(np.column_stack([first, second, np.cross(first, second)]))[0]
    return Pose(rotation, matrix[:, 2])


def _mirrored(pose: Pose) -> Pose:
    """Return the pose of the plane whose relief along the line of sight is inverted."""
    view = pose.translation / np.linalg.norm(pose.translation)
    flip = np.eye(3) - 2 * np.outer(view, view)
    axes = flip @ pose.rotation
    return Pose(axes * [1, 1, -1], pose.translation)


def _solid_start(rays: Array, points: Array) -> Pose | None:
    """Return the pose of points in space by the linear solution (DLT) with known interior orientation."""
    middle = points.mean(axis=0)
    scale = float(np.sqrt(np.mean((points - middle) ** 2)))
    p = np.column_stack([(points - middle) / scale, np.ones(len(points))])
    rows = []
    for i, j in ((1, 2), (2, 0), (0, 1)):
        row = np.zeros((len(p), 12))
        row[:, 4 * j : 4 * j + 4], row[:, 4 * i : 4 * i + 4] = rays[:, i, None] * p, -rays[:, j, None] * p
        rows.append(row)
    matrix = np.linalg.svd(np.concatenate(rows), full_matrices=False)[2][-1].reshape(3, 4)
    if np.median(np.einsum("ni,ni->n", p @ matrix.T, rays)) < 0:
        matrix = -matrix
    left, sizes, right = np.linalg.svd(matrix[:, :3])
    if np.linalg.det(left @ right) <= 0 or sizes[2] <= 1e-6 * sizes[0]:
        return None
    rotation = left @ right
    translation = matrix[:, 3] * scale / sizes.mean()
    return Pose(rotation, translation - rotation @ middle)


def _refined(start: Pose, rays: Array, points: Array, robust: bool) -> TargetPoseFit | None:
    """Return the least-squares pose from ``start``; None where points end up behind the camera.

    Residuals are taken in the plane across each ray, so that every lens is treated alike.
    """
    across = _across(rays)
    rotation, translation = start.rotation, start.translation
    middle = points.mean(axis=0)  # rotate about the target's middle: rotation and shift are nearly separate
    translation = translation + rotation @ middle
    local = points - middle
    weight = np.ones(len(points))
    damping, cost = 1e-6, np.inf
    residual, slope = _residuals(rotation, translation, rays, across, local)
    if residual is None or slope is None:
        return None
    for step in range(STEPS):
        cost = float((weight * (residual**2).sum(axis=1)).sum())
        design = slope.reshape(-1, 6) * np.sqrt(weight).repeat(2)[:, None]
        target = residual.reshape(-1) * np.sqrt(weight).repeat(2)
        normal, right = design.T @ design, design.T @ target
        moved = False
        for _ in range(10):
            by = -np.linalg.solve(normal + damping * np.diag(np.diag(normal)) + 1e-300 * np.eye(6), right)
            trial = rotation @ Rotation.from_rotvec(by[:3]).as_matrix(), translation + by[3:]
            new, new_slope = _residuals(*trial, rays, across, local)
            if new is not None and (weight * (new**2).sum(axis=1)).sum() <= cost:
                rotation, translation, residual, slope = *trial, new, new_slope
                damping, moved = max(damping / 10, 1e-12), True
                break
            damping *= 10
        gained = cost - float((weight * (residual**2).sum(axis=1)).sum())
        if robust and step >= 2 and len(points) > FEWEST_SOLID:
            distance = np.linalg.norm(residual, axis=1)
            sigma = max(SIGMA_BY_MEDIAN_2D * float(np.median(distance)), 1e-9)
            weight = np.clip(1 - (distance / (TUKEY * 2 * sigma)) ** 2, 0, 1) ** 2
        if not moved or (gained <= 1e-10 * cost and step >= 4):
            break
        assert slope is not None
    used = weight > 0
    rms = float(np.sqrt((weight * (residual**2).sum(axis=1)).sum() / max(weight.sum(), 1e-300)))
    return TargetPoseFit(Pose(rotation, translation - rotation @ middle), rms, used)


def _residuals(
    rotation: Array, translation: Array, rays: Array, across: Array, points: Array
) -> tuple[Array | None, Array | None]:
    """Return residuals (n, 2) [tangent] and their slope (n, 2, 6) by rotation and shift; None behind the camera."""
    v = points @ rotation.T + translation
    depth = np.einsum("ni,ni->n", rays, v)
    if not (depth > 1e-9).all():
        return None, None
    residual = np.einsum("nki,ni->nk", across, v) / depth[:, None]
    by_v = (across - residual[:, :, None] * rays[:, None, :]) / depth[:, None, None]
    turned = by_v @ rotation
    # v' = R exp([w]x) p: dv/dw = -R [p]x
    return residual, np.concatenate([-turned @ cross_matrices(points), by_v], axis=2)


def _across(rays: Array) -> Array:
    """Return two unit vectors (n, 2, 3) normal to each ray."""
    side = np.where(np.abs(rays[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    first = np.cross(rays, side)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(rays, first)], axis=1)


def _same(one: TargetPoseFit, other: TargetPoseFit) -> bool:
    turn = one.camera_from_target.rotation.T @ other.camera_from_target.rotation
    return bool(np.linalg.norm(turn - np.eye(3)) < SAME_RAD)


def _widened(fit: TargetPoseFit, good: Array) -> TargetPoseFit:
    used = np.zeros(len(good), dtype=bool)
    used[good] = fit.used
    return TargetPoseFit(fit.camera_from_target, fit.rms_rad, used)


def _normaliser(points: Array) -> Array:
    middle = points.mean(axis=0)
    scale = 1 / max(float(np.sqrt(np.mean((points - middle) ** 2))), 1e-300)
    return np.array([[scale, 0, -scale * middle[0]], [0, scale, -scale * middle[1]], [0, 0, 1.0]])
