"""Covariance of sums of correlated terms, against closed forms of AR(1) and moving average series."""

import numpy as np
import pytest
from scipy.signal import lfilter

from mosca.diagnostics.long_run_covariance import long_run_covariance


@pytest.mark.parametrize(("rho", "low", "high"), [(0.0, 0.93, 1.07), (0.5, 0.8, 1.1), (0.9, 0.7, 1.1)])
def test_the_sum_of_an_autoregressive_series(rho, low, high):
    # var(sum) of n terms of unit variance: n (1 + rho) / (1 - rho), for n far above 1 / (1 - rho)
    rng, n = np.random.default_rng(1), 1000
    noise = rng.normal(size=(200, 2000)) * np.sqrt(1 - rho**2)
    series = lfilter([1.0], [1.0, -rho], noise)[:, -n:]
    stated = np.mean([long_run_covariance(one[:, None])[0, 0] for one in series])
    assert low < stated / (n * (1 + rho) / (1 - rho)) < high


def test_independent_terms_have_whites_covariance_almost():
    rng = np.random.default_rng(2)
    terms = rng.normal(size=(500, 3)) @ np.array([[1.0, 0.5, 0.0], [0.0, 1.0, 0.2], [0.0, 0.0, 2.0]])
    np.testing.assert_allclose(long_run_covariance(terms), terms.T @ terms, rtol=0.25, atol=120)


def test_alternating_terms_are_not_taken_for_certain():
    # their sum is almost zero; how far that would go on is not known, so White's covariance stays
    terms = np.resize([1.0, -1.0], 100)[:, None]
    assert long_run_covariance(terms)[0, 0] == pytest.approx(100)


def test_few_and_silent_terms():
    assert long_run_covariance(np.zeros((1, 2))).tolist() == [[0.0, 0.0], [0.0, 0.0]]
    one = long_run_covariance(np.ones((3, 1)))
    assert 3 <= one[0, 0] <= 9
