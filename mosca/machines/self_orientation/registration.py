"""Registration of a test field in a rig's world: coded targets triangulated by the rig against the field's own file.

The rigid motion is estimated by least squares with the points' covariances, started by Horn (1987)
(``mosca.rigid_bodies.pose_kernels``).
"""

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from mosca.calibration.quality.point_covariance import calibration_shift
from mosca.camera.projection import cross_matrices
from mosca.data.arrays import Array, set_read_only
from mosca.data.calibration import Calibration
from mosca.data.found_targets import CodedDetections
from mosca.data.rig import Pose, Rig
from mosca.data.targets import CodedTarget, TestField
from mosca.errors import InputError
from mosca.rigid_bodies.pose_kernels import fit_pose
from mosca.triangulation.triangulate import triangulate

FEWEST_TARGETS = 4


@dataclass(frozen=True, eq=False)
class Registration:
    """Pose of a test field in a rig's world."""

    world_from_field: Pose
    covariance: Array
    """(6, 6) of position and rotation vector about the world's axes, without errors of the rig's calibration."""
    rms_m: float
    """Rms distance of the targets from their places [m]."""
    targets: int
    by_calibration: Array | None = None
    """(6, u): derivative of the pose by each parameter of the rig's calibration; None where these are not known."""

    def __post_init__(self) -> None:
        set_read_only(self, covariance=(6, 6))
        if self.by_calibration is not None:
            set_read_only(self, by_calibration=(6, None))


def register_field(
    rig: Rig, seen: Iterable[CodedDetections], field: TestField, calibration: Calibration | None = None
) -> Registration:
    """Return the pose of ``field`` at rest, from any number of images of the rig's cameras.

    ``calibration``: the rig's, where its errors are known; they move field and body alike.
    InputError where fewer than four targets are seen by two cameras each, or where they lie in a line.
    """
    row_of = {one.target.number: k for k, one in enumerate(field.targets) if isinstance(one.target, CodedTarget)}
    images: dict[tuple[int, int], list[Array]] = defaultdict(list)
    covariances: dict[tuple[int, int], list[Array]] = defaultdict(list)
    column = {name: c for c, name in enumerate(rig.names)}
    for found in seen:
        for number, xy, covariance in zip(found.number.tolist(), found.xy_px, found.covariance_px2, strict=True):
            if number in row_of and found.camera in column:
                key = (row_of[number], column[found.camera])
                images[key].append(xy)
                covariances[key].append(covariance)
    m, c = len(field.targets), len(rig.names)
    xy, variance = np.full((m, c, 2), np.nan), []
    for (row, camera), centres in images.items():
        xy[row, camera] = np.mean(centres, axis=0)
        noise = np.trace(np.mean(covariances[row, camera], axis=0)) / 2 / len(centres)
        variance.append(noise + rig.cameras[camera].residual_px ** 2)
    sigma_px = float(np.sqrt(np.mean(variance))) if variance else 1.0
    xyz, covariance = triangulate(rig, xy, sigma_px)[:2]
    good = np.isfinite(xyz).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2))
    if good.sum() < FEWEST_TARGETS:
        raise InputError(
            f"registration: {int(good.sum())} of the field's {m} targets are seen by two cameras or more; "
            f"{FEWEST_TARGETS} at least are wanted: show the field to the rig, or light it"
        )
    place = field.positions[good]
    out = np.empty((3, 3)), np.empty(3), np.empty((6, 6)), np.empty(int(good.sum()))
    points, sigma2 = np.ascontiguousarray(xyz[good]), field.sigma_m**2
    if fit_pose(place, points, np.ascontiguousarray(covariance[good]), sigma2, *out) < 0:
        raise InputError("registration: the targets that the rig sees lie in a line; show more of the field")
    rest = points - place @ out[0].T - out[1]
    rms = float(np.sqrt(np.mean(np.sum(rest**2, axis=1))))
    by_calibration = None
    if calibration is not None:
        shift = np.nan_to_num(calibration_shift(calibration, points, np.isfinite(xy[good]).all(axis=2)))
        by_calibration = pose_shift(place @ out[0].T, shift)
    return Registration(Pose(out[0], out[1]), out[2], rms, len(place), by_calibration)


def pose_shift(arms: Array, shifts: Array) -> Array:
    """Return the motion (..., 6, u) of a rigid body whose points, at ``arms`` (..., m, 3) from its origin, move by
    ``shifts`` (..., m, 3, u): translation and rotation vector by least squares with equal weights.
    """
    shape = (*arms.shape[:-1], 3, 3)
    cross = cross_matrices(arms.reshape(-1, 3)).reshape(shape)
    design = np.concatenate([np.broadcast_to(np.eye(3), shape), -cross], axis=-1)
    normal = np.einsum("...kai,...kaj->...ij", design, design)
    return np.asarray(np.linalg.solve(normal, np.einsum("...kai,...kau->...iu", design, shifts)))
