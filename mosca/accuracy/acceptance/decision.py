"""Conforming, not conforming or undecided: decision rules with a guard band.

JCGM 106:2012, *The role of measurement uncertainty in conformity assessment*: the conformance probability of a
normally distributed quantity, and guarded acceptance and rejection with a guard band as wide as the expanded
uncertainty U = 2 u (its section 8.3). Between acceptance and rejection the result is undecided.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from mosca.data.distributions import norm

Decision = Literal["conforming", "not conforming", "undecided"]
COVERAGE = 2.0
"""Coverage factor k of an expanded uncertainty."""


@dataclass(frozen=True)
class Decided:
    """Decision on an error and its limit."""

    decision: Decision
    probability: float
    """Probability that the error is within its limit."""
    expanded: float
    """Expanded uncertainty U = 2 u of the error, in its unit."""


def decided(error: float, limit: float, sigma: float) -> Decided:
    """Return whether ``|error| <= limit``; ``sigma``: standard uncertainty of the error, all in one unit."""
    if sigma > 0:
        probability = float(norm.cdf((limit - error) / sigma) - norm.cdf((-limit - error) / sigma))
    else:
        probability = float(abs(error) <= limit)
    expanded = COVERAGE * sigma
    decision: Decision = "undecided"
    if abs(error) <= limit - expanded:
        decision = "conforming"
    elif abs(error) > limit + expanded:
        decision = "not conforming"
    return Decided(decision, probability, expanded)


def overall(decisions: Iterable[Decision]) -> Decision:
    """Return "not conforming" if any decision is, "conforming" if all are and there is any, else "undecided"."""
    found = set(decisions)
    if "not conforming" in found:
        return "not conforming"
    return "conforming" if found == {"conforming"} else "undecided"
