"""The mount: how the camera body shakes while it looks."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from mosca.data.rig import Pose
from twin.cameras.lens import land
from twin.streams import rng


@dataclass(frozen=True)
class Mount:
    """How the camera body moves. ``body_px`` rms shake a frame, each image axis."""

    body_px: float = 0.03


def pixels_per_radian(lens: np.ndarray) -> float:
    """Return how far the image moves for a small turn of the camera, at the middle of the view [px/rad]."""
    _u, _v, ux, _uy, _uz, _vx, vy, _vz, _ok = land(lens, 0.0, 0.0, 1.0)
    return float(np.sqrt(ux * ux + vy * vy) / np.sqrt(2.0))


def shaken_pose(mount: Mount, name: str, pose: Pose, lens: np.ndarray, pulse: int, seed: int) -> Pose:
    """Return ``world_from_camera`` at a pulse: turned about the camera's x and y axes by ``body_px`` rms each."""
    if mount.body_px == 0.0:
        return pose
    turn = rng(seed, f"camera/{name}/body", pulse).normal(0.0, mount.body_px, 2)
    turn = turn / pixels_per_radian(lens)
    return Pose(pose.rotation @ Rotation.from_rotvec([turn[0], turn[1], 0.0]).as_matrix(), pose.translation)
