"""The calibration movement of a laboratory: every joint through much of its range, one after the other.

The person stands on one leg and swings the other to the front, back and side and round in a circle, with knee and
ankle bent (star-arc with a circle: Camomilla et al. 2006, J. Biomech. 39, 1096). Then follow the other leg, trunk and
head, and both arms. Feet that stand are fixed, and the pelvis follows from them. Angles [rad], for a loop of 24 s.
"""

from collections.abc import Mapping

import numpy as np

from mosca.data.arrays import Array
from mosca.data.motion.motion import (
    Motion,
    matrices_from_quaternions,
    multiply_quaternions,
    quaternions_from_euler,
    without_flips,
)
from twin.scenes.choreography import loop_times
from twin.scenes.posture import Performer
from twin.scenes.submovements import MovementSequence

LENGTH_S = 24.0
"""Length of a loop as written."""
_LEG_S, _ARMS_AT_S = 7.1, 17.9
_APART, _HIP, _KNEE = 0.03, 0.03, 0.06  # abduction and flexion of legs that stand
_HANGING = 0.3  # abduction of an arm at rest
_SIDES = (("l", 1.0), ("r", -1.0))
_SWAY, _HIKE = 0.12, 0.07  # of the legs over the standing foot, of the pelvis above the other
_LIFTED = (0.3, 0.0, 0.0)  # hip of a leg in the air: flexion, abduction, outward rotation
_LIFTED_KNEE, _LIFTED_ANKLE = 0.6, -0.3
_START: Mapping[str, tuple[float, ...]] = {
    "sway": (0.0,),  # of both legs, to the left
    "on_right": (0.5,),  # share of the weight on the right foot
    "pelvis": (0.0, 0.0, 0.0),  # turn to the left, lean forward, bend to the left
    "spine": (0.0, 0.02, 0.0),
    "head": (0.0, 0.0, 0.0),
}
_SIDED: Mapping[str, tuple[float, ...]] = {
    "hip": (0.0, 0.0, 0.0),  # flexion, abduction, outward rotation
    "knee": (0.0,),
    "ankle": (0.0, 0.0),  # plantar flexion, inversion
    "shoulder": (0.0, _HANGING, 0.0),  # flexion, abduction, rotation about the arm
    "elbow": (0.2, 0.0),  # flexion, twist
    "wrist": (0.0, 0.08),  # palmar flexion, radial deviation
}


def range_of_motion(performer: Performer, rng: np.random.Generator, length_s: float = LENGTH_S) -> Motion:
    """Return a loop of about ``length_s``; ``rng`` draws sizes, first leg, directions of rotation and tempo."""
    sequence = MovementSequence()
    sequence.begin(**_START, **{f"{side}_{name}": value for name, value in _SIDED.items() for side, _ in _SIDES})
    first = int(rng.integers(2))
    for k, side in enumerate(("lr", "rl")[first]):
        _swing_leg(sequence, side, k * _LEG_S, rng)
    _bend_trunk(sequence, 2 * _LEG_S, rng)
    for side, _ in _SIDES:
        _raise_arm(sequence, side, _ARMS_AT_S, rng)
    time_s, rate_hz = loop_times(length_s * float(rng.uniform(0.95, 1.05)))
    return _posed(performer, sequence.at(time_s * (LENGTH_S / time_s[-1])), rate_hz)


def _swing_leg(sequence: MovementSequence, side: str, clock: float, rng: np.random.Generator) -> None:
    """Write: weight to the other foot, star, circle, knee with ankle, down again."""
    outward = 1.0 if side == "l" else -1.0
    hip, knee, ankle = (f"{side}_{name}" for name in ("hip", "knee", "ankle"))
    sequence.visit("sway", (clock, clock + 0.8), (clock + 6.5, clock + 7.1), -outward * _SWAY)
    # the weight changes feet while the pelvis is level: only then do both feet give the same pelvis position
    sequence.visit("on_right", (clock, clock + 0.4), (clock + 6.9, clock + 7.1), 0.5 + 0.5 * outward)
    lift_s, down_s = (clock + 0.4, clock + 1.0), (clock + 6.3, clock + 6.9)
    sequence.visit("pelvis", lift_s, down_s, (0.0, 0.0, -outward * _HIKE))
    size = float(rng.uniform(0.92, 1.04))
    round_way = 1.0 if rng.random() < 0.5 else -1.0
    circle = [(0.1 + 0.42 * np.cos(u), 0.24 + 0.2 * np.sin(u), 0.0) for u in _round(round_way, 9)]
    star = [(0.60, 0.0, 0.0), (-0.52, 0.0, 0.0), (0.1, 0.44, 0.0), (0.1, 0.0, 0.0), (0.50, 0.30, 0.0)]
    times = [(0.9, 1.5), (1.4, 2.2), (2.0, 2.7), (2.6, 3.1), (3.0, 3.6)]
    times += [(3.3 + k * 0.22, 3.8 + k * 0.22) for k in range(9)]
    sequence.move(hip, *lift_s, _LIFTED)
    for (start, end), to in zip(times, [*star, *circle], strict=True):
        sequence.move(hip, clock + start, clock + end, size * np.array(to))
    for start, end, to in ((5.2, 5.7, (0.35, 0.0, 0.25)), (5.6, 6.0, (0.35, 0.0, -0.2)), (5.9, 6.3, _LIFTED)):
        sequence.move(hip, clock + start, clock + end, to)
    sequence.move(knee, *lift_s, _LIFTED_KNEE)
    sequence.visit(knee, (clock + 4.6, clock + 5.2), (clock + 5.7, clock + 6.3), float(rng.uniform(1.1, 1.25)))
    sequence.move(ankle, *lift_s, (_LIFTED_ANKLE, 0.0))
    for k, u in enumerate(_round(round_way, 7)):
        start = clock + 4.8 + 0.15 * k
        sequence.move(ankle, start, start + 0.35, (0.1 + 0.35 * np.cos(u), 0.3 * np.sin(u)))
    sequence.move(ankle, clock + 5.7, clock + 6.3, (_LIFTED_ANKLE, 0.0))
    for channel, standing in ((hip, (0.0, 0.0, 0.0)), (knee, (0.0,)), (ankle, (0.0, 0.0))):
        sequence.move(channel, *down_s, standing)


def _round(way: float, points: int) -> Array:
    """Return the angles (points,) of one revolution to the left (1) or right (-1)."""
    return np.asarray(way * np.linspace(0.0, 2 * np.pi, points))


def _bend_trunk(sequence: MovementSequence, clock: float, rng: np.random.Generator) -> None:
    """Write: trunk forward, to both sides, turned both ways; the head follows later, twice as far."""
    side = 1.0 if rng.random() < 0.5 else -1.0
    upright = sequence.target("spine")
    bends = [(0.0, 0.45, 0.0), (0.0, -0.1, 0.0), (0.0, 0.0, 0.42 * side), (0.0, 0.0, -0.42 * side),
             (0.42 * side, 0.0, 0.0), (-0.42 * side, 0.0, 0.0), (0.25 * side, 0.25, 0.2)]  # fmt: skip
    for k, bend in enumerate(bends):
        start = clock + 0.55 * k
        sequence.move("spine", start, start + 0.85, upright + float(rng.uniform(0.9, 1.05)) * np.array(bend))
    sequence.move("spine", clock + 3.85, clock + 4.6, upright)
    sequence.visit("pelvis", (clock, clock + 0.85), (clock + 0.55, clock + 1.4), (0.0, 0.12, 0.0))
    nods = [(0.0, 0.5, 0.0), (0.0, -0.45, 0.0), (0.8 * side, 0.0, 0.0), (-0.8 * side, 0.0, 0.0),
            (0.0, 0.0, 0.45 * side), (0.0, 0.0, -0.45 * side)]  # fmt: skip
    for k, nod in enumerate(nods):
        start = clock + 3.5 + 0.75 * k
        sequence.move("head", start, start + 1.0, float(rng.uniform(0.9, 1.05)) * np.array(nod))
    sequence.move("head", clock + 8.0, clock + 8.9, (0.0, 0.0, 0.0))


def _raise_arm(sequence: MovementSequence, side: str, clock: float, rng: np.random.Generator) -> None:
    """Write: arm forward and to the side, a circle, the elbow with the arm turned, the wrist round."""
    shoulder, elbow, wrist = (f"{side}_{name}" for name in ("shoulder", "elbow", "wrist"))
    way = 1.0 if rng.random() < 0.5 else -1.0
    circle = [(0.6 + 0.5 * np.cos(u), 0.75 + 0.4 * np.sin(u), 0.0) for u in _round(way, 7)]
    ways = [(1.55, _HANGING, 0.0), (0.0, 0.35, 0.0), (0.0, 1.4, 0.0), *circle, (0.3, 0.35, 0.0)]
    times = [(0.0, 0.8), (0.7, 1.4), (1.2, 1.9), *((1.8 + 0.2 * k, 2.3 + 0.2 * k) for k in range(7)), (3.2, 3.8)]
    for (start, end), to in zip(times, ways, strict=True):
        sequence.move(shoulder, clock + start, clock + end, np.array(to) * [rng.uniform(0.94, 1.0), 1.0, 1.0])
    flexed = float(rng.uniform(1.65, 1.85))
    for start, end, turn in ((3.7, 4.2, 0.4), (4.1, 4.7, -0.35), (4.6, 5.1, 0.3)):
        sequence.move(shoulder, clock + start, clock + end, (0.3, 0.35, turn))
    sequence.move(shoulder, clock + 5.2, clock + 5.9, _SIDED["shoulder"])
    for start, end, turn in ((3.1, 3.9, 0.0), (3.7, 4.4, 0.6), (4.2, 5.0, -0.6)):
        sequence.move(elbow, clock + start, clock + end, (flexed, turn))
    sequence.move(elbow, clock + 4.9, clock + 5.9, _SIDED["elbow"])
    for k, u in enumerate(2 * _round(way, 13)):
        start = clock + 2.6 + 0.2 * k
        sequence.move(wrist, start, start + 0.4, (0.7 * np.cos(u), 0.05 + 0.25 * np.sin(u)))
    sequence.move(wrist, clock + 5.3, clock + 5.8, _SIDED["wrist"])


def _posed(performer: Performer, v: dict[str, Array], rate_hz: float) -> Motion:
    """Return the motion through the channels' values (n, k)."""
    skeleton = performer.skeleton
    n = len(v["sway"])
    rotations = np.zeros((n, len(skeleton.names), 4))
    rotations[..., 0] = 1.0

    def turn(joint: str, wxyz: Array) -> None:
        rotations[:, skeleton.index(joint)] = wxyz

    pelvis = quaternions_from_euler(v["pelvis"], "ZXY")
    turn("root", pelvis)
    for joint, channel in (("upperback", "spine"), ("thorax", "spine"), ("lowerneck", "head"), ("head", "head")):
        turn(joint, quaternions_from_euler(v[channel] / 2, "ZXY"))
    roots = []
    for side, sign in _SIDES:
        thigh, shank, foot, standing = _leg(v, side, sign)
        turn(f"{side}femur", multiply_quaternions(_conjugate(pelvis), thigh))
        turn(f"{side}tibia", shank)
        turn(f"{side}foot", foot)
        roots.append(_root_over(performer, side, sign, pelvis, standing))
        flexion, abduction, about = v[f"{side}_shoulder"].T
        upper_arm = np.stack([-flexion, sign * (np.pi / 2 - abduction), about], axis=1)
        turn(f"{side}humerus", quaternions_from_euler(upper_arm, "XYX"))
        turn(f"{side}radius", quaternions_from_euler(v[f"{side}_elbow"] * [-sign, 1.0], "ZX"))
        turn(f"{side}hand", quaternions_from_euler(v[f"{side}_wrist"] * [sign, -sign], "YZ"))
    root = roots[0] + v["on_right"] * (roots[1] - roots[0])
    return Motion(skeleton, rate_hz, root, without_flips(rotations))


def _leg(v: dict[str, Array], side: str, sign: float) -> tuple[Array, Array, Array, tuple[Array, Array]]:
    """Return rotations (n, 4): world_from_thigh, those of knee and ankle, and those of a standing thigh and knee.

    The ankle of a standing leg keeps the foot flat; for a leg in the air, its motion is added to that.
    """
    sway = quaternions_from_euler(v["sway"], "Y")
    moved = np.concatenate([v[f"{side}_hip"], v[f"{side}_knee"]], axis=1)

    def thigh_and_shank(hip_knee: Array) -> tuple[Array, Array]:
        flexion, abduction, outward, knee = hip_knee.T
        hip = np.stack([-(flexion + _HIP), -sign * (abduction + _APART), sign * outward], axis=1)
        thigh = multiply_quaternions(sway, quaternions_from_euler(hip, "XYZ"))
        return thigh, quaternions_from_euler((knee + _KNEE)[:, None], "X")

    standing = thigh_and_shank(np.zeros_like(moved))
    flat = _conjugate(multiply_quaternions(*standing))
    ankle = quaternions_from_euler(v[f"{side}_ankle"] * [1.0, sign], "XY")
    return *thigh_and_shank(moved), multiply_quaternions(flat, ankle), standing


def _root_over(performer: Performer, side: str, sign: float, pelvis: Array, standing: tuple[Array, Array]) -> Array:
    """Return the position of the root (n, 3) [m] when the leg ``standing`` (thigh, knee) stands on its foot."""
    at, skeleton = performer.skeleton.offsets, performer.skeleton
    hip, knee, ankle, ball = (at[skeleton.index(f"{side}{bone}")] for bone in ("femur", "tibia", "foot", "toes"))
    thigh, shank = standing[0], multiply_quaternions(*standing)
    leg = _turned(thigh, knee) + _turned(shank, ankle)
    apart = sign * float(np.sin(_APART)) * float(np.linalg.norm(knee) + np.linalg.norm(ankle))
    foot = np.array([hip[0] + apart, 0.0, performer.sole_m - ball[2]])
    return np.asarray(foot - leg - _turned(pelvis, hip))


def _turned(wxyz: Array, vector: Array) -> Array:
    return np.asarray(matrices_from_quaternions(wxyz) @ vector)


def _conjugate(wxyz: Array) -> Array:
    return np.asarray(wxyz * [1.0, -1.0, -1.0, -1.0])
