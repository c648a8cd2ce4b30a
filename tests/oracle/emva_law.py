"""The exact law of a sensor's counts by scipy, written from the definition, and the chi-square test on it."""

import numpy as np
from scipy.optimize import brentq
from scipy.stats import chisquare, norm, poisson

from twin.cameras.sensor.sensor import Sensor
from witness.emva import Array


def law(sensor: Sensor, mean_e: float) -> tuple[Array, int]:
    """Return the exact law of counts: Poisson electrons, Gaussian noise, response, rounding, limits; its first count.

    P(count = c) = sum_n Poisson(n; mean) [Phi(upper edge) - Phi(lower edge)], the edges in electrons found by
    bisection on the response. A mean below 0 is an offset: no electrons.
    """
    n = np.arange(poisson.ppf(1e-14, max(mean_e, 0.0)), poisson.isf(1e-14, max(mean_e, 0.0)) + 1)
    weights = poisson.pmf(n, max(mean_e, 0.0))
    n = n + min(mean_e, 0.0)
    top = 2**sensor.bits - 1
    black = sensor.black_dn * 2 ** (sensor.bits - 8)
    gain = (top - black) / sensor.full_well_e

    def count(e: float) -> float:
        return black + gain * (e - max(e, 0.0) ** 2 * sensor.linearity / sensor.full_well_e)

    sigma = sensor.read_noise_e
    first = max(0, int(count(n.min() - 9 * sigma)) - 1)
    last = min(top, int(count(n.max() + 9 * sigma)) + 2)
    far = 2.4 * sensor.full_well_e
    inner = [brentq(lambda e, c=c: count(e) - c - 0.5, -far, far, xtol=1e-11) for c in range(first, last)]
    edges = np.array([-np.inf, *inner, np.inf])
    below = norm.cdf((edges[:, None] - n) / sigma) @ weights
    return np.diff(below), first


def chi_square_p(counts: Array, pmf: Array, first: int) -> float:
    """Return the p-value of observed counts against probabilities of first, first + 1, ...; tails pooled."""
    seen = np.bincount((counts - first).astype(int).ravel(), minlength=len(pmf)).astype(float)
    assert len(seen) == len(pmf), "a count outside the law's support"
    expected = pmf * counts.size
    often = np.flatnonzero(expected >= 10)
    below, above = slice(0, often[0]), slice(often[-1] + 1, None)
    observed = np.array([seen[below].sum(), *seen[often], seen[above].sum()])
    wanted = np.array([expected[below].sum(), *expected[often], expected[above].sum()])
    observed, wanted = observed[wanted > 0.5], wanted[wanted > 0.5]
    return float(chisquare(observed, wanted * observed.sum() / wanted.sum()).pvalue)
