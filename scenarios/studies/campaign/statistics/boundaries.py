"""Boundaries of a group-sequential test, and tail probabilities in the stagewise ordering.

Looks are fixed before the first run. The error rate is spent over them by a function of the share of the runs
(Lan and DeMets 1983, Biometrika 70:659), here a power of that share (Kim and DeMets 1987, Biometrika 74:149).
Probabilities come from the recursion of Armitage, McPherson and Rowe (1969, J. R. Stat. Soc. A 132:235) over a
Brownian motion observed at the looks.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.optimize import brentq
from scipy.special import ndtr

from mosca.data.arrays import Array

POWER_OF_MEANS = 3.0
"""Power of the share of the runs in the spending function. 1 spends evenly and has more false verdicts at early
looks, where few values represent the tails of a distribution: ``tests/studies/claims.py`` measures 1, 2 and 3."""
POWER_OF_SHARES = 1.0
"""Even spending: binomial probabilities are exact at each look, and good rigs are known early."""
NODES = 64
"""Nodes of the quadrature between two boundaries: tests compare the tails with a multivariate normal integral."""
FAR = 8.0
"""Standard deviations beyond which a normal density is taken as 0 (1e-15)."""


@dataclass(frozen=True)
class Looks:
    """Looks of a campaign, and the error rate of its verdict."""

    at: tuple[int, ...]
    """Numbers of runs, ascending; the last one is the largest number that is made."""
    error: float
    """Largest probability of a false verdict, both directions together."""

    @property
    def shares(self) -> tuple[float, ...]:
        """Share of the largest number of runs at each look."""
        return tuple(n / self.at[-1] for n in self.at)

    def spent(self, power: float) -> tuple[float, ...]:
        """Return the error rate of one direction that is spent up to each look."""
        return tuple(0.5 * self.error * share**power for share in self.shares)


def default_looks(most: int, first: int = 40, ratio: float = 1.5) -> tuple[int, ...]:
    """Return numbers of runs from ``first`` to ``most``, each about ``ratio`` times the one before."""
    if most <= first:
        return (most,)
    steps = max(1, round(np.log(most / first) / np.log(ratio)))
    numbers = first * (most / first) ** (np.arange(steps + 1) / steps)
    return tuple(dict.fromkeys(int(n) for n in np.round(numbers)))


@cache
def normal_boundaries(looks: Looks, power: float = POWER_OF_MEANS) -> tuple[float, ...]:
    """Return the |z| at each look beyond which there is a verdict."""
    found: list[float] = []
    walk = Walk(looks.shares)
    before = 0.0
    for spent in looks.spent(power):
        tail = walk.next_tail()
        step = spent - before
        # beyond FAR no tail is left to spend
        edge = brentq(lambda z, t=tail, s=step: t(z) - s, 0.0, FAR) if tail(FAR) < step else FAR
        found.append(float(edge))
        walk.go_on(-edge, edge)
        before = spent
    return tuple(found)


class Walk:
    """A standard Brownian motion observed at ``times`` (k,), as long as it stays between boundaries in z."""

    def __init__(self, times: Sequence[float]) -> None:
        self._times = tuple(times)
        self._look = 0
        self._places: Array = np.zeros(1)
        self._masses: Array = np.ones(1)

    def next_tail(self) -> Callable[[float], float]:
        """Return z -> probability of being inside until the next look and above z at it."""
        time, step = self._next()
        places, masses = self._places, self._masses
        return lambda z: float(masses @ ndtr((places - z * np.sqrt(time)) / np.sqrt(step)))

    def go_on(self, low: float, high: float) -> None:
        """Advance to the next look, and keep the part between ``low`` and ``high`` [z]."""
        time, step = self._next()
        width = FAR * np.sqrt(time)
        ends = np.clip(np.array([low, high]) * np.sqrt(time), -width, width)
        unit, weights = _quadrature()
        places = ends[0] + 0.5 * (ends[1] - ends[0]) * (unit + 1)
        kernel = np.exp(-0.5 * (places[:, None] - self._places) ** 2 / step) / np.sqrt(2 * np.pi * step)
        self._masses = 0.5 * (ends[1] - ends[0]) * weights * (kernel @ self._masses)
        self._places = places
        self._look += 1

    def _next(self) -> tuple[float, float]:
        time = self._times[self._look]
        return time, time - (self._times[self._look - 1] if self._look else 0.0)


@cache
def _quadrature() -> tuple[Array, Array]:
    unit, weights = np.polynomial.legendre.leggauss(NODES)
    return unit, weights


def upper_tail(times: Sequence[float], low: Sequence[float], high: Sequence[float], z: float) -> float:
    """Return the probability of results above z at the last of ``times``, in the stagewise ordering.

    Above are all paths that crossed ``high`` (k - 1,) [z] at an earlier look, and those that stayed between ``low``
    and ``high`` until then and are beyond z (Tsiatis, Rosner and Mehta 1984, Biometrics 40:797).
    """
    walk = Walk(times)
    crossed = 0.0
    for below, above in zip(low, high, strict=True):
        crossed += walk.next_tail()(above)
        walk.go_on(below, above)
    return crossed + walk.next_tail()(z)
