"""Another PC's clock, over a simulated network whose delays and clocks are known."""

import numpy as np
import pytest

from hardware.transport.clock import LARGEST_SKEW, RemoteClock


def asked(clock, at_s, offset_s, ppm, there_s, back_s):
    """Ask once: the question leaves at ``at_s`` and takes ``there_s``."""
    remote = offset_s + (at_s + there_s) * (1 + ppm * 1e-6)
    clock.take(round(at_s * 1e9), round(remote * 1e9), round((at_s + there_s + back_s) * 1e9))


@pytest.mark.parametrize("ppm", [0.0, 35.0, -80.0])
def test_offset_and_skew_under_a_busy_network(ppm):
    rng, clock, offset = np.random.default_rng(4), RemoteClock(), 5.0e5
    for k in range(100):
        there, back = 0.3e-3 + rng.exponential(0.4e-3, 2)
        if k % 17 == 5:
            there += 0.4  # a cable that was out
        asked(clock, 100 + 0.2 * k, offset, ppm, there, back)
    at = 100 + 0.2 * 100 + 1.5
    here = clock.to_local(round((offset + at * (1 + ppm * 1e-6)) * 1e9))
    assert abs(here * 1e-9 - at) < 0.3e-3
    assert clock.skew * 1e6 == pytest.approx(-ppm, abs=15)
    assert 0.3e6 <= clock.error_ns < 0.5e6


def test_a_few_answers_are_enough_to_begin():
    clock = RemoteClock()
    for k in range(5):
        assert not clock.ready
        asked(clock, k * 0.02, -7.0, 50.0, 0.2e-3 + 1e-3 * (k % 2), 0.2e-3)
    assert clock.ready
    assert abs(clock.to_local(round((-7.0 + 0.5 * (1 + 50e-6)) * 1e9)) - 0.5e9) < 0.1e6
    assert clock.skew == 0.0


def test_asymmetric_ways_cost_half_their_difference():
    clock = RemoteClock()
    for k in range(50):
        asked(clock, k * 0.2, 0.0, 0.0, 0.5e-3, 0.1e-3)
    assert clock.to_local(10**10) - 10**10 == pytest.approx(-0.2e6, abs=2e3)


def test_a_clock_that_runs_wild_is_not_followed_beyond_reason():
    clock = RemoteClock()
    for k in range(50):
        asked(clock, k * 0.2, 0.0, 5e5, 1e-4, 1e-4)
    assert abs(clock.skew) == LARGEST_SKEW
