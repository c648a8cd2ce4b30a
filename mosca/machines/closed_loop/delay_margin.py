"""Delay margin of a position loop: phase margin of the linear loop divided by its crossover frequency.

The loop of one horizontal axis consists of a double integrator, position and velocity feedback, the attitude loop as
a second-order lag, and a delay: L(s) = (kv s + kp) / s^2 * w^2 / (s^2 + 2 z w s + w^2) * exp(-s T). Its delay margin
is the phase margin over the crossover frequency (Franklin, Powell & Emami-Naeini, Feedback Control of Dynamic
Systems, 7th ed., section 6.4).
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq


@dataclass(frozen=True)
class PositionLoop:
    """Gains of the position loop and lag of the attitude loop."""

    position_gain: float = 16.0
    """[1/s^2]"""
    velocity_gain: float = 7.2
    """[1/s]"""
    attitude_rad_s: float = 20.0
    """Natural frequency of the attitude loop [rad/s]; infinite for no lag."""
    attitude_damping: float = 0.8

    def gain(self, rad_s: float) -> complex:
        """Return the loop's gain without delay at a frequency [rad/s]."""
        s = 1j * rad_s
        lag = 1.0 + 0j
        if np.isfinite(self.attitude_rad_s):
            w = self.attitude_rad_s
            lag = w * w / (s * s + 2 * self.attitude_damping * w * s + w * w)
        return complex((self.velocity_gain * s + self.position_gain) / (s * s) * lag)


def delay_margin_s(loop: PositionLoop) -> float:
    """Return the delay from which on ``loop`` is unstable [s]; 0 where it is unstable without any delay."""
    low, high = 1e-3 * np.sqrt(loop.position_gain), 10 * (loop.velocity_gain + np.sqrt(loop.position_gain))
    crossover = float(brentq(lambda w: abs(loop.gain(w)) - 1.0, low, high))
    # the phase starts from the double integrator's -180 degrees; the lag subtracts up to 180 more
    lead = np.arctan2(loop.velocity_gain * crossover, loop.position_gain)
    lag = 0.0
    if np.isfinite(loop.attitude_rad_s):
        w = loop.attitude_rad_s
        lag = np.arctan2(2 * loop.attitude_damping * w * crossover, w * w - crossover**2)
    return max(0.0, float(lead - lag) / crossover)


def mean_age_s(period_s: float, dropout: float) -> float:
    """Return the mean age of the newest pose beyond its delay [s], for frames ``period_s`` apart.

    ``dropout``: share of frames lost at random. The gaps are geometrically distributed: E[n^2] / (2 E[n]) =
    (1 + dropout) / (2 (1 - dropout)) periods (renewal theory: mean age of a renewal process).
    """
    return period_s * (1 + dropout) / (2 * (1 - dropout))
