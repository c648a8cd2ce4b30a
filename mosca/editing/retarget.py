"""The operation ``retarget``: the same motion on another body."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass

from mosca.data.arrays import Array
from mosca.data.files.toml import SETTINGS, Positive
from mosca.data.motion.bvh import read_bvh
from mosca.data.motion.motion import Motion, Skeleton, forward_kinematics
from mosca.editing.motion_operations import joint_index
from mosca.editing.operation import EditError, Labels


@dataclass(frozen=True, config=SETTINGS)
class Retarget:
    """Put the motion on the skeleton of another BVH file.

    ``joints``: its names = names here, where they differ; a joint without a counterpart keeps the rest pose.
    Rotations are kept; so both skeletons are to have the same rest pose. ``feet``: joints here whose
    bones above them are shin and thigh. The root's path is scaled by the length of the legs, and raised or lowered so
    that in each frame the lowest foot stands as high over the floor as here, scaled too; the floor is where
    the lowest foot ever is.
    """

    skeleton: Path
    feet: Labels
    joints: dict[str, str] = Field(default_factory=dict)
    metres_per_unit: Positive = 0.01

    def within(self, folder: Path) -> "Retarget":
        """Return the same operation with the skeleton's path relative to ``folder``."""
        return replace(self, skeleton=folder / self.skeleton)

    def apply(self, take: Motion) -> Motion:
        """Return the motion of the other skeleton; EditError where names do not fit."""
        other = read_bvh(self.skeleton, metres_per_unit=self.metres_per_unit).skeleton
        return retargeted(take, other, self.feet, self.joints)


def retargeted(take: Motion, other: Skeleton, feet: tuple[str, ...], joints: dict[str, str]) -> Motion:
    """Return ``take`` on the skeleton ``other``, as described in ``Retarget``."""
    for name, mine in joints.items():
        joint_index(other, name, "joints"), joint_index(take.skeleton, mine, "joints")
    sources = [joints.get(name, name) for name in other.names]
    rotations = np.zeros((len(take.root_xyz), len(sources), 4))
    rotations[..., 0] = 1.0
    for k, name in enumerate(sources):
        if name in take.skeleton.names:
            rotations[:, k] = take.rotations[:, take.skeleton.index(name)]
    ours = [joint_index(take.skeleton, name, "feet") for name in feet]
    missing = [name for name in feet if name not in sources]
    if missing or sources[0] != take.skeleton.names[0]:
        lacking = missing[0] if missing else take.skeleton.names[0]
        raise EditError("joints", f"'{lacking}' has no counterpart in the other skeleton; give one in 'joints'")
    theirs = [sources.index(name) for name in feet]
    ratio = _leg_m(other, theirs) / _leg_m(take.skeleton, ours)
    low = _lowest_m(take, ours)
    floor = low.min()
    start = np.array([0.0, 0.0, floor])
    made = Motion(other, take.frame_rate_hz, start + ratio * (take.root_xyz - start), rotations)
    root = np.array(made.root_xyz)
    root[:, 2] += floor + ratio * (low - floor) - _lowest_m(made, theirs)
    return replace(made, root_xyz=root)


def _leg_m(skeleton: Skeleton, feet: list[int]) -> float:
    """Return the mean length [m] of the two bones above each of ``feet``."""
    if any(k == 0 or skeleton.parents[k] <= 0 for k in feet):
        raise EditError(
            "feet", f"{[skeleton.names[k] for k in feet]} given; ankles, with shin and thigh above, wanted"
        )
    bones = [skeleton.offsets[[k, skeleton.parents[k]]] for k in feet]
    length = float(np.linalg.norm(bones, axis=2).sum(axis=1).mean())
    if length <= 0:
        raise EditError("feet", f"{[skeleton.names[k] for k in feet]} given; the legs above them have no length")
    return length


def _lowest_m(take: Motion, feet: list[int]) -> Array:
    """Return the height (t,) [m] of the lowest of the feet and the joints below them."""
    below = set(feet)
    for k, parent in enumerate(take.skeleton.parents.tolist()):
        if parent in below:
            below.add(k)
    result: Array = forward_kinematics(take)[0][:, sorted(below), 2].min(axis=1)
    return result
