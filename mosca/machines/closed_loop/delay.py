"""The delay between a pose's exposure and its use, from a flight's own log of inputs and of poses as they arrived.

Maximum likelihood: at the right delay the Kalman filter's innovations are smallest relative to the noise that it
assumes (prediction error method, Ljung 1999, section 7.4; consistent in closed loop where the noise is modelled,
section 13.4). The unexplained acceleration and the poses' noise are estimated together with the delay, so that
neither needs to be known.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from scipy.optimize import minimize

from mosca.data.arrays import Array, set_read_only
from mosca.errors import InputError
from mosca.machines.closed_loop.late_pose_filter import MotionNoise
from mosca.numba_support.decorators import kernel

FEWEST_POSES = 100
LONGEST_S = 0.3
"""Longest delay that is tried."""
_GRID_S = 0.02
"""Step of a grid of delays, the likeliest of which starts the search; also the unit of the search."""
WORST_SIGMA_S = 0.002
"""Largest standard deviation of a delay that is returned."""
_CURVED_S = 0.001
"""Step of the second difference of the likelihood: smaller than the stated errors."""
_START_SIGMA = (1.0, 1.0)
"""Standard deviations of position [m] and velocity [m/s] before the first pose: wide."""


@dataclass(frozen=True, eq=False)
class FlightLog:
    """Log of a ground computer; all times but ``frame_s`` are of one clock."""

    input_s: Array
    """(n,) time from which each acceleration holds [s]."""
    acceleration: Array
    """(n, 3) known acceleration: measured on board, or commanded and passed through the vehicle's lag [m/s^2]."""
    arrival_s: Array
    """(k,) time at which each pose arrived [s]."""
    frame_s: Array
    """(k,) exposure of each pose by the cameras' clock, whose offset is unknown: frame number over rate [s]."""
    position: Array
    """(k, 3) [m]"""
    covariance: Array
    """(k, 3, 3) [m^2]"""

    def __post_init__(self) -> None:
        n, k = len(np.asarray(self.input_s)), len(np.asarray(self.arrival_s))
        set_read_only(self, input_s=(n,), acceleration=(n, 3), arrival_s=(k,), frame_s=(k,))
        set_read_only(self, position=(k, 3), covariance=(k, 3, 3))


@dataclass(frozen=True)
class DelayEstimate:
    """An estimated delay, with the noise estimated together with it."""

    delay_s: float
    """Mean time from a pose's mid-exposure to its arrival, by the clock of the inputs [s]."""
    sigma_s: float
    """Standard deviation [s], from the curvature of the likelihood."""
    acceleration_mps2: float
    """Estimated rms of the acceleration that the inputs do not explain [m/s^2]."""
    noise_factor: float
    """Estimated ratio of the standard deviation of the poses' noise to the stated one."""
    poses: int

    allowed_s: ClassVar[float] = 0.002
    """Error of an assumed delay below which it does not matter."""

    @property
    def ci95(self) -> tuple[float, float]:
        """95 % interval [s]."""
        return self.delay_s - 1.96 * self.sigma_s, self.delay_s + 1.96 * self.sigma_s


def estimate_delay(
    log: FlightLog, correlation_s: float = 1.0, white: float = 0.0, longest_s: float = LONGEST_S
) -> DelayEstimate:
    """Return the delay of the poses in ``log``.

    ``correlation_s`` of the unexplained acceleration and ``white`` as in ``MotionNoise``. InputError where there are
    too few poses, where the motion does not determine the delay, or where the delay lies at an end of the range 0 to
    ``longest_s``.
    """
    if len(log.arrival_s) < FEWEST_POSES:
        raise InputError(
            f"delay: {len(log.arrival_s)} poses given; {FEWEST_POSES} or more are wanted: log for longer"
        )
    prepared = _Prepared(log)

    def cost(delay_s: float, acceleration: float, factor: float) -> float:
        noise = MotionNoise(acceleration, correlation_s, white)
        return -prepared.log_likelihood(delay_s, noise, factor)

    delays = np.arange(0.0, longest_s + _GRID_S / 2, _GRID_S)
    accelerations = (0.03, 0.3)
    starts = [(float(d), a) for a in accelerations for d in delays]
    first = min(starts, key=lambda start: cost(start[0], start[1], 1.0))
    x0 = np.array([first[0] / _GRID_S, np.log(first[1]), 0.0])
    simplex = x0 + np.array([[0, 0, 0], [0.5, 0, 0], [0, 0.7, 0], [0, 0, 0.3]])
    found = minimize(
        lambda x: cost(x[0] * _GRID_S, np.exp(x[1]), np.exp(x[2])),
        x0,
        method="Nelder-Mead",
        options={"initial_simplex": simplex, "xatol": 2e-3, "fatol": 1e-3, "maxiter": 200},
    )
    delay, acceleration, factor = float(found.x[0] * _GRID_S), float(np.exp(found.x[1])), float(np.exp(found.x[2]))
    if not 0.0 < delay < longest_s:
        raise InputError(
            f"delay: {1e3 * delay:.1f} ms is the likeliest, at an end of 0 to {1e3 * longest_s:g} ms; are the inputs "
            "those of this flight, on the clock of the arrivals?"
        )
    sides = [cost(delay + step, acceleration, factor) for step in (-_CURVED_S, 0.0, _CURVED_S)]
    curvature = (sides[0] - 2 * sides[1] + sides[2]) / _CURVED_S**2
    if curvature <= 0:
        raise InputError("delay: the motion does not tell it; fly steps, or log for longer")
    if curvature**-0.5 > WORST_SIGMA_S:
        raise InputError(
            f"delay: the motion tells it to {1e3 * curvature**-0.5:.1f} ms (standard deviation), "
            f"{1e3 * WORST_SIGMA_S:g} ms are wanted; fly steps, or log for longer"
        )
    return DelayEstimate(delay, float(curvature**-0.5), acceleration, factor, len(log.arrival_s))


class _Prepared:
    """A log in order of exposure, and its inputs integrated, for many trial delays."""

    def __init__(self, log: FlightLog) -> None:
        order = np.argsort(log.frame_s, kind="stable")
        self.late_s = float(np.mean(log.arrival_s - log.frame_s))
        self._frame_s, self._position = log.frame_s[order], np.ascontiguousarray(log.position[order])
        self._variance = np.ascontiguousarray(np.diagonal(log.covariance[order], axis1=1, axis2=2))
        self._input_s = log.input_s
        self._value = np.vstack([log.acceleration, log.acceleration[-1:]])
        gaps = np.diff(log.input_s)[:, None]
        self._speed = np.vstack([np.zeros(3), np.cumsum(gaps * log.acceleration[:-1], axis=0)])
        ways = gaps * self._speed[:-1] + 0.5 * gaps**2 * log.acceleration[:-1]
        self._way = np.vstack([np.zeros(3), np.cumsum(ways, axis=0)])
        # frames come at whole periods: there are few different gaps
        self._gaps, self._gap_of = np.unique(np.round(np.diff(self._frame_s), 9), return_inverse=True)

    def log_likelihood(self, delay_s: float, noise: MotionNoise, factor: float) -> float:
        """Return the log likelihood of the poses for a mean time ``delay_s`` from exposure to arrival."""
        stamps = self._frame_s + self.late_s - delay_s
        v, x = self._integrals(stamps)
        gap = np.diff(stamps)[:, None]
        way, speed = np.diff(x, axis=0) - v[:-1] * gap, np.diff(v, axis=0)
        steps = [noise.step(float(gap_s)) for gap_s in self._gaps]
        transitions = np.array([one for one, _ in steps])[self._gap_of]
        processes = np.array([one for _, one in steps])[self._gap_of]
        start = np.array([_START_SIGMA[0], _START_SIGMA[1], noise.acceleration_mps2]) ** 2
        variance = factor**2 * self._variance
        return float(_innovations(self._position, variance, way, speed, transitions, processes, start))

    def _integrals(self, time_s: Array) -> tuple[Array, Array]:
        """Return the input's single [m/s] and double [m] integrals (n, 3)."""
        k = np.clip(np.searchsorted(self._input_s, time_s, side="right") - 1, 0, len(self._input_s) - 1)
        h = np.maximum(time_s - self._input_s[k], 0.0)[:, None]
        v = self._speed[k] + h * self._value[k]
        return v, self._way[k] + h * self._speed[k] + 0.5 * h * h * self._value[k]


@kernel
def _innovations(
    position: Array, variance: Array, way: Array, speed: Array, transition: Array, process: Array, start: Array
) -> float:
    """Return the log likelihood of positions (k, 3) by a Kalman filter for each axis; the first one starts it."""
    total = 0.0
    for axis in range(3):
        x, v, d = position[0, axis], 0.0, 0.0
        p00, p01, p02, p11, p12, p22 = start[0], 0.0, 0.0, start[1], 0.0, start[2]
        for k in range(len(position)):
            if k > 0:
                f, q = transition[k - 1], process[k - 1]
                x, v, d = (
                    x + f[0, 1] * v + f[0, 2] * d + way[k - 1, axis],
                    v + f[1, 2] * d + speed[k - 1, axis],
                    f[2, 2] * d,
                )
                # rows of F P, then of F P F': F is upper triangular, its diagonal is 1 except for the last element
                a0, a1, a2 = (
                    p00 + f[0, 1] * p01 + f[0, 2] * p02,
                    p01 + f[0, 1] * p11 + f[0, 2] * p12,
                    p02 + f[0, 1] * p12 + f[0, 2] * p22,
                )
                b1, b2 = p11 + f[1, 2] * p12, p12 + f[1, 2] * p22
                p00 = a0 + f[0, 1] * a1 + f[0, 2] * a2 + q[0, 0]
                p01 = a1 + f[1, 2] * a2 + q[0, 1]
                p02 = f[2, 2] * a2 + q[0, 2]
                p11 = b1 + f[1, 2] * b2 + q[1, 1]
                p12 = f[2, 2] * b2 + q[1, 2]
                p22 = f[2, 2] * f[2, 2] * p22 + q[2, 2]
            s = p00 + variance[k, axis]
            off = position[k, axis] - x
            g0, g1, g2 = p00 / s, p01 / s, p02 / s
            x, v, d = x + g0 * off, v + g1 * off, d + g2 * off
            p11, p12, p22 = p11 - g1 * p01, p12 - g1 * p02, p22 - g2 * p02
            p00, p01, p02 = p00 - g0 * p00, p01 - g0 * p01, p02 - g0 * p02
            if k > 0:
                total -= 0.5 * (off * off / s + np.log(2 * np.pi * s))
    return total
