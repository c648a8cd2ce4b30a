"""Verdicts on rigs whose truth is known, boundaries computed in another way, and controls that must fail."""

from itertools import product

import numpy as np
import pytest
from scipy import stats
from virtual_rigs import rms_of_runs

from scenarios.studies.campaign.statistics import means, shares
from scenarios.studies.campaign.statistics.boundaries import Looks, default_looks, normal_boundaries, upper_tail
from scenarios.studies.campaign.statistics.judge import judge
from scenarios.studies.campaign.statistics.questions import Question

LOOKS = Looks(default_looks(200), 0.05)
RMS = Question("rms", 1.0)


def walk_covariance(times):
    return np.minimum.outer(times, times) / np.sqrt(np.outer(times, times))


def test_looks_are_fixed_beforehand():
    looks = default_looks(200)
    assert (looks[0], looks[-1]) == (40, 200)
    ratios = np.divide(looks[1:], looks[:-1])
    assert np.all((ratios > 1.4) & (ratios < 1.6))
    assert default_looks(12) == (12,)


def test_boundaries_spend_the_error_rate_and_no_more():
    looks = Looks((40, 100, 200), 0.05)
    edges = normal_boundaries(looks)
    # a rectangle's probability by Genz's integration: none of the looks crosses either boundary
    inside = stats.multivariate_normal(np.zeros(3), walk_covariance(np.array(looks.shares)))
    crossed = 1 - inside.cdf(np.array(edges), lower_limit=-np.array(edges))
    assert crossed == pytest.approx(0.05, abs=2e-4)
    assert 2 * stats.norm.sf(edges[0]) == pytest.approx(0.05 * 0.2**3, rel=1e-6)


def test_a_tail_in_the_stagewise_ordering_is_an_integral_over_paths():
    times, low, high, z = (0.2, 0.5, 1.0), (-3.0, -2.4), (2.6, 2.2), 1.1
    # its integrals are by random points, as many as it takes
    exact = {"seed": 1, "maxpts": 10_000_000, "abseps": 1e-7, "releps": 1e-7}
    paths = stats.multivariate_normal(np.zeros(3), walk_covariance(np.array(times)), **exact)
    two = stats.multivariate_normal(np.zeros(2), walk_covariance(np.array(times[:2])), **exact)
    first = stats.norm.sf(2.6)
    second = two.cdf([2.6, 9.0], lower_limit=[-3.0, 2.2])
    last = paths.cdf([2.6, 2.2, 9.0], lower_limit=[-3.0, -2.4, 1.1])
    assert upper_tail(times, low, high, z) == pytest.approx(first + second + last, abs=1e-5)


def test_counts_are_those_of_all_sequences():
    looks = Looks((4, 8), 0.2)
    edges = shares.count_boundaries(looks, 0.5)
    found = [0.0, 0.0]
    for sequence in product((0, 1), repeat=8):
        for n, (low, high) in zip(looks.at, edges, strict=True):
            good = sum(sequence[:n])
            if good >= high or good <= low:
                found[good >= high] += 0.5**8
                break
    assert max(found) <= 0.1
    # the next count in either direction would spend too much
    (_, (low, high)) = edges
    wider = [sum(sum(s) >= high - 1 for s in product((0, 1), repeat=8)) / 256, 0]
    assert wider[0] > 0.1
    assert low == 8 - high


def test_one_look_is_clopper_and_pearson():
    looks = Looks((40,), 0.05)
    for good in (0, 20, 38, 40):
        wanted = stats.binomtest(good, 40).proportion_ci(0.95, "exact")
        assert shares.share_interval(looks, (), good) == pytest.approx((wanted.low, wanted.high), abs=1e-6)


def test_one_look_at_values_without_skewness_is_students_interval():
    values = np.array([-2.0, -1.0, -0.5, 0.0, 0.5, 1.0, 2.0]) + 5
    found = judge(Question("mean", 4.0), list(values), Looks((7,), 0.05))
    wanted = stats.t.interval(0.95, 6, loc=5.0, scale=stats.sem(values))
    assert (found.low, found.high) == pytest.approx(wanted, rel=1e-4)
    assert found.verdict == ("not conforming" if wanted[0] > 4 else "undecided")


@pytest.mark.parametrize("distribution", ["normal", "lognormal"])
def test_verdicts_and_intervals_on_virtual_rigs(distribution):
    rng = np.random.default_rng(20)
    truths = rng.uniform(0.5, 1.5, 80)
    false = undecided = covered = 0
    for true in truths:
        found = judge(RMS, list(rms_of_runs(rng, true, 200, distribution)), LOOKS)
        false += found.verdict == ("conforming" if true > 1 else "not conforming")
        undecided += found.verdict == "undecided"
        covered += found.low <= true <= found.high
        # a verdict and its interval say the same
        assert (found.verdict == "undecided") == (found.low <= 1 <= found.high)
    assert false <= 0.05 * 80
    assert undecided <= 0.15 * 80
    # 95 % less 2.9 standard deviations of 80 trials; the night's study has 1,000
    assert covered >= 0.88 * 80


def test_at_the_limit_itself_verdicts_are_false_as_seldom_as_stated():
    rng = np.random.default_rng(21)
    trials = 100
    found = [judge(RMS, list(rms_of_runs(rng, 1.0)), LOOKS).verdict for _ in range(trials)]
    decided = trials - found.count("undecided")
    assert decided <= stats.binom.ppf(0.999, trials, 0.05)


def test_the_control_looks_after_every_run_with_an_interval_for_one_look():
    """What the boundaries are there for: the same looks at 1.96 standard deviations are wrong far too often."""
    rng = np.random.default_rng(22)
    trials, n = 400, np.arange(1, 201)
    squares = np.array([rms_of_runs(rng, 1.0) ** 2 for _ in range(trials)])
    mean = squares.cumsum(axis=1) / n
    deviation = np.sqrt((squares**2).cumsum(axis=1) / n - mean**2)
    z = ((mean - 1) / np.maximum(deviation, 1e-9) * np.sqrt(n))[:, 39:]
    assert np.mean(np.abs(z).max(axis=1) > stats.norm.isf(0.025)) > 0.2


def test_a_planted_bug_is_seen(monkeypatch):
    """Boundaries of half their height break the error rate that the test above holds."""
    rng = np.random.default_rng(21)
    monkeypatch.setattr(means, "normal_boundaries", lambda looks: tuple(z / 2 for z in normal_boundaries(looks)))
    found = [judge(RMS, list(rms_of_runs(rng, 1.0)), LOOKS).verdict for _ in range(40)]
    assert 40 - found.count("undecided") > stats.binom.ppf(0.999, 40, 0.05)


def test_shares_are_judged_exactly():
    question = Question("quantile", 1.0, quantile=0.9)
    assert judge(question, [0.5] * 200, LOOKS).verdict == "conforming"
    assert judge(question, [0.5, 2.0] * 100, LOOKS).verdict == "not conforming"
    # a run that failed keeps no limit
    failing = judge(question, [0.5, None] * 100, LOOKS)
    assert (failing.verdict, failing.failed) == ("not conforming", failing.runs // 2)
    least = Question("quantile", 0.99, upper=False, quantile=0.9)
    assert judge(least, [1.0] * 200, LOOKS).verdict == "conforming"
    rng = np.random.default_rng(5)
    covered = 0
    for share in rng.uniform(0.8, 1.0, 40):
        found = judge(question, list(2.0 * (rng.random(200) > share)), LOOKS)
        covered += found.low <= share <= found.high
        assert (found.verdict == "undecided") == (found.low <= 0.9 <= found.high)
    assert covered >= 36


def test_runs_that_fail_count_against_a_mean():
    rng = np.random.default_rng(3)
    good = list(rng.normal(0.5, 0.05, 200))
    assert judge(Question("mean", 1.0), good, LOOKS).verdict == "conforming"
    found = judge(Question("mean", 1.0), [None, *good[1:]], LOOKS)
    assert (found.verdict, found.failed) == ("not conforming", 1)
    assert "1 of 40 runs failed" in found.note
    some = Question("mean", 1.0, failed_share=0.1)
    assert judge(some, [None, *good[1:]], LOOKS).verdict == "conforming"
    many = judge(some, [None if k % 5 == 0 else one for k, one in enumerate(good)], LOOKS)
    assert many.verdict == "not conforming"


def test_values_that_are_all_the_same_decide_no_mean():
    found = judge(Question("mean", 1.0), [0.5] * 200, LOOKS)
    assert (found.verdict, found.low, found.done) == ("undecided", None, True)
    assert "same value" in found.note


def test_the_guard_band_is_where_verdicts_begin():
    rng = np.random.default_rng(8)
    values = rms_of_runs(rng, 0.9)
    found = judge(RMS, list(values), LOOKS)
    last = found.looks[-1]
    assert found.guard_band == pytest.approx(1 - last.conforming)
    # the same values a little smaller or larger than needed
    scale = last.conforming / last.estimate
    one = Looks((found.runs,), 0.05)
    edge = judge(RMS, list(values[: found.runs]), one).looks[-1].conforming
    assert edge < 1
    assert (scale > 1) == (found.verdict == "conforming")
