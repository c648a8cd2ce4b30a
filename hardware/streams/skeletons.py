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
"""Number of the only skeleton."""
MOST_INSTANTS = 500
"""Number of instants whose median is a bone's offset, a length of the fitted model that is equal in all of them."""
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

    ``frames`` (n,) and ``time_ns`` (n,): those of the poses. Joints whose joint above is missing are left out.
    """

    def __init__(self, motion: JointMotion, up: UpAxis = "z", name: str = "person") -> None:
        self.frames, self.time_ns = motion.frame, motion.time_ns
        self._up: UpAxis = up
        self._joints: list[str] = []
        for joint in JOINTS:  # from the pelvis on outward
            if joint in motion.joints and (joint == "pelvis" or _above(joint) in self._joints):
                self._joints.append(joint)
        self._parents = [-1 if one == "pelvis" else self._joints.index(_above(one)) for one in self._joints]
        centre, turn = self._in_world(motion)
        self.model = StreamedSkeleton(name, NUMBER, _bones(self._joints, self._parents, centre, turn))
        self._rows = self._records(centre, turn)
        self._last = _nowhere(len(self._joints))

    def at(self, frame: int) -> tuple[tuple[int, Array], ...]:
        """Return the skeleton at a frame; a bone without a pose keeps its last one and is not ``TRACKED``."""
        row = int(np.searchsorted(self.frames, frame))
        there = row < len(self.frames) and self.frames[row] == frame
        return self._after(self._rows[row] if there else None)

    def posed(self, motion: JointMotion | None) -> tuple[tuple[int, Array], ...]:
        """Return the skeleton at the one instant of a ``motion`` with the same joints; None: not known."""
        return self._after(None if motion is None else self._records(*self._in_world(motion))[0])

    def restart(self) -> None:
        """Forget the last poses."""
        self._last = _nowhere(len(self._last))

    def _in_world(self, motion: JointMotion) -> tuple[Array, Array]:
        """Return the joints' centres (n, b, 3) and their segments' quaternions wxyz in the world (n, b, 4)."""
        columns = [motion.joints.index(joint) for joint in self._joints]
        turn = np.array(motion.rotation[:, columns])
        for k, parent in enumerate(self._parents):
            if parent >= 0:
                turn[:, k] = np.stack(product(turn[:, parent].T, turn[:, k].T), axis=1)
        return motion.centre[:, columns], turn

    def _records(self, centre: Array, turn: Array) -> Array:
        """Return records (n, b) BODY."""
        rows: Array = np.zeros(turn.shape[:2], BODY)
        rows["id"] = NUMBER << 16 | np.arange(1, turn.shape[1] + 1)
        rows["position"] = centre @ UP[self._up].T
        turned = product(UP_TURN[self._up], np.moveaxis(turn, -1, 0))
        rows["quaternion"] = np.stack(turned, axis=-1)[..., [1, 2, 3, 0]]
        known = np.isfinite(rows["position"]).all(axis=2) & np.isfinite(turn).all(axis=2)
        rows["params"] = np.where(known, TRACKED, 0)
        return rows

    def _after(self, row: Array | None) -> tuple[tuple[int, Array], ...]:
        self._last["params"] = 0
        if row is not None:
            known = row["params"] == TRACKED
            self._last[known] = row[known]
        return ((NUMBER, self._last.copy()),)


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
