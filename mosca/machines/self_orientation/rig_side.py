"""Poses of a camera on a body that a rig tracks, in the test field's frame, with all their errors."""

from dataclasses import dataclass, replace

import numpy as np

from mosca.calibration.quality.point_covariance import calibration_shift
from mosca.camera.projection import cross_matrices, inside_image, project
from mosca.data.arrays import Array, set_read_only
from mosca.data.bodies import BodyPoses, RigidBody
from mosca.data.calibration import Calibration
from mosca.data.rig import Pose
from mosca.data.rotations import rotation_from_quaternion
from mosca.errors import InputError
from mosca.machines.self_orientation.camera_path import CameraPath, in_frame, moved
from mosca.machines.self_orientation.registration import Registration, pose_shift

RIG = "rig "
"""Prefix of the names of the rig's own parameters among the shared ones."""
AXES = ("x", "y", "z", "turn x", "turn y", "turn z")


@dataclass(frozen=True, eq=False)
class LeverArm:
    """Pose of a camera on a body: body_from_camera, and its covariance (6, 6) in the body's axes."""

    body_from_camera: Pose
    covariance: Array

    def __post_init__(self) -> None:
        set_read_only(self, covariance=(6, 6))


def body_path(poses: BodyPoses, name: str) -> CameraPath:
    """Return the measured poses of a body in order of time; InputError for fewer than two."""
    mine = poses.of(name)
    if len(mine) < 2:
        raise InputError(
            f"body '{name}': {len(mine)} poses measured, two at least are wanted; are its markers in the tracks?"
        )
    mine = mine.select(np.unique(mine.time_ns, return_index=True)[1])
    rotation = np.array([rotation_from_quaternion(q) for q in mine.quaternion])
    return CameraPath(mine.time_ns, rotation, mine.position, mine.covariance)


def with_calibration(path: CameraPath, body: RigidBody, calibration: Calibration) -> CameraPath:
    """Return the path with the errors of the body's poses from the rig's calibration, assuming equal weights of all
    markers and that each is seen by all cameras in whose images it lies.
    """
    n, m, u = len(path), len(body.markers), len(calibration.parameters)
    arm = np.einsum("nij,kj->nki", path.rotation, body.positions)
    xyz = (path.position[:, None] + arm).reshape(-1, 3)
    seen = np.column_stack([inside_image(one, project(one, xyz)) for one in calibration.rig.cameras])
    shift = np.nan_to_num(calibration_shift(calibration, xyz, seen)).reshape(n, m, 3, u)
    names = tuple(f"{RIG}{name}" for name in calibration.parameters)
    return path.with_shared(names, calibration.covariance, pose_shift(arm, shift))


def camera_by_rig(body: CameraPath, lever: LeverArm, field: Registration) -> CameraPath:
    """Return the camera's poses in the test field's frame, from those of the body that carries it."""
    turn = _both(body.rotation)
    path = moved(body, lever.body_from_camera).with_shared(
        tuple(f"lever {axis}" for axis in AXES), lever.covariance, turn
    )
    g = field.world_from_field
    away = cross_matrices(path.position - g.translation)
    by_field = np.zeros((len(path), 6, 6))
    # if the field is shifted by d and turned by r, the camera is shifted by -d and turned back in the field's frame
    by_field[:, :3, :3], by_field[:, :3, 3:], by_field[:, 3:, 3:] = -np.eye(3), away, -np.eye(3)
    path = path.with_shared(tuple(f"field {axis}" for axis in AXES), field.covariance, by_field)
    if field.by_calibration is not None:
        # the rig's calibration moves body and field together: common errors cancel in the field's frame
        assert path.by_parameter is not None
        rig = np.flatnonzero([name.startswith(RIG) for name in path.shared.names])
        both = np.array(path.by_parameter)
        both[:, :, rig] += by_field @ field.by_calibration
        path = replace(path, by_parameter=both)
    return in_frame(path, g.inverse())


def with_clock(path: CameraPath, sigma_s: float) -> CameraPath:
    """Return the path with the error of a clock offset that is known to ``sigma_s`` [s]."""
    return path.with_shared(("clock",), np.array([[sigma_s**2]]), path.rates()[:, :, None])


def _both(rotation: Array) -> Array:
    both = np.zeros((len(rotation), 6, 6))
    both[:, :3, :3], both[:, 3:, 3:] = rotation, rotation
    return both
