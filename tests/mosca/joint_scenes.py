"""Joints in motion for tests: rotations and centres that scipy and hand formulas make."""

import numpy as np
from scipy.spatial.transform import Rotation

from mosca.data.joint_motion import JOINTS, JointMotion


def wxyz(rotation: Rotation) -> np.ndarray:
    return rotation.as_quat()[..., [3, 0, 1, 2]]


def motion_of(rotations: dict[str, Rotation], covariance: np.ndarray | None = None, **columns: object) -> JointMotion:
    """Return joints that rotate as given, all at the origin; ``covariance`` (3, 3) of all rotations [rad^2]."""
    n = len(next(iter(rotations.values())))
    j = len(rotations)
    known = np.full((3, 3), np.nan) if covariance is None else covariance
    given = {
        "frame": np.arange(n),
        "time_ns": 10_000_000 * np.arange(n),
        "joints": tuple(rotations),
        "centre": np.zeros((n, j, 3)),
        "centre_covariance": np.tile(1e-6 * np.eye(3), (n, j, 1, 1)),
        "rotation": np.stack([wxyz(one) for one in rotations.values()], axis=1),
        "rotation_covariance": np.tile(known, (n, j, 1, 1)),
    }
    return JointMotion(**{**given, **columns})


def some_motion(n: int = 12, seed: int = 1) -> JointMotion:
    """Return all joints with random places, rotations and covariances, some of them unknown."""
    rng = np.random.default_rng(seed)
    j = len(JOINTS)
    half, turned = rng.normal(0, 1e-3, (n, j, 3, 3)), rng.normal(0, 1e-2, (n, j, 3, 3))
    covariances = [(c + c.swapaxes(2, 3)) / 2 for c in (half @ half.swapaxes(2, 3), turned @ turned.swapaxes(2, 3))]
    centre = rng.normal(0, 1, (n, j, 3))
    rotation = wxyz(Rotation.random(n * j, random_state=seed)).reshape(n, j, 4)
    for column in (centre, rotation, *covariances):
        column[3, 4] = np.nan
    times = 1_790_000_000_000_000_001 + 10_000_000 * np.arange(n)
    return JointMotion(np.arange(5, 5 + n), times, JOINTS, centre, covariances[0], rotation, covariances[1])
