"""Re-orientation of a bumped camera from points tracked by the others: its pose is estimated, its lens is held."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from mosca.calibration.common.robust_fit import SIGMA_BY_MEDIAN_2D
from mosca.calibration.monitoring.large_shift import REACH_PX
from mosca.camera.projection import project, project_with_jacobians
from mosca.data.arrays import Array, read_only
from mosca.data.detections import Detections
from mosca.data.rig import Camera, Pose, Rig
from mosca.data.tracks import Points
from mosca.errors import CalibrationError, InputError
from mosca.triangulation.triangulate import triangulate

FEWEST_POINTS = 12
STEPS = 30
OUTLIER_SIGMAS = 4.0
"""Robust standard deviations from which a pair is left out."""
LEAST_RELIEF = 0.02
"""Least over largest extent of the points, below which a line of points determines no pose."""
PAIRED_PX = 3.0
"""Largest distance of an image from a point's projection [px] for a pair, after the coarse shift."""


@dataclass(frozen=True, eq=False)
class CameraObservations:
    """A camera's image points of points that other cameras measured.

    ``frame`` (n,); ``xyz`` (n, 3) [m] and ``covariance`` (n, 3, 3) from the other cameras alone; ``xy_px`` (n, 2)
    and ``covariance_px2`` (n, 2, 2) of the camera's own image.
    """

    frame: Array
    xyz: Array
    covariance: Array
    xy_px: Array
    covariance_px2: Array

    @classmethod
    def joined(cls, parts: "list[CameraObservations]") -> "CameraObservations":
        """Return the parts one after the other."""
        return cls(*(np.concatenate([getattr(p, name) for p in parts]) for name in cls.__dataclass_fields__))

    def __len__(self) -> int:
        return len(self.xyz)


@dataclass(frozen=True, eq=False)
class Reorientation:
    """A camera's new pose.

    ``covariance`` (6, 6) of rotation about its own axes [rad] and position [m], with the body's shake; ``sigma0`` of
    unit weight (1 where the stated errors are right); ``used`` (n,) bool; ``rms_px`` of the used residuals;
    ``turn_rad`` and ``shift_m`` from the pose before.
    """

    camera: Camera
    covariance: Array
    sigma0: float
    used: Array
    rms_px: float
    turn_rad: float
    shift_m: float


def gather(
    rig: Rig,
    name: str,
    frame: int,
    detections: Mapping[str, Detections],
    points: Points,
    shift_px: tuple[float, float] | None = None,
) -> CameraObservations:
    """Return camera ``name``'s observations of those points of a frame that two or more other cameras measure.

    The points are measured without the camera itself. ``shift_px``: displacement (x, y) of its image
    (``common_shift``) after a bump so large that its images were not matched; then they are paired with points again.
    """
    index, found = rig.names.index(rig.camera(name).name), detections.get(name)
    others = Rig(tuple(c for c in rig.cameras if c.name != name))
    if found is None or len(others.cameras) < 2:
        return _nothing()
    table = np.full((len(points), len(others.cameras), 2), np.nan)
    sigma = np.full(table.shape[:2], np.nan)
    for k, camera in enumerate(others.cameras):
        ray = points.rays[:, rig.names.index(camera.name)]
        rows = np.flatnonzero(ray >= 0)
        if camera.name in detections and len(rows):
            table[rows, k] = detections[camera.name].xy_px[ray[rows]]
            sigma[rows, k] = np.sqrt(
                np.trace(detections[camera.name].covariance_px2[ray[rows]], axis1=1, axis2=2) / 2
            )
    typical = float(np.nanmedian(sigma)) if np.isfinite(sigma).any() else 1.0
    xyz, covariance, _ = triangulate(others, table, typical)
    met: Array = np.asarray(np.isfinite(xyz).all(axis=1))
    if shift_px is None:
        own = points.rays[:, index]
        rows = np.flatnonzero(met & (own >= 0))
        which = own[rows]
    else:
        rows, which = _paired(rig.camera(name), xyz, met, found, shift_px)
    return CameraObservations(
        np.full(len(rows), frame), xyz[rows], covariance[rows], found.xy_px[which], found.covariance_px2[which]
    )


def common_shift(rig: Rig, name: str, detections: Mapping[str, Detections], points: Points) -> tuple[float, float]:
    """Return the shift (x, y) [px] that most of a camera's images have against the points of the others.

    It is the densest bin of all differences in one frame set; (0, 0) where there are none.
    """
    camera, found = rig.camera(name), detections.get(name)
    others = (points.rays >= 0).sum(axis=1) - (points.rays[:, rig.names.index(name)] >= 0)
    xy = project(camera, points.xyz[others >= 2])
    xy = xy[np.isfinite(xy).all(axis=1)]
    if found is None or len(found) == 0 or len(xy) == 0:
        return 0.0, 0.0
    apart = (found.xy_px[None] - xy[:, None]).reshape(-1, 2)
    apart = apart[np.abs(apart).max(axis=1) < REACH_PX]
    if len(apart) == 0:
        return 0.0, 0.0
    tree = cKDTree(apart)
    near = tree.query_ball_point(apart, PAIRED_PX)
    best = max(near, key=len)
    x, y = np.median(apart[best], axis=0)
    return float(x), float(y)


def reorient(camera: Camera, seen: CameraObservations, body_px: float = 0.03) -> Reorientation:
    """Resect ``camera`` from ``seen`` with its lens held, starting from its old pose.

    Weights follow from the image's and the point's covariances; wrong pairs are left out.
    ``body_px``: shake of a whole image, which all points of a frame share. CalibrationError for fewer than
    12 points, points on a line, or a pose that does not fit.
    """
    where = f"camera '{camera.name}'"
    if len(seen) < FEWEST_POINTS:
        raise CalibrationError(
            f"{where}: {len(seen)} points that two other cameras track, at least {FEWEST_POINTS} are needed to "
            "re-orient it; a rig of two cameras cannot: calibrate the exterior orientation anew"
        )
    extent = np.linalg.svd(seen.xyz - seen.xyz.mean(axis=0), compute_uv=False)
    if extent[1] < LEAST_RELIEF * extent[0]:
        raise CalibrationError(f"{where}: the tracked points lie on one line; move about in the volume")
    pose, used = camera.world_from_camera, np.ones(len(seen), dtype=bool)
    for step in range(STEPS):
        at = replace(camera, world_from_camera=pose)
        rest, slope, weight = _linearised(at, seen)
        squared = np.einsum("ni,nij,nj->n", rest, weight, rest)
        # from a poor initial pose all residuals are large: wrong points have larger ones than the others
        scale = max(float(np.median(squared)) * SIGMA_BY_MEDIAN_2D**2, 1.0)
        used = np.isfinite(squared) & (squared < 2 * OUTLIER_SIGMAS**2 * scale)
        normal = np.einsum("nki,nkl,nlj->ij", slope[used], weight[used], slope[used])
        right = np.einsum("nki,nkl,nl->i", slope[used], weight[used], rest[used])
        size = 1 / np.sqrt(np.diag(normal))
        change = size * np.linalg.solve(normal * size[:, None] * size, size * right)
        pose = Pose(pose.rotation @ Rotation.from_rotvec(change[:3]).as_matrix(), pose.translation + change[3:])
        if step > 2 and change @ normal @ change < 1e-8:
            break
    if used.sum() < max(FEWEST_POINTS, 0.5 * len(seen)):
        raise CalibrationError(
            f"{where}: only {int(used.sum())} of {len(seen)} tracked points fit one pose; calibrate the exterior "
            "orientation anew with the target"
        )
    freedom = 2 * int(used.sum()) - 6
    sigma0 = float(np.sqrt(squared[used].sum() / freedom))
    covariance = max(sigma0, 1.0) ** 2 * np.linalg.inv(normal) + _shaken(
        seen.frame[used], slope[used], weight[used], normal, body_px
    )
    old = camera.world_from_camera
    turn = Rotation.from_matrix(old.rotation.T @ pose.rotation).magnitude()
    return Reorientation(
        replace(camera, world_from_camera=pose),
        read_only(covariance, (6, 6), "covariance"),
        sigma0,
        read_only(used, (None,), "used", np.bool_),
        float(np.sqrt(np.mean(rest[used] ** 2))),
        float(turn),
        float(np.linalg.norm(pose.translation - old.translation)),
    )


def _linearised(camera: Camera, seen: CameraObservations) -> tuple[Array, Array, Array]:
    """Return residuals (n, 2), their derivatives by the pose (n, 2, 6) and weights (n, 2, 2)."""
    p = project_with_jacobians(camera, seen.xyz)
    spread = seen.covariance_px2 + p.by_point @ seen.covariance @ np.swapaxes(p.by_point, 1, 2)
    bad = ~np.isfinite(p.xy_px).all(axis=1)
    spread[bad] = np.eye(2)
    return seen.xy_px - p.xy_px, np.nan_to_num(p.by_pose), np.linalg.inv(spread)


def _shaken(frame: Array, slope: Array, weight: Array, normal: Array, body_px: float) -> Array:
    """Return the covariance (6, 6) of the pose due to the shake of whole images: each frame shifts as a whole."""
    inverse, total = np.linalg.inv(normal), np.zeros((6, 6))
    for one in np.unique(frame):
        rows = frame == one
        gain = inverse @ np.einsum("nki,nkl->il", slope[rows], weight[rows])
        total += body_px**2 * gain @ gain.T
    return total


def _paired(
    camera: Camera, xyz: Array, met: Array, found: Detections, shift_px: tuple[float, float]
) -> tuple[Array, Array]:
    """Return points and detections that are each other's nearest once the image is shifted."""
    rows = np.flatnonzero(met)
    if len(rows) == 0 or len(found) == 0:
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    xy = project(camera, xyz[rows]) + shift_px
    rows, xy = rows[np.isfinite(xy).all(axis=1)], xy[np.isfinite(xy).all(axis=1)]
    apart, which = cKDTree(found.xy_px).query(xy)
    _, back = cKDTree(xy).query(found.xy_px)
    good = (apart < PAIRED_PX) & (back[which] == np.arange(len(xy)))
    return rows[good], which[good]


def _nothing() -> CameraObservations:
    return CameraObservations(
        np.empty(0, dtype=np.int64), np.empty((0, 3)), np.empty((0, 3, 3)), np.empty((0, 2)), np.empty((0, 2, 2))
    )


def reoriented(rig: Rig, name: str, seen: CameraObservations, body_px: float = 0.03) -> tuple[Rig, Reorientation]:
    """Return the rig with camera ``name`` in its new pose. InputError for a rig of fewer than three cameras."""
    if len(rig.cameras) < 3:
        raise InputError(
            f"camera '{name}': a rig of {len(rig.cameras)} cameras cannot re-orient one from the others' "
            "points, 3 are needed; calibrate the exterior orientation anew with the target"
        )
    new = reorient(rig.camera(name), seen, body_px)
    return Rig(tuple(new.camera if c.name == name else c for c in rig.cameras)), new
