"""The channels of a person's movement sequence: position of the body, hands and feet; steps; the postures.

All lengths are those of a person of 1.75 m [m], angles [rad]. ``place`` (x, y, turn to the left from -y)
carries pelvis and hands; feet are fixed in the world and moved step by step.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from mosca.data.arrays import Array
from twin.scenes.posture import Postures
from twin.scenes.submovements import MovementSequence, Values

HEIGHT_M = 0.90
"""Height of the root of a person who stands with knees unlocked [m]."""
HANGING = (0.27, 0.08, -0.52)
"""Position of a wrist that hangs at the side, from the middle of the shoulders (outward, forward, up) [m]."""
STEP_LIFT_M = 0.05
_STEP_PITCH = 0.35
_KNOTS_HZ = 200.0
_STAND: Mapping[str, Values] = {
    "place": (0.0, 0.0, 0.0),
    "shift": (0.0, 0.0),  # of the pelvis from the place: left, forward
    "height": HEIGHT_M,
    "pelvis": (0.0, 0.05, 0.0),
    "spine": (0.0, 0.02, 0.0),
    "gaze": (0.0, 0.0),
}
_SIDED: Mapping[str, Values] = {
    "hand": HANGING,
    "elbow": (0.5, -1.0, -0.2),
    "forearm": 0.0,
    "wrist": 0.08,
    "lift": 0.0,
    "pivot": (0.0, 0.0),  # turn outward and pitch, on the ball
    "knee": 0.05,
}
Stance = Mapping[str, Sequence[float]]
"""Side "l", "r" -> position of the ball of its foot: (left, forward, turn to the left) from the place."""
FEET_TOGETHER: Stance = {"l": (0.11, 0.14, 0.12), "r": (-0.11, 0.14, -0.12)}


def begin(stance: Stance, **start: Values) -> MovementSequence:
    """Return the sequence of a standing person; ``start``: channels with other start values ("l_hand", "height")."""
    sequence = MovementSequence()
    sided = {f"{side}_{name}": value for name, value in _SIDED.items() for side in "lr"}
    feet = {f"{side}_foot": footing((0.0, 0.0, 0.0), stance, side) for side in "lr"}
    sequence.begin(**{**_STAND, **sided, **feet, **start})
    return sequence


def footing(place: Sequence[float] | Array, stance: Stance, side: str) -> Array:
    """Return the pose (x, y, turn) of a foot of a person at ``place``."""
    left, forward, turn = stance[side]
    c, s = np.cos(place[2]), np.sin(place[2])
    return np.array([place[0] + c * left + s * forward, place[1] + s * left - c * forward, place[2] + turn])


def step(
    sequence: MovementSequence, side: str, start_s: float, end_s: float, to: Values, lift_m: float = STEP_LIFT_M
) -> None:
    """Lift a foot and put it down at ``to`` (x, y, turn)."""
    sequence.move(f"{side}_foot", start_s, end_s, to)
    sequence.hill(f"{side}_lift", start_s, end_s, lift_m)
    sequence.hill(f"{side}_pivot", start_s, end_s, (0.0, _STEP_PITCH))


def loop_times(length_s: float) -> tuple[Array, float]:
    """Return the instants (n,) at which to pose a loop, 0 to ``length_s`` with both ends, and their rate [Hz]."""
    count = round(length_s * _KNOTS_HZ)
    return np.linspace(0.0, length_s, count + 1), count / length_s


def read(sequence: MovementSequence, time_s: Array, scale: float) -> Postures:
    """Return the postures at ``time_s`` (n,) of a person ``scale`` times 1.75 m tall."""
    v = sequence.at(time_s)
    place, shift = v["place"], v["shift"]
    c, s = np.cos(place[:, 2]), np.sin(place[:, 2])
    x = place[:, 0] + c * shift[:, 0] + s * shift[:, 1]
    y = place[:, 1] + s * shift[:, 0] - c * shift[:, 1]

    def both(name: str) -> Array:
        return np.stack([v[f"l_{name}"], v[f"r_{name}"]], axis=1)

    foot, pivot = both("foot"), both("pivot")
    turn = foot[..., 2] + pivot[..., 0] * [1.0, -1.0]
    return Postures(
        pelvis_xyz=scale * np.stack([x, y, v["height"][:, 0]], axis=1),
        facing=place[:, 2],
        pelvis=v["pelvis"],
        spine=v["spine"],
        gaze=v["gaze"],
        hands=scale * both("hand"),
        elbows=both("elbow"),
        forearms=both("forearm")[..., 0],
        wrists=both("wrist")[..., 0],
        balls=scale * np.concatenate([foot[..., :2], both("lift")], axis=2),
        feet=np.stack([turn, pivot[..., 1]], axis=-1),
        knees=both("knee")[..., 0],
    )
