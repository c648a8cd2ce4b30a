"""Questions on a series of runs, and the judgements on them."""

from dataclasses import dataclass
from typing import Literal

Statistic = Literal["mean", "rms", "quantile"]
Verdict = Literal["conforming", "not conforming", "undecided"]


@dataclass(frozen=True)
class Question:
    """Whether a statistic of the runs' values keeps its limit."""

    statistic: Statistic
    limit: float
    """Limit in the values' unit."""
    upper: bool = True
    """Whether the limit is the largest value allowed; else the smallest."""
    quantile: float = 0.95
    """For "quantile": share of the runs that must keep the limit, each by itself."""

    failed_share: float = 0.0
    """For a mean: share of the runs that may fail; the mean is that of the others."""

    def keeps(self, value: float | None) -> bool:
        """Return whether one run keeps the limit; a failed run (None) does not."""
        if value is None:
            return False
        return value <= self.limit if self.upper else value >= self.limit


@dataclass(frozen=True)
class LookResult:
    """Result at one look."""

    runs: int
    estimate: float | None
    conforming: float | None
    """Estimates on the good side of this value are conforming; None where none would be."""
    broken: float | None
    """Estimates on the bad side of this value are not conforming."""


@dataclass(frozen=True)
class Judgement:
    """The verdict on one question, with the data for it."""

    verdict: Verdict
    done: bool
    """Whether more runs change nothing: there is a verdict, or all looks were taken."""
    runs: int
    """Number of runs at the last look taken."""
    failed: int
    """Number of these runs without a value."""
    estimate: float | None
    """The estimate; for "quantile" the share of runs that keep the limit."""
    low: float | None
    high: float | None
    """Confidence interval (``low``, ``high``) of the estimated value, at 1 minus the error rate; None where none."""
    target: float
    """Value with which the estimate is compared: the limit, for "quantile" the required share."""
    guard_band: float | None
    """Margin by which an estimate must beat the target to be conforming, at the last look (JCGM 106, 8.3)."""
    looks: tuple[LookResult, ...]
    note: str = ""
