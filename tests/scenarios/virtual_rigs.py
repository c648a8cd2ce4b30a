"""Runs of rigs whose true error is known: errors at points of a volume from a covariance, and a scale of each rig."""

import numpy as np

POINTS, MODES, FRAMES = 8, 6, 60
DISTRIBUTIONS = ("normal", "lognormal", "skewed", "heavy")
"""Of what makes rigs differ: modes of a calibration's error, or their size from rig to rig."""


def rms_of_runs(rng, true_rms, runs=200, distribution="normal"):
    """Return the rms error (runs,) of each run; the root of the mean of their squares tends to ``true_rms``.

    A run is one rig: an error of its calibration, of MODES modes with a covariance over POINTS points that is drawn
    for each call, common to its frames, and noise that is not. The calibration's share of the variance is from 0.3
    to 0.9.
    """
    shape = rng.standard_normal((3 * POINTS, MODES)) * rng.uniform(0.3, 1.0, MODES)
    shape /= np.sqrt((shape**2).sum() / POINTS)
    share = rng.uniform(0.3, 0.9)
    errors = amplitudes(rng, runs, distribution) @ shape.T
    noise = rng.chisquare(3 * FRAMES, (runs, POINTS)) / (3 * FRAMES)
    squares = share * (errors**2).sum(axis=1) / POINTS + (1 - share) * noise.mean(axis=1)
    return true_rms * np.sqrt(squares)


def amplitudes(rng, runs, distribution):
    """Return the modes' amplitudes (runs, MODES), of variance 1."""
    normal = rng.standard_normal((runs, MODES))
    if distribution == "lognormal":  # one rig is worse than the other: sizes spread by a factor of 1.35
        size = np.exp(0.3 * rng.standard_normal((runs, 1)) - 0.3**2)
        return size * normal
    if distribution == "skewed":
        return (rng.chisquare(2, (runs, MODES)) - 2) / 2
    if distribution == "heavy":
        return rng.standard_t(5, (runs, MODES)) / np.sqrt(5 / 3)
    return normal
