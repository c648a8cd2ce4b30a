"""The pilot on the ground: a Kalman filter fuses late poses, and a position controller uses its prediction.

The position controller is that of ``twin.scenes.flight`` (Lee, Leok & McClamroch 2010, eq. 12), on the predicted
state. On board are the attitude controller, and the gyroscope and attitude that it needs: these are taken as exact.
"""

import heapq
from collections import deque
from typing import NamedTuple

import numpy as np

from mosca.data.arrays import Array
from mosca.machines.closed_loop.delay import FlightLog
from mosca.machines.closed_loop.input_integral import InputIntegral
from mosca.machines.closed_loop.late_pose_filter import LatePoseFilter, MotionNoise
from scenarios.spec.flight import FlightSpec
from twin.scenes.flight import ATTITUDE_GAIN, CONTROL_STEPS, GRAVITY, PHYSICS_STEP_S, RATE_GAIN, Reference
from twin.scenes.live_flight import Aboard
from twin.streams import rng

PERIOD_S = PHYSICS_STEP_S * CONTROL_STEPS
_START_SIGMA = (0.1, 2.0)
"""Standard deviations of position [m] and velocity [m/s] at the first pose: wide."""


class ArrivedPose(NamedTuple):
    """A pose that reaches the controller."""

    arrival_s: float
    frame_s: float
    """Mid-exposure of the pose."""
    position: Array
    """(3,) position of the body's origin [m]."""
    covariance: Array
    """(3, 3) covariance of the errors that are new in each pose [m^2]."""
    lasting: Array
    """(3, 3) covariance of errors that successive poses share: no filter can separate them from the motion [m^2]."""


class ControlStep(NamedTuple):
    """Estimate, reference and truth at a control step."""

    time_s: float
    position: Array
    """(3,) true [m]."""
    velocity: Array
    """(3,) true [m/s]."""
    wanted: Array
    """(3,) [m]"""
    estimated: Array
    """(3,) predicted for this instant [m]; NaN before the first pose."""
    covariance: Array
    """(3, 3) covariance of the estimate [m^2]."""
    pose_age_s: float
    """Age of the newest fused pose [s]."""


def motion_noise(spec: FlightSpec) -> MotionNoise:
    """Return the process noise besides the predictor's known acceleration."""
    white = spec.imu_noise_mps2 * PERIOD_S**0.5 if spec.inputs == "imu" else 0.0
    return MotionNoise(spec.unexplained_mps2, spec.unexplained_s, white)


class Pilot:
    """Steers a drone by the poses that it receives.

    ``shift_s``: error of the assumed exposure time of a pose (too late is above 0); 0 where the delay is known.
    ``keeps_log``: false where the delay and the predictions are not needed, which takes half the time.
    """

    def __init__(self, spec: FlightSpec, shift_s: float, seed: int, keeps_log: bool = True) -> None:
        self._spec, self.shift_s, self._keeps_log = spec, shift_s, keeps_log
        self.noise = motion_noise(spec)
        self._waiting: list[ArrivedPose] = []
        self._lasting = np.zeros((3, 3))
        self._inputs = InputIntegral()
        self._filter: LatePoseFilter | None = None
        self._sent: deque[tuple[float, Array, float]] = deque()
        self._lag = AttitudeLag()
        self._random = rng(seed, "flight/imu")
        self._bias = self._random.normal(0.0, spec.imu_bias_mps2, 3)
        self._known: list[tuple[float, Array]] = []
        self.arrived: list[ArrivedPose] = []
        self.steps: list[ControlStep] = []

    def receive(self, pose: ArrivedPose) -> None:
        """Take a pose that will arrive at its ``arrival_s``."""
        heapq.heappush(self._waiting, pose)

    def steer(self, time_s: float, aboard: Aboard, wanted: Reference) -> tuple[Array, float]:
        """Return the specific force (3,) [m/s^2] and the yaw [rad] that act from ``time_s``."""
        self._fuse(time_s)
        if self._spec.inputs == "imu":
            measured = aboard.acceleration + self._bias + self._random.normal(0.0, self._spec.imu_noise_mps2, 3)
            self._know(time_s - PERIOD_S, measured)
        self._log(time_s, aboard, wanted)
        # the command takes effect on board at the next control step
        acts_s = time_s + PERIOD_S * np.ceil(self._spec.command_s / PERIOD_S - 1e-9)
        push, yaw = self._command(time_s, acts_s, aboard, wanted)
        self._sent.append((acts_s, push, yaw))
        if self._spec.inputs == "commands":
            self._know(acts_s, self._lag.step(push - GRAVITY, aboard.centre_m))
        while len(self._sent) > 1 and self._sent[1][0] <= time_s + 1e-9:
            self._sent.popleft()
        _acts, push, yaw = self._sent[0]
        return push, yaw

    def log(self) -> FlightLog:
        """Return the data available on the ground, for the estimate of the delay."""
        late = self.arrived
        return FlightLog(
            np.array([time_s for time_s, _ in self._known]),
            np.array([value for _, value in self._known]).reshape(-1, 3),
            np.array([one.arrival_s for one in late]),
            np.array([one.frame_s for one in late]),
            np.array([one.position for one in late]).reshape(-1, 3),
            np.array([one.covariance for one in late]).reshape(-1, 3, 3),
        )

    def _know(self, time_s: float, acceleration: Array) -> None:
        self._inputs.append(time_s, acceleration)
        if self._keeps_log:
            self._known.append((time_s, acceleration))

    def _fuse(self, time_s: float) -> None:
        """Fuse the poses that have arrived."""
        while self._waiting and self._waiting[0][0] <= time_s:
            pose = heapq.heappop(self._waiting)
            self.arrived.append(pose)
            stamp_s = pose.frame_s + self.shift_s
            if self._filter is None:
                self._filter = LatePoseFilter(
                    self.noise, stamp_s, pose.position, np.zeros(3), _START_SIGMA, inputs=self._inputs
                )
            self._filter.fuse(stamp_s, pose.position, pose.covariance)
            self._lasting = pose.lasting

    def _command(self, time_s: float, acts_s: float, aboard: Aboard, wanted: Reference) -> tuple[Array, float]:
        """Return the command that will act at ``acts_s``."""
        spec, known = self._spec, self._filter
        if known is None or time_s < spec.handover_s:
            now, speed, unexplained = aboard.position, aboard.velocity, np.zeros(3)
            position, velocity, acceleration, yaw = wanted.at(time_s)
        else:
            position, velocity, acceleration, yaw = wanted.at(acts_s)
            now, speed, unexplained = known.mean_at(max(acts_s, known.newest_s))
            if spec.inputs == "imu":  # this is the sensor's error, not a force
                unexplained = np.zeros(3)
        push = (
            acceleration
            + GRAVITY
            - unexplained
            + spec.position_gain * (position - now)
            + spec.velocity_gain * (velocity - speed)
        )
        return push, float(yaw)

    def _log(self, time_s: float, aboard: Aboard, wanted: Reference) -> None:
        at, covariance, age_s = np.full(3, np.nan), np.full((3, 3), np.nan), np.inf
        if self._filter is not None and self._keeps_log:
            found = self._filter.at(max(time_s, self._filter.newest_s))
            at, covariance = found.position, found.covariance[:3, :3] + self._lasting
            age_s = time_s - self._filter.newest_s + self.shift_s
        self.steps.append(
            ControlStep(time_s, aboard.position, aboard.velocity, wanted.at(time_s)[0], at, covariance, age_s)
        )


class AttitudeLag:
    """The attitude loop's response to commanded horizontal accelerations; thrust acts at once.

    The loop on board measures once a control period and holds its moments until the next: a'' = ATTITUDE_GAIN (u - a)
    - RATE_GAIN a', with the right side at the period's start. A continuous model would respond half a period later. A
    drone turns about its centre of mass, so that its origin below it first moves the opposite way, by the height
    times the tilt a / g.
    """

    def __init__(self) -> None:
        self._tilt, self._rate = np.zeros(2), np.zeros(2)

    def step(self, wanted: Array, centre_m: float) -> Array:
        """Return the origin's mean acceleration (3,) over a control period with the command ``wanted`` (3,) [m/s^2].

        ``centre_m``: as in ``Aboard``.
        """
        h, before, rate = PERIOD_S, self._tilt, self._rate
        held = ATTITUDE_GAIN * (wanted[:2] - before) - RATE_GAIN * rate
        self._tilt, self._rate = before + h * rate + 0.5 * h * h * held, rate + h * held
        mean = before + 0.5 * h * rate + h * h / 6.0 * held - centre_m / GRAVITY[2] * held
        return np.array([*mean, wanted[2]])
