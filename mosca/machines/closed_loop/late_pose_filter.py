"""A Kalman filter that fuses poses at the instants at which they were exposed, however late they arrive.

The state of each axis is position, velocity, and an acceleration that the known input does not explain (a first-order
Gauss-Markov process; Bar-Shalom, Li & Kirubarajan 2001, section 8.2, the Singer model, here added to a known input).
A pose older than one already fused is inserted at its instant, and the later ones are fused again, which is exact.
The prediction to the present integrates the known input.
"""

from bisect import bisect_right
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mosca.data.arrays import Array
from mosca.machines.closed_loop.input_integral import InputIntegral

_AXES = np.eye(3)


@dataclass(frozen=True)
class MotionNoise:
    """Noise of the acceleration that the known input does not explain."""

    acceleration_mps2: float = 0.1
    """Rms of the unexplained acceleration, each axis [m/s^2]."""
    correlation_s: float = 1.0
    """Its correlation time [s]."""
    white: float = 0.0
    """Density of an additional white noise of the known acceleration [m/s^2/sqrt(Hz)]."""

    def step(self, dt_s: float) -> tuple[Array, Array]:
        """Return transition and process covariance (3, 3) of one axis over ``dt_s`` [s] (Singer 1970, eq. 8)."""
        transition, process = self._coloured(dt_s)
        if self.white > 0:
            rate, half = self.white**2 * dt_s, self.white**2 * dt_s**2 / 2
            process[:2, :2] += [[self.white**2 * dt_s**3 / 3, half], [half, rate]]
        return transition, process

    def _coloured(self, dt_s: float) -> tuple[Array, Array]:
        tc, e = self.correlation_s, np.exp(-dt_s / self.correlation_s)
        a = 1.0 / tc
        x = a * dt_s
        gain_v, gain_p = tc * (1 - e), tc * tc * (e - 1 + x)
        transition = np.array([[1.0, dt_s, gain_p], [0.0, 1.0, gain_v], [0.0, 0.0, e]])
        if x < 1e-2:  # the closed form suffers cancellation; white jerk for a short step, error of order x
            q = 2 * self.acceleration_mps2**2 * a
            d = dt_s
            short = q * np.array(
                [[d**5 / 20, d**4 / 8, d**3 / 6], [d**4 / 8, d**3 / 3, d * d / 2], [d**3 / 6, d * d / 2, d]]
            )
            return transition, short
        s2, e2 = self.acceleration_mps2**2, e * e
        q11 = s2 / a**4 * (1 - e2 + 2 * x + 2 * x**3 / 3 - 2 * x * x - 4 * x * e)
        q12 = s2 / a**3 * (e2 + 1 - 2 * e + 2 * x * e - 2 * x + x * x)
        q13 = s2 / a**2 * (1 - e2 - 2 * x * e)
        q22 = s2 / a**2 * (4 * e - 3 - e2 + 2 * x)
        q23 = s2 / a * (e2 + 1 - 2 * e)
        return transition, np.array([[q11, q12, q13], [q12, q22, q23], [q13, q23, s2 * (1 - e2)]])


class PredictedMotion(NamedTuple):
    """Position and velocity of a body at an instant."""

    position: Array
    """(3,) [m]"""
    velocity: Array
    """(3,) [m/s]"""
    unexplained: Array
    """(3,) acceleration in addition to the known input [m/s^2]."""
    covariance: Array
    """(9, 9) of position, velocity and unexplained acceleration."""


class _Fused(NamedTuple):
    """State after fusing a pose, and the pose."""

    time_s: float
    mean: Array  # (3, 3): rows position, velocity, unexplained acceleration; columns x, y, z
    covariance: Array  # (9, 9), in the order of the rows
    position: Array
    noise: Array
    log_likelihood: float


class LatePoseFilter:
    """Fuses late poses and predicts to any later instant; inputs and stamps must be of one clock.

    Parameters
    ----------
    noise
        Acceleration that the inputs do not explain.
    time_s, position, velocity
        Instant [s], position (3,) [m] and velocity (3,) [m/s] of the start.
    sigma
        Standard deviations of the start's position [m] and velocity [m/s], each axis.
    memory_s
        A pose older than the newest fused one by more than this is refused.
    inputs
        The known acceleration, to which values may be appended. Default: none yet.
    """

    def __init__(
        self,
        noise: MotionNoise,
        time_s: float,
        position: Array,
        velocity: Array,
        sigma: tuple[float, float],
        memory_s: float = 1.0,
        inputs: InputIntegral | None = None,
    ) -> None:
        self.noise, self.refused = noise, 0
        self.inputs = InputIntegral() if inputs is None else inputs
        self._memory_s = memory_s
        start = np.diag([sigma[0] ** 2, sigma[1] ** 2, noise.acceleration_mps2**2])
        mean = np.array([position, velocity, np.zeros(3)], dtype=float)
        self._fused = [_Fused(time_s, mean, np.kron(start, _AXES), mean[0], np.zeros((3, 3)), 0.0)]
        self.log_likelihood = 0.0

    @property
    def newest_s(self) -> float:
        """Stamp of the newest pose that was fused [s]."""
        return self._fused[-1].time_s

    def fuse(self, time_s: float, position: Array, covariance: Array) -> bool:
        """Fuse a pose that was exposed at ``time_s``: ``position`` (3,) [m], ``covariance`` (3, 3) [m^2].

        Returns False, and counts it in ``refused``, where it is older than all states kept.
        """
        k = bisect_right([one.time_s for one in self._fused], time_s) - 1
        if k < 0:
            self.refused += 1
            return False
        again = self._fused[k + 1 :]
        del self._fused[k + 1 :]
        self._add(time_s, np.asarray(position, dtype=float), np.asarray(covariance, dtype=float))
        for one in again:
            self.log_likelihood -= one.log_likelihood
            self._add(one.time_s, one.position, one.noise)
        while len(self._fused) > 2 and self._fused[1].time_s < self._fused[-1].time_s - self._memory_s:
            del self._fused[0]
        return True

    def at(self, time_s: float) -> PredictedMotion:
        """Return the state at ``time_s``, not before the newest pose."""
        mean, covariance = self._carried(self._fused[-1], time_s)
        return PredictedMotion(mean[0], mean[1], mean[2], covariance)

    def mean_at(self, time_s: float) -> Array:
        """Return position, velocity and unexplained acceleration (3, 3), row by row, at ``time_s``."""
        return self._mean(self._fused[-1], time_s, self.noise.step(time_s - self.newest_s)[0])

    def _mean(self, last: _Fused, time_s: float, transition: Array) -> Array:
        mean: Array = transition @ last.mean
        way, speed = self.inputs.effect(last.time_s, time_s)
        mean[0] += way
        mean[1] += speed
        return mean

    def _carried(self, last: _Fused, time_s: float) -> tuple[Array, Array]:
        transition, process = self.noise.step(time_s - last.time_s)
        every = np.kron(transition, _AXES)
        covariance: Array = every @ last.covariance @ every.T + np.kron(process, _AXES)
        return self._mean(last, time_s, transition), covariance

    def _add(self, time_s: float, position: Array, noise: Array) -> None:
        mean, covariance = self._carried(self._fused[-1], time_s)
        innovation = position - mean[0]
        s = covariance[:3, :3] + noise
        gain = np.linalg.solve(s, covariance[:3]).T
        updated = mean + (gain @ innovation).reshape(3, 3)
        left = np.eye(9)
        left[:, :3] -= gain
        after = left @ covariance @ left.T + gain @ noise @ gain.T
        misfit = innovation @ np.linalg.solve(s, innovation)
        gained = -0.5 * float(misfit + np.log(np.linalg.det(2 * np.pi * s)))
        self.log_likelihood += gained
        self._fused.append(_Fused(time_s, updated, after, position, noise, gained))
