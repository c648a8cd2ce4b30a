"""A small skeleton, pelvis and legs, and takes of it that its own kinematics make."""

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np

from mosca.data.tracks import Tracks
from mosca.skeleton.fit import FittedSubject
from mosca.skeleton.joints import SegmentAxes
from mosca.skeleton.mjcf import compiled
from mosca.skeleton.model import HUMAN, Kinematics, SkeletonModel, model_from_mjcf

RATE_HZ = 50.0
LONGER_M = 0.02
"""How much longer the thighs of the person in a take are than the model's."""


def legs_mjcf() -> str:
    """Return the model of a person without its trunk."""
    root = ElementTree.fromstring(HUMAN.read_text(encoding="utf-8"))
    pelvis = root.find("worldbody/body")
    pelvis.remove(pelvis.find("body[@name='abdomen']"))
    left = {joint.get("name") for joint in pelvis.iter("joint")}
    custom = root.find("custom")
    for element in list(custom):
        if element.get("name").split("/")[1] not in left:
            custom.remove(element)
    return ElementTree.tostring(root, encoding="unicode")


def legs_model() -> SkeletonModel:
    """Return that model with all its markers."""
    text = legs_mjcf()
    mj = compiled(text, "legs")
    return model_from_mjcf(text, mj, [mj.site(k).name for k in range(mj.nsite)], "legs")


def true_parameters(model: SkeletonModel) -> np.ndarray:
    """Return the parameters of the person in the takes: longer thighs, markers off their usual places."""
    rng = np.random.default_rng(5)
    parameters = np.array(model.parameters)
    parameters[3 * len(model.joints) :] += rng.normal(0, 0.005, 3 * len(model.labels))
    for joint in ("l_knee", "r_knee"):
        parameters[model.joint_rows(joint)][1] -= LONGER_M
    return parameters


def poses(model: SkeletonModel, n: int, still: bool = False) -> np.ndarray:
    """Return poses (n, nq): every joint turns to all sides, knees mostly bend; ``still``: none moves."""
    kinematics = Kinematics(model)
    t = np.arange(n) / RATE_HZ
    found = np.tile(kinematics.mj.qpos0, (n, 1))
    for k in range(n):
        step = np.zeros(kinematics.mj.nv)
        step[:3] = [0.3 * np.sin(t[k]), 0.2 * t[k], 0.9]
        for j, joint in enumerate(model.joints):
            turn = {"hip": (0.4, 0.3, 0.7), "knee": (0.02, 0.1, 0.6), "ankle": (0.2, 0.2, 0.4)}[joint[2:]]
            phase = np.array([2.1, 3.3, 5.2]) * t[k] + j
            step[6 + 3 * j : 9 + 3 * j] = turn * np.sin(phase) - [0, 0, 0.7 if "knee" in joint else 0]
        # the model is y up, the world z up
        upright = kinematics.moved(found[k], np.r_[0, 0, 0, np.pi / 2, 0, 0, np.zeros(kinematics.mj.nv - 6)])
        found[k] = kinematics.moved(upright, step if not still else step * (np.arange(len(step)) < 3))
    return found


def take(
    model: SkeletonModel, n: int = 60, *, prefix: str = "", noise_m: float = 3e-4, still: bool = False, seed: int = 1
) -> tuple[Tracks, np.ndarray]:
    """Return tracks of n frames and the true joint centres (n, b + 1, 3), the root's first."""
    kinematics = Kinematics(model, true_parameters(model))
    markers, centres = [], []
    for q in poses(model, n, still):
        kinematics.pose(q)
        markers.append(kinematics.markers())
        centres.append(kinematics.joint_centres())
    xyz = np.array(markers) + np.random.default_rng(seed).normal(0, noise_m, (n, len(model.labels), 3))
    m = len(model.labels)
    frame = np.repeat(np.arange(n), m)
    return (
        Tracks(
            frame=frame,
            time_ns=(frame * 1e9 / RATE_HZ).astype(np.int64),
            track=np.tile(np.arange(m), n),
            label=np.tile([prefix + label for label in model.labels], n),
            xyz=xyz.reshape(-1, 3),
            covariance=np.tile(noise_m**2 * np.eye(3), (n * m, 1, 1)),
            n_cameras=np.full(n * m, 4),
            residual_px=np.full(n * m, 0.1),
            status=np.full(n * m, "measured"),
        ),
        np.array(centres),
    )


def made_subject(seed: int = 3) -> FittedSubject:
    """Return a subject of arbitrary numbers, without a fit."""
    rng = np.random.default_rng(seed)
    model = legs_model()
    p, mj = len(model.parameters), Kinematics(model).mj
    root = rng.normal(0, 1e-3, (p, p))
    turns = {body: np.linalg.qr(rng.normal(size=(3, 3)))[0] for body in ("pelvis", "l_thigh")}
    axes = {body: turn * np.linalg.det(turn) for body, turn in turns.items()}
    slopes = {body: rng.normal(size=(3, p)) for body in axes}
    q = poses(model, 3)[2]
    return FittedSubject(
        model=model,
        parameters=model.parameters + rng.normal(0, 0.01, p),
        covariance=root @ root.T,
        skin_m=np.abs(rng.normal(0, 0.01, len(model.labels))),
        size=1.1,
        q=q,
        posture=rng.normal(0, 0.1, mj.nv),
        axes=SegmentAxes(axes, slopes),
        residual_rms_m=0.004,
        frames=60,
    )


def write_legs(path: Path) -> Path:
    """Write the model of pelvis and legs; return its path."""
    path.write_text(legs_mjcf(), encoding="utf-8")
    return path
