"""A flight that is simulated while it is filmed: an outside pilot steers by the cameras' measurements.

The physics and the attitude controller on board are those of ``twin.scenes.flight``. A request for the configuration
at a later instant than so far continues the simulation; earlier configurations are looked up.
"""

from dataclasses import dataclass
from threading import Lock
from typing import NamedTuple, Protocol

import mujoco
import numpy as np

from mosca.data.arrays import Array
from twin.scenes.flight import CONTROL_STEPS, PHYSICS_STEP_S, SETTLE_S, Airframe, Reference, smooth_gusts
from twin.scenes.paths import StepPath, step_path

_BLOCK_S = 60.0
"""Length of time for which gusts are drawn at once."""
_KEPT_ARCS = 64


@dataclass(frozen=True, eq=False)
class Bounds:
    """Limits of a flight that has not crashed: body's origin in the box and above the floor, body upright."""

    center: Array
    """(3,) [m]"""
    half: Array
    """(3,) half edges of the box [m]."""
    floor_m: float | None
    """Height of the origin at which it touches the floor; None: no floor."""

    def crash(self, position: Array, up_z: float) -> str:
        """Return in words why a state is a crash; "" where it is none. ``up_z``: z of the body's upward axis."""
        if self.floor_m is not None and position[2] < self.floor_m:
            return "hit the floor"
        if (np.abs(position - self.center) > self.half).any():
            return "left the working space"
        return "tilted by more than 90 degrees" if up_z < 0 else ""


class Aboard(NamedTuple):
    """The drone's state at a control step; a pilot may use the part that a real drone measures."""

    position: Array
    """(3,) [m], true."""
    velocity: Array
    """(3,) [m/s], true."""
    acceleration: Array
    """(3,) mean over the last control period, world axes [m/s^2], true."""
    centre_m: float
    """Height of the centre of mass above the origin [m]; ``position`` and ``velocity`` are those of the origin."""


class Steering(Protocol):
    """A pilot, who steers a flight."""

    def steer(self, time_s: float, aboard: Aboard, wanted: Reference) -> tuple[Array, float]:
        """Return the specific force (3,) [m/s^2] and the yaw [rad] that act from ``time_s`` for a control period."""
        ...


class LiveFlight:
    """A flight in progress; ``configuration_at`` of a scene. Any thread may call it, one at a time.

    Parameters
    ----------
    model
        One free body with four rotors.
    reference
        The reference path.
    pilot
        Steers each control period.
    bounds
        Outside them the flight has crashed, and the drone stays where it is.
    gust_n
        Rms force of gusts on each axis [N].
    first_s
        First instant that may be requested; the flight starts a second before it.
    rng
        Draws the gusts.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        reference: Reference,
        pilot: Steering,
        bounds: Bounds,
        gust_n: float,
        first_s: float,
        rng: np.random.Generator,
    ) -> None:
        self.crashed_s, self.crash, self.reference = np.inf, "", reference
        self._model, self._pilot, self._bounds = model, pilot, bounds
        self._begin_s = first_s - SETTLE_S
        count = round(_BLOCK_S / (PHYSICS_STEP_S * CONTROL_STEPS))
        steps_s = self._begin_s + PHYSICS_STEP_S * CONTROL_STEPS * np.arange(count)
        self._gusts = gust_n * smooth_gusts(steps_s, rng)
        self._airframe, self._data = Airframe(model), mujoco.MjData(model)
        position, velocity, _acceleration, yaw = reference.at(self._begin_s)
        self._data.qpos[:7] = [*position, np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]
        self._data.qvel[:3] = velocity
        self._before = self._data.qvel[:3].copy()
        self._qpos, self._qvel = [self._data.qpos.copy()], [self._data.qvel.copy()]
        self._arcs: dict[int, StepPath] = {}
        self._lock = Lock()

    @property
    def now_s(self) -> float:
        """Time up to which the flight has been simulated [s]."""
        return self._begin_s + (len(self._qpos) - 1) * PHYSICS_STEP_S

    def __call__(self, time_s: float) -> Array:
        """Return qpos (7,) at session time ``time_s``; the flight is continued where that is later than ``now_s``."""
        with self._lock:
            self.advance(time_s)
            k = max(0, int(np.floor((time_s - self._begin_s) / PHYSICS_STEP_S)))
            if k not in self._arcs:
                if len(self._arcs) >= _KEPT_ARCS:
                    self._arcs.clear()
                first = self._begin_s + k * PHYSICS_STEP_S
                ends = np.array(self._qpos[k : k + 2]), np.array(self._qvel[k : k + 2])
                self._arcs[k] = step_path(self._model, first, PHYSICS_STEP_S, *ends)
            return self._arcs[k](time_s)

    def position(self, time_s: float) -> Array:
        """Return the origin's true position (3,) [m], extrapolated from the last physics step, to micrometres."""
        self.advance(time_s)
        k = int(np.floor((time_s - self._begin_s) / PHYSICS_STEP_S))
        left: float = time_s - self._begin_s - k * PHYSICS_STEP_S
        return np.asarray(self._qpos[k][:3] + left * self._qvel[k][:3])

    def advance(self, time_s: float) -> None:
        """Continue the flight until the step after ``time_s``."""
        while self.now_s <= time_s + PHYSICS_STEP_S:
            k = len(self._qpos) - 1
            control, between = divmod(k, CONTROL_STEPS)
            if not self.crash:
                if not between:
                    self._steer(control)
                mujoco.mj_step(self._model, self._data)
                if between == CONTROL_STEPS - 1:
                    self._judge()
            self._qpos.append(self._data.qpos.copy())
            self._qvel.append(self._data.qvel.copy())

    def _steer(self, control: int) -> None:
        """Ask the pilot for the force and yaw of a control period."""
        velocity = self._data.qvel[:3].copy()
        acceleration = (velocity - self._before) / (PHYSICS_STEP_S * CONTROL_STEPS)
        self._before = velocity
        centre_m = float(self._model.body_ipos[self._airframe.body][2])
        aboard = Aboard(self._data.qpos[:3].copy(), velocity, acceleration, centre_m)
        push, yaw = self._pilot.steer(self.now_s, aboard, self.reference)
        self._airframe.steer(self._data, push, yaw, self._gusts[control % len(self._gusts)])

    def _judge(self) -> None:
        x, y = self._data.qpos[4:6]
        found = self._bounds.crash(self._data.qpos[:3], float(1 - 2 * (x * x + y * y)))
        if found:
            self.crash, self.crashed_s = found, self.now_s + PHYSICS_STEP_S
            self._data.qvel[:] = 0.0
