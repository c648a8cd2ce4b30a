"""A person who walks without a recording: joint angles and path as closed forms of time.

All quantities are C2 in time. Angles are sines of the stride's phase. At the ends of a lane, speed and heading follow
the quintic 10 u^3 - 15 u^4 + 6 u^5, which starts and ends without slope and curvature. Feet are not fixed to the
floor while they roll over it (they slide by centimetres). The pelvis rises and falls so that the lower foot stays
within millimetres of the floor. Segment lengths: Drillis and Contini 1966 as in Winter, Biomechanics and Motor
Control of Human Movement, fig. 4.1.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.interpolate import CubicSpline

from mosca.data.arrays import Array
from mosca.data.motion.motion import (
    Motion,
    Skeleton,
    forward_kinematics,
    multiply_quaternions,
    quaternions_from_euler,
)
from mosca.errors import InputError
from twin.scenes.anatomy import FOOT_RADIUS_M

GaitPath = Literal["in_place", "circle", "back_and_forth"]
GAIT_PATHS: tuple[GaitPath, ...] = ("in_place", "circle", "back_and_forth")
GaitDetail = Literal["planar", "full"]
GAIT_DETAILS: tuple[GaitDetail, ...] = ("planar", "full")
"""Motion of hips and knees in the planes of the legs alone, or also across them as in people (``_pose``)."""
_TURN_S = 2.0
_RAMP_S = 0.8
_SKIN_M = 0.06  # skin and markers beyond the joints
_SHORTEST_PATH_M = 0.1
_CLEARANCE_M = 0.002
_BOB_HARMONICS = 6

# joint, parent, offset as a share of stature (left, back, up)
_BODY: tuple[tuple[str, str, tuple[float, float, float]], ...] = (
    ("root", "", (0.0, 0.0, 0.0)),
    ("lfemur", "root", (0.052, 0.0, 0.0)),
    ("ltibia", "lfemur", (0.0, 0.0, -0.245)),
    ("lfoot", "ltibia", (0.0, 0.0, -0.246)),
    ("ltoes", "lfoot", (0.006, -0.085, -0.018)),
    ("ltoes_end", "ltoes", (0.0, -0.035, 0.0)),
    ("rfemur", "root", (-0.052, 0.0, 0.0)),
    ("rtibia", "rfemur", (0.0, 0.0, -0.245)),
    ("rfoot", "rtibia", (0.0, 0.0, -0.246)),
    ("rtoes", "rfoot", (-0.006, -0.085, -0.018)),
    ("rtoes_end", "rtoes", (0.0, -0.035, 0.0)),
    ("upperback", "root", (0.0, 0.005, 0.09)),
    ("thorax", "upperback", (0.0, 0.005, 0.09)),
    ("lowerneck", "thorax", (0.0, 0.0, 0.12)),
    ("head", "lowerneck", (0.0, 0.0, 0.055)),
    ("head_end", "head", (0.0, 0.0, 0.11)),
    ("lhumerus", "thorax", (0.117, 0.0, 0.098)),
    ("lradius", "lhumerus", (0.186, 0.0, 0.0)),
    ("lhand", "lradius", (0.146, 0.0, 0.0)),
    ("lhand_end", "lhand", (0.1, 0.0, 0.0)),
    ("rhumerus", "thorax", (-0.117, 0.0, 0.098)),
    ("rradius", "rhumerus", (-0.186, 0.0, 0.0)),
    ("rhand", "rradius", (-0.146, 0.0, 0.0)),
    ("rhand_end", "rhand", (-0.1, 0.0, 0.0)),
)


def walker_skeleton(stature_m: float) -> Skeleton:
    """Return the skeleton of a walker ``stature_m`` tall, arms along x in the rest pose, facing -y."""
    names = tuple(name for name, _, _ in _BODY)
    parents = [-1 if not parent else names.index(parent) for _, parent, _ in _BODY]
    return Skeleton(names, np.array(parents), np.array([o for _, _, o in _BODY]) * stature_m)


@dataclass(frozen=True, eq=False)
class Gait:
    """Walking as a function of time; made by ``walk``."""

    path: GaitPath
    center: Array
    """(2,): centre of the path [m]."""
    extent: Array
    """(2,): the circle's radius twice, or the vector from the middle of the lane to its end [m]."""
    speed_mps: float
    stride_hz: float
    phase: float
    heading: float
    stride: CubicSpline
    """Joint rotations and root height of one stride, a periodic C2 spline over its phase (0..2 pi)."""

    def at(self, time_s: float) -> tuple[Array, Array]:
        """Return the root's position (3,) [m] and all joints' rotations (j, 4) wxyz at ``time_s``."""
        values = self.stride((2 * np.pi * self.stride_hz * time_s + self.phase) % (2 * np.pi))
        place, heading = self._track(time_s)
        rotations = values[1:].reshape(-1, 4)
        # At rest the walker faces -y: a heading is measured from +x.
        half = (heading + np.pi / 2) / 2
        turn = np.array([np.cos(half), 0.0, 0.0, np.sin(half)])
        rotations[0] = multiply_quaternions(turn, rotations[0])
        return np.array([place[0], place[1], values[0]]), rotations

    def _track(self, time_s: float) -> tuple[Array, float]:
        """Return the root's position (2,) [m] and its heading [rad]."""
        if self.path == "in_place":
            return self.center, self.heading
        if self.path == "circle":
            radius = float(self.extent[0])
            angle = self.heading + self.speed_mps / radius * time_s
            return self.center + radius * np.array([np.cos(angle), np.sin(angle)]), angle + np.pi / 2
        # Lane, turn, lane, turn; the draw of the phase decides where in the lap the session starts.
        length = 2 * float(np.linalg.norm(self.extent))
        lane_s = length / self.speed_mps + _RAMP_S
        half_lap = lane_s + _TURN_S
        lap, within = divmod(time_s + self.phase / np.pi * half_lap, half_lap)
        walked = self.speed_mps * _ramped(within, lane_s)
        side = -1.0 if lap % 2 == 0 else 1.0
        along = side * (1 - 2 * walked / length)
        turned = _quintic((within - lane_s) / _TURN_S)
        return self.center + along * self.extent, self.heading + np.pi * (lap + turned)


def walk(
    skeleton: Skeleton,
    path: GaitPath,
    center: Array,
    half_box: Array,
    speed_mps: float,
    rng: np.random.Generator,
    detail: GaitDetail = "planar",
) -> Gait:
    """Return a walk about ``center`` (2,) whose limbs and markers stay within ``half_box`` (2,) [m] of it.

    ``rng`` draws the phase of the first step, the start on the path and, for a walk in place, the heading.
    A lane too short to reach ``speed_mps`` is walked more slowly. Raises InputError where the box is too small.
    """
    phase, heading = rng.uniform(0, 2 * np.pi, 2)
    leg = -float(np.sum(skeleton.offsets[[skeleton.index("ltibia"), skeleton.index("lfoot")], 2]))
    # Cadence rises with speed (0.9 strides/s at 1.2 m/s); the swing of the hips makes the stride.
    stride_hz = 0.55 + 0.3 * speed_mps
    share = 0.15 if path == "in_place" else speed_mps / (4 * stride_hz * leg)
    stride, reach = _stride(skeleton, float(np.arcsin(min(share, 0.55))), detail == "full")
    room = half_box - reach
    least = 0.0 if path == "in_place" else _SHORTEST_PATH_M
    if room.min() < (least if path == "circle" else 0.0) or room.max() < least:
        raise InputError(
            f"box_size_m = {(2 * half_box).tolist()} across: a walker needs {2 * reach:.2f} m and, to walk in a "
            f"circle or a lane, {2 * _SHORTEST_PATH_M} m more; enlarge the box or use gait = 'in_place'"
        )
    extent = np.zeros(2)
    if path == "circle":
        extent = np.full(2, float(room.min()))
    elif path == "back_and_forth":
        axis = int(np.argmax(room))
        extent[axis] = room[axis]
        heading = axis * np.pi / 2  # from the lane's end at -extent towards +extent
        speed_mps = min(speed_mps, 2 * float(room[axis]) / _RAMP_S)
    return Gait(path, center, extent, speed_mps, stride_hz, phase, heading, stride)


def _pose(skeleton: Skeleton, phases: Array, swing: float, full: bool) -> Array:
    """Return joint rotations (n, j, 4) of the walker at stride ``phases`` (n,) [rad], heading not applied.

    ``full``: motion as in people (Kadaba et al. 1990, J. Orthop. Res. 8, 383). The pelvis sinks by 5 degrees on the
    side of the leg that swings, so that hips adduct in stance and abduct in swing. Thighs do not turn with the
    pelvis, and turn by 3 degrees of their own. Knees give way by 13 degrees under the weight.
    """
    rotations = np.zeros((len(phases), len(skeleton.names), 4))
    rotations[..., 0] = 1.0

    def turn(joint: str, order: str, *angles: Array | float) -> None:
        stacked = np.stack([np.broadcast_to(np.asarray(a, float), phases.shape) for a in angles], axis=-1)
        rotations[:, skeleton.index(joint)] = quaternions_from_euler(stacked, order)

    sway = np.sin(phases)
    sunk = 0.085 * sway if full else np.zeros_like(sway)
    turn("root", "ZXY", 0.07 * np.cos(phases), 0.04, -sunk if full else 0.03 * sway)
    turn("upperback", "ZXY", -0.08 * np.cos(phases), -0.01, -0.03 * sway)
    turn("thorax", "ZXY", -0.09 * np.cos(phases), 0.02 * np.cos(2 * phases), -0.02 * sway)
    turn("lowerneck", "ZX", 0.06 * np.cos(phases), -0.03)
    turn("head", "ZX", 0.04 * np.cos(phases - 0.3), 0.02 * np.sin(2 * phases))
    for side, own, mirror in (("l", phases, 1.0), ("r", phases + np.pi, -1.0)):
        # Facing -y, a limb that hangs down swings forward by a negative rotation about x.
        hip = swing * np.cos(own) + 0.06
        knee = 0.12 + (0.45 + swing) * ((1 - np.sin(own)) / 2) ** 2
        if full:
            given_way = 0.22 * ((1 + np.cos(own - 0.9)) / 2) ** 6
            knee = 0.12 + (0.45 + swing) * ((1 - np.sin(own)) / 2) ** 3 + given_way
        ankle = knee - hip + 0.05 * np.sin(own)
        if full:
            turned = -0.07 * np.cos(phases) + 0.05 * mirror * np.sin(own)
            turn(f"{side}femur", "XYZ", -hip, sunk - 0.02 * mirror, turned)
        else:
            turn(f"{side}femur", "XY", -hip, -0.02 * mirror)
        turn(f"{side}tibia", "X", knee)
        turn(f"{side}foot", "X", -0.7 * ankle)
        arm = -1.1 * swing * np.cos(own) + 0.03
        turn(f"{side}humerus", "XY", -arm, mirror * (np.pi / 2 - 0.22))
        turn(f"{side}radius", "Z", -mirror * (0.35 - 0.25 * np.cos(own)))
        turn(f"{side}hand", "Z", -mirror * 0.08)
    return rotations


def _stride(skeleton: Skeleton, swing: float, full: bool) -> tuple[CubicSpline, float]:
    """Return root height and joint rotations over the stride's phase, and the reach of the skin [m]."""
    phases = np.linspace(0, 2 * np.pi, 257)
    rotations = _pose(skeleton, phases, swing, full)
    rotations[-1] = rotations[0]
    poses = Motion(skeleton, 1.0, np.zeros((len(phases), 3)), rotations)
    positions, world_from_joint = forward_kinematics(poses)
    heights = _harmonics(phases) @ _bob(skeleton, phases, positions, world_from_joint)
    heights[-1] = heights[0]
    values = np.concatenate([heights[:, None], rotations.reshape(len(phases), -1)], axis=1)
    reach = float(np.linalg.norm(positions[..., :2], axis=-1).max()) + _SKIN_M
    return CubicSpline(phases, values, bc_type="periodic"), reach


def _bob(skeleton: Skeleton, phases: Array, positions: Array, world_from_joint: Array) -> Array:
    """Return Fourier coefficients of the root height that keeps the lower foot just above the floor."""
    scale = float(np.linalg.norm(skeleton.offsets[skeleton.index("ltibia")])) / (0.245 * 1.75)
    soles = []
    for side in "lr":
        ankle, ball = skeleton.index(f"{side}foot"), skeleton.index(f"{side}toes")
        heel = np.array([0.0, 0.045 * scale, skeleton.offsets[ball, 2]])
        soles += [positions[:, ball, 2], positions[:, skeleton.index(f"{side}toes_end"), 2]]
        soles.append((positions[:, ankle] + world_from_joint[:, ankle] @ heel)[:, 2])
    needed = FOOT_RADIUS_M * scale - np.min(soles, axis=0)
    terms = _harmonics(phases)
    coefficients = np.linalg.lstsq(terms, needed, rcond=None)[0]
    coefficients[0] += np.max(needed - terms @ coefficients) + _CLEARANCE_M
    return np.asarray(coefficients)


def _harmonics(phases: Array) -> Array:
    """Return cosines and sines (n, 2 h + 1) of the stride's first harmonics at ``phases`` (n,)."""
    orders = phases[:, None] * np.arange(1, _BOB_HARMONICS + 1)
    return np.concatenate([np.ones((len(phases), 1)), np.cos(orders), np.sin(orders)], axis=1)


def _ramped(time_s: float, lane_s: float) -> float:
    """Return the distance walked [m] at 1 m/s top speed, with quintic ramps at both ends of a lane of ``lane_s``."""
    t = min(max(time_s, 0.0), lane_s)
    if t > lane_s / 2:
        return lane_s - _RAMP_S - _ramped(lane_s - t, lane_s)
    if t > _RAMP_S:
        return t - _RAMP_S / 2
    u = t / _RAMP_S
    return float(_RAMP_S * u**4 * (2.5 - 3 * u + u * u))  # integral of the quintic


def _quintic(u: float) -> float:
    u = min(max(u, 0.0), 1.0)
    return u**3 * (10 - 15 * u + 6 * u * u)
