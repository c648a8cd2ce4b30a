"""Stability of a position loop that contains a Kalman filter, which treats late poses as new ones.

The loop of one horizontal axis is modelled as linear, without noise, and as a periodic discrete system. It consists
of a double integrator behind the attitude loop's lag, poses every so many control steps, each ``delay`` late, and the
filter's stationary gain. Predicted position and velocity are fed back, and the filter's unexplained acceleration is
subtracted, which is an integral action. The loop is stable where all eigenvalues over a period lie within the unit
circle (Floquet; Bittanti & Colaneri, Periodic Systems, 2009, section 1.2).
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm, solve_discrete_are

from mosca.data.arrays import Array
from mosca.machines.closed_loop.delay_margin import PositionLoop
from mosca.machines.closed_loop.late_pose_filter import MotionNoise

LONGEST_S = 0.5
"""Longest delay that is tried."""


@dataclass(frozen=True)
class FilteredLoop:
    """A position loop whose filter does not know the delay of its poses."""

    loop: PositionLoop
    noise: MotionNoise
    sigma_m: float
    """Standard deviation of a pose's position, per axis [m]."""
    control_s: float
    """Control period [s]."""
    frame_s: float
    """Mean time between poses that arrive [s]; rounded to whole control periods."""
    measures: bool = False
    """True: the known acceleration is measured, and nothing is subtracted; False: it is that of the commands."""

    def radius(self, delay_s: float) -> float:
        """Return the largest absolute eigenvalue over a pose period: below 1 the loop is stable."""
        late = max(1, round(delay_s / self.control_s))
        every = max(1, round(self.frame_s / self.control_s))
        state = np.eye(4 + late + 3 + 4)
        gain = self._gain(every * self.control_s)
        for k in range(every):
            state = self._stepped(state, late, gain if k == 0 else None)
        return float(np.abs(np.linalg.eigvals(state)).max())

    def margin_s(self) -> float:
        """Return the delay from which on the loop is unstable [s], to one control period; inf above LONGEST_S."""
        for late in range(1, round(LONGEST_S / self.control_s)):
            if self.radius(late * self.control_s) > 1.0:
                return (late - 0.5) * self.control_s
        return np.inf

    def _gain(self, period_s: float) -> Array:
        """Return the filter's stationary gain (3,) for poses ``period_s`` apart."""
        transition, process = self.noise.step(period_s)
        row = np.array([[1.0, 0.0, 0.0]])
        prior = solve_discrete_are(transition.T, row.T, process, np.array([[self.sigma_m**2]]))
        gain: Array = prior[:, 0] / (prior[0, 0] + self.sigma_m**2)
        return gain

    def _stepped(self, state: Array, late: int, gain: Array | None) -> Array:
        """Return the states (n, columns) one control period later; with a ``gain``, a pose is fused first.

        Rows: position, velocity, acceleration and its rate; earlier positions; the filter's three states; the model
        of the lag, its mean acceleration over the coming period, and the command that acts in that period.
        """
        h = self.control_s
        plant, line, known = state[:4], state[4 : 4 + late], state[4 + late : 7 + late].copy()
        lag, coming, sent = state[7 + late : 9 + late], state[9 + late], state[10 + late]
        if gain is not None:
            known = known + np.outer(gain, line[-1] - known[0])
        moved, mean = _plant_step(self.loop, h, plant, sent)
        transition = self.noise.step(h)[0]
        input_mean = mean if self.measures else coming
        ahead = transition @ known + np.outer([h * h / 2, h, 0.0], input_mean)
        command = -self.loop.position_gain * ahead[0] - self.loop.velocity_gain * ahead[1]
        if not self.measures:
            command = command - ahead[2]
        lagged = np.vstack([np.zeros((2, state.shape[1])), lag])
        lag_after, next_mean = _plant_step(self.loop, h, lagged, command)
        parts = (moved, plant[:1], line[:-1], ahead, lag_after[2:], next_mean[None], command[None])
        return np.vstack(parts)


def _plant_step(loop: PositionLoop, h: float, plant: Array, command: Array) -> tuple[Array, Array]:
    """Return position, velocity, acceleration and its rate after ``h``, and the mean acceleration within it."""
    w, z = loop.attitude_rad_s, loop.attitude_damping
    drift = np.zeros((5, 5))
    drift[0, 1] = drift[1, 2] = drift[2, 3] = 1.0
    drift[3, 2:] = (-w * w, -2 * z * w, w * w)
    step = expm(drift * h)
    after = step[:4] @ np.vstack([plant, command])
    return after, (after[1] - plant[1]) / h
