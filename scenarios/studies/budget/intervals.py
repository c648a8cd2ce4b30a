"""Intervals of a budget's figures over seeds and over blocks of the take."""

import numpy as np

from mosca.data.arrays import Array
from mosca.data.distributions import t
from scenarios.studies.budget.evaluate import Squares

BLOCKS = 10
"""Number of blocks of a take: of two seconds each is 0.2 s, in which a hidden marker becomes visible again."""
RISK = 0.05


def by_seed_and_block(runs: list[Squares]) -> Array:
    """Return mean squares (seeds, BLOCKS) of one coalition, such that the mean of a row is that seed's mean square.

    The mean square of a seed is a ratio of sums, v = sum(a) / sum(n). A block's value is v + (a - v n) / mean(n), the
    ratio's first-order share (Cochran 1977, section 6.3), so that functions linear in v are linear in the blocks.
    """
    rows = []
    for one in runs:
        cut = np.arange(len(one.sums)) * BLOCKS // max(len(one.sums), 1)
        sums, weights = (np.bincount(cut, values, BLOCKS) for values in (one.sums, one.weights))
        value = sums.sum() / max(weights.sum(), 1.0)
        rows.append(value + (sums - value * weights) / max(weights.mean(), 1e-12))
    return np.array(rows)


def interval95(values: Array, more: float = 0.0) -> tuple[float, float]:
    """Return the 95 % interval of the mean of values (seeds, blocks).

    Seeds and blocks are crossed: the variance of the mean is taken as the sum of that over seeds and that over blocks
    (on the safe side, since their common part counts twice; Owen 2007), with Satterthwaite's degrees of freedom. With
    one seed only blocks are used. ``more``: half-width of a further, independent interval.
    """
    mean = float(values.mean())
    parts = [
        (float(side.var(ddof=1)) / len(side), len(side) - 1)
        for side in (values.mean(axis=1), values.mean(axis=0))
        if len(side) > 1
    ]
    variance = sum(part for part, _ in parts)
    if variance <= 0.0:
        return mean - more, mean + more
    freedom = variance**2 / sum(part**2 / degrees for part, degrees in parts)
    half = float(np.hypot(t.ppf(1 - RISK / 2, freedom) * np.sqrt(variance), more))
    return mean - half, mean + half
