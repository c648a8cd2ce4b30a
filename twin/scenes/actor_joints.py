"""The actor's anatomical frames (``mosca.data.truth.JointTruth``), from its markers and joints in the rest pose."""

from collections.abc import Mapping

import mujoco
import numpy as np

from mosca.data.arrays import Array
from mosca.data.joint_motion import JOINTS
from mosca.data.motion.motion import Motion, forward_kinematics
from twin.scenes.actor_markers import Seat
from twin.scenes.anatomy import LEFT, UP, Anatomy
from twin.scenes.joint_frames import JointFrames, Segment

_LEAST_SPREAD = 1.0 - float(np.cos(np.deg2rad(10.0)))
"""Least spread of a joint's rotations from which its axis is estimated: 10 degrees rms about it. Recorded bones are
off by a degree or so, which then tilts the axis by a tenth of a radian."""
FlexionAxes = Mapping[str, tuple[Array, Array]]
"""Joint ("l_knee", "r_elbow", ...) -> its axis of flexion (3,) in the proximal and in the distal bone."""
_BENT = {"knee": ("thigh", "shank"), "elbow": ("upper_arm", "forearm")}
_SIDES = ("l", "r")


def hinge_axes() -> FlexionAxes:
    """Return the axes of ``gait.walker_skeleton``: knees bend about x, elbows about z."""
    axes: dict[str, tuple[Array, Array]] = {}
    for side, sign in zip(_SIDES, (-1.0, 1.0), strict=True):
        axes[f"{side}_knee"] = -LEFT, -LEFT
        axes[f"{side}_elbow"] = sign * UP, sign * UP
    return axes


def recorded_axes(anatomy: Anatomy, motion: Motion) -> FlexionAxes:
    """Return the axes of a recording's knees and elbows (NaN where they hardly bend)."""
    _, world_from_joint = forward_kinematics(motion)
    axes: dict[str, tuple[Array, Array]] = {}
    for side in _SIDES:
        for joint, (near, far) in _BENT.items():
            bones = [world_from_joint[:, anatomy.parts[f"{side}_{part}"]] for part in (near, far)]
            axes[f"{side}_{joint}"] = flexion_axis(np.swapaxes(bones[0], -1, -2) @ bones[1], flexed=joint == "elbow")
    return axes


def flexion_axis(rotations: Array, *, flexed: bool) -> tuple[Array, Array]:
    """Return the unit axis (3,) in the proximal and in the distal bone about which a joint turns.

    ``rotations`` (n, 3, 3) proximal_from_distal, unity when straight; ``flexed``: whether it flexes about the axis
    (else extends). The axes are the least-squares solution of R_i b = a over unit a and b (SARA, Ehrig et al. 2007,
    J. Biomech. 40, 2150): the first singular vectors of the mean rotation. NaN where the rotations spread by less
    than _LEAST_SPREAD.
    """
    mean = np.mean(rotations, axis=0)
    u, spread, vt = np.linalg.svd(mean)
    if spread[0] - spread[1] < _LEAST_SPREAD:
        return np.full(3, np.nan), np.full(3, np.nan)
    turned = u[:, 0] @ np.array([mean[2, 1] - mean[1, 2], mean[0, 2] - mean[2, 0], mean[1, 0] - mean[0, 1]])
    sign = 1.0 if (turned > 0) == flexed else -1.0
    return sign * u[:, 0], sign * vt[0]


def joint_frames(
    anatomy: Anatomy, seated: list[Seat], diameter_m: float, flexion: FlexionAxes, model: mujoco.MjModel
) -> JointFrames:
    """Return the frames of an actor whose bodies in ``model`` have the names of the skeleton's joints."""
    landmarks = {seat.name: seat.centre(diameter_m) for seat in seated}

    def body(part: str) -> int:
        return int(model.body(anatomy.skeleton.names[anatomy.parts[part]]).id)

    def segment(part: str, axes: Array) -> Segment:
        return Segment(body(part), axes)

    world = Segment(0, np.eye(3))
    pelvis, thorax, head = (
        segment(part, axes)
        for part, axes in zip(("pelvis", "chest", "head"), _trunk_axes(_Points(landmarks)), strict=True)
    )
    joined = {"pelvis": (world, pelvis), "lumbar": (pelvis, thorax), "neck": (thorax, head)}
    centres = {"pelvis": (body("l_thigh"), body("r_thigh"))}
    for side in _SIDES:
        thigh, shank, foot = (
            segment(f"{side}_{part}", axes)
            for part, axes in zip(
                ("thigh", "shank", "foot"), _leg_axes(anatomy, landmarks, flexion, side), strict=True
            )
        )
        carrier = anatomy.part_or(f"{side}_wrist", f"{side}_forearm")
        arm = _arm_axes(anatomy, landmarks, flexion, side)
        upper_arm, hand = segment(f"{side}_upper_arm", arm[0]), segment(f"{side}_hand", arm[2])
        forearm = segment(carrier, arm[1])
        for joint, near, far, part in (
            ("hip", pelvis, thigh, "thigh"),
            ("knee", thigh, shank, "shank"),
            ("ankle", shank, foot, "foot"),
            ("shoulder", thorax, upper_arm, "upper_arm"),
            ("elbow", upper_arm, forearm, "forearm"),
            ("wrist", forearm, hand, "hand"),
        ):
            joined[f"{side}_{joint}"] = near, far
            centres[f"{side}_{joint}"] = body(f"{side}_{part}"), body(f"{side}_{part}")
    return JointFrames.of({name: joined[name] for name in JOINTS}, centres)


class _Points:
    """Landmarks by name; NaN for those that are not worn, so that results computed from them are NaN."""

    def __init__(self, landmarks: Mapping[str, Array]) -> None:
        self._landmarks = landmarks

    def mid(self, *names: str) -> Array:
        """Return the middle (3,) of landmarks."""
        return np.asarray(np.mean([self._landmarks.get(name, np.full(3, np.nan)) for name in names], axis=0))


def _trunk_axes(at: _Points) -> tuple[Array, Array, Array]:
    """Return the axes (3, 3) of pelvis, thorax and head in the rest pose."""
    pelvis = _from_z(at.mid("RASI") - at.mid("LASI"), x=at.mid("LASI", "RASI") - at.mid("LPSI", "RPSI"))
    low = at.mid("STRN", "T10")
    up = at.mid("CLAV", "C7") - low
    thorax = _from_y(up, z=np.cross(at.mid("CLAV") - at.mid("C7"), up))
    ahead = at.mid("LFHD", "RFHD") - at.mid("LBHD", "RBHD")
    head = _from_x(ahead, z=at.mid("RFHD", "RBHD") - at.mid("LFHD", "LBHD"))
    return pelvis, thorax, head


def _leg_axes(
    anatomy: Anatomy, landmarks: Mapping[str, Array], flexion: FlexionAxes, side: str
) -> tuple[Array, Array, Array]:
    """Return the axes (3, 3) of thigh, shank and foot in the rest pose."""
    at, letter = _Points(landmarks), side.upper()
    hip, knee, ankle = (anatomy.points[f"{side}_{part}"] for part in ("thigh", "shank", "foot"))
    of_thigh, of_shank = flexion[f"{side}_knee"]
    heel = at.mid(f"{letter}HEE")
    ahead = at.mid(f"{letter}TOE") - heel
    right = 1.0 if side == "r" else -1.0  # where the little toe is
    foot = _from_x(ahead, z=right * (at.mid(f"{letter}MT5") - at.mid(f"{letter}TOE")))
    return _from_y(hip - knee, z=of_thigh), _from_y(knee - ankle, z=of_shank), foot


def _arm_axes(
    anatomy: Anatomy, landmarks: Mapping[str, Array], flexion: FlexionAxes, side: str
) -> tuple[Array, Array, Array]:
    """Return the axes (3, 3) of upper arm, forearm and hand in the rest pose."""
    at, letter = _Points(landmarks), side.upper()
    shoulder, elbow, wrist = (anatomy.points[f"{side}_{part}"] for part in ("upper_arm", "forearm", "hand"))
    right = 1.0 if side == "r" else -1.0  # where thumbs point in the anatomical position
    upper_arm = _from_y(shoulder - elbow, z=flexion[f"{side}_elbow"][0])
    forearm = _from_y(elbow - wrist, z=right * (at.mid(f"{letter}WRA") - at.mid(f"{letter}WRB")))
    finger, little = at.mid(f"{letter}FIN"), at.mid(f"{letter}PNK")
    hand = _from_y(wrist - (finger + little) / 2, z=right * (finger - little))
    return upper_arm, forearm, hand


def _from_x(x: Array, *, z: Array) -> Array:
    """Return axes (3, 3), in columns, with the first along ``x`` and the third nearest to ``z``."""
    first, third = _unit(x), _across(z, x)
    return np.stack([first, np.cross(third, first), third], axis=1)


def _from_y(y: Array, *, z: Array) -> Array:
    """Return axes (3, 3), in columns, with the second along ``y`` and the third nearest to ``z``."""
    second, third = _unit(y), _across(z, y)
    return np.stack([np.cross(second, third), second, third], axis=1)


def _from_z(z: Array, *, x: Array) -> Array:
    """Return axes (3, 3), in columns, with the third along ``z`` and the first nearest to ``x``."""
    third, first = _unit(z), _across(x, z)
    return np.stack([first, np.cross(third, first), third], axis=1)


def _across(vector: Array, axis: Array) -> Array:
    """Return the unit vector (3,) along the part of ``vector`` that is across ``axis``."""
    along = _unit(axis)
    return _unit(vector - vector @ along * along)


def _unit(vector: Array) -> Array:
    return np.asarray(vector / np.linalg.norm(vector))
