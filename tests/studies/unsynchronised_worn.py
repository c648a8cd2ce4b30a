"""Cameras on the actor's body, for the experiment of ``tests.studies.unsynchronised``: they move as its bones do.

Three small fisheye cameras, 200 degrees across, on belly, left wrist and right shin, each on a bracket of 0.2 m to
the front of its bone in the rest pose, and turned there so that in the first frame it looks at the body's middle.
What the body hides is not modelled here: points alone.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mosca.data.arrays import Array
from mosca.data.motion.motion import forward_kinematics
from mosca.data.rig import Camera, FisheyeLens, Pose, Rig
from mosca.errors import InputError
from tests.studies.unsynchronised import FRAME_RATE_HZ, HEIGHT, LONGEST_FRAMES, WIDTH, read_motion, wide_camera

BONES = ("lowerback", "lwrist", "rtibia"), ("abdomen", "lHand", "rShin")
"""Bones of belly, wrist and shin in ASF skeletons and in converted ones."""
BRACKET_M = (0.0, -0.2, 0.0)
FISHEYE_PX = WIDTH / float(np.radians(200.0))


@dataclass(frozen=True, eq=False)
class WornPaths:
    """Cameras on a body: ``rotations`` (t, c, 3, 3) and ``centres`` (t, c, 3) at the frames of the motion only."""

    cameras: tuple[str, ...]
    rotations: Array
    centres: Array

    def at(self, time_s: Array) -> tuple[Array, Array]:
        """Return world_from_camera at instants of frames (t,); InputError at others."""
        frame = np.rint(np.asarray(time_s) * FRAME_RATE_HZ).astype(int)
        if np.abs(frame / FRAME_RATE_HZ - time_s).max(initial=0.0) > 1e-6:
            raise InputError("worn cameras are known at the motion's frames only; ask for those instants")
        return self.rotations[frame], self.centres[frame]


def worn(folder: Path, name: str) -> tuple[Rig, WornPaths]:
    """Return three cameras on the actor of CMU motion ``name`` (the rig: in the first frame), and their paths."""
    motion = read_motion(folder, name)
    joints, turns = (part[:LONGEST_FRAMES] for part in forward_kinematics(motion))
    bones = next(names for names in BONES if names[0] in motion.skeleton.names)
    middle = joints[0].mean(axis=0)
    lens = FisheyeLens(FISHEYE_PX, FISHEYE_PX, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)
    cameras, rotations, centres = [], [], []
    for bone in bones:
        k = motion.skeleton.index(bone)
        path = joints[:, k] + turns[:, k] @ np.array(BRACKET_M)
        first = wide_camera(f"on {bone}", path[0], middle).world_from_camera
        rotations.append(turns[:, k] @ (turns[0, k].T @ first.rotation))
        centres.append(path)
        pose = Pose(rotations[-1][0], path[0])
        cameras.append(Camera(f"on {bone}", WIDTH, HEIGHT, lens, pose))
    paths = WornPaths(tuple(c.name for c in cameras), np.stack(rotations, axis=1), np.stack(centres, axis=1))
    return Rig(tuple(cameras)), paths
