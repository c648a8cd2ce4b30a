"""Named random streams: distinct by seed, name and index, the same on every machine."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import kstest

from twin.streams import key, rng


def test_key_is_the_digest_that_b2sum_gives():
    # printf '7/camera/left/body/3' | b2sum -l 64  gives 173af985f96c4a05, read from its last byte
    assert key(7, "camera/left/body", 3) == 0x054A6CF985F93A17


def test_seed_name_and_index_each_make_another_stream():
    first = rng(5, "camera/a/trigger", 2).random(4)
    for other in (rng(6, "camera/a/trigger", 2), rng(5, "camera/b/trigger", 2), rng(5, "camera/a/trigger", 3)):
        assert not np.any(first == other.random(4))


@settings(max_examples=200, deadline=None, derandomize=True)
@given(st.integers(0, 2**63), st.text(max_size=20), st.integers(0, 10**9))
def test_any_name_has_a_key_of_64_bits(seed, name, index):
    assert 0 <= key(seed, name, index) < 2**64


def test_keys_of_a_session_never_meet():
    keys = {
        key(seed, f"camera/{camera}/{what}", pulse)
        for seed in (0, 1)
        for camera in ("a", "b", "a/b", "1")
        for what in ("body", "trigger", "sensor")
        for pulse in range(500)
    }
    assert len(keys) == 2 * 4 * 3 * 500


def test_first_draws_of_successive_pulses_are_independent():
    # one draw a pulse is how the shutter and the mount use the streams
    draws = np.array([rng(3, "camera/a/trigger", pulse).normal() for pulse in range(3000)])
    other = np.array([rng(3, "camera/b/trigger", pulse).normal() for pulse in range(3000)])
    limit = 4.5 / np.sqrt(3000)
    assert kstest(draws, "norm").pvalue > 1e-3
    for lag in (1, 2, 5):
        assert abs(np.mean(draws[lag:] * draws[:-lag])) < limit
    assert abs(np.mean(draws * other)) < limit


def test_streams_leave_the_global_random_state_alone():
    before = np.random.get_state()[1].copy()  # noqa: NPY002 (the state that must not move)
    rng(1, "anything").normal(size=100)
    np.testing.assert_array_equal(np.random.get_state()[1], before)  # noqa: NPY002
