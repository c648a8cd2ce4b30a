"""Actions of a person without a recording, besides walking: running, boxing, dancing, ..., as endless loops.

Each action is a loop of postures at 200 Hz, drawn once (order, positions, timing, handedness), converted to joint
rotations and played as a periodic C2 spline. Limbs hide markers as they do in recorded people: hands
before chest and face, crossed arms, crouches.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.interpolate import CubicSpline

from mosca.data.arrays import Array
from mosca.data.motion.motion import Motion, Skeleton, forward_kinematics, multiply_quaternions
from mosca.errors import InputError
from twin.scenes.anatomy import FOOT_RADIUS_M
from twin.scenes.boxing import boxing
from twin.scenes.dancing import dance
from twin.scenes.jumping import jumps
from twin.scenes.posture import STATURE_M, Balance, Performer
from twin.scenes.range_of_motion import range_of_motion
from twin.scenes.running import run
from twin.scenes.world import Box

ActionName = Literal["walk", "run", "boxing", "dance", "jump", "range_of_motion"]
ACTIONS: tuple[ActionName, ...] = ("walk", "run", "boxing", "dance", "jump", "range_of_motion")
_PERFORMED: dict[ActionName, Callable[[Performer, np.random.Generator], Motion]] = {
    "run": run,
    "boxing": boxing,
    "dance": dance,
    "jump": jumps,
    "range_of_motion": range_of_motion,
}
_CLEARANCE_M = 0.002  # of standing soles above the floor
_SKIN_M = 0.07  # skin and markers beyond the joints
_OBLIQUE = 0.1


@dataclass(frozen=True, eq=False)
class Action:
    """A loop of a moving person; made by ``act``. ``loop``: root position and rotations over ``length_s``."""

    loop: CubicSpline
    length_s: float
    start_s: float

    def at(self, time_s: float) -> tuple[Array, Array]:
        """Return the root's position (3,) [m] and all joints' rotations (j, 4) wxyz at ``time_s``."""
        values = self.loop((time_s + self.start_s) % self.length_s)
        return values[:3], values[3:].reshape(-1, 4)


def act(name: ActionName, skeleton: Skeleton, balance: Balance, box: Box, rng: np.random.Generator) -> Action:
    """Return the action ``name`` (not "walk") of ``skeleton`` (``gait.walker_skeleton``) over the box's middle.

    ``balance``: its masses, for the flight of a jump. ``rng`` draws the differences between performances, and the
    start in the loop. Raises InputError where limbs would leave the box.
    """
    scale = float(np.linalg.norm(skeleton.offsets[skeleton.index("ltibia")])) / (0.245 * STATURE_M)
    performer = Performer(skeleton, scale, FOOT_RADIUS_M * scale + _CLEARANCE_M, balance)
    motion = _placed(_PERFORMED[name](performer, rng), _heading(rng), box)
    check_inside(motion, box, _SKIN_M, f"action = '{name}': the person", "enlarge it or take action = 'walk'")
    values = np.concatenate([motion.root_xyz, motion.rotations.reshape(len(motion.root_xyz), -1)], axis=1)
    if not np.allclose(values[0], values[-1], atol=1e-6):
        raise ValueError(f"the action {name} does not end as it starts")
    values[-1] = values[0]
    loop = CubicSpline(np.arange(len(values)) / motion.frame_rate_hz, values, bc_type="periodic")
    return Action(loop, motion.duration_s, float(rng.uniform(0.0, motion.duration_s)))


def _heading(rng: np.random.Generator) -> float:
    """Return a heading [rad] along one of the box's edges, or nearly."""
    return float(rng.integers(4) * np.pi / 2 + rng.uniform(-_OBLIQUE, _OBLIQUE))


def _placed(motion: Motion, heading: float, box: Box) -> Motion:
    """Return ``motion`` rotated by ``heading`` [rad], with the middle of its limbs over that of the box."""
    half = heading / 2
    turn = np.array([np.cos(half), 0.0, 0.0, np.sin(half)])
    rotations = motion.rotations.copy()
    rotations[:, 0] = multiply_quaternions(turn, rotations[:, 0])
    c, s = np.cos(heading), np.sin(heading)
    root = motion.root_xyz @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    turned = Motion(motion.skeleton, motion.frame_rate_hz, root, rotations)
    positions, _ = forward_kinematics(turned)
    middle = (positions.min(axis=(0, 1)) + positions.max(axis=(0, 1))) / 2
    shift = np.array([box.center[0] - middle[0], box.center[1] - middle[1], 0.0])
    return Motion(motion.skeleton, motion.frame_rate_hz, root + shift, rotations)


def check_inside(motion: Motion, box: Box, skin_m: float, who: str, remedy: str) -> None:
    """Raise InputError, which names ``who`` and the ``remedy``, where limbs leave the box at a side or at the top.

    ``skin_m``: distance by which skin and markers reach beyond the joints.
    """
    positions, _ = forward_kinematics(motion)
    low, high = positions.min(axis=(0, 1)) - skin_m, positions.max(axis=(0, 1)) + skin_m
    # From below, a person is bounded by the floor, not by the box.
    if (low[:2] < box.low[:2]).any() or (high > box.high).any():
        needs = " x ".join(f"{edge:.2f}" for edge in high[:2] - low[:2])
        raise InputError(
            f"{who} moves through {needs} m up to {high[2]:.2f} m; the box is "
            f"{' x '.join(f'{edge:g}' for edge in box.size)} m up to {box.high[2]:.2f} m: {remedy}"
        )
