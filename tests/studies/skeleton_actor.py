"""The synthetic actor's markers and joints without cameras, and errors of joints: for studies of the skeleton."""

from typing import Any

import mujoco
import numpy as np

from mosca.data.arrays import Array
from mosca.data.joint_motion import JointMotion
from mosca.skeleton.marker_frames import MarkerFrames
from mosca.skeleton.model import HUMAN, SkeletonModel, read_skeleton_model
from scenarios.score.people import rotation_vectors
from twin.scenes.actor import build_actor

NOISE_M = 3e-4
"""Standard deviation of a marker's coordinate: a good rig's."""
Truth = tuple[tuple[str, ...], Array, Array]
"""Names of j joints, centres (n, j, 3) [m], rotations (n, j, 4) wxyz."""


def actor_take(
    action: str,
    duration_s: float = 6.0,
    rate_hz: float = 50.0,
    seed: int = 1,
    noise_m: float = NOISE_M,
    **options: Any,
) -> tuple[SkeletonModel, MarkerFrames, Truth]:
    """Return the model with the actor's markers, the markers with noise, and the joints' truth.

    ``options`` are those of ``build_actor``.
    """
    box = np.array([0.0, 0.0, 1.3]), np.array([4.0, 4.0, 2.8])
    scene = build_actor(
        duration_s=duration_s,
        box_center_m=box[0],
        box_size_m=box[1],
        rng=np.random.default_rng(seed),
        action=action,  # type: ignore[arg-type]
        **options,
    )
    assert scene.joints is not None
    data, n = mujoco.MjData(scene.model), int(duration_s * rate_hz)
    geoms = list(scene.marker_geoms)
    xyz = np.empty((n, len(geoms), 3))
    places, rotations = np.empty((n, scene.model.nbody, 3)), np.empty((n, scene.model.nbody, 3, 3))
    for k in range(n):
        data.qpos[:] = scene.configuration_at(k / rate_hz)
        mujoco.mj_kinematics(scene.model, data)
        xyz[k], places[k], rotations[k] = data.geom_xpos[geoms], data.xpos, data.xmat.reshape(-1, 3, 3)
    true = scene.joints.truth(places, rotations)
    model = read_skeleton_model(HUMAN, scene.marker_names)
    noisy = xyz + np.random.default_rng(seed + 100).normal(0, noise_m, xyz.shape)
    covariance = np.tile(noise_m**2 * np.eye(3), (n, len(model.labels), 1, 1))
    columns = [scene.marker_names.index(label) for label in model.labels]
    times = np.round(np.arange(n) / rate_hz * 1e9).astype(np.int64)
    frames = MarkerFrames(model.labels, np.arange(n), times, noisy[:, columns], covariance)
    return model, frames, (tuple(true.names), true.centre, true.rotation)


def apart(joints: JointMotion, truth: Truth) -> tuple[Array, Array]:
    """Return centres less the true ones (n, j, 3) [m] and rotation vectors to the true rotations [rad]; NaN: none."""
    names, centre, rotation = truth
    order = [names.index(name) for name in joints.joints]
    return joints.centre - centre[:, order], rotation_vectors(joints.rotation, rotation[:, order])


def joint_errors(joints: JointMotion, truth: Truth) -> dict[str, tuple[float, float]]:
    """Return joint -> rms of the centre's distance from truth [m] and of the rotation's angle [rad]; NaN: none."""
    sizes = [np.linalg.norm(one, axis=2) for one in apart(joints, truth)]
    return {name: (rms(sizes[0][:, k]), rms(sizes[1][:, k])) for k, name in enumerate(joints.joints)}


def rms(values: Any) -> float:
    """Return the root mean square of ``values`` without NaN; NaN for none."""
    known = np.array([value for value in values if np.isfinite(value)])
    return float(np.sqrt(np.mean(known**2))) if len(known) else float("nan")
