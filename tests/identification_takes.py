"""Driven bodies of known dynamics, simulated apart from the code under test (scipy's exact zero-order hold)."""

from dataclasses import dataclass

import numpy as np
from scipy.signal import cont2discrete, lfilter

from mosca.machines.identification.held_inputs import HeldInputs
from mosca.machines.identification.velocities import PlanarPath

FINE_S = 0.001


@dataclass(frozen=True)
class Known:
    """``numerators`` (k lists) over ``denominator`` in s, highest power first, strictly proper."""

    numerators: tuple[tuple[float, ...], ...]
    denominator: tuple[float, ...]

    def gains(self) -> np.ndarray:
        return np.array([one[-1] / self.denominator[-1] for one in self.numerators])

    def distance(self, inputs: HeldInputs, duration_s: float, delay_s: float = 0.0) -> np.ndarray:
        """Return the integral of the answer from rest (n,), each FINE_S."""
        steps = round(duration_s / FINE_S)
        at = np.searchsorted(inputs.time_s + delay_s, FINE_S * np.arange(steps) + 1e-9, side="right") - 1
        u = np.where(at[:, None] >= 0, inputs.values[np.maximum(at, 0)], 0.0)
        total = np.zeros(steps + 1)
        for j, numerator in enumerate(self.numerators):
            system = (np.array(numerator), np.append(self.denominator, 0.0))  # and an integrator
            b, a, _ = cont2discrete(system, FINE_S)
            total[1:] += lfilter(b.ravel(), a, np.append(u[:, j], 0.0))[1:]
        return total


def noise_inputs(seed: int, duration_s: float, hold_s: float = 0.2) -> HeldInputs:
    """Return the paper's noise on two sides, from 0 s on."""
    rng = np.random.default_rng([seed, 11])
    times = np.arange(0.0, duration_s, hold_s)
    average, difference = 30 * rng.uniform(-1, 1, len(times)), 60 * rng.uniform(-1, 1, len(times))
    sides = np.stack([average - difference / 2, average + difference / 2], axis=1)
    return HeldInputs(("left", "right"), times, sides)


def driven_path(
    forwards: np.ndarray, yaw: np.ndarray, period_s: float, sigma: tuple[float, float], seed: int
) -> PlanarPath:
    """Return the noisy path of distances and headings each FINE_S; ``sigma`` of places [m] and headings [rad]."""
    every = round(period_s / FINE_S)
    heading = (yaw[1:] + yaw[:-1]) / 2
    move = np.diff(forwards)
    xy = np.zeros((len(yaw), 2))
    xy[1:] = np.cumsum(np.stack([move * np.cos(heading), move * np.sin(heading)], axis=1), axis=0)
    values = np.column_stack([xy, yaw])[::every]
    rng = np.random.default_rng([seed, 12])
    spread = np.array([sigma[0], sigma[0], sigma[1]])
    n = len(values)
    time_ns = np.round(np.arange(n) * period_s * 1e9).astype(np.int64)
    noisy = values + spread * rng.normal(size=(n, 3))
    return PlanarPath(np.arange(n), time_ns, noisy, np.tile(np.diag(spread**2), (n, 1, 1)))


def first_order(rate: float, gains: tuple[float, ...]) -> Known:
    """Return gains / (s / rate + 1)."""
    return Known(tuple((g * rate,) for g in gains), (1.0, rate))
