"""What is asked of a series of runs, and what is found."""

from dataclasses import dataclass
from typing import Literal

Statistic = Literal["mean", "rms", "quantile"]
Verdict = Literal["conforming", "not conforming", "undecided"]


@dataclass(frozen=True)
class Question:
    """Whether a statistic of the runs' values keeps its limit."""

    statistic: Statistic
    limit: float
    """In the values' unit."""
    upper: bool = True
    """Whether the limit is the largest value allowed; else the smallest."""
    quantile: float = 0.95
    """Of "quantile": the share of the runs that must keep the limit, each by itself."""

    failed_share: float = 0.0
    """Of a mean: the share of the runs that may fail; the mean is that of the others."""

    def keeps(self, value: float | None) -> bool:
        """Return whether one run keeps the limit; one that failed (None) does not."""
        if value is None:
            return False
        return value <= self.limit if self.upper else value >= self.limit


@dataclass(frozen=True)
class LookResult:
    """What was known at one look."""

    runs: int
    estimate: float | None
    conforming: float | None
    """Estimates on the good side of this one were conforming; None where none would have been."""
    broken: float | None
    """Estimates on the bad side of this one were not."""


@dataclass(frozen=True)
class Judgement:
    """The verdict on one question and what it rests on."""

    verdict: Verdict
    done: bool
    """Whether more runs change nothing: there is a verdict, or all looks were taken."""
    runs: int
    """At the last look taken."""
    failed: int
    """Of these, runs without a value."""
    estimate: float | None
    """Of "quantile" the share of runs that keep the limit."""
    low: float | None
    high: float | None
    """Confidence interval of what is estimated, at 1 minus the error rate; None where there is none."""
    target: float
    """What the estimate is held against: the limit, of "quantile" the wanted share."""
    guard_band: float | None
    """By how much an estimate must be better than the target to be conforming, at the last look (JCGM 106, 8.3)."""
    looks: tuple[LookResult, ...]
    note: str = ""
