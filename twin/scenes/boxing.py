"""A boxer in training: guard, jabs, crosses, hooks, a cover behind crossed forearms, steps in between.

The loop is written for a boxer who leads with the left; others are its mirror image. Hands start a strike while hips
and shoulders already turn (Cheraghi et al. 2014, "Kinematics of straight right punch in boxing": from the ground up).
A straight punch lasts 0.13 s, and the speed of the wrist peaks at 6 to 8 m/s.
"""

from dataclasses import dataclass

import numpy as np

from mosca.data.motion.motion import Motion
from twin.scenes.choreography import Stance, begin, footing, loop_times, read, step
from twin.scenes.posture import Performer, posed
from twin.scenes.submovements import MovementSequence

STANCE: Stance = {"l": (0.12, 0.26, -0.25), "r": (-0.15, -0.08, -0.75)}
_GUARD = {"l": (0.15, 0.36, 0.08), "r": (0.14, 0.24, 0.06)}
_CHIN = (0.14, 0.20, 0.08)  # where the other hand covers during a strike
_ELBOW = {"l": (0.55, 0.05, -1.0), "r": (0.5, -0.2, -1.0)}
_PELVIS, _SPINE = (-0.45, 0.10, 0.0), (-0.15, 0.14, 0.0)
_HEIGHT_M, _HEEL = 0.855, 0.3
_BOB_M, _BOB_S = 0.014, 0.42
_ROOM_M = 0.14
_LEFT_HANDED = 0.2


@dataclass(frozen=True)
class Strike:
    """A strike of one hand: its way over ``load`` to ``reach``, and the motion of the body with it."""

    side: str
    reach: tuple[float, float, float]
    elbow: tuple[float, float, float]
    """Direction of the elbow at the end."""
    twist: float
    pelvis: float
    """Rotation of the pelvis at the end."""
    spine: float
    """Rotation of the spine at the end."""
    shift: tuple[float, float]
    """Shift of the weight (left, forward)."""
    pivot: tuple[float, float]
    """Pivot of that side's foot on its ball (rotation outward, heel up)."""
    out_s: float
    load: tuple[float, float, float] | None = None


STRIKES = {
    "jab": Strike("l", (0.02, 0.68, 0.10), (0.7, 0.1, -0.8), -0.7, -0.60, -0.30, (0.0, 0.05), (0.0, 0.0), 0.135),
    "cross": Strike(
        "r", (0.00, 0.63, 0.08), (0.7, 0.1, -0.8), -0.8, 0.35, 0.30, (0.03, 0.07), (-0.45, 0.30), 0.150
    ),
    "lead_hook": Strike(
        "l", (-0.04, 0.50, 0.10), (1.0, 0.1, -0.3), -0.3, -0.95, -0.35, (-0.03, 0.03), (-0.45, 0.35), 0.130,
        (0.36, 0.29, 0.02),
    ),
    "rear_hook": Strike(
        "r", (-0.02, 0.50, 0.10), (1.0, 0.1, -0.3), -0.3, 0.30, 0.35, (0.03, 0.05), (-0.50, 0.35), 0.140,
        (0.36, 0.24, 0.02),
    ),
}  # fmt: skip
COMBINATIONS = (
    ("jab", "jab", "cross"),
    ("jab", "cross", "lead_hook"),
    ("cover", "lead_hook", "cross"),
    ("jab", "rear_hook", "cover"),
    ("lead_hook", "rear_hook", "jab"),
)
_BEFORE_S, _BACK_S, _LOAD_S = 0.05, 0.26, 0.20


def boxing(performer: Performer, rng: np.random.Generator) -> Motion:
    """Return a loop of all combinations, with order, positions and timing drawn by ``rng``.

    Every fifth boxer leads with the right.
    """
    sequence, length = _round(rng)
    time_s, rate = loop_times(length)
    postures = read(sequence, time_s, performer.scale)
    return posed(performer, postures.mirrored() if rng.random() < _LEFT_HANDED else postures, rate)


def _round(rng: np.random.Generator) -> tuple[MovementSequence, float]:
    """Return the loop of a boxer who leads with the left, and its length [s]."""
    hands = {f"{side}_hand": _GUARD[side] for side in "lr"}
    elbows = {f"{side}_elbow": _ELBOW[side] for side in "lr"}
    sequence = begin(
        STANCE, height=_HEIGHT_M, pelvis=_PELVIS, spine=_SPINE, r_pivot=(0.0, _HEEL), l_knee=0.1, r_knee=0.1,
        **hands, **elbows,
    )  # fmt: skip
    clock = 0.3
    order = rng.permutation(len(COMBINATIONS))
    for k, which in enumerate(order):
        for name in COMBINATIONS[which]:
            clock = _cover(sequence, clock, rng) if name == "cover" else _strike(sequence, STRIKES[name], clock, rng)
        last = k == len(order) - 1
        place = np.zeros(3) if last else rng.uniform([-_ROOM_M, -_ROOM_M, -0.45], [_ROOM_M, _ROOM_M, 0.45])
        clock = _step_to(sequence, clock + 0.15, place)
    bobs = int(clock / _BOB_S)
    for k in range(bobs):
        start = k * clock / bobs
        sequence.hill("height", start, start + clock / bobs, _BOB_M)
    return sequence, clock


def _strike(sequence: MovementSequence, strike: Strike, clock: float, rng: np.random.Generator) -> float:
    """Write a strike from ``clock`` on; return when the next one may start."""
    own, faster = strike.side, rng.uniform(0.94, 1.06)
    hand, elbow, twist = f"{own}_hand", f"{own}_elbow", f"{own}_forearm"
    start = clock + _BEFORE_S
    if strike.load is not None:
        sequence.move(hand, clock, clock + _LOAD_S, strike.load)
        sequence.move(elbow, clock, clock + _LOAD_S, (0.9, -0.2, -0.7))
        start = clock + _LOAD_S - 0.06
    end = start + strike.out_s * faster
    back = end + _BACK_S * faster
    aim = np.asarray(strike.reach) + rng.normal(0.0, (0.015, 0.01, 0.025))
    sequence.move(hand, start, end, aim)
    sequence.move(elbow, start - 0.12, end, strike.elbow)
    sequence.move(twist, start, end, strike.twist)
    out_s, back_s = (start - _BEFORE_S, end), (end, back + 0.08)
    sequence.visit("pelvis", out_s, back_s, (strike.pelvis, *_PELVIS[1:]))
    sequence.visit("spine", out_s, back_s, (strike.spine, *_SPINE[1:]))
    sequence.visit("shift", out_s, back_s, strike.shift)
    sequence.visit(f"{own}_pivot", out_s, back_s, sequence.target(f"{own}_pivot") + strike.pivot)
    covering = "r" if own == "l" else "l"
    sequence.visit(f"{covering}_hand", (start - 0.12, end - 0.02), (end + 0.04, back), _CHIN)
    sequence.move(hand, end + 0.01, back, _GUARD[own])
    sequence.move(elbow, end + 0.01, back, _ELBOW[own])
    sequence.move(twist, end + 0.01, back, 0.0)
    return back - 0.04


def _cover(sequence: MovementSequence, clock: float, rng: np.random.Generator) -> float:
    """Write a cover behind crossed forearms, head down; return when the next strike may start."""
    up, held = clock + 0.22, clock + 0.22 + rng.uniform(0.25, 0.45)
    down = held + 0.25
    out_s, back_s = (clock, up), (held, down)
    for side, wrist, elbow in (
        ("l", (-0.07, 0.40, 0.14), (0.7, 0.2, -1.0)),
        ("r", (-0.07, 0.23, 0.02), (0.7, -0.2, -1.0)),
    ):
        sequence.visit(f"{side}_hand", out_s, back_s, wrist)
        sequence.visit(f"{side}_elbow", out_s, back_s, elbow)
    slowly_s = (held, down + 0.1)
    sequence.visit("gaze", out_s, slowly_s, (0.0, 0.22))
    sequence.visit("height", out_s, slowly_s, _HEIGHT_M - 0.06)
    sequence.visit("spine", out_s, slowly_s, (_SPINE[0], _SPINE[1] + 0.12, 0.0))
    return down


def _step_to(sequence: MovementSequence, clock: float, place: np.ndarray) -> float:
    """Write a step of both feet to ``place`` (x, y, turn); return when it is done."""
    way = place - sequence.target("place")
    # The foot on the side of the way goes first, so that the feet do not meet.
    forward = np.sin(place[2]) * way[0] - np.cos(place[2]) * way[1]
    first, second = ("l", "r") if forward > 0 else ("r", "l")
    sequence.move("place", clock, clock + 0.62, place)
    step(sequence, first, clock, clock + 0.30, footing(place, STANCE, first))
    step(sequence, second, clock + 0.30, clock + 0.60, footing(place, STANCE, second))
    return clock + 0.65
