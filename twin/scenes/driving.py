"""Driving a skid-steered robot with white noise or given commands: the motors, the contact physics.

Commands after the Mosca paper, section 4.3: U(t) = [a_m rand(t), d_m rand(t)], the average of the two
sides' PWM and their difference, rand uniform on [-1, 1]. A motor's torque at the wheel is
stall_torque (pwm / 255 - wheel speed / free speed): a permanent-magnet motor on a voltage.

Given commands are the lines of text that a program sends to the real robot (``{"left": 120, "right": 80}``).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from mosca.data.arrays import Array
from mosca.data.files.bounded import parse_json
from mosca.errors import InputError
from twin.scenes.scene import Commands
from twin.scenes.world import Box

PHYSICS_STEP_S = 0.001
FULL_PWM = 255.0
STALL_TORQUE_N_M = 8.0
FREE_SPEED_RAD_S = 18.0
_SETTLE_S = 0.5
HALF_DIAGONAL_M = 0.26
COMMAND_NAMES = ("pwm_average", "pwm_difference", "pwm_left", "pwm_right")


@dataclass(frozen=True, eq=False)
class Drive:
    """A driven run: qpos (n, nq) and qvel (n, nv) at every millisecond from ``first_s`` on, and the commands."""

    first_s: float
    qpos: Array
    qvel: Array
    commands: Commands


Sides = Callable[[int, Array], tuple[float, float] | None]
"""Step from 0 s on and qpos -> the PWM of the left and the right side from this step on; None: unchanged."""


def noise(
    box: Box, margin_m: float, *, average_pwm: float, difference_pwm: float, hold_s: float, rng: np.random.Generator
) -> Sides:
    """Return the paper's white noise, each command held for ``hold_s``.

    A rule keeps the robot in the working space. Where its centre is within ``margin_m`` of the box's side and the
    drawn average would drive it further out, the average is negated. This changes neither its magnitude nor the
    sequence of random numbers.
    """
    held = max(round(hold_s / PHYSICS_STEP_S), 1)

    def sides(step: int, qpos: Array) -> tuple[float, float] | None:
        if step % held:
            return None
        draw = rng.uniform(-1, 1, 2)
        average = _turned_back(average_pwm * draw[0], qpos, box, margin_m)
        difference = difference_pwm * draw[1]
        left, right = np.clip([average - difference / 2, average + difference / 2], -FULL_PWM, FULL_PWM)
        return float(left), float(right)

    return sides


def given(lines: Sequence[tuple[int, str]], box: Box) -> Sides:
    """Return the commands in ``lines`` (session time [ns] and text), each held until the next; at rest before.

    Raises InputError for a text that is no command; the returned function does where the robot leaves ``box``.
    """
    due = sorted(((round(t * 1e-9 / PHYSICS_STEP_S), *read_command(text)) for t, text in lines), key=lambda c: c[0])
    if due and due[0][0] < 0:
        raise InputError(f"command at {due[0][0] * PHYSICS_STEP_S:g} s: the robot takes commands from 0 s on")
    waiting = iter(due)
    coming = next(waiting, None)

    def sides(step: int, qpos: Array) -> tuple[float, float] | None:
        nonlocal coming
        _demand_inside(step, qpos, box)
        now = None
        while coming is not None and coming[0] <= step:
            now = coming[1], coming[2]
            coming = next(waiting, None)
        return now

    return sides


def read_command(line: str) -> tuple[float, float]:
    """Return the PWM of the left and the right side, -255..255, from a line of JSON; InputError otherwise."""
    try:
        told = parse_json(line)
        left, right = float(told["left"]), float(told["right"])
    except (ValueError, KeyError, TypeError):
        raise InputError(
            f'robot: command {line[:60]!r} given; {{"left": PWM, "right": PWM}} is wanted, -255 to 255 each'
        ) from None
    if not (abs(left) <= FULL_PWM and abs(right) <= FULL_PWM):
        raise InputError(f"robot: command {line[:60]!r} given; left and right from -255 to 255 are wanted")
    return left, right


def drive(model: mujoco.MjModel, start_m: Array, heading_rad: float, duration_s: float, sides: Sides) -> Drive:
    """Return a run from -0.1 s to ``duration_s`` + 0.1 s; commands start at 0 s.

    ``model``: qpos starts with the robot's free joint; actuators are the left wheels, then the right wheels, with PWM
    as control. ``start_m`` (2,) and ``heading_rad``: its pose until then.
    """
    begin = -0.1 - _SETTLE_S
    steps = int(np.ceil((duration_s + 0.1 - begin) / PHYSICS_STEP_S)) + 1
    settled, start = round(_SETTLE_S / PHYSICS_STEP_S), round(-begin / PHYSICS_STEP_S)
    data = mujoco.MjData(model)
    data.qpos[:2] = start_m
    data.qpos[3:7] = [np.cos(heading_rad / 2), 0, 0, np.sin(heading_rad / 2)]
    wheels = model.nu // 2
    qpos, qvel = np.empty((steps + 1, model.nq)), np.empty((steps + 1, model.nv))
    times, values = [], []
    for k in range(steps + 1):
        command = sides(k - start, data.qpos) if k >= start else None
        if command is not None:
            left, right = command
            data.ctrl[:wheels], data.ctrl[wheels:] = left, right
            times.append((k - start) * round(PHYSICS_STEP_S * 1e9))
            values.append([(left + right) / 2, right - left, left, right])
        qpos[k], qvel[k] = data.qpos, data.qvel
        mujoco.mj_step(model, data)
    commands = Commands(
        COMMAND_NAMES, np.array(times, dtype=np.int64), np.array(values).reshape(-1, len(COMMAND_NAMES))
    )
    first = begin + settled * PHYSICS_STEP_S
    return Drive(first, qpos[settled:], qvel[settled:], commands)


def true_velocities(path: Callable[[float], Array], start_s: Array, end_s: Array, point_m: Array) -> Array:
    """Return the mean speed forwards [m/s] of a point of a free body, and its mean yaw rate [rad/s]: (n, 2).

    The displacement is taken along the mean of the headings, the horizontal directions of the body's x axis; the yaw
    is about the world's z.

    Parameters
    ----------
    path
        Session time [s] -> qpos, of which the first seven are the body's free joint.
    start_s, end_s
        (n,): begin and end of each mean, less than half a turn apart.
    point_m
        (3,) in the body's axes.
    """
    places, headings = [], []
    for times in (start_s, end_s):
        qpos = np.array([path(float(t))[:7] for t in times])
        world_from_body = Rotation.from_quat(qpos[:, 3:], scalar_first=True)
        axis = world_from_body.apply([1.0, 0.0, 0.0])
        places.append(qpos[:, :3] + world_from_body.apply(point_m))
        headings.append(np.arctan2(axis[:, 1], axis[:, 0]))
    turn = np.remainder(headings[1] - headings[0] + np.pi, 2 * np.pi) - np.pi
    mean = headings[0] + turn / 2
    move = places[1] - places[0]
    forwards = np.cos(mean) * move[:, 0] + np.sin(mean) * move[:, 1]
    return np.asarray(np.stack([forwards, turn], axis=1) / (end_s - start_s)[:, None])


def _demand_inside(step: int, qpos: Array, box: Box) -> None:
    out = np.abs(qpos[:2] - box.center[:2]) > box.size[:2] / 2 - HALF_DIAGONAL_M
    if out.any():
        raise InputError(
            f"commands: they drive the robot out of the working space at {step * PHYSICS_STEP_S:.2f} s, in "
            f"{'xy'[int(np.argmax(out))]}; shorten them, set heading_deg, or enlarge [working_space]"
        )


def _turned_back(average: float, qpos: Array, box: Box, margin_m: float) -> float:
    """Return ``average``, negated where it would drive a robot that is near a side further out."""
    w, x, y, z = qpos[3:7]
    forward = np.array([w * w + x * x - y * y - z * z, 2 * (x * y + w * z)])
    from_center = qpos[:2] - box.center[:2]
    near = np.abs(from_center) > box.size[:2] / 2 - margin_m
    outward = np.where(near, np.sign(from_center), 0.0)
    return -average if average * float(forward @ outward) > 0 else average
