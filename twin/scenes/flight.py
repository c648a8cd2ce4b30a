"""Flying a quadrotor along a smooth closed path: the path, the controller, the physics.

The controller is the geometric one of Lee, Leok and McClamroch, "Geometric tracking control of a
quadrotor UAV on SE(3)" (CDC 2010), eqs. 12-19, without the feed-forward of angular acceleration.
"""

from dataclasses import dataclass
from typing import Literal

import mujoco
import numpy as np
from scipy.interpolate import CubicSpline

from mosca.data.arrays import Array
from mosca.errors import InputError

FlightPath = Literal["figure_eight", "circle", "waypoints", "hover", "steps"]
FLIGHT_PATHS: tuple[FlightPath, ...] = ("figure_eight", "circle", "waypoints", "hover", "steps")
STEP_M, STEP_S = 0.1, 1.0
LARGEST_ACCELERATION_M_S2 = 4.0
PHYSICS_STEP_S = 0.001
CONTROL_STEPS = 5  # 200 Hz, as in the AR.Drone's own loop
SETTLE_S = 1.0
POSITION_GAIN, VELOCITY_GAIN = 16.0, 7.2  # 1/s^2, 1/s: 4 rad/s, damping 0.9
ATTITUDE_GAIN, RATE_GAIN = 400.0, 32.0  # 1/s^2, 1/s: 20 rad/s, damping 0.8
_YAW_SWING_RAD, _YAW_PERIOD_S = 0.5, 12.0
GRAVITY = np.array([0.0, 0.0, 9.81])

_SIDES = np.array([[0.5, 0, 0], [-0.5, 0, 0], [0, 0.5, 0], [0, -0.5, 0], [0, 0, 0.5], [0, 0, -0.5]])


@dataclass(frozen=True, eq=False)
class Reference:
    """The reference path: a closed C2 curve over its length [m], flown at constant speed."""

    curve: CubicSpline
    speed_mps: float
    start_m: float
    yaw_phase: float
    steps: bool = False
    """Whether the place jumps by STEP_M every STEP_S, along one axis after the other and back."""

    def at(self, time_s: float | Array) -> tuple[Array, Array, Array, Array]:
        """Return the reference position, velocity, acceleration (..., 3) and yaw (...) [rad] at ``time_s`` (...)."""
        way = self.start_m + self.speed_mps * time_s
        yaw = _YAW_SWING_RAD * np.sin(2 * np.pi * time_s / _YAW_PERIOD_S + self.yaw_phase)
        v = self.speed_mps
        if self.steps:
            place = self.curve(way) + STEP_M * _SIDES[np.floor(np.asarray(time_s) / STEP_S).astype(int) % len(_SIDES)]
            return place, 0 * place, 0 * place, np.asarray(yaw)
        return self.curve(way), v * self.curve(way, 1), v * v * self.curve(way, 2), np.asarray(yaw)


def plan_flight(
    path: FlightPath, center: Array, half: Array, speed_mps: float, rng: np.random.Generator
) -> Reference:
    """Return a closed path that stays within ``half`` (3,) [m] of ``center`` (3,) [m].

    "hover" stays at the centre, "steps" jumps about it by 0.1 m each second: an excitation for identification.
    ``rng`` draws where a path starts and, for "waypoints", six points in the box that it passes. Raises InputError
    where the path's bends would need more than 4 m/s^2 at ``speed_mps``.
    """
    start, yaw_phase = rng.uniform(0, 1), rng.uniform(0, 2 * np.pi)
    angle = np.linspace(0, 2 * np.pi, 241)
    if path == "figure_eight":
        unit = np.stack([np.sin(angle), np.sin(2 * angle), np.cos(angle)], axis=1)
    elif path == "circle":
        unit = np.stack([np.cos(angle), np.sin(angle), np.sin(angle)], axis=1)
    elif path in ("hover", "steps"):
        still = CubicSpline([0.0, 1.0], np.array([center, center]))
        return Reference(still, speed_mps, start, yaw_phase, path == "steps")
    elif path == "waypoints":
        # Once around the box, so that no bend is a hairpin.
        around = (np.arange(6) + rng.uniform(-0.25, 0.25, 6)) * np.pi / 3
        out = rng.uniform(0.5, 1.0, 6)
        points = np.stack([out * np.cos(around), out * np.sin(around), rng.uniform(-1, 1, 6)], axis=1)
        points = np.vstack([points, points[:1]])
        unit = CubicSpline(_lengths(points), points, bc_type="periodic")(np.linspace(0, _lengths(points)[-1], 241))
        unit = unit - (unit.max(axis=0) + unit.min(axis=0)) / 2
        unit /= np.abs(unit).max(axis=0)  # a spline swings out beyond its points
    else:
        raise InputError(f"path = {path!r} given; allowed: {', '.join(FLIGHT_PATHS)}")
    knots = center + unit * half
    knots[-1] = knots[0]
    lengths = _lengths(knots)
    curve = CubicSpline(lengths, knots, bc_type="periodic")
    bend = float(np.linalg.norm(curve(np.linspace(0, lengths[-1], 2000), 2), axis=1).max())
    if speed_mps**2 * bend > LARGEST_ACCELERATION_M_S2:
        fastest = np.sqrt(LARGEST_ACCELERATION_M_S2 / bend)
        raise InputError(
            f"speed_mps = {speed_mps}: the tightest bend of path '{path}' in this box has a radius of "
            f"{1 / bend:.3f} m and allows {fastest:.2f} m/s; fly more slowly, enlarge the box or take another path"
        )
    return Reference(curve, speed_mps, start * float(lengths[-1]), yaw_phase)


def fly(
    model: mujoco.MjModel,
    reference: Reference,
    first_s: float,
    last_s: float,
    gust_n: float,
    rng: np.random.Generator,
) -> tuple[float, Array, Array]:
    """Return the first instant [s] and qpos (n, 7), qvel (n, 6) at every millisecond of the flight.

    ``model``: one free body with four rotors as actuators (thrusts [N]). ``gust_n``: rms force [N] of a
    smooth gust on each axis, a sum of sinusoids of 0.1-1 Hz drawn from ``rng``. The flight starts a
    second before ``first_s`` on the path, so that the start has died away.
    """
    begin = first_s - SETTLE_S
    settled = round(SETTLE_S / PHYSICS_STEP_S)
    steps = int(np.ceil((last_s - begin) / PHYSICS_STEP_S)) + 1
    controlled_s = begin + PHYSICS_STEP_S * np.arange(0, steps + 1, CONTROL_STEPS)
    position, velocity, acceleration, yaw = reference.at(controlled_s)
    gusts = gust_n * smooth_gusts(controlled_s, rng)
    data = mujoco.MjData(model)
    data.qpos[:7] = [*position[0], np.cos(yaw[0] / 2), 0, 0, np.sin(yaw[0] / 2)]
    data.qvel[:3] = velocity[0]
    airframe = Airframe(model)
    qpos, qvel = np.empty((steps + 1, model.nq)), np.empty((steps + 1, model.nv))
    for k in range(steps + 1):
        qpos[k], qvel[k] = data.qpos, data.qvel
        c, between = divmod(k, CONTROL_STEPS)
        if not between:
            push = (
                acceleration[c]
                + GRAVITY
                + POSITION_GAIN * (position[c] - qpos[k, :3])
                + VELOCITY_GAIN * (velocity[c] - qvel[k, :3])
            )
            airframe.steer(data, push, float(yaw[c]), gusts[c])
        mujoco.mj_step(model, data)
    return begin + settled * PHYSICS_STEP_S, qpos[settled:], qvel[settled:]


class Airframe:
    """The rotors, and the attitude controller on board, which measures attitude and rate without error."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self.body = int(model.jnt_bodyid[0])
        self._mass, self._inertia = float(model.body_mass[self.body]), _inertia(model, self.body)
        self._mixer = np.linalg.inv(_wrench_of_thrusts(model))

    def steer(self, data: mujoco.MjData, push: Array, yaw: float, gust_n: Array) -> None:
        """Set the rotors for a specific force ``push`` (3,) [m/s^2] and a ``yaw`` [rad], and the gust (3,) [N]."""
        wrench = _wrench(push, yaw, data.qpos[3:7], data.qvel[3:6], self._mass, self._inertia)
        data.ctrl[:] = self._mixer @ wrench
        data.xfrc_applied[self.body, :3] = gust_n


def _wrench(push: Array, yaw: float, wxyz: Array, rate: Array, mass: float, inertia: Array) -> Array:
    """Return thrust [N] and moments (3,) [N m] in body axes (Lee et al. eqs. 12, 15, 16).

    ``push`` (3,) is the specific force wanted [m/s^2], ``rate`` (3,) the angular velocity in body axes.
    """
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, wxyz)
    r = rotation.reshape(3, 3)
    up = push / np.sqrt(push @ push)
    side = _cross(up, np.array([np.cos(yaw), np.sin(yaw), 0.0]))
    side /= np.sqrt(side @ side)
    r_wanted = np.stack([_cross(side, up), side, up], axis=1)
    skew = (r_wanted.T @ r - r.T @ r_wanted) / 2
    error = np.array([skew[2, 1], skew[0, 2], skew[1, 0]])
    moment = inertia @ (-ATTITUDE_GAIN * error - RATE_GAIN * rate) + _cross(rate, inertia @ rate)
    return np.array([mass * push @ r[:, 2], *moment])


def smooth_gusts(times_s: Array, rng: np.random.Generator) -> Array:
    """Return forces (n, 3) of unit rms on each axis at ``times_s`` (n,)."""
    frequencies, phases = 2 * np.pi * rng.uniform(0.1, 1.0, (4, 3)), rng.uniform(0, 2 * np.pi, (4, 3))
    waves = np.sin(frequencies * times_s[:, None, None] + phases)
    return np.asarray(waves.sum(axis=1) / np.sqrt(2))  # four unit sinusoids have an rms of sqrt(2)


def _cross(a: Array, b: Array) -> Array:
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def _wrench_of_thrusts(model: mujoco.MjModel) -> Array:
    """Return the matrix (4, 4) from the rotors' thrusts [N] to total thrust and moments in body axes."""
    rows = []
    for k in range(model.nu):
        x, y, _ = model.site_pos[int(model.actuator_trnid[k, 0])]
        rows.append([1.0, y, -x, model.actuator_gear[k, 5]])
    return np.array(rows).T


def _inertia(model: mujoco.MjModel, body: int) -> Array:
    axes = np.zeros(9)
    mujoco.mju_quat2Mat(axes, model.body_iquat[body])
    r = axes.reshape(3, 3)
    return np.asarray(r @ np.diag(model.body_inertia[body]) @ r.T)


def _lengths(points: Array) -> Array:
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
