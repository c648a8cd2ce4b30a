"""Joints of a person as the bones of a streamed skeleton: poses of segments in the world, and their tree.

A bone is the segment that its joint carries; it begins at the joint. Its rotation is the product of those of the
joints above it. Numbers: bones count from 1; the pelvis has the parent 0. In frames the high half of a bone's number
is the skeleton's, as in OptiTrack's SDK (``NatNetTypes.h``, ``sRigidBodyData``).
"""

import numpy as np

from hardware.streams.turns import UP, UP_TURN, UpAxis, product
from hardware.streams.values import BODY, TRACKED, StreamedBody, StreamedSkeleton
from mosca.data.arrays import Array
from mosca.data.joint_motion import JOINTS, JointMotion
from mosca.data.rotations import rotation_from_quaternion

NUMBER = 1
"""Of the skeleton: there is one."""
MOST_INSTANTS = 500
"""Of which a bone's offset is the median: it is a length of the fitted model, alike in all."""
_SEGMENTS = {
    "pelvis": "pelvis", "lumbar": "thorax", "neck": "head", "hip": "thigh", "knee": "shank", "ankle": "foot",
    "shoulder": "upper_arm", "elbow": "forearm", "wrist": "hand",
}  # fmt: skip
"""Joint, without its side -> the segment that it carries."""
_ABOVE = {
    "lumbar": "pelvis", "neck": "lumbar", "hip": "pelvis", "knee": "hip", "ankle": "knee", "shoulder": "lumbar",
    "elbow": "shoulder", "wrist": "elbow",
}  # fmt: skip
"""Joint, without its side -> the joint above it."""


class SkeletonPoses:
    """Bones of ``motion`` with the axis ``up`` upward; ``model``: their definitions.

    ``frames`` (n,) and ``time_ns`` (n,): of the poses. Joints whose joint above is missing are left out.
    """

    def __init__(self, motion: JointMotion, up: UpAxis = "z", name: str = "person") -> None:
        self.frames, self.time_ns = motion.frame, motion.time_ns
        joints: list[str] = []
        for joint in JOINTS:  # from the pelvis on outward
            if joint in motion.joints and (joint == "pelvis" or _above(joint) in joints):
                joints.append(joint)
        columns = [motion.joints.index(joint) for joint in joints]
        centre = motion.centre[:, columns]
        turn = np.array(motion.rotation[:, columns])
        parents = [-1 if joint == "pelvis" else joints.index(_above(joint)) for joint in joints]
        for k, parent in enumerate(parents):
            if parent >= 0:
                turn[:, k] = np.stack(product(turn[:, parent].T, turn[:, k].T), axis=1)
        self.model = StreamedSkeleton(name, NUMBER, _bones(joints, parents, centre, turn))
        self._rows: Array = np.zeros((len(motion), len(joints)), BODY)
        self._rows["id"] = NUMBER << 16 | np.arange(1, len(joints) + 1)
        self._rows["position"] = centre @ UP[up].T
        turned = product(UP_TURN[up], np.moveaxis(turn, -1, 0))
        self._rows["quaternion"] = np.stack(turned, axis=-1)[..., [1, 2, 3, 0]]
        known = np.isfinite(self._rows["position"]).all(axis=2) & np.isfinite(turn).all(axis=2)
        self._rows["params"] = np.where(known, TRACKED, 0)
        self._last = _nowhere(len(joints))

    def at(self, frame: int) -> tuple[tuple[int, Array], ...]:
        """Return the skeleton at a frame; a bone without a pose keeps its last one and is not ``TRACKED``."""
        self._last["params"] = 0
        row = int(np.searchsorted(self.frames, frame))
        if row < len(self.frames) and self.frames[row] == frame:
            known = self._rows[row]["params"] == TRACKED
            self._last[known] = self._rows[row][known]
        return ((NUMBER, self._last.copy()),)

    def restart(self) -> None:
        """Forget the last poses."""
        self._last = _nowhere(len(self._last))


def _nowhere(bones: int) -> Array:
    made: Array = np.zeros(bones, BODY)
    made["id"], made["quaternion"] = NUMBER << 16 | np.arange(1, bones + 1), [0.0, 0.0, 0.0, 1.0]
    return made


def _parts(joint: str) -> tuple[str, str]:
    """Return the side ("l_", "r_" or "") and the rest of a joint's name."""
    return (joint[:2], joint[2:]) if joint[:2] in ("l_", "r_") else ("", joint)


def _above(joint: str) -> str:
    side, name = _parts(joint)
    above = _ABOVE[name]
    return above if above in JOINTS else side + above


def _bones(joints: list[str], parents: list[int], centre: Array, turn: Array) -> tuple[StreamedBody, ...]:
    """Return definitions; ``offset``: median place of the bone's joint in its parent's axes [m], 0 where unknown."""
    bones = []
    for k, (joint, parent) in enumerate(zip(joints, parents, strict=True)):
        offset = np.zeros(3)
        if parent >= 0:
            known_turns = np.flatnonzero(np.isfinite(turn[:, parent]).all(axis=1))
            there = [
                rotation_from_quaternion(turn[i, parent]).T @ (centre[i, k] - centre[i, parent])
                for i in known_turns[:: max(1, len(known_turns) // MOST_INSTANTS)]
            ]
            known = [one for one in there if np.isfinite(one).all()]
            offset = np.median(known, axis=0) if known else offset
        side, name = _parts(joint)
        x, y, z = offset.tolist()
        bones.append(StreamedBody(side + _SEGMENTS[name], k + 1, parent=parent + 1, offset=(x, y, z)))
    return tuple(bones)
