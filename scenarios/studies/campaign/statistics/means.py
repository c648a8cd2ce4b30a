"""Sequential verdicts on means: Student's statistic, corrected for skewness, against group-sequential boundaries.

Errors are skewed: the mean and the deviation of few values are then correlated, and Student's interval misses large
means too often. Hall's transformation (1992, J. R. Stat. Soc. B 54:221) removes the skewness by a monotone cubic.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import brentq
from scipy.special import ndtr, ndtri, stdtr, stdtrit
from scipy.stats import skew

from mosca.data.arrays import Array
from scenarios.studies.campaign.statistics.boundaries import FAR, Looks, normal_boundaries, upper_tail
from scenarios.studies.campaign.statistics.questions import Judgement, LookResult, Question, Verdict

SMALL = 1e-9
"""Skewness below which the cubic is taken as a straight line."""
FARTHEST = 1e4
"""Standard deviations of a mean within which the ends of its interval are searched."""
NEAR_SAME = 1e-12
"""Deviation over mean below which values count as equal: their last digits differ by rounding."""


@dataclass(frozen=True)
class Moments:
    """Moments of the values at one look."""

    n: int
    mean: float
    deviation: float
    skewness: float

    @classmethod
    def of(cls, values: Array, positive: bool = False) -> "Moments":
        """Return the moments of ``values`` (n,); deviation and skewness with their small-sample corrections.

        The skewness of few values is too small, since the rare large value is not among them. ``positive``: the
        values cannot be below 0, like squares; then the skewness is at least that of a lognormal distribution of the
        same relative deviation v, 3 v + v^3 (a chi-square distribution has 2 v).
        """
        n = len(values)
        if n < 3:
            return cls(n, float(np.mean(values)) if n else np.nan, 0.0, 0.0)
        mean, deviation = float(np.mean(values)), float(np.std(values, ddof=1))
        if deviation <= NEAR_SAME * abs(mean):
            return cls(n, mean, 0.0, 0.0)
        skewness = float(skew(values, bias=False))
        if positive:
            relative = deviation / mean
            skewness = max(skewness, 3 * relative + relative**3)
        return cls(n, mean, deviation, skewness)

    @property
    def sigma(self) -> float:
        """Standard deviation of the mean."""
        return self.deviation / float(np.sqrt(self.n))

    def z(self, value: float) -> float:
        """Return the distance of the mean above ``value`` as a standard normal deviate."""
        return self.z_of((self.mean - value) / self.sigma)

    def z_of(self, student: float) -> float:
        """Return the normal deviate for Student's statistic: skewness removed, then the one of the same tail."""
        u = self._bend()
        free = ((1 + u * student) ** 3 - 1) / (3 * u) + self.skewness / (6 * np.sqrt(self.n))
        z = float(np.sign(free) * -ndtri(stdtr(self.n - 1, -abs(free))))
        return min(max(z, -FAR), FAR)

    def student_of(self, z: float) -> float:
        """Return the Student's statistic whose normal deviate is ``z``."""
        free = float(np.sign(z) * -stdtrit(self.n - 1, ndtr(-abs(z))))
        u = self._bend()
        cube = 1 + 3 * u * (free - self.skewness / (6 * np.sqrt(self.n)))
        return float((np.cbrt(cube) - 1) / u)

    def _bend(self) -> float:
        u = self.skewness / (3 * float(np.sqrt(self.n)))
        return u if abs(u) > SMALL else SMALL


def judge_mean(question: Question, values: Sequence[float | None], looks: Looks) -> Judgement:
    """Return the verdict on the mean, or the root mean square, of the values so far; None: a failed run.

    A failed run has no value for the mean. Where more than ``failed_share`` of the largest number of runs failed, the
    claim is not kept. While more than this share of the runs so far failed, there is no verdict that the claim is
    kept. Looks are taken in order until there is a verdict; values beyond that look are not used.
    """
    limit = question.limit**2 if question.statistic == "rms" else question.limit
    edges = normal_boundaries(looks)
    found = Judgement("undecided", False, 0, 0, None, None, None, question.limit, None, ())
    for k, runs in enumerate(looks.at):
        if runs > len(values):
            break
        moments, failed = _moments(question, values[:runs])
        found = replace(found, runs=runs, failed=failed, done=runs == looks.at[-1])
        found = _with_failures(_at_look(question, limit, moments, edges[k], found), question, looks)
        if found.done:
            break
    taken = [_moments(question, values[: look.runs])[0] for look in found.looks]
    return _with_interval(found, question, limit, taken, looks)


def _moments(question: Question, values: Sequence[float | None]) -> tuple[Moments, int]:
    """Return the moments of the values, or of their squares, and the number of failed runs."""
    known = np.array([value for value in values if value is not None], float)
    moments = Moments.of(known**2, positive=True) if question.statistic == "rms" else Moments.of(known)
    return moments, len(values) - len(known)


def _shown(question: Question, x: float) -> float | None:
    """Return a mean in the unit of the limit; None for a mean square below 0."""
    if question.statistic != "rms":
        return float(x)
    return float(np.sqrt(x)) if x >= 0 else None


def _at_look(question: Question, limit: float, m: Moments, edge: float, before: Judgement) -> Judgement:
    """Return the judgement at the next look, whose boundary is ``edge`` [z], without the interval."""
    if not m.deviation > 0:
        same = "fewer than 3 runs gave a value" if m.n < 3 else f"all {m.n} runs gave the same value"
        estimate = None if m.n == 0 else _shown(question, m.mean)
        note = f"{same}: nothing is known of the spread; claim a quantile, or vary something"
        look = LookResult(before.runs, estimate, None, None)
        return replace(before, estimate=estimate, guard_band=None, looks=(*before.looks, look), note=note)
    # estimates at which there would be a verdict
    below, above = (_shown(question, limit + m.student_of(one) * m.sigma) for one in (-edge, edge))
    good, bad = (below, above) if question.upper else (above, below)
    z = m.z(limit)
    verdict: Verdict = "undecided"
    if abs(z) > edge:
        verdict = "conforming" if (z < 0) == question.upper else "not conforming"
    estimate = _shown(question, m.mean)
    return replace(
        before,
        verdict=verdict,
        done=before.done or verdict != "undecided",
        estimate=estimate,
        guard_band=None if good is None else abs(question.limit - good),
        looks=(*before.looks, LookResult(before.runs, estimate, good, bad)),
        note="",
    )


def _with_failures(found: Judgement, question: Question, looks: Looks) -> Judgement:
    """Return the verdict after the failed runs are taken into account."""
    if found.failed > question.failed_share * looks.at[-1]:
        note = f"{found.failed} of {found.runs} runs failed; allowed are {question.failed_share:g} of {looks.at[-1]}"
        return replace(found, verdict="not conforming", done=True, note=note)
    if found.verdict == "conforming" and found.failed > question.failed_share * found.runs:
        note = f"{found.failed} of {found.runs} runs failed, more than the share of {question.failed_share:g}"
        return replace(found, verdict="undecided", done=found.runs == looks.at[-1], note=note)
    return found


def _with_interval(
    found: Judgement, question: Question, limit: float, taken: Sequence[Moments], looks: Looks
) -> Judgement:
    """Return the verdict with its interval, where the values have a spread."""
    if not taken or not all(one.deviation > 0 for one in taken):
        return found
    low, high = interval(taken, limit, looks)
    if question.statistic == "rms":
        low = max(low, 0.0)
    return replace(found, low=_shown(question, low), high=_shown(question, high))


def interval(taken: Sequence[Moments], limit: float, looks: Looks) -> tuple[float, float]:
    """Return the confidence interval of the mean after the looks ``taken``, at 1 minus the error rate.

    It contains the means that are not rejected in the stagewise ordering, given that no earlier look had a verdict on
    ``limit``; it excludes the limit if and only if the last look has a verdict. For a true mean other than the limit,
    the boundaries of earlier looks are shifted for its own statistic, by the deviations observed at these looks.
    """
    *earlier, m = taken
    edges = normal_boundaries(looks)
    times = looks.shares[: len(taken)]
    tail = 0.5 * looks.error
    bounds = [[then.student_of(one) for one in (-edge, edge)] for then, edge in zip(earlier, edges, strict=False)]

    def surprise(mean: float, sign: int) -> float:
        """Return the probability of the found value or more (sign 1) or less (-1) if ``mean`` is true."""
        ends = [
            sorted(sign * then.z_of(one + (limit - mean) / then.sigma) for one in both)
            for then, both in zip(earlier, bounds, strict=True)
        ]
        return upper_tail(times, [e[0] for e in ends], [e[1] for e in ends], sign * m.z(mean))

    found = []
    for sign in (1, -1):
        far, near = 3.0, 0.0
        while surprise(m.mean - sign * far * m.sigma, sign) > tail and far < FARTHEST:
            far *= 1.6
        while surprise(m.mean - sign * near * m.sigma, sign) < tail and near > -FARTHEST:
            near = near * 1.6 - 0.5
        step = brentq(lambda d, s=sign: surprise(m.mean - s * d * m.sigma, s) - tail, near, far, xtol=1e-6)
        found.append(m.mean - sign * step * m.sigma)
    return found[0], found[1]
