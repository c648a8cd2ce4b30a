"""The skeleton's joint centres and knee axes beside SCoRE and SARA, which know two adjacent segments and no more.

SCoRE: Ehrig et al. 2006, J. Biomech. 39:2798; SARA: Ehrig et al. 2007, J. Biomech. 40:2150. Markers of the synthetic
actor, rigid on its segments, with noise.
"""

from collections.abc import Mapping

import numpy as np
import pytest

from mosca.data.arrays import Array
from mosca.data.joint_motion import JointMotion
from mosca.data.motion.motion import matrices_from_quaternions
from mosca.skeleton.fit import fit_subject
from mosca.skeleton.marker_frames import MarkerFrames
from mosca.skeleton.track import track_subject
from tests.studies.skeleton_actor import Truth, actor_take

pytestmark = pytest.mark.slow
Pose = tuple[Array, Array]
"""Rotations (n, 3, 3) and centres (n, 3) of a segment."""
SEGMENTS: Mapping[str, tuple[str, ...]] = {
    "pelvis": ("LASI", "RASI", "LPSI", "RPSI", "LWT", "RWT"),
    "chest": ("C7", "T10", "CLAV", "STRN", "LBAK", "RBAK", "LCHE", "RCHE"),
    **{f"{s.lower()}_thigh": tuple(f"{s}{name}" for name in ("THI", "THF", "THB", "KNE")) for s in "LR"},
    **{f"{s.lower()}_shank": tuple(f"{s}{name}" for name in ("TIB", "SHN", "CLF", "ANK")) for s in "LR"},
    **{f"{s.lower()}_upper_arm": tuple(f"{s}{name}" for name in ("UPA", "UPB", "ELB")) for s in "LR"},
}
BALL_JOINTS = {
    **{f"{s}_hip": ("pelvis", f"{s}_thigh") for s in "lr"},
    **{f"{s}_shoulder": ("chest", f"{s}_upper_arm") for s in "lr"},
}


def segment(xyz: Array) -> Pose:
    """Return the poses of markers (n, m, 3) of one shape: each frame turned to the mean (Kabsch)."""
    centre = xyz.mean(axis=1)
    away = xyz - centre[:, None]
    shape = away[0]
    for _ in range(3):
        left, _, right = np.linalg.svd(np.einsum("nmi,mj->nij", away, shape))
        left[:, :, 2] *= np.linalg.det(left @ right)[:, None]
        rotation = left @ right
        shape = np.einsum("nji,nmj->nmi", rotation, away).mean(axis=0)
    return rotation, centre


def score(near: Pose, far: Pose) -> tuple[Array, float]:
    """Return the ball joint's centre (n, 3) and its standard deviation [m]: R c + t is one place in both segments."""
    matrix = np.concatenate([near[0], -far[0]], axis=2).reshape(-1, 6)
    apart = (far[1] - near[1]).ravel()
    centre, *_ = np.linalg.lstsq(matrix, apart)
    left = apart - matrix @ centre
    covariance = np.linalg.inv(matrix.T @ matrix) * (left @ left) / (len(left) - 6)
    ends = [pose[0] @ c + pose[1] for pose, c in zip((near, far), (centre[:3], centre[3:]), strict=True)]
    return np.mean(ends, axis=0), float(np.sqrt(np.trace(covariance)))


def sara(near: Pose, far: Pose) -> Array:
    """Return the hinge's direction (n, 3), unit: that along which the centre that ``score`` looks for is free."""
    matrix = np.concatenate([near[0], -far[0]], axis=2).reshape(-1, 6)
    free = np.linalg.svd(matrix, full_matrices=False)[2][-1]
    direction = near[0] @ free[:3] + far[0] @ free[3:]
    return np.asarray(direction / np.linalg.norm(direction, axis=1)[:, None])


Fitted = tuple[MarkerFrames, Truth, JointMotion, dict[str, Pose]]


@pytest.fixture(scope="module")
def fitted() -> Fitted:
    """A dance, which moves hips and shoulders in all directions and bends the right knee."""
    model, frames, truth = actor_take("dance", 6.0, 5.0, markers=60)
    poses = {
        name: segment(frames.xyz[:, [frames.labels.index(label) for label in labels]])
        for name, labels in SEGMENTS.items()
    }
    subject = fit_subject(model, frames)
    return frames, truth, track_subject(subject, frames).joints, poses


def rms_m(away: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(away**2, axis=1))))


@pytest.mark.parametrize("joint", BALL_JOINTS)
def test_ball_joints_agree_with_score_and_are_no_worse(fitted: Fitted, joint: str) -> None:
    _, (names, centre, _), joints, poses = fitted
    theirs, sigma = score(*(poses[name] for name in BALL_JOINTS[joint]))
    true, k = centre[:, names.index(joint)], joints.joints.index(joint)
    ours = joints.centre[:, k]
    stated = np.sqrt(np.trace(joints.centre_covariance[:, k], axis1=1, axis2=2).mean())
    assert rms_m(theirs - true) < 3 * sigma
    assert rms_m(ours - theirs) < 3 * np.hypot(sigma, stated)
    assert rms_m(ours - true) < max(rms_m(theirs - true), 1e-3)


def test_a_knees_axis_agrees_with_sara(fitted: Fitted) -> None:
    """Of the anatomical axes z is the flexion axis made perpendicular to the thigh's length: SARA's is, here, too."""
    _, (names, _, rotation), joints, poses = fitted
    theirs = sara(poses["r_thigh"], poses["r_shank"])

    def thigh(rotations: Array, among: tuple[str, ...]) -> Array:
        pelvis, hip = (matrices_from_quaternions(rotations[:, among.index(name)]) for name in ("pelvis", "r_hip"))
        return np.asarray(pelvis @ hip)

    ours, true = thigh(joints.rotation, joints.joints), thigh(rotation, names)

    def off_deg(one: Array, axes: Array) -> float:
        across = one - np.sum(one * axes[:, :, 1], axis=1)[:, None] * axes[:, :, 1]
        cosine = np.abs(np.sum(across * axes[:, :, 2], axis=1)) / np.linalg.norm(across, axis=1)
        return float(np.rad2deg(np.arccos(np.minimum(cosine, 1.0))).max())

    assert off_deg(theirs, ours) < 1.0
    assert off_deg(theirs, true) < 1.0
    assert off_deg(ours[:, :, 2], true) < 1.0
