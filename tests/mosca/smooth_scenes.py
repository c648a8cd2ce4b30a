"""Smooth random motion, and smoothing as one linear least-squares problem, for the tests of smoothers."""

import numpy as np


def motions(frames, markers, seed=1):
    """Positions (frames, markers, 3) at 100 Hz: sums of sines up to 2 Hz."""
    rng = np.random.default_rng(seed)
    t = 0.01 * np.arange(frames)[:, None, None, None]
    f = rng.uniform(0.2, 2.0, (1, markers, 3, 4))
    return (rng.uniform(0, 0.1, f.shape) * np.sin(2 * np.pi * (f * t + rng.random(f.shape)))).sum(axis=3)


def nees_of(tracks, xyz):
    """Squared errors (n,) in units of the stated covariance."""
    away = tracks.xyz - xyz[tracks.frame, tracks.track]
    return np.einsum("ni,ni->n", away, np.linalg.solve(tracks.covariance, away[:, :, None])[:, :, 0])


def least_squares(seen, variance, moves, noises, speed2, acceleration2):
    """Positions (t,) of one axis and their variances, from all that was ``seen`` (t,), NaN where nothing was.

    ``variance`` (t,) of what was seen; ``moves`` and ``noises`` (t - 1, 3, 3) from each instant to the next.
    """
    n = len(seen)
    information, right = np.zeros((3 * n, 3 * n)), np.zeros(3 * n)
    information[1, 1], information[2, 2] = 1 / speed2, 1 / acceleration2
    for k in np.flatnonzero(np.isfinite(seen)):
        information[3 * k, 3 * k] += 1 / variance[k]
        right[3 * k] += seen[k] / variance[k]
    for k, (move, noise) in enumerate(zip(moves, noises, strict=True)):
        rows = np.zeros((3, 3 * n))
        rows[:, 3 * k : 3 * k + 6] = np.hstack([-move, np.eye(3)])
        information += rows.T @ np.linalg.solve(noise, rows)
    inverse = np.linalg.inv(information)
    return (inverse @ right)[::3], np.diag(inverse)[::3]
