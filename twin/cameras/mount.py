"""The mount: how the camera body shakes while it looks."""

import numpy as np
from scipy.spatial.transform import Rotation

from mosca.data.rig import Pose
from twin.cameras.camera import VirtualCamera
from twin.cameras.lens import land
from twin.streams import rng


def pixels_per_radian(lens: np.ndarray) -> float:
    """Return how far the image moves for a small turn of the camera, at the middle of the view [px/rad]."""
    _u, _v, ux, _uy, _uz, _vx, vy, _vz, _ok = land(lens, 0.0, 0.0, 1.0)
    return float(np.sqrt(ux * ux + vy * vy) / np.sqrt(2.0))


def shaken_pose(camera: VirtualCamera, lens: np.ndarray, pulse: int, seed: int) -> Pose:
    """Return ``world_from_camera`` at a pulse: turned about the camera's x and y axes by ``body_px`` rms each."""
    pose = camera.camera.world_from_camera
    if camera.errors.body_px == 0.0:
        return pose
    turn = rng(seed, f"camera/{camera.camera.name}/body", pulse).normal(0.0, camera.errors.body_px, 2)
    turn = turn / pixels_per_radian(lens)
    return Pose(pose.rotation @ Rotation.from_rotvec([turn[0], turn[1], 0.0]).as_matrix(), pose.translation)
