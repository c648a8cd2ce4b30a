"""Operations on motions of skeletons: trim, filter, rotate. Frames count from 0."""

from dataclasses import replace

import numpy as np
from pydantic.dataclasses import dataclass
from scipy.spatial.transform import Rotation

from mosca.data.arrays import Array
from mosca.data.files.toml import SETTINGS, Positive
from mosca.data.motion.motion import Motion, Skeleton, multiply_quaternions
from mosca.editing.low_pass import SHORTEST, low_pass
from mosca.editing.operation import (
    Blend,
    EditError,
    Frames,
    Labels,
    RotationKeyframes,
    between_keyframes,
    rows_between,
    unknown_name,
)


@dataclass(frozen=True, config=SETTINGS)
class TrimMotion:
    """Keep a stretch of frames alone; its first frame becomes frame 0."""

    frames: Frames

    def apply(self, take: Motion) -> Motion:
        """Return the motion in these frames."""
        rows = rows_between(frames_of(take), self.frames)
        return replace(take, root_xyz=take.root_xyz[rows], rotations=take.rotations[rows])


@dataclass(frozen=True, config=SETTINGS)
class FilterMotion:
    """Zero-phase Butterworth low-pass of rotations, as quaternions that are made unit again; the root's path too.

    Components instead of angles: near one rotation quaternions are as good as linear, and have no gimbal lock.
    """

    cutoff_hz: Positive
    joints: Labels | None = None

    def apply(self, take: Motion) -> Motion:
        """Return the filtered motion: only ``joints`` where they are given, and the path with the root."""
        made = low_pass(self.cutoff_hz, take.frame_rate_hz)
        t = len(take.root_xyz)
        if t < SHORTEST:
            raise EditError("cutoff_hz", f"{t} frames given; {SHORTEST} or more are wanted to filter")
        names = take.skeleton.names if self.joints is None else self.joints
        rotations, root = np.array(take.rotations), take.root_xyz
        for k in [joint_index(take.skeleton, name, "joints") for name in names]:
            smooth = made.filtered(take.rotations[:, k])
            rotations[:, k] = smooth / np.linalg.norm(smooth, axis=1, keepdims=True)
            root = made.filtered(take.root_xyz) if k == 0 else root
        return replace(take, root_xyz=root, rotations=rotations)


@dataclass(frozen=True, config=SETTINGS)
class RotateJoint:
    """Turn a joint by rotation vectors r at keyframes, in its own axes: R becomes R exp([r]); blended between."""

    joint: str
    keyframes: RotationKeyframes
    blend: Blend = "smooth"

    def apply(self, take: Motion) -> Motion:
        """Return the motion with this joint and all joints below it turned."""
        k = joint_index(take.skeleton, self.joint, "joint")
        vectors = np.deg2rad(between_keyframes(frames_of(take), self.keyframes, self.blend))
        turned = np.any(vectors != 0.0, axis=1)
        rotations = np.array(take.rotations)
        turns = quaternions_of(Rotation.from_rotvec(vectors[turned]))
        rotations[turned, k] = beside(multiply_quaternions(rotations[turned, k], turns), rotations[turned, k])
        return replace(take, rotations=rotations)


def frames_of(take: Motion) -> Array:
    """Return the numbers (t,) of the frames."""
    return np.arange(len(take.root_xyz))


def joint_index(skeleton: Skeleton, name: str, key: str) -> int:
    """Return the index of a joint; EditError suggests joints with similar names."""
    if name not in skeleton.names:
        raise EditError(key, unknown_name(name, skeleton.names, "joint"))
    return skeleton.index(name)


def quaternions_of(rotations: Rotation) -> Array:
    """Return quaternions (..., 4) wxyz."""
    result: Array = rotations.as_quat()[..., [3, 0, 1, 2]]
    return result


def beside(wxyz: Array, old: Array) -> Array:
    """Return quaternions (n, 4) with the signs that put each on the side of ``old`` (n, 4)."""
    signs = np.where(np.sum(wxyz * old, axis=-1, keepdims=True) < 0, -1.0, 1.0)
    return wxyz * signs
