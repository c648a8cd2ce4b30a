"""Records of vibration with known modes, made without the code under test: exact samples of oscillators.

An oscillator on white force, sampled at instants dt apart, is a vector x = (q, q') that obeys x' = F x + e with
F = expm(A dt) and e of covariance P - F P F^T, P the stationary covariance diag(s^2, s^2 w^2).
"""

from collections.abc import Sequence

import numpy as np
from scipy.linalg import expm

from mosca.data.arrays import Array
from mosca.machines.vibration.displacements import Displacements

RATE_HZ = 200.0
FREQUENCIES_HZ = (20.0, 38.0, 61.0, 78.0)
DAMPING = (0.01, 0.008, 0.006, 0.008)
RMS_M = (150e-6, 60e-6, 30e-6, 20e-6)
PLACES = np.stack(np.meshgrid(np.linspace(0.05, 0.55, 5), np.linspace(0.05, 0.35, 4)), -1).reshape(-1, 2)
NOISE_M = 15e-6


def oscillator(n: int, hz: float, damping: float, rms_m: float, rng: np.random.Generator) -> Array:
    """Return n samples of an oscillator's displacement [m]."""
    w, dt = 2 * np.pi * hz, 1 / RATE_HZ
    step = expm(np.array([[0.0, 1.0], [-(w**2), -2 * damping * w]]) * dt)
    spread = rms_m**2 * np.diag([1.0, w**2])
    kicks = rng.multivariate_normal(np.zeros(2), spread - step @ spread @ step.T, size=n)
    x = rng.multivariate_normal(np.zeros(2), spread)
    result = np.empty(n)
    for k in range(n):
        result[k] = x[0]
        x = step @ x + kicks[k]
    return result


def plate_shapes(places: Array = PLACES) -> Array:
    """Return shapes (m, 4) of half waves 1 x 1, 2 x 1, 1 x 2 and 2 x 2 over 0.6 x 0.4 m."""
    x, y = np.pi * places[:, 0] / 0.6, np.pi * places[:, 1] / 0.4
    return np.stack([np.sin(i * x) * np.sin(j * y) for i, j in ((1, 1), (2, 1), (1, 2), (2, 2))], axis=1)


def plate_values(length_s: float, seed: int, noise_m: float = NOISE_M) -> Array:
    """Return deflections (t, m) [m] of a plate in four modes, with white noise."""
    rng = np.random.default_rng(seed)
    n = round(length_s * RATE_HZ)
    pairs = zip(FREQUENCIES_HZ, DAMPING, RMS_M, strict=True)
    q = np.stack([oscillator(n, hz, damping, rms, rng) for hz, damping, rms in pairs], axis=1)
    return np.asarray(q @ plate_shapes().T + noise_m * rng.standard_normal((n, len(PLACES))))


def record_of(values: Array, places: Array = PLACES, variance: float = NOISE_M**2) -> Displacements:
    """Return deflections (t, m) as what is analysed."""
    m = values.shape[1]
    names: Sequence[str] = [f"P{k + 1}" for k in range(m)]
    return Displacements(
        tuple(names), np.column_stack([places, np.zeros(m)]), np.array([[0.0, 0.0, 1.0]]), values,
        np.full(m, variance), RATE_HZ, np.empty((m, 0)), (),
    )  # fmt: skip
