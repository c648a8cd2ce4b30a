"""The operation ``foot_lock``: holds the ankle of a standing foot, by two-bone inverse kinematics of its leg."""

from dataclasses import replace

import numpy as np
from pydantic.dataclasses import dataclass
from scipy.spatial.transform import Rotation

from mosca.data.arrays import Array
from mosca.data.files.toml import SETTINGS, NotNegative, Positive
from mosca.data.motion.motion import Motion, forward_kinematics
from mosca.editing.motion_operations import beside, frames_of, joint_index, quaternions_of
from mosca.editing.operation import EditError, Frames, eased, rows_between

STRAIGHT_RAD = 1e-2
"""Bend of the knee below which hip, knee and ankle do not determine their plane."""
STILL_SHARE = 0.25
"""An ankle stands below this share of the 95 % quantile of its speed, which is about its peak in a walk's swing."""
SWAY_MPS = 0.05
"""Least speed limit of a standing ankle: one that stands all the time has no swing to compare with."""


@dataclass(frozen=True, config=SETTINGS)
class FootLock:
    """Hold the ankle during contacts where it is when it is slowest, corrections fade over ``blend_s`` [s].

    ``leg``: hip, knee and ankle joint. ``contacts``: first and last frames; without them, stretches of
    ``shortest_s`` or more in which the ankle is slower than ``still_mps``, by default STILL_SHARE of its own fast
    motion, as far as the leg reaches the place. Hip and knee turn as little as that takes; the foot keeps its
    direction in the world. While it is blended, a leg that is too short stretches out towards the place.
    """

    leg: tuple[str, str, str]
    contacts: tuple[Frames, ...] | None = None
    still_mps: Positive | None = None
    shortest_s: NotNegative = 0.1
    blend_s: NotNegative = 0.1

    def apply(self, take: Motion) -> Motion:
        """Return the motion with this leg changed in and around the contacts; EditError where there is none."""
        joints = [joint_index(take.skeleton, name, "leg") for name in self.leg]
        if [int(take.skeleton.parents[k]) for k in joints[1:]] != joints[:2] or joints[0] == 0:
            raise EditError(
                "leg", f"{list(self.leg)} given; hip, knee and ankle, each the parent of the next, wanted"
            )
        positions, rotations = forward_kinematics(take)
        ankle = positions[:, joints[2]]
        found = self._contacts(take, positions[:, joints])
        contacts = [frames for frames, _ in found]
        weight, target = np.zeros(len(ankle)), np.array(ankle)
        lead = round(self.blend_s * take.frame_rate_hz)
        frame = frames_of(take)
        for k, (first, last) in enumerate(contacts):
            before = (first - contacts[k - 1][1] - 1) // 2 if k else lead
            after = (contacts[k + 1][0] - last - 1) // 2 if k + 1 < len(contacts) else lead
            away = np.maximum(first - frame, frame - last)
            over = np.where(frame < first, min(lead, before), min(lead, after)) + 1.0
            own = np.where(away <= 0, 1.0, eased(np.clip(1.0 - away / over, 0.0, 1.0), "smooth"))
            # the correction at the contact's end fades out: a foot in swing is not pulled to the contact's place
            target += own[:, None] * (found[k][1] - ankle[np.clip(frame, first, last)])
            weight = np.maximum(weight, own)
        rows = weight > 0
        world = rotations[rows][:, joints]
        hinge = _mean_hinge(positions[:, joints], rotations[:, joints[0]])
        turned = _turned(positions[rows][:, joints], world, target[rows], hinge)
        parents = (rotations[rows, take.skeleton.parents[joints[0]]], turned[:, 0], turned[:, 1])
        changed = np.array(take.rotations)
        for k, joint in enumerate(joints):
            local = quaternions_of(Rotation.from_matrix(np.swapaxes(parents[k], 1, 2) @ turned[:, k]))
            changed[rows, joint] = beside(local, take.rotations[rows, joint])
        return replace(take, rotations=changed)

    def _contacts(self, take: Motion, leg: Array) -> list[tuple[Frames, Array]]:
        """Return contacts and the places (3,) held in them; ``leg`` (t, 3, 3): hip, knee, ankle."""
        speed, shortest = speeds(leg[:, 2], take.frame_rate_hz), self.shortest_s * take.frame_rate_hz
        if self.contacts is not None:
            last = -1
            for one in self.contacts:
                rows_between(frames_of(take), one, "contacts")
                found, beyond_m = _within_reach(leg, speed, one)
                if found[0] != one or one[0] <= last:
                    what = f"the leg is {1e3 * beyond_m:.0f} mm too short in it" if found[0] != one else "it overlaps"
                    raise EditError("contacts", f"{list(one)} given; {what}; a shorter contact is wanted")
                last = one[1]
            return [_within_reach(leg, speed, one)[0] for one in self.contacts]
        learned = max(STILL_SHARE * float(np.quantile(speed, 0.95)), SWAY_MPS)
        still = learned if self.still_mps is None else self.still_mps
        held = [_within_reach(leg, speed, one)[0] for one in still_stretches(speed, still, shortest)]
        held = [one for one in held if one[0][1] - one[0][0] + 1 >= max(shortest, 1)]
        if not held:
            text = f"{still:.3g} taken; '{self.leg[2]}' is never slower, within the leg's reach, for"
            raise EditError("still_mps", f"{text} {self.shortest_s:g} s on end")
        return held


def _within_reach(leg: Array, speed: Array, frames: Frames) -> tuple[tuple[Frames, Array], float]:
    """Return the part of ``frames`` in which the place (3,) of the slowest ankle is in reach, and this place.

    The last value is the largest distance [m] by which the place is out of reach.
    """
    first, last = frames
    slowest = first + int(np.argmin(speed[first : last + 1]))
    place = leg[slowest, 2]
    reach = np.linalg.norm(np.diff(leg[slowest], axis=0), axis=1).sum()
    beyond = np.linalg.norm(leg[first : last + 1, 0] - place, axis=1) - reach
    outside = first + np.flatnonzero(beyond > 1e-9)
    begin = max(outside[outside < slowest], default=first - 1) + 1
    end = min(outside[outside > slowest], default=last + 1) - 1
    return ((int(begin), int(end)), place), float(beyond.max())


def speeds(xyz: Array, rate_hz: float) -> Array:
    """Return the speed (t,) [m/s] of a point (t, 3) [m], by central differences."""
    if len(xyz) < 2:
        return np.zeros(len(xyz))
    result: Array = np.linalg.norm(np.gradient(xyz, axis=0), axis=1) * rate_hz
    return result


def still_stretches(speed: Array, still_mps: float, shortest: float) -> list[Frames]:
    """Return first and last frames of the stretches of ``shortest`` frames or more below ``still_mps`` [m/s]."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], speed < still_mps, [0]])))
    ends = zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)
    return [(first, end - 1) for first, end in ends if end - first >= max(shortest, 1)]


def _mean_hinge(leg: Array, hip: Array) -> Array:
    """Return the knee's axis (3,) in the hip's axes, from all frames, weighted by the bend; EditError if none."""
    normals = np.cross(leg[:, 2] - leg[:, 1], leg[:, 0] - leg[:, 1])
    mean = np.einsum("tji,tj->i", hip, normals)
    bones = np.linalg.norm(leg[0, 1] - leg[0, 0]) * np.linalg.norm(leg[0, 2] - leg[0, 1])
    if np.linalg.norm(mean) <= STRAIGHT_RAD * bones:
        raise EditError("leg", "this leg never bends, or has a bone without length: its knee's axis is not told")
    result: Array = mean / np.linalg.norm(mean)
    return result


def _turned(leg: Array, world: Array, target: Array, hinge: Array) -> Array:
    """Return world rotations (n, 3, 3, 3) of hip, knee and ankle that put the ankle at ``target`` (n, 3).

    ``leg`` (n, 3, 3) positions, ``world`` (n, 3, 3, 3) present rotations. The knee turns about its axis until the
    distance from hip to ankle is right (law of cosines); then the leg turns about the hip the shortest way.
    """
    hip, knee, ankle = np.moveaxis(leg, 1, 0)
    thigh, shin, aim = hip - knee, ankle - knee, target - hip
    a, b = np.linalg.norm(thigh, axis=1), np.linalg.norm(shin, axis=1)
    distance = np.clip(np.linalg.norm(aim, axis=1), np.abs(a - b), a + b)
    wanted = np.arccos(np.clip((a * a + b * b - distance * distance) / (2.0 * a * b), -1.0, 1.0))
    normal = np.cross(shin, thigh)
    size = np.linalg.norm(normal, axis=1)
    now = np.arctan2(size, np.sum(shin * thigh, axis=1))
    own = normal / np.maximum(size, 1e-300)[:, None]
    axis = np.where((np.pi - now > STRAIGHT_RAD)[:, None], own, world[:, 0] @ hinge)
    bend = Rotation.from_rotvec((now - wanted)[:, None] * axis)
    there = knee + bend.apply(shin) - hip
    swing_axis = np.cross(there, aim)
    sine = np.linalg.norm(swing_axis, axis=1)
    angle = np.arctan2(sine, np.sum(there * aim, axis=1))
    swing = Rotation.from_rotvec(swing_axis * (angle / np.maximum(sine, 1e-300))[:, None])
    return np.stack([swing.as_matrix() @ world[:, 0], (swing * bend).as_matrix() @ world[:, 1], world[:, 2]], axis=1)
