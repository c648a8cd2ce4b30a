"""Space resection without starting values: one camera's interior and exterior orientation from known points.

The direct linear transformation (Abdel-Aziz and Karara 1971) gives the 3 x 4 projection matrix of at least six
points that do not lie in one plane; its factors are the camera. Random samples scored by the median residual
(Rousseeuw 1984; concentration steps of Rousseeuw and Van Driessen 1999) tolerate up to about a third of
blunders. The result has no distortion; ``mosca.calibration.single_camera.adjust`` starts from it.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import rq

from mosca.calibration.common.robust_fit import SIGMA_BY_MEDIAN_2D
from mosca.camera.projection import lens_directions, lens_pixels
from mosca.data.arrays import Array
from mosca.data.rig import FisheyeLens, OpenCVLens, Pose
from mosca.errors import CalibrationError

FEWEST_POINTS = 6
# rms distance from the best plane over the largest rms extent: below it the principal distance and the distance
# to the camera cannot be distinguished
LEAST_RELIEF = 5e-3
SAMPLES = 300
SAMPLES_A_FIELD_ANGLE = 60
KEPT_SAMPLES = 10
CONCENTRATION_STEPS = 3
INLIER_SIGMAS = 4.0
"""Robust standard deviations up to which an image is an inlier."""
# with a median residual beyond this share of the image's extent no camera fits, whatever its distortion
WORST_MEDIAN_SHARE = 0.05
FISHEYE_HALF_ANGLES_DEG = range(20, 125, 10)


@dataclass(frozen=True, eq=False)
class Resection:
    """A camera without distortion.

    ``lens`` pinhole or equidistant; ``inliers`` (n,) bool, points that agree; ``median_px`` the median
    distance of all points from their projection.
    """

    lens: OpenCVLens | FisheyeLens
    world_from_camera: Pose
    inliers: Array
    median_px: float


def resect(where: str, xy_px: Array, xyz: Array, rng: np.random.Generator) -> Resection:
    """Resect a pinhole camera from pixels (n, 2) and world points (n, 3) [m], n >= 6.

    ``where`` begins the error messages (for instance "camera 'left'"); ``rng`` draws the samples.
    The skew that the linear solution allows is dropped. CalibrationError for fewer than 6 points, points in
    a plane or on a line, mirrored points, points on both sides of the camera, or no camera that fits.
    """
    xy, world = _checked(where, xy_px, xyz)
    centre = xy.mean(axis=0)
    scale = float(max(np.sqrt(np.mean((xy - centre) ** 2)), 1e-12))
    image = np.column_stack([(xy - centre) / scale, np.ones(len(xy))])
    matrix, inliers = _robust_matrix(where, image, world, rng)
    back = np.array([[scale, 0, centre[0]], [0, scale, centre[1]], [0, 0, 1.0]])
    interior, rotation, origin = _factors(where, back @ matrix, world[inliers], len(world))
    lens = OpenCVLens(*(float(interior[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2))))
    pose = Pose(rotation.T, origin)
    # points are judged by the residual of the linear solution (with its skew), not by that of the pinhole
    homogeneous = np.column_stack([world, np.ones(len(world))]) @ (back @ matrix).T
    distance = np.linalg.norm(homogeneous[:, :2] / homogeneous[:, 2:] - xy, axis=1)
    median = float(np.median(distance))
    if median > WORST_MEDIAN_SHARE * np.ptp(xy, axis=0).max():
        raise CalibrationError(
            f"{where}: no camera fits these points (half of them are more than {median:.1f} px off); "
            "check that each row pairs a pixel with its own target point, and the order of the columns"
        )
    return Resection(lens, pose, inliers, median)


def resect_fisheye(
    where: str, size: tuple[int, int], xy_px: Array, xyz: Array, rng: np.random.Generator
) -> Resection:
    """Resect an equidistant camera of ``size`` (width, height) with its axis in the middle of the image.

    Tries field angles and keeps the one whose rays meet the points best; for narrow fields the resected pinhole
    is good enough. Arguments and errors as for ``resect``; points beside and behind the camera are allowed here.
    """
    xy, world = _checked(where, xy_px, xyz)
    cx, cy = (size[0] - 1) / 2, (size[1] - 1) / 2
    found: list[Resection] = []
    failures: list[CalibrationError] = []
    try:
        pinhole = resect(where, xy, world, rng)
        f = float(np.sqrt(pinhole.lens.fx_px * pinhole.lens.fy_px))
        pose = aim(pinhole, (cx, cy))
        found.append(_evaluated(FisheyeLens(f, f, cx, cy), pose, xy, world))
    except CalibrationError as failure:
        failures.append(failure)
    radius = np.linalg.norm(xy - (cx, cy), axis=1).max()
    for half_angle in np.deg2rad(FISHEYE_HALF_ANGLES_DEG):
        f = radius / half_angle
        lens = FisheyeLens(f, f, cx, cy)
        matrix, _ = _robust_matrix(where, lens_directions(lens, xy), world, rng, SAMPLES_A_FIELD_ANGLE)
        left, sizes, right = np.linalg.svd(matrix[:, :3])
        if np.linalg.det(left @ right) > 0 and sizes[2] > 1e-6 * sizes[0]:
            origin = -np.linalg.solve(matrix[:, :3], matrix[:, 3])
            found.append(_evaluated(lens, Pose((left @ right).T, origin), xy, world))
    if not found:
        raise failures[0]
    best = min(found, key=lambda candidate: candidate.median_px)
    if best.median_px > WORST_MEDIAN_SHARE * np.ptp(xy, axis=0).max():
        raise (
            failures[0]
            if failures
            else CalibrationError(
                f"{where}: no fisheye camera fits these points (half of them are more than "
                f"{best.median_px:.1f} px off); check the pairs, or try the lens model 'opencv'"
            )
        )
    return best


def aim(resection: Resection, centre_px: tuple[float, float]) -> Pose:
    """Return the pose rotated so that its z axis is the ray of ``centre_px``.

    If the principal point is then held at ``centre_px``, the image moves little, since a shift of the principal
    point and a small rotation of a camera cannot be separated.
    """
    z = lens_directions(resection.lens, np.array([centre_px]))[0]
    y = np.cross(z, [1.0, 0.0, 0.0])
    y /= np.linalg.norm(y)
    turn = np.column_stack([np.cross(y, z), y, z])
    return Pose(resection.world_from_camera.rotation @ turn, resection.world_from_camera.translation)


def _checked(where: str, xy_px: Array, xyz: Array) -> tuple[Array, Array]:
    xy = np.asarray(xy_px, dtype=float).reshape(-1, 2)
    world = np.asarray(xyz, dtype=float).reshape(-1, 3)
    if len(xy) != len(world):
        raise ValueError(f"{where}: {len(xy)} pixels and {len(world)} points given")
    if not (np.isfinite(xy).all() and np.isfinite(world).all()):
        raise CalibrationError(f"{where}: a pixel or target point is not a finite number; leave that row out")
    different = len(np.unique(world, axis=0))
    if different < FEWEST_POINTS:
        raise CalibrationError(
            f"few-views: {where}: {different} different points given, at least {FEWEST_POINTS} are needed; "
            "measure more"
        )
    extent = np.linalg.svd(world - world.mean(axis=0), compute_uv=False)
    if extent[1] < LEAST_RELIEF * extent[0]:
        raise CalibrationError(f"{where}: the target points lie on one line; add points beside it")
    if extent[2] < LEAST_RELIEF * extent[0]:
        raise CalibrationError(
            f"little-depth: {where}: the target points lie in one plane, which does not determine a camera; add "
            "points at another height or pictures of the target at another distance"
        )
    return xy, world


def _robust_matrix(
    where: str, image: Array, world: Array, rng: np.random.Generator, samples: int = SAMPLES
) -> tuple[Array, Array]:
    """Return the projection matrix (3, 4) of rays ``image`` (n, 3) and points (n, 3), and the inliers (n,)."""
    n = len(world)
    # whitened points condition the equations for flat targets too
    mean = world.mean(axis=0)
    left, sizes, right = np.linalg.svd(world - mean, full_matrices=False)
    points = np.column_stack([left * np.sqrt(n), np.ones(n)])
    subset = np.argsort(rng.random((samples, n)), axis=1)[:, :FEWEST_POINTS]
    matrices = np.concatenate([_linear(image[None], points[None]), _linear(image[subset], points[subset])])
    for _ in range(CONCENTRATION_STEPS):
        distance = _distances(matrices, image, points)
        best = np.argsort(np.median(distance, axis=1))[:KEPT_SAMPLES]
        half = np.argsort(distance[best], axis=1)[:, : max(FEWEST_POINTS, (n + 1) // 2)]
        matrices = np.concatenate([matrices[best], _linear(image[half], points[half])])
    distance = _distances(matrices, image, points)
    first = int(np.argmin(np.median(distance, axis=1)))
    matrix, near = matrices[first], distance[first]
    inliers = np.ones(n, dtype=bool)
    for _ in range(5):
        limit = INLIER_SIGMAS * SIGMA_BY_MEDIAN_2D * np.median(near)
        inliers = near <= max(limit, 1e-9)
        if inliers.sum() < FEWEST_POINTS:
            raise CalibrationError(f"{where}: fewer than {FEWEST_POINTS} points agree on one camera; check the pairs")
        matrix = _linear(image[inliers][None], points[inliers][None])[0]
        near = _distances(matrix[None], image, points)[0]
    design = _equations(image[inliers][None], points[inliers][None])[0]
    singular = np.linalg.svd(design, compute_uv=False)
    if singular[-2] < 1e-9 * singular[0]:
        raise CalibrationError(
            f"{where}: the points that agree do not determine a camera (they lie in a plane or on one curve); "
            "add points at other depths"
        )
    whitened_by_world = np.eye(4)
    whitened_by_world[:3, :3] = np.sqrt(n) * right / sizes[:, None]
    whitened_by_world[:3, 3] = -whitened_by_world[:3, :3] @ mean
    matrix = matrix @ whitened_by_world
    front = (image[inliers] * (np.column_stack([world, np.ones(n)])[inliers] @ matrix.T)).sum(axis=1)
    return matrix * (1.0 if np.median(front) > 0 else -1.0), inliers


def _equations(image: Array, points: Array) -> Array:
    """Return the homogeneous equations (k, 3 n, 12) of ``image x (P point) = 0``."""
    k, n = image.shape[:2]
    x, y, z = (image[:, :, i, None] * points for i in range(3))
    none = np.zeros_like(x)
    rows = np.stack(
        [
            np.concatenate([none, -z, y], axis=2),
            np.concatenate([z, none, -x], axis=2),
            np.concatenate([-y, x, none], axis=2),
        ],
        axis=2,
    )
    return rows.reshape(k, 3 * n, 12)


def _linear(image: Array, points: Array) -> Array:
    """Return projection matrices (k, 3, 4) of k sets of rays (k, n, 3) and homogeneous points (k, n, 4)."""
    equations = _equations(image, points)
    triangular = np.linalg.qr(equations, mode="r")
    return np.linalg.svd(triangular)[2][:, -1].reshape(-1, 3, 4)


def _distances(matrices: Array, image: Array, points: Array) -> Array:
    """Return the distances (k, n) of k matrices' projections from rays (n, 3), as sines of angles.

    The sine does not depend on the sign of the matrix; ``_factors`` corrects rays that point backwards.
    """
    w = points @ np.swapaxes(matrices, 1, 2)
    w /= np.maximum(np.linalg.norm(w, axis=2, keepdims=True), 1e-300)
    unit = image / np.linalg.norm(image, axis=1, keepdims=True)
    return np.asarray(np.linalg.norm(np.cross(w, unit[None]), axis=2))


def _factors(where: str, matrix: Array, world: Array, seen: int) -> tuple[Array, Array, Array]:
    """Return interior orientation K (3, 3), camera_from_world rotation (3, 3) and the projection centre (3,).

    ``world``: the points that agree; ``seen``: number of all points.
    """
    depth = world @ matrix[2, :3] + matrix[2, 3]
    if np.median(depth) < 0:
        matrix, depth = -matrix, -depth
    if (depth <= 0).any():
        raise CalibrationError(
            f"{where}: {int((depth <= 0).sum())} of the {len(depth)} points that agree, of {seen} seen, would lie "
            "behind the camera; show it more points (30 or so), at different depths, and check the pairs"
        )
    if np.linalg.det(matrix[:, :3]) < 0:
        raise CalibrationError(
            f"{where}: the points are mirrored; either the pixel columns are swapped (row before column) or count "
            "upwards, or the target's axes are left-handed: swap the columns or turn one axis' sign"
        )
    interior, rotation = rq(matrix[:, :3])
    signs = np.sign(np.diag(interior))
    interior, rotation = interior * signs, rotation * signs[:, None]
    return interior / interior[2, 2], rotation, -np.linalg.solve(matrix[:, :3], matrix[:, 3])


def _evaluated(lens: FisheyeLens, pose: Pose, xy: Array, world: Array) -> Resection:
    distance = np.linalg.norm(lens_pixels(lens, pose.inverse().transform(world)) - xy, axis=1)
    distance = np.nan_to_num(distance, nan=np.inf)
    median = float(np.median(distance))
    return Resection(lens, pose, distance <= INLIER_SIGMAS * SIGMA_BY_MEDIAN_2D * median, median)
