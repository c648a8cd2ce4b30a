"""Motion of a target through the working space: by hand, on a turntable, from pose to pose, or at rest.

A hand's path is a sum of sinusoids in each coordinate and each angle: smooth, without beginning or end, and
with nothing above ``highest_hz``.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from mosca.data.arrays import Array, read_only
from mosca.data.rotations import quaternion_from_rotation
from twin.scenes.emission import Glow
from twin.scenes.figure import Figure
from twin.scenes.scene import Scene
from twin.scenes.world import Box, compiled

WAVES = 3
_SHARES = np.array([0.7, 0.2, 0.1])  # of the range along each coordinate
_RATES = np.array([1.0, 1.9, 3.1])  # of the first wave's
_RATE_SPREAD = 0.15


@dataclass(frozen=True, eq=False)
class CarriedPath:
    """Pose of a free body at any time t, as qpos (7,): position [m] and attitude wxyz.

    Position: ``center`` + sum of ``swing`` sin(``rates`` t + ``phases``). Attitude: ``rest``, rotated in its own axes
    by the rotation vector sum of ``sway`` sin(``sway_rates`` t + ``sway_phases``), then about the world's z by
    ``spin`` t + ``spin_phase``.
    """

    center: Array
    """(3,) [m]"""
    swing: Array
    """(w, 3) [m]"""
    rates: Array
    phases: Array
    rest: Array
    """(4,) wxyz"""
    sway: Array
    """(w, 3) [rad]"""
    sway_rates: Array
    sway_phases: Array
    spin: float
    """[rad/s]"""
    spin_phase: float

    def __post_init__(self) -> None:
        for name in ("swing", "rates", "phases", "sway", "sway_rates", "sway_phases"):
            object.__setattr__(self, name, read_only(getattr(self, name), (None, 3), name))
        object.__setattr__(self, "center", read_only(self.center, (3,), "center"))
        object.__setattr__(self, "rest", read_only(self.rest, (4,), "rest"))

    def __call__(self, time_s: float) -> Array:
        """Return qpos (7,) at session time ``time_s``."""
        qpos = np.empty(7)
        qpos[:3] = self.center + (self.swing * np.sin(self.rates * time_s + self.phases)).sum(axis=0)
        vector = (self.sway * np.sin(self.sway_rates * time_s + self.sway_phases)).sum(axis=0)
        angle = float(np.linalg.norm(vector))
        # sin(a / 2) / a by numpy's sinc stays smooth through a vector of zero
        sway = np.concatenate([[np.cos(angle / 2)], np.sinc(angle / 2 / np.pi) / 2 * vector])
        half = (self.spin * time_s + self.spin_phase) / 2
        spin = np.array([np.cos(half), 0.0, 0.0, np.sin(half)])
        swayed = np.empty(4)
        mujoco.mju_mulQuat(swayed, self.rest, sway)
        mujoco.mju_mulQuat(qpos[3:], spin, swayed)
        return qpos

    @property
    def highest_hz(self) -> float:
        """Highest frequency of position and rotation vector [Hz]."""
        rates = np.concatenate([self.rates, self.sway_rates]) * (np.concatenate([self.swing, self.sway]) != 0)
        return float(rates.max(initial=0.0) / (2 * np.pi))


def standing(center: Array, rotation: Array | None = None, spin: float = 0.0, phase: float = 0.0) -> CarriedPath:
    """Return a body at rest at ``center`` (3,), or rotating there about the vertical at ``spin`` [rad/s]."""
    rest = quaternion_from_rotation(np.eye(3) if rotation is None else rotation)
    none = np.zeros((0, 3))
    return CarriedPath(center, none, none, none, rest, none, none, none, spin, phase)


def carried_by_hand(
    room: Array,
    *,
    center: Array,
    rotation: Array,
    sway_rad: Array,
    speed_mps: float,
    turn_rad_s: float,
    spin: float,
    rng: np.random.Generator,
) -> CarriedPath:
    """Return a path that fills ``center`` +- ``room`` (3,) [m] and never leaves it.

    ``rotation`` (3, 3): attitude at rest; ``sway_rad`` (3,): range of the rotation vector along each of its
    axes; ``speed_mps``: rms speed; ``turn_rad_s``: rms rate of the rotation vector; ``spin``: rate about the vertical
    [rad/s]; ``rng`` draws phases and frequencies.
    """
    rates, sway_rates = (
        _RATES[:, None] * rng.uniform(1 - _RATE_SPREAD, 1 + _RATE_SPREAD, (WAVES, 3)) for _ in range(2)
    )
    phases, sway_phases = (rng.uniform(0, 2 * np.pi, (WAVES, 3)) for _ in range(2))
    swing, sway = _SHARES[:, None] * np.asarray(room), _SHARES[:, None] * np.asarray(sway_rad)
    return CarriedPath(
        center,
        swing,
        _at_rate(swing, rates, speed_mps),
        phases,
        quaternion_from_rotation(rotation),
        sway,
        _at_rate(sway, sway_rates, turn_rad_s),
        sway_phases,
        spin,
        float(rng.uniform(0, 2 * np.pi)) if spin else 0.0,
    )


def carried_body(spec: mujoco.MjSpec, name: str) -> mujoco.MjsBody:
    """Add a free body to ``spec``, whose pose is given by a ``CarriedPath``."""
    body = spec.worldbody.add_body(name=name)
    body.add_freejoint(name=name)
    # MuJoCo requires a mass of moving bodies; nothing here is simulated
    body.mass, body.inertia, body.explicitinertial = 1e-3, [1e-6, 1e-6, 1e-6], True
    return body


def carried_scene(
    spec: mujoco.MjSpec,
    names: Sequence[str],
    path: "CarriedPath | SteppedPath",
    duration_s: float,
    *,
    body: str,
    glow: Glow,
    figures: dict[str, Figure] | None = None,
) -> Scene:
    """Return the scene of ``spec``, whose only free body carries the markers ``names``, all of one ``glow``."""
    model, geoms = compiled(spec, names)
    shared = dict.fromkeys(names, glow)
    return Scene(
        model, tuple(names), geoms, path, duration_s, {body: tuple(names)}, figures=figures or {}, glows=shared
    )


def room_around(box: Box, reach: float, what: str) -> Array:
    """Return the distance (3,) [m] by which a body of radius ``reach`` [m] may swing; InputError if not at all."""
    return box.half_inside(np.full(3, reach), what)


def _at_rate(amplitudes: Array, rates: Array, wanted: float) -> Array:
    """Return ``rates`` times a factor, so that the rms rate of the sum of sinusoids is ``wanted``."""
    rms = np.sqrt(np.square(amplitudes * rates).sum() / 2)  # no two frequencies are equal: squares add up
    return np.asarray(rates * (wanted / rms if rms > 0 else 0.0))


@dataclass(frozen=True, eq=False)
class SteppedPath:
    """Pose of a free body that rests at one pose after the other, as qpos (7,)."""

    stands: Array
    """(s, 7) positions [m] and attitudes wxyz."""
    hold_s: float
    """Duration of each pose; the last one does not end."""
    lead_s: float
    """Time by which a step to the next pose is earlier, so that no exposure shows the step."""
    first_s: float = 0.0
    """Additional duration of the first pose."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "stands", read_only(self.stands, (None, 7), "stands"))

    def __call__(self, time_s: float) -> Array:
        """Return qpos (7,) at session time ``time_s``."""
        stand = int((time_s + self.lead_s - self.first_s) / self.hold_s)
        return np.array(self.stands[min(max(stand, 0), len(self.stands) - 1)])


def put_from_stand_to_stand(
    center: Array,
    stands: int,
    hold_s: float,
    *,
    lead_s: float,
    shift_m: Array,
    tilt_rad: float,
    rng: np.random.Generator,
    first_s: float = 0.0,
) -> SteppedPath:
    """Return a body that rests upright at ``center`` (3,) first, then at random positions and attitudes about it.

    ``shift_m`` (3,): largest shift along each axis; ``tilt_rad``: largest tilt; the angles about the vertical are
    evenly spaced. ``first_s``: additional duration of the first pose.
    """
    rows = [np.concatenate([center, [1.0, 0.0, 0.0, 0.0]])]
    for k in range(1, stands):
        place = center + rng.uniform(-1, 1, 3) * shift_m
        lean, side = rng.uniform(0.3, 1.0) * tilt_rad, rng.uniform(0, 2 * np.pi)
        turn = 2 * np.pi * k / stands
        tilted, turned, attitude = np.empty(4), np.empty(4), np.empty(4)
        mujoco.mju_axisAngle2Quat(tilted, np.array([np.cos(side), np.sin(side), 0.0]), lean)
        mujoco.mju_axisAngle2Quat(turned, np.array([0.0, 0.0, 1.0]), turn)
        mujoco.mju_mulQuat(attitude, tilted, turned)
        rows.append(np.concatenate([place, attitude]))
    return SteppedPath(np.array(rows), hold_s, lead_s, first_s)
