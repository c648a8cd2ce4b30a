"""The delay from a flight's log on made-up motions of a known delay; the delay margin against simulated loops."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from mosca.errors import InputError
from mosca.machines.closed_loop.delay import FlightLog, estimate_delay
from mosca.machines.closed_loop.delay_margin import PositionLoop, delay_margin_s, mean_age_s
from mosca.machines.closed_loop.filtered_loop import FilteredLoop
from mosca.machines.closed_loop.late_pose_filter import MotionNoise

STEP_S = 0.001


def log_of(delay_s, seed, *, kicks=True, sigma_m=2e-4, jitter_s=0.0, length_s=8.0):
    """Return the log of a body that is pushed by known accelerations and an unknown one of 0.05 m/s^2 rms."""
    random = np.random.default_rng(seed)
    count = round((length_s + 1) / STEP_S)
    time_s = STEP_S * np.arange(count)
    held = round(0.005 / STEP_S)
    known = np.repeat(random.normal(scale=1.0 if kicks else 0.01, size=(count // 100, 3)), 100, axis=0)
    shrink = np.exp(-STEP_S / 1.0)
    unknown = lfilter([0.05 * np.sqrt(1 - shrink**2)], [1, -shrink], random.normal(size=(count, 3)), axis=0)
    pushed = known + unknown  # each holds for a step: the sums below are exact
    speed = np.vstack([np.zeros(3), np.cumsum(pushed * STEP_S, axis=0)])[:-1]
    place = np.vstack([np.zeros(3), np.cumsum(speed * STEP_S + pushed * STEP_S**2 / 2, axis=0)])[:-1]
    exposed = np.arange(50, count - 400, 10)
    measured = place[exposed] + random.normal(scale=sigma_m, size=(len(exposed), 3))
    arrival = time_s[exposed] + delay_s - jitter_s + random.exponential(jitter_s, len(exposed))
    covariance = np.broadcast_to(sigma_m**2 * np.eye(3), (len(exposed), 3, 3))
    # the cameras' clock began at another time than the controller's
    return FlightLog(time_s[::held], known[::held], arrival, time_s[exposed] - 17.3, measured, covariance)


@pytest.mark.parametrize("delay_s", [0.012, 0.047, 0.150])
@pytest.mark.parametrize("seed", [1, 2])
def test_the_delay_is_found_to_2_ms(delay_s, seed):
    found = estimate_delay(log_of(delay_s, seed))
    assert abs(found.delay_s - delay_s) < 0.002
    assert abs(found.delay_s - delay_s) < 4 * found.sigma_s
    assert found.noise_factor == pytest.approx(1.0, abs=0.1)


def test_jitter_and_noise_stated_wrongly_do_no_harm():
    log = log_of(0.030, 5, jitter_s=0.004)
    found = estimate_delay(replace(log, covariance=log.covariance / 4))
    # the mean of 800 exponential numbers of 4 ms is known to 0.14 ms
    assert abs(found.delay_s - 0.030) < 0.002
    assert found.noise_factor == pytest.approx(2.0, abs=0.2)


def test_intervals_hold_the_delay():
    inside = 0
    for seed in range(20):
        low, high = estimate_delay(log_of(0.040, 100 + seed, length_s=4.0)).ci95
        inside += low <= 0.040 <= high
    assert inside >= 16  # of a binomial of 20 and 0.95, 15 and fewer come in 0.3 % of cases


def test_a_motion_that_does_not_tell_is_refused():
    with pytest.raises(InputError, match=r"delay: .*(tells|tell|likeliest)"):
        estimate_delay(log_of(0.030, 1, kicks=False, length_s=3.0))
    log = log_of(0.030, 1)
    short = FlightLog(*(getattr(log, name)[:50] for name in FlightLog.__dataclass_fields__))
    with pytest.raises(InputError, match="50 poses given; 100 or more"):
        estimate_delay(short)


def test_the_margin_of_a_double_integrator_in_closed_form():
    """PD without lag, kp = 1, kv = sqrt(2): |L| = 1 where w^4 = 2 w^2 + 1; phase lead atan(kv w / kp)."""
    crossover = np.sqrt(1 + np.sqrt(2))
    wanted = np.arctan(np.sqrt(2) * crossover) / crossover
    loop = PositionLoop(1.0, np.sqrt(2.0), np.inf)
    assert delay_margin_s(loop) == pytest.approx(wanted, rel=1e-9)


@pytest.mark.parametrize(("factor", "dies"), [(0.97, True), (1.03, False)])
def test_a_simulated_loop_grows_just_beyond_the_margin(factor, dies):
    """Euler steps of 0.2 ms of the default loop with its attitude lag; the late state comes from a ring of states."""
    loop = PositionLoop()
    h = 2e-4
    late = round(factor * delay_margin_s(loop) / h)
    past = np.zeros((late + 1, 2))
    past[:] = (0.01, 0.0)
    x, v, a, j = 0.01, 0.0, 0.0, 0.0
    w, z = loop.attitude_rad_s, loop.attitude_damping
    peaks = []
    for k in range(100_000):
        old = past[k % (late + 1)].copy()
        past[k % (late + 1)] = (x, v)
        wanted = -loop.position_gain * old[0] - loop.velocity_gain * old[1]
        j += h * (w * w * (wanted - a) - 2 * z * w * j)
        a += h * j
        v += h * a
        x += h * v
        peaks.append(abs(x))
    early, end = max(peaks[10_000:30_000]), max(peaks[80_000:])
    assert (end < 0.8 * early) if dies else (end > 1.25 * early)


def test_mean_age_by_counting():
    """Frames 10 ms apart, 60 % lost: the age beyond the delay at random instants, counted."""
    random = np.random.default_rng(7)
    kept = np.flatnonzero(random.uniform(size=400_000) >= 0.6) * 0.01
    asked = random.uniform(10, 3900, 200_000)
    age = asked - kept[np.searchsorted(kept, asked) - 1]
    assert mean_age_s(0.01, 0.6) == pytest.approx(age.mean(), rel=0.01)


def test_with_an_ideal_filter_the_margin_is_the_closed_forms():
    """A filter that trusts poses alone leaves the loop of the closed form, but for half a control period of hold."""
    ideal = FilteredLoop(PositionLoop(), MotionNoise(10.0, 0.1), 1e-7, 0.005, 0.005, measures=True)
    assert ideal.margin_s() == pytest.approx(delay_margin_s(PositionLoop()) - 0.0025, abs=0.0026)


def test_a_filter_that_takes_late_poses_for_new_ones_costs_margin():
    """Its unexplained acceleration is an integral action; a force that the delay feigns is fed back."""
    commands = FilteredLoop(PositionLoop(), MotionNoise(), 1e-4, 0.005, 0.01)
    assert commands.margin_s() < 0.5 * delay_margin_s(PositionLoop())
    assert commands.radius(0.005) < 1.0 < commands.radius(0.1)
