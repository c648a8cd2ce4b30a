"""A jumper: countermovement jumps forward with both feet, a turn on the spot, and back.

The path of the whole body's centre of mass is prescribed, and the pelvis follows from it. Before take-off the centre
rises along a quintic that ends with the acceleration of free fall. In flight it falls freely (exactly: masses are
those of the body that is shown), and the landing continues from there. So the ground force is continuous, never
pulls, and is zero while both feet are off the ground. Angular momentum is not conserved in flight.
Phases as in Linthorne 2001, "Analysis of standing vertical jumps using a force platform".
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import BPoly

from mosca.data.arrays import Array
from mosca.data.motion.motion import Motion
from twin.scenes.choreography import FEET_TOGETHER, begin, footing, loop_times, read, step
from twin.scenes.posture import Performer, Postures, balanced, posed
from twin.scenes.submovements import MovementSequence, minimum_jerk

GRAVITY_MPS2 = 9.81
_CROUCH_S, _PUSH_S, _CATCH_S, _RISE_S, _REST_S = 0.60, 0.34, 0.36, 0.60, 0.25
_STEP_S, _STEPS_A_FOOT = 0.22, 4
_TAKEOFF_M, _LANDING_M = 0.10, -0.03  # centre of mass over where it is standing
_LEAN_M, _BEHIND_M = 0.19, 0.12  # centre of mass before the feet at take-off, behind them at landing

_CROUCHED_PITCH = 0.14  # heels leave the floor a little in a crouch


@dataclass(frozen=True)
class Jump:
    """One jump: start [s], distance of the feet, rise of the centre of mass in flight, and its sinking before [m]."""

    start_s: float
    distance_m: float
    rise_m: float
    crouch_m: float

    @property
    def takeoff_mps(self) -> float:
        """Speed upward at take-off."""
        return float(np.sqrt(2 * GRAVITY_MPS2 * self.rise_m))

    @property
    def landing_mps(self) -> float:
        """Speed downward at landing."""
        return float(np.sqrt(2 * GRAVITY_MPS2 * (self.rise_m + _TAKEOFF_M - _LANDING_M)))

    @property
    def takeoff_s(self) -> float:
        """When the feet leave the floor."""
        return self.start_s + _CROUCH_S + _PUSH_S

    @property
    def landing_s(self) -> float:
        """When the feet are back on the floor."""
        return self.takeoff_s + (self.takeoff_mps + self.landing_mps) / GRAVITY_MPS2

    @property
    def end_s(self) -> float:
        """When the jumper is standing again."""
        return self.landing_s + _CATCH_S + _RISE_S

    def rise(self) -> BPoly:
        """Return the height of the centre of mass above standing [m] over time."""
        g = -GRAVITY_MPS2
        return BPoly.from_derivatives(
            [self.start_s, self.start_s + _CROUCH_S, self.takeoff_s, self.landing_s, self.landing_s + _CATCH_S,
             self.end_s],
            [[0, 0, 0], [-self.crouch_m, 0, 0], [_TAKEOFF_M, self.takeoff_mps, g],
             [_LANDING_M, -self.landing_mps, g], [-0.9 * self.crouch_m, 0, 0], [0, 0, 0]],
        )  # fmt: skip

    def advance(self) -> BPoly:
        """Return the distance that the centre of mass has moved forward [m] over time."""
        flown = self.distance_m - _LEAN_M - _BEHIND_M
        speed = flown / (self.landing_s - self.takeoff_s)
        return BPoly.from_derivatives(
            [self.start_s, self.start_s + _CROUCH_S, self.takeoff_s, self.landing_s, self.landing_s + _CATCH_S],
            [[0, 0, 0], [-0.01, 0, 0], [_LEAN_M, speed, 0], [_LEAN_M + flown, speed, 0], [self.distance_m, 0, 0]],
        )  # fmt: skip


def jumps(performer: Performer, rng: np.random.Generator) -> Motion:
    """Return a loop of a jump forth and a jump back, with lengths, heights and depths drawn by ``rng``."""
    distance = float(rng.uniform(0.50, 0.62))
    here, there = np.array([0.0, distance / 2, 0.0]), np.array([0.0, -distance / 2, 0.0])
    sequence = begin(FEET_TOGETHER, arms=(0.1, 0.52), place=here)
    for side in "lr":
        sequence.begin(**{f"{side}_foot": footing(here, FEET_TOGETHER, side)})
    clock, made = 0.2, []
    for end in (there, here):
        jump = Jump(clock, distance * performer.scale, float(rng.uniform(0.20, 0.30)), float(rng.uniform(0.24, 0.30)))
        made.append(jump)
        heading = float(sequence.target("place")[2])
        _write(sequence, jump, np.array([*end[:2], heading]))
        clock = _turn_round(sequence, jump.end_s, np.array([*end[:2], heading]), np.pi - 2 * heading)
    time_s, rate = loop_times(clock + _REST_S)
    postures = read(sequence, time_s, performer.scale)
    postures = replace(postures, **_swung(sequence.at(time_s)["arms"], performer.scale))
    wanted = _led(performer, postures, made, time_s, rate, performer.scale * np.stack([here, there]))
    return balanced(performer, replace(postures, pelvis_xyz=wanted + [0.0, 0.0, -0.05]), rate, wanted)


def _write(sequence: MovementSequence, jump: Jump, place: Array) -> None:
    """Write trunk, arms and feet of a jump to ``place`` (x, y, turn)."""
    low, off, down = jump.start_s + _CROUCH_S, jump.takeoff_s, jump.landing_s
    for channel, parts in {"pelvis": (0.50, 0.12, 0.40, 0.05), "spine": (0.35, 0.05, 0.30, 0.02)}.items():
        crouched, flying, caught, standing = parts
        sequence.move(channel, jump.start_s, low, (0.0, crouched, 0.0))
        sequence.move(channel, low, off + 0.05, (0.0, flying, 0.0))
        sequence.move(channel, down - 0.20, down + 0.25, (0.0, caught, 0.0))
        sequence.move(channel, down + _CATCH_S, jump.end_s, (0.0, standing, 0.0))
    # Arms: back while crouching, through to the front and up, forward at landing, down.
    sequence.move("arms", jump.start_s, low - 0.02, (-0.75, 0.50))
    sequence.move("arms", low - 0.14, off + 0.05, (1.9, 0.46))
    sequence.move("arms", down - 0.25, down + 0.15, (1.05, 0.48))
    sequence.move("arms", down + 0.30, jump.end_s, (0.1, 0.52))
    sequence.move("gaze", jump.start_s, low, (0.0, 0.15))
    sequence.move("gaze", down, jump.end_s, (0.0, 0.0))
    for side in "lr":
        sequence.move(f"{side}_foot", off, down, footing(place, FEET_TOGETHER, side))
        sequence.hill(f"{side}_lift", off, down, 0.16)
        for start, end, pitch in (
            (jump.start_s, low, _CROUCHED_PITCH),
            (off - 0.20, off + 0.03, 0.75),
            (off + 0.08, down, 0.0),
            (down, down + _CATCH_S, _CROUCHED_PITCH),
            (down + _CATCH_S, jump.end_s, 0.0),
        ):
            sequence.move(f"{side}_pivot", start, end, (0.0, pitch))
        sequence.move(f"{side}_knee", jump.start_s, low, 0.12)
        sequence.move(f"{side}_knee", down + _CATCH_S, jump.end_s, 0.05)


def _turn_round(sequence: MovementSequence, clock: float, place: Array, angle: float) -> float:
    """Write a turn on the spot by ``angle`` in small steps; return when it is done."""
    steps = 2 * _STEPS_A_FOOT
    sequence.move("place", clock, clock + steps * _STEP_S, place + [0.0, 0.0, angle])
    sides = "lr" if angle > 0 else "rl"  # the foot inside the turn goes first
    for k in range(steps):
        # A foot is put down with the heading that the body has in the middle of its stance.
        share = 1.0 if k >= steps - 2 else float(minimum_jerk(np.array((k + 1.5) / steps)))
        turned = place + [0.0, 0.0, angle * share]
        side = sides[k % 2]
        start = clock + k * _STEP_S
        step(sequence, side, start, start + _STEP_S, footing(turned, FEET_TOGETHER, side))
    return clock + steps * _STEP_S


def _swung(arms: Array, scale: float) -> dict[str, Array]:
    """Return hands and elbows of arms swung forward by ``arms`` (n, 2): angle from hanging [rad], reach [m]."""
    angle, reach = arms.T
    hand = np.stack([np.full_like(angle, 0.30), reach * np.sin(angle), -reach * np.cos(angle)], axis=-1)
    elbow = np.stack([np.full_like(angle, 0.5), -np.cos(angle), -np.sin(angle)], axis=-1)
    return {"hands": scale * np.stack([hand, hand], axis=1), "elbows": np.stack([elbow, elbow], axis=1)}


def _led(
    performer: Performer, postures: Postures, made: list[Jump], time_s: Array, rate: float, feet_m: Array
) -> Array:
    """Return the prescribed centre of mass (n, 3) [m]; ``feet_m`` (2, 3): positions where the jumps start."""
    standing = performer.balance.center_of_mass(posed(performer, _first(postures), rate))[0]
    before = float(feet_m[0, 1] - standing[1])  # distance in front of the standing position
    place, advance, rise = (
        np.tile(feet_m[0, :2], (len(time_s), 1)),
        np.full(len(time_s), before),
        np.zeros(len(time_s)),
    )
    for k, jump in enumerate(made):
        during = (time_s >= jump.start_s) & (time_s <= jump.end_s)
        forward, up = jump.advance(), jump.rise()
        advance[during] += forward(np.minimum(time_s[during], forward.x[-1]))
        rise[during] = up(time_s[during])
        place[time_s > jump.end_s] = feet_m[1 - k, :2]
    turn = postures.facing
    ahead = np.stack([np.sin(turn), -np.cos(turn)], axis=-1)
    return np.column_stack([place + advance[:, None] * ahead, standing[2] + rise])


def _first(postures: Postures) -> Postures:
    return Postures(**{name: value[:1] for name, value in vars(postures).items()})
