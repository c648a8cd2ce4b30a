"""How often verdicts of claims are false, on virtual rigs of known truth, beside other ways to decide.

    python -m tests.studies.claims [--rigs 1000] [--truth uniform|limit]

Each rig kind has a true rms error (uniform in 0.5 to 1.5 of the limit, or the limit itself) and up to 200 runs, whose
errors come from a covariance (tests/scenarios/virtual_rigs.py). Rows: what decides; columns: verdicts, coverage of
the interval that is reported at the end, runs that were made.
"""

import argparse
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import stats

from scenarios.studies.campaign.statistics import boundaries
from scenarios.studies.campaign.statistics.boundaries import Looks, default_looks
from scenarios.studies.campaign.statistics.judge import judge
from scenarios.studies.campaign.statistics.means import Moments
from scenarios.studies.campaign.statistics.questions import Question

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scenarios"))
from virtual_rigs import DISTRIBUTIONS, rms_of_runs

LOOKS = Looks(default_looks(200), 0.05)
Decision = tuple[str, float, float, int]
"""Verdict, ends of the interval, runs."""


def sequential(values: np.ndarray) -> Decision:
    """Decide as claims do."""
    found = judge(Question("rms", 1.0), list(values), LOOKS)
    return found.verdict, found.low or 0.0, np.inf if found.high is None else found.high, found.runs


def with_quantile(values: np.ndarray) -> Decision:
    """Decide whether the 0.8 quantile keeps the limit; the interval is of the share of runs that keep it."""
    found = judge(Question("quantile", 1.0, quantile=0.8), list(values), LOOKS)
    return found.verdict, found.low or 0.0, 1.0 if found.high is None else found.high, found.runs


def students(edges: tuple[float, ...] | None, power: float = 3.0) -> Callable[[np.ndarray], Decision]:
    """Return a decision by Student's statistic, not freed of skewness, at ``edges`` or the sequential boundaries."""
    limits = edges or boundaries.normal_boundaries(LOOKS, power)

    def decide(values: np.ndarray) -> Decision:
        for n, edge in zip(LOOKS.at, limits, strict=True):
            m = Moments.of(values[:n] ** 2)
            z = stats.norm.isf(stats.t.sf(abs(m.mean - 1) / m.sigma, n - 1)) * np.sign(m.mean - 1)
            if abs(z) > edge:
                break
        verdict = "undecided" if abs(z) <= edge else ("conforming" if z < 0 else "not conforming")
        low, high = (m.mean + sign * 1.96 * m.sigma for sign in (-1, 1))
        return verdict, max(low, 0.0) ** 0.5, high**0.5, n

    return decide


def confidence_sequence(values: np.ndarray) -> Decision:
    """Decide after each run by an asymptotic confidence sequence (Waudby-Smith and others 2024, Ann. Stat. 52).

    Its boundary is a normal mixture, tuned to be narrowest at 100 runs.
    """
    n = np.arange(1, len(values) + 1)
    squares = values**2
    mean = squares.cumsum() / n
    deviation = np.sqrt(np.maximum((squares**2).cumsum() / n - mean**2, 1e-12))
    rho2 = (2 * np.log(1 / 0.05) + np.log(1 + 2 * np.log(1 / 0.05))) / 100
    half = deviation * np.sqrt(2 * (n * rho2 + 1) / (n**2 * rho2) * np.log(np.sqrt(n * rho2 + 1) / 0.05))
    decided = np.flatnonzero(np.abs(mean - 1)[39:] > half[39:])
    k = decided[0] + 39 if len(decided) else len(values) - 1
    verdict = "undecided" if not len(decided) else ("conforming" if mean[k] < 1 else "not conforming")
    return verdict, max(mean[k] - half[k], 0.0) ** 0.5, (mean[k] + half[k]) ** 0.5, int(n[k])


RULES: dict[str, Callable[[np.ndarray], Decision]] = {
    "claims": sequential,
    "without skewness, power 1": students(None, 1.0),
    "without skewness, power 3": students(None, 3.0),
    "confidence sequence": confidence_sequence,
    "control: 1.96 at each look": students((1.96,) * len(LOOKS.at)),
}


@dataclass(frozen=True)
class Measured:
    """Shares of campaigns, and the mean number of runs."""

    accept: float
    """Found conforming, and are not (or are at the limit)."""
    reject: float
    """Found not conforming, and are (or are at the limit)."""
    undecided: float
    covered: float
    runs: float

    def row(self, name: str, distribution: str) -> str:
        """Return a line of the table."""
        shares = " | ".join(f"{100 * one:.1f} %" for one in (self.accept, self.reject, self.undecided, self.covered))
        return f"| {name} | {distribution} | {shares} | {self.runs:.0f} |"


def measured(rule: Callable[[np.ndarray], Decision], distribution: str, rigs: int, truth: str, seed: int) -> Measured:
    """Return what a rule does on so many kinds of rigs."""
    rng = np.random.default_rng(seed)
    accept = reject = undecided = covered = runs = 0
    for _ in range(rigs):
        true = 1.0 if truth == "limit" else rng.uniform(0.5, 1.5)
        verdict, low, high, made = rule(rms_of_runs(rng, true, 200, distribution))
        accept += verdict == "conforming" and true >= 1
        reject += verdict == "not conforming" and true <= 1
        undecided += verdict == "undecided"
        covered += low <= true <= high
        runs += made
    return Measured(*(count / rigs for count in (accept, reject, undecided, covered, runs)))


def of_quantiles(rigs: int, seed: int) -> Measured:
    """Return what a quantile claim does: the share of runs that keep the limit is uniform in 0.6 to 1."""
    rng = np.random.default_rng(seed)
    accept = reject = undecided = covered = runs = 0
    for _ in range(rigs):
        share = rng.uniform(0.6, 1.0)
        verdict, low, high, made = with_quantile(np.where(rng.random(200) < share, 0.5, 1.5))
        accept += verdict == "conforming" and share < 0.8
        reject += verdict == "not conforming" and share >= 0.8
        undecided += verdict == "undecided"
        covered += low <= share <= high
        runs += made
    return Measured(*(count / rigs for count in (accept, reject, undecided, covered, runs)))


def main() -> None:
    """Print the table."""
    given = argparse.ArgumentParser(description=__doc__)
    given.add_argument("--rigs", type=int, default=1000)
    given.add_argument("--truth", choices=["uniform", "limit"], default="uniform")
    given.add_argument("--seed", type=int, default=1)
    options = given.parse_args()
    print("| decides | distribution | false accept | false reject | undecided | covered | runs |")
    print("|---|---|---|---|---|---|---|")
    for name, rule in RULES.items():
        for distribution in DISTRIBUTIONS:
            found = measured(rule, distribution, options.rigs, options.truth, options.seed)
            print(found.row(name, distribution), flush=True)
    if options.truth == "uniform":
        print(of_quantiles(options.rigs, options.seed).row("claims, 0.8 quantile", "any"))


if __name__ == "__main__":
    main()
