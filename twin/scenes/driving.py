"""Driving a skid-steered robot with white noise: the commands, the motors, the contact physics.

Commands after the Mosca paper, section 4.3: U(t) = [a_m rand(t), d_m rand(t)], the average of the two
sides' PWM and their difference, rand uniform on [-1, 1]. A motor's torque at the wheel is
stall_torque (pwm / 255 - wheel speed / free speed): a permanent-magnet motor on a voltage.
"""

from dataclasses import dataclass

import mujoco
import numpy as np

from mosca.data.arrays import Array
from twin.scenes.scene import Commands
from twin.scenes.world import Box

PHYSICS_STEP_S = 0.001
FULL_PWM = 255.0
STALL_TORQUE_N_M = 8.0
FREE_SPEED_RAD_S = 18.0
_SETTLE_S = 0.5
COMMAND_NAMES = ("pwm_average", "pwm_difference", "pwm_left", "pwm_right")


@dataclass(frozen=True, eq=False)
class Drive:
    """A driven run: qpos (n, nq) and qvel (n, nv) at every millisecond from ``first_s`` on, and the commands."""

    first_s: float
    qpos: Array
    qvel: Array
    commands: Commands


def drive(
    model: mujoco.MjModel,
    box: Box,
    margin_m: float,
    duration_s: float,
    *,
    average_pwm: float,
    difference_pwm: float,
    hold_s: float,
    rng: np.random.Generator,
) -> Drive:
    """Return a white noise run from -0.1 s to ``duration_s`` + 0.1 s; commands start at 0 s.

    ``model``: qpos starts with the robot's free joint; actuators are the left wheels, then the right
    wheels, with PWM as control. Each command is held for ``hold_s``. Rule that keeps the robot in the
    working space: where its centre is within ``margin_m`` of the box's side and the average drawn would
    drive it further out, the average's sign is turned. The magnitude stays as drawn, and so does the
    sequence of random numbers.
    """
    begin = -0.1 - _SETTLE_S
    steps = int(np.ceil((duration_s + 0.1 - begin) / PHYSICS_STEP_S)) + 1
    settled, start = round(_SETTLE_S / PHYSICS_STEP_S), round(-begin / PHYSICS_STEP_S)
    held = max(round(hold_s / PHYSICS_STEP_S), 1)
    data = mujoco.MjData(model)
    data.qpos[:2] = box.center[:2]
    heading = rng.uniform(0, 2 * np.pi)
    data.qpos[3:7] = [np.cos(heading / 2), 0, 0, np.sin(heading / 2)]
    wheels = model.nu // 2
    qpos, qvel = np.empty((steps + 1, model.nq)), np.empty((steps + 1, model.nv))
    times, values = [], []
    for k in range(steps + 1):
        if k >= start and (k - start) % held == 0:
            draw = rng.uniform(-1, 1, 2)
            average = _turned_back(average_pwm * draw[0], data.qpos, box, margin_m)
            difference = difference_pwm * draw[1]
            left, right = np.clip([average - difference / 2, average + difference / 2], -FULL_PWM, FULL_PWM)
            data.ctrl[:wheels], data.ctrl[wheels:] = left, right
            times.append((k - start) * round(PHYSICS_STEP_S * 1e9))
            values.append([average, difference, left, right])
        qpos[k], qvel[k] = data.qpos, data.qvel
        mujoco.mj_step(model, data)
    commands = Commands(COMMAND_NAMES, np.array(times), np.array(values))
    first = begin + settled * PHYSICS_STEP_S
    return Drive(first, qpos[settled:], qvel[settled:], commands)


def _turned_back(average: float, qpos: Array, box: Box, margin_m: float) -> float:
    """Return ``average`` with the sign that does not drive a robot near the side further out."""
    w, x, y, z = qpos[3:7]
    forward = np.array([w * w + x * x - y * y - z * z, 2 * (x * y + w * z)])
    from_center = qpos[:2] - box.center[:2]
    near = np.abs(from_center) > box.size[:2] / 2 - margin_m
    outward = np.where(near, np.sign(from_center), 0.0)
    return -average if average * float(forward @ outward) > 0 else average
