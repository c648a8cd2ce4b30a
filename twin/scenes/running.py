"""A runner on a treadmill: a stride that repeats, with both feet off the belt between steps.

The path of the whole body's centre of mass is prescribed, as in a jump. It falls freely in flight, and the ground
force is half a sine over each stance (Alexander 1984, Am. Zool. 24, 85), which gives 2.2 times the weight for the
contact and flight times used here. A foot on the belt moves back at the belt's speed. Times and sizes are those of
people who run at 2.7 to 3.1 m/s: 160 to 170 steps a minute, contact 0.25 s, centre of mass up and down by 8 cm, heel
at the height of the knee in swing (Novacheck 1998, Gait Posture 7, 77).
"""

import numpy as np
from scipy.interpolate import BPoly

from mosca.data.arrays import Array
from mosca.data.motion.motion import Motion
from twin.scenes.choreography import loop_times
from twin.scenes.jumping import GRAVITY_MPS2
from twin.scenes.posture import Performer, Postures, balanced, posed

_CONTACT_SHARE = 0.345  # of a stride, each foot
_LOW_M = 0.085  # centre of mass in the middle of a stance, below standing upright
_BEHIND_M = 0.03  # middle of a foot's way on the belt, behind the centre of mass
_APART_M, _SWAY_M = 0.055, 0.010  # balls of the feet and centre of mass to the side
_SPEED_MPS, _STRIDE_HZ = (2.7, 3.1), (1.34, 1.42)


def run(performer: Performer, rng: np.random.Generator) -> Motion:
    """Return a stride; ``rng`` draws the belt's speed and the cadence."""
    # Equal Froude numbers: speed is in proportion to the square root of a person's size.
    speed = float(rng.uniform(*_SPEED_MPS)) / np.sqrt(performer.scale)
    time_s, rate_hz = loop_times(np.sqrt(performer.scale) / float(rng.uniform(*_STRIDE_HZ)))
    stride_s = float(time_s[-1])
    postures = _postures(performer, time_s, stride_s, speed)
    standing = performer.balance.center_of_mass(posed(performer, _upright(performer), rate_hz))[0]
    phase = 2 * np.pi * time_s / stride_s - np.pi * _CONTACT_SHARE
    wanted = np.stack(
        [
            performer.scale * _SWAY_M * np.cos(phase),
            np.zeros_like(time_s),
            standing[2] - performer.scale * _LOW_M + rise(time_s, stride_s),
        ],
        axis=-1,
    )
    return balanced(performer, postures, rate_hz, wanted)


def rise(time_s: Array, stride_s: float) -> Array:
    """Return the height of the centre of mass (n,) above that in the middle of a stance [m].

    Stances begin at 0 and half a stride; their upward speed at the end equals their downward speed at the beginning.
    """
    contact = _CONTACT_SHARE * stride_s
    flight = stride_s / 2 - contact
    most = GRAVITY_MPS2 * np.pi / 2 * (contact + flight) / contact  # of the half sine: its mean carries the weight

    def stance(t: Array | float) -> Array:
        turn = np.pi / contact
        fallen = -GRAVITY_MPS2 * (flight * t + t**2) / 2
        return np.asarray(fallen + most / turn * (t - np.sin(turn * t) / turn))

    t = np.mod(time_s, stride_s / 2)
    since = t - contact
    flown = stance(contact) + GRAVITY_MPS2 * (flight * since - since**2) / 2
    return np.where(t < contact, stance(t), flown) - stance(contact / 2)


def _postures(performer: Performer, time_s: Array, stride_s: float, speed_mps: float) -> Postures:
    """Return the postures with the left foot's stance beginning at 0, and the pelvis at standing height."""
    scale, n = performer.scale, len(time_s)
    phase = 2 * np.pi * time_s / stride_s
    fore, zero = np.cos(phase), np.zeros(n)  # fore: the left leg's, and the right arm's
    feet = [_foot(np.mod(time_s + shift * stride_s, stride_s), stride_s, speed_mps, scale) for shift in (0.0, 0.5)]
    balls = np.stack(
        [
            np.stack([sign * scale * np.full(n, _APART_M), -ahead, lift], axis=-1)
            for sign, (ahead, lift, _) in zip((1, -1), feet, strict=True)
        ],
        axis=1,
    )
    arms = np.stack([-fore, fore], axis=1)
    hands = np.stack([0.18 - 0.05 * arms, 0.10 + 0.20 * arms, -0.30 + 0.07 * arms], axis=-1)
    return Postures(
        pelvis_xyz=np.column_stack([zero, zero, np.full(n, 0.9 * scale)]),
        facing=zero,
        pelvis=np.column_stack([-0.10 * fore, np.full(n, 0.10), -0.06 * np.sin(phase)]),
        spine=np.column_stack([0.26 * fore, np.full(n, 0.05), 0.05 * np.sin(phase)]),
        gaze=np.column_stack([zero, np.full(n, 0.05)]),
        hands=scale * hands,
        elbows=np.tile([0.4, -1.0, -0.3], (n, 2, 1)),
        forearms=np.full((n, 2), 0.3),
        wrists=np.full((n, 2), 0.08),
        balls=balls,
        feet=np.stack([np.tile([0.06, -0.06], (n, 1)), np.stack([pitch for *_, pitch in feet], axis=1)], axis=-1),
        knees=np.full((n, 2), 0.03),
    )


def _foot(since_s: Array, stride_s: float, speed_mps: float, scale: float) -> tuple[Array, Array, Array]:
    """Return a ball's position ahead and above [m] and its foot's pitch [rad], (n,) each, ``since_s`` touch-down."""
    contact = _CONTACT_SHARE * stride_s
    swing = stride_s - contact
    front = speed_mps * contact / 2 - scale * _BEHIND_M
    back = front - speed_mps * contact
    ahead = BPoly.from_derivatives(
        [0, contact, contact + 0.55 * swing, stride_s],
        [[front, -speed_mps, 0], [back, -speed_mps, 0], [0.3 * front, 1.35 * speed_mps, 0], [front, -speed_mps, 0]],
    )
    above = BPoly.from_derivatives(
        [0, contact, contact + 0.40 * swing, stride_s],
        [[0, 0, 0], [0, 0, 0], [0.16 * scale, 0, -4.0 * scale], [0, 0, 0]],
    )
    pitch = BPoly.from_derivatives(
        [0, 0.25 * contact, contact, contact + 0.35 * swing, stride_s],
        [[0, 0, 0], [0, 0, 0], [0.95, 6.0, 0], [1.35, 0, -20.0], [0, 0, 0]],
    )
    return ahead(since_s), above(since_s), pitch(since_s)


def _upright(performer: Performer) -> Postures:
    """Return the posture, n = 1, of standing with the feet below the hips."""
    one = _postures(performer, np.zeros(1), 1.0, 0.0)
    balls = performer.scale * np.array([[[0.1, -0.12, 0.0], [-0.1, -0.12, 0.0]]])
    return Postures(**{**vars(one), "balls": balls, "pelvis": np.zeros((1, 3)), "spine": np.zeros((1, 3))})
