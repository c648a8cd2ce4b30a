"""Fixed-lag smoothing: the offline smoother where the lag has no end, a dense solve, honest covariances."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from smooth_scenes import least_squares, motions, nees_of

from mosca.data.tracks import Samples, Tracks, table
from mosca.errors import InputError
from mosca.smoothing.fixed_lag import FixedLag, LagSettings
from mosca.smoothing.rts import SmoothSettings, smoothed
from mosca.tracking.motion_models import motion

SIGMA = 1e-3
PERIOD_NS = 10_000_000


def samples_of(frame, xyz, there, rng):
    track = np.flatnonzero(there)
    n = len(track)
    covariance = np.tile(SIGMA**2 * np.diag([1.0, 1.0, 4.0]), (n, 1, 1))
    return Samples(
        np.full(n, frame), np.full(n, frame * PERIOD_NS), track,
        xyz[track] + rng.normal(0, SIGMA, (n, 3)) * [1.0, 1.0, 2.0], covariance,
        np.full(n, 4), np.full(n, 0.05), np.zeros(n, np.int8),
    )  # fmt: skip


def steps_of(xyz, keep, seed=0):
    rng = np.random.default_rng(seed)
    return [(f, samples_of(f, xyz[f], keep[f], rng)) for f in range(len(xyz))]


def lagged(steps, settings):
    """The parts that leave at each step, and what waits at the end."""
    smoother = FixedLag(settings)
    return [*(smoother.step(frame, samples) for frame, samples in steps), smoother.rest()]


def gappy(frames, markers):
    keep = np.ones((frames, markers), bool)
    rng = np.random.default_rng(4)
    for m in range(markers):
        for start in rng.integers(5, frames - 30, 4):
            keep[start : start + rng.integers(1, 25), m] = False
    return keep


def test_with_an_endless_lag_it_is_the_offline_smoother():
    xyz, keep = motions(200, 4), gappy(200, 4)
    steps = steps_of(xyz, keep)
    ours = table(lagged(steps, LagSettings(lag=1000, acceleration_mps2=8.0)))
    theirs = smoothed(table([s for _, s in steps]), SmoothSettings(acceleration_mps2=8.0))
    for name in ("frame", "time_ns", "track", "n_cameras", "residual_px", "status"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))
    np.testing.assert_allclose(ours.xyz, theirs.xyz, atol=1e-9)
    np.testing.assert_allclose(ours.covariance, theirs.covariance, atol=1e-13)


@pytest.mark.parametrize("lag", [0, 3, 7])
def test_it_equals_the_least_squares_of_all_that_was_measured_until_then(lag):
    # one linear system for each instant, from the same prior and noise; one axis, one track with a gap
    acceleration, memory, speed = 6.0, 0.1, 3.0
    xyz, keep = motions(24, 1), np.ones((24, 1), bool)
    keep[9:12] = False
    steps = steps_of(xyz, keep, 2)
    smoother = FixedLag(LagSettings(lag=lag, acceleration_mps2=acceleration))
    found = {}
    for f, samples in steps:
        out = smoother.step(f, samples)
        found |= {int(k): (x, c, f) for k, x, c in zip(out.frame, out.xyz, out.covariance, strict=True)}
    assert sorted(found) == [f for f in range(24 - lag) if keep[f, 0]]
    for f, (place, covariance, now) in found.items():
        seen = [k for k in range(now + 1) if keep[k, 0]]
        singer = [motion("acceleration", 0.01 * (b - a), memory) for a, b in pairwise(seen)]
        moves = [np.array([[1, m.pv, m.pa], [0, 1, m.va], [0, 0, m.aa]]) for m in singer]
        noises = [np.array([[m.qpp, m.qpv, m.qpa], [m.qpv, m.qvv, m.qva], [m.qpa, m.qva, m.qaa]]) for m in singer]
        noises = [acceleration**2 * noise for noise in noises]
        for axis in (0, 2):
            xyz_seen = np.array([steps[k][1].xyz[0, axis] for k in seen])
            variances = np.array([steps[k][1].covariance[0, axis, axis] for k in seen])
            wanted = least_squares(xyz_seen, variances, moves, noises, speed**2, acceleration**2)
            assert place[axis] == pytest.approx(wanted[0][seen.index(f)], abs=1e-8)
            assert covariance[axis, axis] == pytest.approx(wanted[1][seen.index(f)], rel=1e-6)


def test_a_longer_lag_is_nearer_and_each_says_honestly_how_near():
    xyz, keep = motions(600, 8, seed=3), np.ones((600, 8), bool)
    rms = []
    for lag in (0, 2, 5, 10, 20):
        tracks = table(lagged(steps_of(xyz, keep, 5), LagSettings(lag=lag)))
        assert len(tracks) == keep.sum()
        later = tracks.select(tracks.frame >= 50)
        rms.append(np.sqrt(np.mean((later.xyz - xyz[later.frame, later.track]) ** 2)))
        # errors are correlated in time: 8 tracks of 5.5 s; the band is of that many, not of all samples
        assert 2.0 < nees_of(later, xyz).mean() < 3.4
    assert all(a > b for a, b in pairwise(rms))
    assert rms[3] < 0.6 * SIGMA * np.sqrt(2.0)


def test_samples_that_were_confirmed_late_leave_in_order_with_the_others():
    # the first 30 samples of a track come together, with the lag long past
    xyz = motions(60, 1)
    steps = steps_of(xyz, np.ones((60, 1), bool))
    held = Samples.joined([s for _, s in steps[:31]])
    fed = [(f, Samples.none()) for f in range(30)] + [(30, held), *steps[31:]]
    parts = lagged(fed, LagSettings(lag=5, acceleration_mps2=8.0))
    assert parts[30].frame.tolist() == list(range(26))
    assert [p.frame.tolist() for p in parts[31:60]] == [[f - 5] for f in range(31, 60)]
    assert parts[60].frame.tolist() == list(range(55, 60))


def test_what_comes_twice_or_too_late_passes_as_it_was_measured():
    xyz = motions(10, 1)
    steps = steps_of(xyz, np.ones((10, 1), bool))
    smoother = FixedLag(LagSettings(lag=3))
    for f, samples in steps:
        smoother.step(f, samples)
    out = smoother.step(10, steps[8][1])
    assert out.frame.tolist() == [8, 7]
    np.testing.assert_array_equal(out.xyz[0], steps[8][1].xyz[0])
    assert smoother.rest().frame.tolist() == [8, 9]


def test_forgotten_tracks_begin_anew_and_free_their_place():
    xyz = np.zeros((2, 3))
    smoother = FixedLag(LagSettings(lag=0, forget_s=1.0))
    rng = np.random.default_rng(0)
    for f in range(0, 40_000, 200):
        one = samples_of(f, xyz, np.array([True, False]), rng)
        out = smoother.step(f, Samples(*(v if n != "track" else v + f for n, v in vars(one).items())))
        assert out.track.tolist() == [f]
    assert len(smoother._slot_of) <= 2
    assert smoother.capacity == 32


@given(st.integers(0, 12), st.lists(st.lists(st.integers(0, 4), unique=True, max_size=5), min_size=1, max_size=40))
def test_every_sample_leaves_once_and_none_before_its_time(lag, instants):
    rng = np.random.default_rng(1)
    there = [np.isin(np.arange(5), who) for who in instants]
    steps = [(f, samples_of(f, np.zeros((5, 3)), t, rng)) for f, t in enumerate(there)]
    parts = lagged(steps, LagSettings(lag=lag))
    for f, part in enumerate(parts[:-1]):
        assert (part.frame == f - lag).all()
    got = table(parts)
    wanted = table([s for _, s in steps])
    np.testing.assert_array_equal(got.frame, wanted.frame)
    np.testing.assert_array_equal(got.track, wanted.track)


def test_a_lag_below_zero_is_an_input_error():
    with pytest.raises(InputError, match="lag = -1"):
        FixedLag(LagSettings(lag=-1))
    assert len(FixedLag().rest()) == len(Tracks.none())
