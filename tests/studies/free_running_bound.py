"""How well any linear estimator can know a moving point between the exposures of free-running cameras.

Bayesian Cramer-Rao bound (Van Trees 1968) of a Gaussian process whose spectrum is known: the posterior variance of a
position given all image points with true names, true instants and the covariance of their true errors. No estimator
that knows of the motion its second moments only can be better on average; one that knows that the motion is a sum of
few sinusoids could. The spectrum is that of the true motion, averaged over points and axes.
"""

from collections.abc import Callable

import numpy as np
from scipy.signal.windows import blackmanharris

RATE_HZ, HIGHEST_HZ = 200.0, 60.0
"""Sampling of the true motion for its spectrum, and its end."""
ANYWHERE_M = 1.0
"""Standard deviation of a point's mean position, which nothing is known of [m]."""


def spectrum(path: Callable[[float], np.ndarray], begin_s: float, end_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Return frequencies (f,) [Hz] and the variance an axis (f,) [m^2] at each of the motion ``path`` (points, 3)."""
    time_s = np.arange(begin_s, end_s, 1.0 / RATE_HZ)
    xyz = np.array([path(float(t)) for t in time_s]).reshape(len(time_s), -1)
    away = xyz - xyz.mean(axis=0)
    # side lobes of -92 dB: power that leaks to high frequencies would raise the bound
    power = (np.abs(np.fft.rfft(away * blackmanharris(len(time_s))[:, None], axis=0)) ** 2).mean(axis=1)
    frequency = np.fft.rfftfreq(len(time_s), 1.0 / RATE_HZ)
    kept = frequency < HIGHEST_HZ
    return frequency[kept], power[kept] * float((away**2).mean()) / power[kept].sum()


def least_variance(
    at_s: np.ndarray,
    time_s: np.ndarray,
    by_point: np.ndarray,
    covariance: np.ndarray,
    of_motion: tuple[np.ndarray, np.ndarray],
) -> np.ndarray:
    """Return the least variance (t,) [m^2] of a position (all three axes together) at ``at_s`` (t,).

    ``time_s`` (n,), ``by_point`` (n, 2, 3) [px/m] and ``covariance`` (n, 2, 2) [px^2] of its image points;
    ``of_motion``: frequencies [Hz] and variances an axis [m^2].
    """
    frequency, power = of_motion
    n = len(time_s)

    def related(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        apart = 2.0 * np.pi * np.subtract.outer(a, b)
        return (np.cos(np.multiply.outer(apart, frequency)) * power).sum(axis=-1) + ANYWHERE_M**2

    images = np.einsum("nai,mbi,nm->namb", by_point, by_point, related(time_s, time_s))
    for k in range(n):
        images[k, :, k] += covariance[k]
    across = np.einsum("tn,nai->tina", related(at_s, time_s), by_point).reshape(len(at_s), 3, 2 * n)
    gain = np.linalg.solve(images.reshape(2 * n, 2 * n), across.reshape(-1, 2 * n).T).T.reshape(across.shape)
    return np.asarray(3.0 * (power.sum() + ANYWHERE_M**2) - (gain * across).sum(axis=(1, 2)))
