"""Postures of a person given by the positions of hands and feet, and the joint rotations for them.

Arms and legs are chains of two bones, solved in closed form by the law of cosines. A target out of reach is
moved in smoothly, so that elbows and knees never lock. The skeleton is ``gait.walker_skeleton``: at rest it
faces -y, its left at +x. Targets of hands are given as (outward, forward, up), so that the same numbers describe
mirrored positions left and right.
"""

from dataclasses import dataclass, fields, replace

import numpy as np
from scipy.spatial.transform import Rotation

from mosca.data.arrays import Array
from mosca.data.motion.motion import (
    Motion,
    Skeleton,
    forward_kinematics,
    matrices_from_quaternions,
    quaternions_from_euler,
    without_flips,
)

STATURE_M = 1.75
"""Height of the person for whom choreographies are written; they are scaled for others."""
_LONGEST_SHARE = 0.985  # of a limb's length: an elbow or knee stays bent by 10 deg at least
_SOFT_SHARE = 0.02  # of a limb's length: how early it is drawn in
_BALANCE_STEPS, _BALANCE_GAIN = 7, 1.25
_SIDES = (("l", 1.0), ("r", -1.0))


@dataclass(frozen=True, eq=False)
class Postures:
    """A person at n instants, floor z = 0 [m, rad]; second axis of limbs: left, right."""

    pelvis_xyz: Array
    """(n, 3): position of the root."""
    facing: Array
    """(n,) heading: angle to the left from -y."""
    pelvis: Array
    """(n, 3) rotation to the left, lean forward, bend to the left; relative to ``facing``."""
    spine: Array
    """(n, 3): the same rotations of the chest relative to the pelvis."""
    gaze: Array
    """(n, 2) rotation and nod of the head relative to ``facing``."""
    hands: Array
    """(n, 2, 3) wrists from the middle of the shoulders, (outward, forward, up) along ``facing``."""
    elbows: Array
    """(n, 2, 3) direction of the elbow in the same axes."""
    forearms: Array
    """(n, 2) twist."""
    wrists: Array
    """(n, 2) flexion."""
    balls: Array
    """(n, 2, 3) balls of the feet in the world, z above the floor."""
    feet: Array
    """(n, 2, 2) rotation to the left in the world, and pitch (heel up)."""
    knees: Array
    """(n, 2) rotation outward of the knee relative to the foot."""

    def mirrored(self) -> "Postures":
        """Return the same postures with left and right exchanged."""
        flip = {f.name: getattr(self, f.name).copy() for f in fields(self)}
        for name in ("hands", "elbows", "forearms", "wrists", "balls", "feet", "knees"):
            flip[name] = flip[name][:, ::-1].copy()
        flip["pelvis_xyz"][:, 0] *= -1
        flip["facing"] *= -1
        for name in ("pelvis", "spine"):
            flip[name][:, [0, 2]] *= -1
        flip["gaze"][:, 0] *= -1
        flip["balls"][..., 0] *= -1
        flip["feet"][..., 0] *= -1
        return Postures(**flip)


@dataclass(frozen=True, eq=False)
class Balance:
    """Masses (j,) [kg] that the joints' bones carry, and their centres (j, 3) in the joints' axes [m]."""

    masses: Array
    centers: Array

    def center_of_mass(self, motion: Motion) -> Array:
        """Return the body's centre of mass (t, 3) [m] in the frames of ``motion``."""
        positions, world_from_joint = forward_kinematics(motion)
        places = positions + np.einsum("tjab,jb->tja", world_from_joint, self.centers)
        return np.asarray(np.einsum("j,tja->ta", self.masses / self.masses.sum(), places))


@dataclass(frozen=True, eq=False)
class Performer:
    """A moving person: a ``gait.walker_skeleton``, ``scale`` times 1.75 m tall, and the masses of its bones.

    ``sole_m``: height of the ball joint of a foot on the floor [m].
    """

    skeleton: Skeleton
    scale: float
    sole_m: float
    balance: Balance


def posed(performer: Performer, p: Postures, frame_rate_hz: float) -> Motion:
    """Return the motion of ``performer`` through the postures ``p``."""
    skeleton, world = performer.skeleton, _trunk(p)
    local = {"upperback": world["bend"], "thorax": world["bend"], **_head(p)}
    at = skeleton.offsets
    upperback = p.pelvis_xyz + world["root"] @ at[skeleton.index("upperback")]
    thorax = upperback + (world["root"] @ world["bend"]) @ at[skeleton.index("thorax")]
    shoulders = [thorax + world["thorax"] @ at[skeleton.index(f"{side}humerus")] for side, _ in _SIDES]
    middle = (shoulders[0] + shoulders[1]) / 2
    for k, (side, sign) in enumerate(_SIDES):
        hand = middle + _along(p.facing, p.hands[:, k], sign)
        pole = _along(p.facing, p.elbows[:, k], sign)
        bones = [float(np.linalg.norm(at[skeleton.index(f"{side}{bone}")])) for bone in ("radius", "hand")]
        upper, inside, flexion = _two_bones(shoulders[k], hand, bones, pole)
        # Arms lie along x at rest and bend towards -y.
        humerus = np.stack([sign * upper, -inside, np.cross(sign * upper, -inside)], axis=-1)
        local[f"{side}humerus"] = _transposed(world["thorax"]) @ humerus
        local[f"{side}radius"] = _euler("ZX", np.stack([-sign * flexion, p.forearms[:, k]], axis=-1))
        local[f"{side}hand"] = _euler("Z", -sign * p.wrists[:, k, None])
        _leg(performer, p, k, world["root"], local)
    local["root"] = world["root"]
    rotations = np.zeros((len(p.facing), len(skeleton.names), 4))
    rotations[..., 0] = 1.0
    for name, matrices in local.items():
        xyzw = Rotation.from_matrix(matrices).as_quat()
        rotations[:, skeleton.index(name)] = xyzw[:, [3, 0, 1, 2]]
    return Motion(skeleton, frame_rate_hz, p.pelvis_xyz, without_flips(rotations))


def balanced(performer: Performer, p: Postures, frame_rate_hz: float, wanted: Array) -> Motion:
    """Return the motion through ``p`` with the pelvis moved so that the centre of mass is at ``wanted`` (n, 3).

    The remaining error is reduced by a fixed-point iteration. Since the feet stay in place, a correction is 0 to 40 %
    too small; it is over-relaxed by a quarter, and seven iterations leave micrometres.
    """
    for _ in range(_BALANCE_STEPS):
        motion = posed(performer, p, frame_rate_hz)
        missing = wanted - performer.balance.center_of_mass(motion)
        p = replace(p, pelvis_xyz=p.pelvis_xyz + _BALANCE_GAIN * missing)
    return posed(performer, p, frame_rate_hz)


def _trunk(p: Postures) -> dict[str, Array]:
    """Return the rotations (n, 3, 3) of root and thorax in the world and of half of the spine."""
    root = _euler("Z", p.facing[:, None]) @ _euler("ZXY", p.pelvis)
    bend = _euler("ZXY", p.spine / 2)
    return {"root": root, "bend": bend, "thorax": root @ bend @ bend}


def _head(p: Postures) -> dict[str, Array]:
    """Return the rotations of neck and head for ``gaze``, independent of the trunk."""
    wanted = p.gaze - (p.pelvis + p.spine)[:, :2]
    return {"lowerneck": _euler("ZX", 0.45 * wanted), "head": _euler("ZX", 0.45 * wanted)}


def _leg(performer: Performer, p: Postures, k: int, root: Array, local: dict[str, Array]) -> None:
    side, sign = _SIDES[k]
    skeleton, at = performer.skeleton, performer.skeleton.offsets
    hip = p.pelvis_xyz + root @ at[skeleton.index(f"{side}femur")]
    foot = _euler("ZX", p.feet[:, k])
    ankle = p.balls[:, k] + [0.0, 0.0, performer.sole_m] - foot @ at[skeleton.index(f"{side}toes")]
    heading = p.feet[:, k, 0] + sign * p.knees[:, k]
    pole = np.stack([np.sin(heading), -np.cos(heading), np.full(len(heading), 0.1)], axis=-1)
    bones = [float(np.linalg.norm(at[skeleton.index(f"{side}{bone}")])) for bone in ("tibia", "foot")]
    thigh, behind, flexion = _two_bones(hip, ankle, bones, pole)
    femur = np.stack([np.cross(behind, -thigh), behind, -thigh], axis=-1)
    tibia = _euler("X", flexion[:, None])
    local[f"{side}femur"] = _transposed(root) @ femur
    local[f"{side}tibia"] = tibia
    local[f"{side}foot"] = _transposed(femur @ tibia) @ foot
    # Toes stay flat on the floor while the heel is up.
    local[f"{side}toes"] = _euler("X", -p.feet[:, k, 1:])


def _two_bones(start: Array, end: Array, bones: list[float], pole: Array) -> tuple[Array, Array, Array]:
    """Return a chain's first bone's direction (n, 3), the side (n, 3) to which it bends, and its flexion (n,).

    ``start`` and ``end`` (n, 3): ends of the chain; ``bones``: lengths of its two bones [m]; ``pole`` (n, 3): the
    direction of its middle joint. The side is across the first bone; the flexion is the angle between the bones.
    """
    first, second = bones
    way = end - start
    far = np.linalg.norm(way, axis=1)
    longest, soft = _LONGEST_SHARE * (first + second), _SOFT_SHARE * (first + second)
    length = (far + longest - np.sqrt((far - longest) ** 2 + soft**2)) / 2
    along = way / far[:, None]
    across = pole - np.sum(pole * along, axis=1, keepdims=True) * along
    across = across / np.linalg.norm(across, axis=1, keepdims=True)
    cosine = np.clip((first**2 + length**2 - second**2) / (2 * first * length), -1.0, 1.0)
    sine = np.sqrt(1 - cosine**2)
    bone = cosine[:, None] * along + sine[:, None] * across
    side = sine[:, None] * along - cosine[:, None] * across
    return bone, side, np.arctan2(length * sine, length * cosine - first)


def _along(facing: Array, values: Array, sign: float) -> Array:
    """Return (outward, forward, up) values (n, 3) of a side as world vectors, for a person with this ``facing``."""
    at_rest = np.stack([sign * values[:, 0], -values[:, 1], values[:, 2]], axis=-1)
    c, s = np.cos(facing), np.sin(facing)
    x, y = at_rest[:, 0], at_rest[:, 1]
    return np.stack([c * x - s * y, s * x + c * y, at_rest[:, 2]], axis=-1)


def _euler(order: str, angles: Array) -> Array:
    """Return rotation matrices (n, 3, 3) of ``angles`` (n, k) about axes ``order``, left to right."""
    return matrices_from_quaternions(quaternions_from_euler(angles, order))


def _transposed(matrices: Array) -> Array:
    return np.swapaxes(matrices, -1, -2)
