"""Sequential verdicts on shares of runs: exact binomial probabilities, no approximation and no distribution assumed.

A quantile of the runs' values keeps a limit where at least that share of the runs keeps it.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
from scipy.optimize import brentq
from scipy.stats import binom

from mosca.data.arrays import Array
from scenarios.studies.campaign.statistics.boundaries import POWER_OF_SHARES, Looks
from scenarios.studies.campaign.statistics.questions import Judgement, LookResult, Question, Verdict


@cache
def count_boundaries(looks: Looks, share: float) -> tuple[tuple[int, int], ...]:
    """Return for each look (low, high): verdicts are at ``low`` good runs or fewer and ``high`` or more.

    They are the closest counts whose probability, if exactly ``share`` of all runs are good, is within the error rate
    spent. -1 and n + 1 where no count has a verdict.
    """
    found: list[tuple[int, int]] = []
    inside = _Counts(share)
    spent = [0.0, 0.0]
    for n, allowed in zip(looks.at, looks.spent(POWER_OF_SHARES), strict=True):
        masses = inside.after(n)
        above, below = np.cumsum(masses[::-1])[::-1], np.cumsum(masses)
        high = int(np.argmax(np.append(above, 0.0) <= allowed - spent[1]))
        low = int(np.searchsorted(below, allowed - spent[0], side="right")) - 1
        spent[1] += float(above[high]) if high <= n else 0.0
        spent[0] += float(below[low]) if low >= 0 else 0.0
        inside.keep(low, high)
        found.append((low, high))
    return tuple(found)


class _Counts:
    """Distribution of the number of good runs between boundaries, if a ``share`` of all runs is good."""

    def __init__(self, share: float) -> None:
        self._share = share
        self._n = 0
        self._masses: Array = np.ones(1)

    def after(self, n: int) -> Array:
        """Return the probability (n + 1,) of each count after ``n`` runs."""
        more = n - self._n
        self._masses = np.convolve(self._masses, binom.pmf(np.arange(more + 1), more, self._share))
        self._n = n
        return self._masses

    def keep(self, low: int, high: int) -> None:
        """Drop counts of ``low`` and below, and of ``high`` and above."""
        self._masses = self._masses.copy()
        self._masses[: low + 1] = 0.0
        self._masses[high:] = 0.0


def tail(share: float, looks: Looks, edges: Sequence[tuple[int, int]], good: int, above: bool) -> float:
    """Return the probability of ``good`` runs at the look after ``edges``, or of results beyond in the ordering.

    With ``above``, beyond are more good runs at this look, or a crossing of the upper boundary at an earlier look;
    else the mirror image. ``share``: share of all runs that are good.
    """
    inside = _Counts(share)
    crossed = 0.0
    for n, (low, high) in zip(looks.at, edges, strict=False):
        masses = inside.after(n)
        crossed += float(masses[high:].sum() if above else masses[: low + 1].sum())
        inside.keep(low, high)
    masses = inside.after(looks.at[len(edges)])
    return crossed + float(masses[good:].sum() if above else masses[: good + 1].sum())


def judge_share(question: Question, values: Sequence[float | None], looks: Looks) -> Judgement:
    """Return the verdict on the share of runs that keep the limit, so far; a failed run (None) does not.

    Looks are taken in order until there is a verdict; values beyond that look are not used.
    """
    wanted = question.quantile
    edges = count_boundaries(looks, wanted)
    found = Judgement("undecided", False, 0, 0, None, None, None, wanted, None, ())
    for k, runs in enumerate(looks.at):
        if runs > len(values):
            break
        good = sum(map(question.keeps, values[:runs]))
        low, high = edges[k]
        verdict: Verdict = "undecided"
        if good >= high:
            verdict = "conforming"
        elif good <= low:
            verdict = "not conforming"
        look = LookResult(runs, good / runs, None if high > runs else high / runs, None if low < 0 else low / runs)
        found = Judgement(
            verdict, verdict != "undecided" or runs == looks.at[-1], runs,
            sum(value is None for value in values[:runs]), float(good / runs), None, None, wanted,
            None if look.conforming is None else look.conforming - wanted, (*found.looks, look),
        )  # fmt: skip
        if verdict != "undecided":
            break
    if not found.runs:
        return found
    k = looks.at.index(found.runs)
    ends = share_interval(looks, edges[:k], sum(map(question.keeps, values[: found.runs])))
    return replace(found, low=ends[0], high=ends[1])


def share_interval(looks: Looks, edges: Sequence[tuple[int, int]], good: int) -> tuple[float, float]:
    """Return the exact interval of the share, at 1 minus the error rate, in the stagewise ordering.

    At the first look it is the interval of Clopper and Pearson (1934, Biometrika 26:404), at later looks that of
    Jennison and Turnbull (1983, Technometrics 25:49).
    """
    half = 0.5 * looks.error
    low = _root(lambda p: tail(p, looks, edges, good, True) - half)
    high = _root(lambda p: half - tail(p, looks, edges, good, False))
    return low, high


def _root(rising: Callable[[float], float]) -> float:
    """Return the root of a rising function of a share; an end where there is none."""
    if rising(0.0) >= 0:
        return 0.0
    if rising(1.0) <= 0:
        return 1.0
    return float(brentq(rising, 0.0, 1.0, xtol=1e-10))
