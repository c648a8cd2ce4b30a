"""Covariance of the sum of a series whose terms are not independent of their neighbours."""

import numpy as np

from mosca.data.arrays import Array

MOST_PERSISTENT = 0.99
"""Largest autocorrelation of neighbours that is used: nothing can be estimated from a series whose correlation has no
end."""


def long_run_covariance(terms: Array) -> Array:
    """Return the covariance (c, c) of the sum of ``terms`` (n, c), a series with mean zero.

    The estimate is heteroscedasticity and autocorrelation consistent (Newey and West 1987, Econometrica 55, 703),
    with Bartlett's weights. The lag up to which neighbours count follows from the autocorrelation of the series
    (Andrews 1991, Econometrica 59, 817, eq. 6.2 with an AR(1)). For independent terms it is White's (1980), the sum
    of their squares.
    """
    n = len(terms)
    scale = np.sqrt(np.mean(terms**2, axis=0))
    unit = terms / np.where(scale > 0, scale, 1.0)
    rho = float(np.clip(np.sum(unit[1:] * unit[:-1]) / max(float(np.sum(unit**2)), 1e-300), 0.0, MOST_PERSISTENT))
    reach = int(1.1447 * (4 * rho**2 / (1 - rho**2) ** 2 * n) ** (1 / 3))
    total = terms.T @ terms
    for lag in range(1, min(reach, n - 1) + 1):
        along = terms[lag:].T @ terms[:-lag]
        total += (1 - lag / (reach + 1)) * (along + along.T)
    return np.asarray(total)
