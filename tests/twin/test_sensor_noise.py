"""The random numbers of pixels against scipy: exact inversions, number by number."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numba import njit
from scipy.special import gammainc, gammaincc, ndtri
from scipy.stats import poisson as scipy_poisson

from twin.cameras.sensor import counter_rng as noise

BITS = np.random.default_rng(4).integers(0, 2**64, 200_000, dtype=np.uint64)
U = ((BITS >> np.uint64(12)).astype(float) + 0.5) / 2.0**52


@njit
def normals(bits, out):
    for i in range(bits.size):
        out[i] = noise.normal(bits[i])


@njit
def poissons(mu, bits, out):
    for i in range(bits.size):
        out[i] = noise.poisson(mu, bits[i])


def test_mix_is_splitmix64():
    # the published generator's first numbers for the seed 1234567 (Vigna's splitmix64.c)
    state, numbers = 1234567, []
    for _ in range(3):
        state = (state + int(noise.STEP)) % 2**64
        numbers.append(int(np.uint64(noise.mix(np.uint64(state)))))
    assert numbers == [6457827717110365317, 3203168211198807973, 9817491932198370423]


def test_normal_is_the_inverse_of_the_normal_law():
    edges = np.array([0, 2**12, 2**30, 2**63, 2**64 - 1, 2**64 - 2**30], dtype=np.uint64)
    bits = np.concatenate([edges, BITS])
    u = ((bits >> np.uint64(12)).astype(float) + 0.5) / 2.0**52
    got = np.empty(bits.size)
    normals(bits, got)
    np.testing.assert_allclose(got, np.where(u < 0.5, ndtri(u), -ndtri(1 - u)), rtol=1e-13, atol=1e-15)


@pytest.mark.parametrize("mu", [0.0, 0.3, 5.0, 9.99, 10.0, 10.5, 12.0, 20.0, 50.0, 210.0, 1_000.0, 15_000.0, 1e5])
def test_poisson_is_the_inverse_of_the_poisson_law(mu):
    # the number n with P(N < n) <= u < P(N <= n), for each of 200,000 u; none is off
    got = np.empty(BITS.size)
    poissons(mu, BITS, got)
    assert (scipy_poisson.cdf(got, mu) >= U).all()
    assert (scipy_poisson.cdf(got - 1, mu) <= U).all()


def test_poisson_in_the_far_tails():
    ends = np.array([0, 2**12, 2**20, 2**30, 2**64 - 2**20, 2**64 - 2**30], dtype=np.uint64)
    u = ((ends >> np.uint64(12)).astype(float) + 0.5) / 2.0**52
    for mu in (10.0, 200.0, 5_000.0):
        got = np.empty(ends.size)
        poissons(mu, ends, got)
        low, high = u < 0.5, u >= 0.5
        np.testing.assert_array_equal(got[low], scipy_poisson.ppf(u[low], mu))
        assert (scipy_poisson.sf(got[high], mu) <= (1 - u[high]) * (1 + 1e-9)).all()
        assert (scipy_poisson.sf(got[high] - 1, mu) >= (1 - u[high]) * (1 - 1e-9)).all()


@pytest.mark.parametrize("mu", np.geomspace(10, 1e5, 25))
def test_the_series_error_is_within_its_bound(mu):
    # x with P(N < x) = Phi(w), by the incomplete gamma function; the bound is never used up (0.54 at most)
    w = np.linspace(-7.5, 7.5, 301)
    x = np.maximum(series(mu, w), 0.02)
    below, above = gammaincc(x, mu), gammainc(x, mu)
    w = np.where(below < above, ndtri(below), -ndtri(above))
    far = np.abs(series(mu, w) - x)[np.abs(w) < 8.3]
    bound = ((0.03 + 0.002 * w**6) / mu**1.5 + 1e-13 * mu)[np.abs(w) < 8.3]
    assert (far < 0.6 * bound).all()


def series(mu, w):
    return (
        mu + np.sqrt(mu) * w + (2 + w**2) / 6 - (2 * w + w**3) / (72 * np.sqrt(mu))
        + (-8 / 405 + 7 * w**2 / 810 + w**4 / 270) / mu
    )  # fmt: skip


@given(mu=st.floats(0.0, 50_000.0), more=st.floats(0.0, 50.0), bits=st.integers(0, 2**64 - 1))
def test_poisson_rises_with_its_mean(mu, more, bits):
    assert noise.poisson(mu + more, np.uint64(bits)) >= noise.poisson(mu, np.uint64(bits))
