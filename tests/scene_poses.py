"""Where the one body of a scene is."""

import mujoco
import numpy as np

from twin.scenes.scene import Scene


def body_pose(scene: Scene, time_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Position (3,) and rotation (3, 3) of the one free body."""
    qpos = scene.configuration_at(time_s)
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, qpos[3:])
    return qpos[:3], rotation.reshape(3, 3)
