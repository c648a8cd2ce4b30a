"""A dancer: turns on one foot, arms overhead, arms that cross before the chest, squats, steps to the side.

Every figure starts and ends in a stand with hanging arms, so that figures can follow in any order. The motion of a
turn is made without rotation, then rotated as a whole about the ball of the standing foot.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from mosca.data.arrays import Array
from mosca.data.motion.motion import Motion, multiply_quaternions
from twin.scenes.choreography import HANGING, HEIGHT_M, Stance, begin, footing, loop_times, read, step
from twin.scenes.posture import Performer, posed
from twin.scenes.submovements import MovementSequence, minimum_jerk

STANCE: Stance = {"l": (0.13, 0.14, 0.2), "r": (-0.13, 0.14, -0.2)}
_WIDE, _WIDE_ELBOW = (0.70, 0.16, 0.02), (0.1, -0.6, -1.0)
_OVERHEAD, _OVERHEAD_ELBOW = (0.24, 0.10, 0.45), (1.0, 0.0, -0.9)
_OPEN = (0.52, 0.30, 0.0)
_FRONT = (0.24, 0.42, -0.02)
# Arms closed: one across the chest, the other across the belly; hand and elbow.
_ABOVE, _ABOVE_ELBOW = (-0.10, 0.38, 0.08), (1.0, 0.1, -0.3)
_BELOW, _BELOW_ELBOW = (-0.06, 0.27, -0.20), (1.0, -0.3, -0.9)
_FRONT_ELBOW, _HANGING_ELBOW = (1.0, -0.1, -0.6), (0.5, -1.0, -0.2)
_OTHER = {"l": "r", "r": "l"}


@dataclass(frozen=True)
class Turn:
    """A full turn to the left (``sign`` 1) or right (-1) about ``pivot`` (x, y) [m of a 1.75 m person]."""

    start_s: float
    end_s: float
    pivot: tuple[float, float]
    sign: float


def dance(performer: Performer, rng: np.random.Generator) -> Motion:
    """Return a loop of every figure and two turns, with order, sides and tempo drawn by ``rng``."""
    sequence = begin(STANCE)
    beat, clock = float(rng.uniform(0.42, 0.5)), 0.1
    turns: list[Turn] = []
    figures = (_overhead, _crossing, _squat, _aside)
    order: list[tuple[Callable[..., Any], str]] = [
        (figures[k], "lr"[int(rng.integers(2))]) for k in rng.permutation(len(figures))
    ]
    # One turn to the left and one to the right: the loop ends with the heading of its start.
    for place, side in zip(sorted(rng.choice(len(order), 2, replace=False), reverse=True), "lr", strict=True):
        order.insert(int(place), (_turn, side))
    for figure, side in order:
        if figure is _turn:
            turns.append(_turn(sequence, clock, beat, side, rng))
            clock = turns[-1].end_s + 1.6 * beat
        else:
            clock = figure(sequence, clock, beat, side, rng)
    time_s, rate = loop_times(clock + 0.1)
    return _turned(posed(performer, read(sequence, time_s, performer.scale), rate), time_s, turns, performer.scale)


def _arms(
    sequence: MovementSequence, start: float, end: float, hand: Array | tuple[float, ...], elbow: tuple[float, ...]
) -> None:
    for side in "lr":
        sequence.move(f"{side}_hand", start, end, hand)
        sequence.move(f"{side}_elbow", start, end, elbow)


def _close(sequence: MovementSequence, start: float, end: float, above: str, up_m: float) -> None:
    """Write arms that cross before the trunk, the arm of side ``above`` in front, ``up_m`` higher than usual."""
    for own, hand, elbow in ((above, _ABOVE, _ABOVE_ELBOW), (_OTHER[above], _BELOW, _BELOW_ELBOW)):
        sequence.move(f"{own}_hand", start, end, (*hand[:2], hand[2] + up_m))
        sequence.move(f"{own}_elbow", start, end, elbow)


def _hang(sequence: MovementSequence, start: float, end: float) -> None:
    _arms(sequence, start, end, HANGING, _HANGING_ELBOW)


def _overhead(sequence: MovementSequence, clock: float, beat: float, side: str, rng: np.random.Generator) -> float:
    """Write: both arms by the side overhead, a bend to one side and the other, arms down before the body."""
    sign = 1.0 if side == "l" else -1.0
    bend = sign * rng.uniform(0.14, 0.24)
    _arms(sequence, clock, clock + 1.3 * beat, _WIDE, _WIDE_ELBOW)
    _arms(sequence, clock + 0.8 * beat, clock + 2.0 * beat, _OVERHEAD, _OVERHEAD_ELBOW)
    for k, to in enumerate((bend, -bend, 0.0)):
        start, end = clock + (1.6 + 1.1 * k) * beat, clock + (2.9 + 1.1 * k) * beat
        sequence.move("spine", start, end, (0.0, 0.02, to))
        sequence.move("pelvis", start, end, (0.0, 0.05, to / 3))
        sequence.move("shift", start, end, (-0.25 * to, 0.0))
    _arms(sequence, clock + 4.4 * beat, clock + 5.5 * beat, _FRONT, _FRONT_ELBOW)
    _hang(sequence, clock + 5.1 * beat, clock + 6.1 * beat)
    return clock + 6.0 * beat


def _crossing(sequence: MovementSequence, clock: float, beat: float, side: str, rng: np.random.Generator) -> float:
    """Write: arms wide open, crossed before the chest with ``side`` in front, open, crossed again, down."""
    _arms(sequence, clock, clock + 1.2 * beat, _WIDE, _WIDE_ELBOW)
    now = clock + 1.2 * beat
    for front in (side, _OTHER[side]):
        up = rng.uniform(-0.02, 0.05)
        _close(sequence, now, now + 0.8 * beat, front, up)
        sequence.move("spine", now, now + 0.8 * beat, (0.25 if front == "l" else -0.25, 0.12, 0.0))
        sequence.move("spine", now + 1.1 * beat, now + 2.1 * beat, (0.0, 0.02, 0.0))
        _arms(sequence, now + 1.1 * beat, now + 2.0 * beat, _WIDE, _WIDE_ELBOW)
        now += 2.1 * beat
    _hang(sequence, now, now + 1.3 * beat)
    return now + 1.2 * beat


def _squat(sequence: MovementSequence, clock: float, beat: float, side: str, rng: np.random.Generator) -> float:
    """Write: a squat with the arms forward and one hand over the other, and up again with arms overhead."""
    depth = rng.uniform(0.30, 0.36)
    low, up = clock + 1.8 * beat, clock + 2.5 * beat
    out_s, back_s = (clock, low), (up, up + 1.6 * beat)
    sequence.visit("height", out_s, back_s, HEIGHT_M - depth)
    sequence.visit("shift", out_s, back_s, (0.0, -0.07))
    sequence.visit("pelvis", out_s, back_s, (0.0, 0.45, 0.0))
    sequence.visit("spine", out_s, back_s, (0.0, 0.30, 0.0))
    for own in "lr":
        sequence.visit(f"{own}_knee", out_s, back_s, 0.35)
        sequence.visit(f"{own}_pivot", out_s, back_s, (0.0, 0.25))
    _close(sequence, clock, low, side, 0.0)
    _arms(sequence, up, up + 1.1 * beat, _OPEN, _OVERHEAD_ELBOW)
    _arms(sequence, up + 0.7 * beat, up + 1.8 * beat, _OVERHEAD, _OVERHEAD_ELBOW)
    _arms(sequence, up + 2.1 * beat, up + 3.3 * beat, _WIDE, _WIDE_ELBOW)
    _hang(sequence, up + 2.8 * beat, up + 3.9 * beat)
    return up + 3.8 * beat


def _aside(sequence: MovementSequence, clock: float, beat: float, side: str, rng: np.random.Generator) -> float:
    """Write: a step to one side and back, one arm thrown up, the other across the body."""
    way = (1.0 if side == "l" else -1.0) * rng.uniform(0.16, 0.24)
    home = sequence.target("place").copy()
    now, other = clock, _OTHER[side]
    for place, first in ((home + [way, 0.0, 0.0], side), (home, other)):
        sequence.move("place", now, now + 2.0 * beat, place)
        step(sequence, first, now, now + 0.95 * beat, footing(place, STANCE, first))
        step(sequence, _OTHER[first], now + beat, now + 1.95 * beat, footing(place, STANCE, _OTHER[first]))
        high, across = (0.30, 0.12, 0.44), (-0.06, 0.30, -0.1)
        sequence.move(f"{first}_hand", now, now + 0.8 * beat, (0.55, 0.25, 0.0))
        sequence.move(f"{first}_hand", now + 0.5 * beat, now + 1.3 * beat, high)
        sequence.move(f"{first}_elbow", now, now + beat, _OVERHEAD_ELBOW)
        # The arms come down by the side: the straight way from overhead leads through the face.
        sequence.move(f"{_OTHER[first]}_hand", now, now + 0.8 * beat, _OPEN)
        sequence.move(f"{_OTHER[first]}_hand", now + 0.5 * beat, now + 1.4 * beat, across)
        sequence.move(f"{_OTHER[first]}_elbow", now, now + 1.1 * beat, _FRONT_ELBOW)
        sequence.hill("height", now + 0.2 * beat, now + 1.8 * beat, -0.05)
        now += 2.1 * beat
    _arms(sequence, now - 0.4 * beat, now + 0.7 * beat, (0.5, 0.28, -0.05), _FRONT_ELBOW)
    _hang(sequence, now + 0.2 * beat, now + 1.2 * beat)
    return now + 1.2 * beat


def _turn(sequence: MovementSequence, clock: float, beat: float, side: str, rng: np.random.Generator) -> Turn:
    """Write a turn towards ``side`` on the foot of that side, the other knee lifted, arms closed."""
    sign, free = (1.0 if side == "l" else -1.0), _OTHER[side]
    open_, end = clock + 1.4 * beat, clock + 1.4 * beat + float(rng.uniform(1.25, 1.5))
    home = sequence.target("place").copy()
    _arms(sequence, clock, open_, (0.66, 0.24, 0.02), _WIDE_ELBOW)
    _close(sequence, open_ - 0.2 * beat, open_ + 0.9 * beat, side, 0.0)
    _arms(sequence, end - 0.8 * beat, end + 0.4 * beat, _WIDE, _WIDE_ELBOW)
    _hang(sequence, end + 0.3 * beat, end + 1.6 * beat)
    sequence.visit("shift", (clock, open_), (end, end + 1.4 * beat), (0.12 * sign, 0.05))
    out_s, back_s = (open_ - 0.6 * beat, open_ + 0.4 * beat), (end - 0.3 * beat, end + 0.8 * beat)
    sequence.visit(f"{side}_pivot", out_s, back_s, (0.0, 0.45))
    sequence.visit("height", out_s, back_s, HEIGHT_M + 0.05)
    out_s, back_s = (open_ - 0.3 * beat, open_ + 0.9 * beat), (end - 0.9 * beat, end + 0.2 * beat)
    raised: Stance = {free: (-0.10 * sign, 0.16, -0.5 * sign)}
    sequence.visit(f"{free}_foot", out_s, back_s, footing(home, raised, free))
    sequence.visit(f"{free}_lift", out_s, back_s, 0.32)
    sequence.visit(f"{free}_pivot", out_s, back_s, (0.0, 0.7))
    sequence.visit(f"{free}_knee", out_s, back_s, 0.3)
    ball = footing(home, STANCE, side)
    return Turn(open_ - 0.1 * beat, end, (float(ball[0]), float(ball[1])), sign)


def _turned(motion: Motion, time_s: Array, turns: list[Turn], scale: float) -> Motion:
    """Return ``motion`` rotated as a whole about each turn's pivot; between turns it is unchanged."""
    root, rotations = motion.root_xyz.copy(), motion.rotations.copy()
    for turn in turns:
        angle = turn.sign * 2 * np.pi * minimum_jerk((time_s - turn.start_s) / (turn.end_s - turn.start_s))
        c, s = np.cos(angle), np.sin(angle)
        x, y = (root[:, k] - scale * turn.pivot[k] for k in (0, 1))
        root[:, 0], root[:, 1] = c * x - s * y + scale * turn.pivot[0], s * x + c * y + scale * turn.pivot[1]
        zero = np.zeros_like(angle)
        wxyz = np.stack([np.cos(angle / 2), zero, zero, np.sin(angle / 2)], axis=-1)
        rotations[:, 0] = multiply_quaternions(wxyz, rotations[:, 0])
    return Motion(motion.skeleton, motion.frame_rate_hz, root, rotations)
