"""Configurations between the instants at which they are known: smooth, and pure functions of time.

Every path is called with the session time t [s] and returns qpos (nq,). Paths hold nothing that changes,
so that any thread may call them.
"""

from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.interpolate import CubicSpline

from mosca.data.arrays import Array, read_only


def quaternion_addresses(model: mujoco.MjModel) -> tuple[Array, Array]:
    """Return the addresses at which quaternions start in qpos and their angular velocities in qvel: (k,) and (k,)."""
    free = model.jnt_type == mujoco.mjtJoint.mjJNT_FREE
    turning = free | (model.jnt_type == mujoco.mjtJoint.mjJNT_BALL)
    shift = 3 * free[turning].astype(np.int64)
    return model.jnt_qposadr[turning] + shift, model.jnt_dofadr[turning] + shift


def normalized(qpos: Array, quaternions: Array) -> Array:
    """Return ``qpos`` (..., nq) with unit quaternions, which start at addresses ``quaternions`` (k,)."""
    blocks = quaternions[:, None] + np.arange(4)
    result = np.array(qpos, dtype=np.float64)
    parts = result[..., blocks]
    result[..., blocks] = parts / np.linalg.norm(parts, axis=-1, keepdims=True)
    return result


@dataclass(frozen=True, eq=False)
class SplinePath:
    """A natural cubic spline through known configurations, in seconds after ``start_s`` of the record.

    Quaternions are splined by component and normalised. Their signs do not flip within the record, so that at
    motion capture rates this differs from a spline on the sphere by the cube of the angle between
    frames. The path is C2. Outside the record it continues with the velocity at the record's end, which is C2 as well
    because a natural spline ends without acceleration.
    """

    spline: CubicSpline
    first_s: float
    last_s: float
    start_s: float
    quaternions: Array

    def __call__(self, time_s: float) -> Array:
        """Return qpos (nq,) at session time ``time_s``."""
        wanted = time_s + self.start_s
        held = min(max(wanted, self.first_s), self.last_s)
        qpos = self.spline(held)
        if wanted != held:
            qpos = qpos + (wanted - held) * self.spline(held, 1)
        return normalized(qpos, self.quaternions)


def spline_path(time_s: Array, qpos: Array, quaternions: Array, *, start_s: float = 0.0) -> SplinePath:
    """Return the path through ``qpos`` (n, nq) at rising ``time_s`` (n,) of a record, n > 1.

    ``quaternions`` (k,): addresses of quaternions in qpos; sign flips between frames are removed here.
    Session time 0 is ``start_s`` of the record.
    """
    known = normalized(qpos, quaternions)
    for address in quaternions:
        part = known[:, address : address + 4]
        flips = np.where(np.sum(part[1:] * part[:-1], axis=1) < 0, -1.0, 1.0)
        part[1:] *= np.cumprod(flips)[:, None]
    spline = CubicSpline(time_s, known, bc_type="natural", extrapolate=False)
    return SplinePath(spline, float(time_s[0]), float(time_s[-1]), start_s, np.asarray(quaternions))


@dataclass(frozen=True, eq=False)
class StepPath:
    """Physics steps joined by cubic Hermite arcs that keep each step's position and velocity: C1.

    Rotations follow cubic arcs of the rotation vector from one step's attitude to the next's.
    """

    first_s: float
    """Time of the first step."""
    step_s: float
    qpos: Array
    """(n, nq): configurations."""
    qvel: Array
    """(n, nv): velocities."""
    linear: tuple[Array, Array]  # addresses in qpos and qvel of all that is no quaternion
    angular: tuple[Array, Array]
    turns: Array  # (n - 1, k, 3) rotation vector from a step to the next, in the body's axes
    turn_rates: Array  # (n - 1, k, 3) its rate at the next step

    def __call__(self, time_s: float) -> Array:
        """Return qpos (nq,) at session time ``time_s``; ValueError outside the steps."""
        place = (time_s - self.first_s) / self.step_s
        k = min(max(int(np.floor(place)), 0), len(self.qpos) - 2)
        s = place - k
        if not -1e-6 <= s <= 1 + 1e-6:
            last = self.first_s + (len(self.qpos) - 1) * self.step_s
            raise ValueError(f"time_s = {time_s}: the physics ran from {self.first_s} to {last} s")
        q, v = self.linear
        h00, h01 = (1 + 2 * s) * (1 - s) ** 2, s * s * (3 - 2 * s)
        h10, h11 = s * (1 - s) ** 2 * self.step_s, s * s * (s - 1) * self.step_s
        result = self.qpos[k].copy()
        result[q] = (
            h00 * self.qpos[k, q] + h01 * self.qpos[k + 1, q] + h10 * self.qvel[k, v] + h11 * self.qvel[k + 1, v]
        )
        for j, (address, rate) in enumerate(zip(*self.angular, strict=True)):
            vector = h01 * self.turns[k, j] + h10 * self.qvel[k, rate : rate + 3] + h11 * self.turn_rates[k, j]
            result[address : address + 4] = _turned(self.qpos[k, address : address + 4], vector)
        value: Array = result
        return value


def step_path(model: mujoco.MjModel, first_s: float, step_s: float, qpos: Array, qvel: Array) -> StepPath:
    """Return the path through physics steps ``qpos`` (n, nq), ``qvel`` (n, nv), ``step_s`` apart."""
    quaternion_q, quaternion_v = quaternion_addresses(model)
    known = normalized(qpos, quaternion_q)
    taken_q = (quaternion_q[:, None] + np.arange(4)).reshape(-1)
    taken_v = (quaternion_v[:, None] + np.arange(3)).reshape(-1)
    linear = np.setdiff1d(np.arange(model.nq), taken_q), np.setdiff1d(np.arange(model.nv), taken_v)
    steps, turning = len(known) - 1, len(quaternion_q)
    turns, rates = np.zeros((steps, turning, 3)), np.zeros((steps, turning, 3))
    for j, (address, rate) in enumerate(zip(quaternion_q, quaternion_v, strict=True)):
        attitude = known[:, address : address + 4]
        turns[:, j] = _rotation_vectors(attitude[:-1], attitude[1:])
        rates[:, j] = _rates_of_vector(turns[:, j], np.asarray(qvel)[1:, rate : rate + 3])
    return StepPath(
        first_s,
        step_s,
        read_only(known, (None, model.nq), "qpos"),
        read_only(qvel, (len(known), model.nv), "qvel"),
        linear,
        (quaternion_q, quaternion_v),
        read_only(turns, (steps, turning, 3), "turns"),
        read_only(rates, (steps, turning, 3), "rates"),
    )


def _turned(wxyz: Array, vector: Array) -> Array:
    """Return the quaternion (4,) followed by a rotation by ``vector`` (3,) [rad] in the body's own axes."""
    half = np.linalg.norm(vector) / 2
    w, (x, y, z) = np.cos(half), np.sinc(half / np.pi) / 2 * vector
    a, b, c, d = wxyz
    return np.array(
        [
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        ]
    )


def _rotation_vectors(before: Array, after: Array) -> Array:
    """Return rotation vectors (n, 3) [rad] from attitudes ``before`` (n, 4) to ``after``, in body axes."""
    w = np.sum(before * after, axis=1)
    a, u = before[:, :1], before[:, 1:]
    xyz = a * after[:, 1:] - after[:, :1] * u - np.cross(u, after[:, 1:])
    sign = np.where(w < 0, -1.0, 1.0)
    sine = np.linalg.norm(xyz, axis=1)
    half = np.arctan2(sine, np.abs(w))
    scale = 2 / np.sinc(half / np.pi)  # full angle over sine of the half
    return np.asarray(xyz * (sign * scale)[:, None])


def _rates_of_vector(vectors: Array, angular: Array) -> Array:
    """Return d(vector)/dt (n, 3) of rotation vectors (n, 3) at body angular velocities (n, 3) [rad/s].

    The inverse right Jacobian of SO(3): w + v x w / 2 + c v x (v x w) (Chirikjian 2012, eq. 10.86).
    """
    angle = np.linalg.norm(vectors, axis=1)
    small = angle < 1e-3
    safe = np.where(small, 1.0, angle)
    c = np.where(small, 1 / 12, (1 - safe / 2 / np.tan(safe / 2)) / safe**2)
    once = np.cross(vectors, angular)
    return np.asarray(angular + once / 2 + c[:, None] * np.cross(vectors, once))
