"""The whole of the study of claims: 1,000 kinds of rigs, verdicts and intervals as stated."""

import pytest

from tests.studies.claims import measured, sequential, students


@pytest.mark.slow
def test_verdicts_on_a_thousand_kinds_of_rigs():
    found = measured(sequential, "normal", 1000, "uniform", 1)
    assert found.accept <= 0.05
    assert found.reject <= 0.05
    assert found.undecided <= 0.15
    assert 0.93 <= found.covered <= 0.97


@pytest.mark.slow
def test_at_the_limit_and_the_control_that_must_fail():
    found = measured(sequential, "normal", 1000, "limit", 1)
    # 5 % and two standard deviations of 1,000 trials
    assert found.accept + found.reject <= 0.064
    control = measured(students((1.96,) * 5), "normal", 1000, "limit", 1)
    assert control.accept + control.reject > 0.08


def test_a_row_says_what_was_counted():
    found = measured(lambda values: ("conforming", 0.0, 2.0, 40), "normal", 10, "uniform", 1)
    assert (found.reject, found.undecided, found.covered, found.runs) == (0.0, 0.0, 1.0, 40.0)
    assert 0 < found.accept < 1
