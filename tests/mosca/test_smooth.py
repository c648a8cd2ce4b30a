"""Smoothing and filling: measured stays measured, errors shrink, filled samples have true covariances."""

from dataclasses import replace

import numpy as np
import pytest
from smooth_scenes import least_squares, motions, nees_of
from track_points import made_tracks

from mosca.data.tracks import Tracks
from mosca.smoothing.gap_filling import filled
from mosca.smoothing.rts import SmoothSettings, smooth_one, smoothed

SIGMA = 1e-3


def tracks_of(xyz, keep, seed=0):
    """xyz (t, m, 3) true; keep (t, m): which are measured, with noise."""
    rng = np.random.default_rng(seed)
    frame, track = np.nonzero(keep)
    return made_tracks(frame, track, xyz[frame, track] + rng.normal(0, SIGMA, (len(frame), 3)), SIGMA)


def gaps(frames, markers, length):
    keep = np.ones((frames, markers), bool)
    for start in range(40, frames - 40, 90):
        for m in range(markers):
            keep[start + 7 * m : start + 7 * m + length, m] = False
    return keep


def test_smoothing_equals_the_least_squares_of_all_measurements():
    # the same prior and noise written as one linear system: positions must agree
    rng = np.random.default_rng(3)
    t, dt, speed2, var = 6, 0.1, 4.0, 2.0
    f = np.array([[1, dt, dt * dt / 2], [0, 1, dt], [0, 0, 0.8]])
    g = np.array([[0.3, 0.0, 0.0], [0.1, 0.4, 0.0], [0.05, 0.1, 0.5]])
    noise = g @ g.T
    xyz, measured = rng.normal(0, 1, (t, 3)), np.array([True, True, False, False, True, True])
    covariance = np.tile(0.01 * np.eye(3), (t, 1, 1))
    place, spread, _, _ = smooth_one(
        xyz, covariance, measured, np.tile(f, (t, 1, 1)), np.tile(noise, (t, 1, 1)), speed2, var
    )
    for axis in range(3):
        seen = np.where(measured, xyz[:, axis], np.nan)
        wanted, variance = least_squares(seen, np.full(t, 0.01), [f] * (t - 1), [var * noise] * (t - 1), speed2, var)
        np.testing.assert_allclose(place[:, axis], wanted, atol=1e-9)
        np.testing.assert_allclose(spread[:, axis, axis], variance, rtol=1e-8)


def test_smoothed_is_nearer_to_the_truth_and_measured_stays_as_it_is():
    xyz = motions(300, 3)
    tracks = tracks_of(xyz, np.ones((300, 3), bool))
    result = smoothed(tracks)

    def rms(one):
        return np.sqrt(np.mean((one.xyz - xyz[one.frame, one.track]) ** 2))

    assert rms(result) < 0.7 * rms(tracks)
    assert (result.status == "measured").all()
    added = filled(tracks)
    np.testing.assert_array_equal(added.xyz, tracks.xyz)


def wild(frames, markers, seed):
    """Random accelerations of 15 m/s^2 that last 0.15 s, within a spring's reach: nothing like sines."""
    rng = np.random.default_rng(seed)
    place, speed, push = np.zeros((3, markers, 3))
    out = np.empty((frames, markers, 3))
    for k in range(frames):
        push = push * (1 - 0.01 / 0.15) + rng.normal(0, 15 * np.sqrt(2 * 0.01 / 0.15), push.shape)
        speed = speed + 0.01 * (push - 4 * speed - 20 * place)
        place = place + 0.01 * speed
        out[k] = place
    return out


@pytest.mark.parametrize("motion", [motions, wild])
@pytest.mark.parametrize("length", [1, 3, 8, 14])
def test_filled_samples_are_marked_and_cover_the_truth_as_often_as_they_say(motion, length):
    inside, squares, count = 0.0, 0.0, 0
    for seed in (1, 2):
        xyz, keep = motion(700, 6, seed), gaps(700, 6, length)
        tracks = tracks_of(xyz, keep, seed)
        together = filled(tracks)
        new, old = (together.select(together.status == status) for status in ("filled", "measured"))
        np.testing.assert_array_equal(old.xyz, tracks.xyz)
        assert len(new) == (~keep).sum()
        assert (new.n_cameras == 0).all()
        assert np.isnan(new.residual_px).all()
        nees = nees_of(new, xyz)
        inside, squares, count = inside + (nees <= 7.815).sum(), squares + nees.sum(), count + len(new)
        widths = np.trace(new.covariance, axis1=1, axis2=2)
        assert np.median(widths) > 3 * SIGMA**2 * (0.1 if length == 1 else 0.3)
    gaps_filled = count / length  # samples of a gap err together: 80 gaps, of which 95 % +- 2.4 %
    assert gaps_filled > 70
    assert inside / count > 0.95 - 3 * np.sqrt(0.95 * 0.05 / gaps_filled)
    # and not by being timid: a covariance three times too wide has a mean square of 1
    assert squares / count > 1.3


def test_filled_samples_have_their_track_s_label():
    tracks = tracks_of(motions(200, 2), gaps(200, 2, 3))
    label = np.where(tracks.track == 1, "elbow", "")
    together = filled(replace(tracks, label=label))
    assert (together.status == "filled").any()
    np.testing.assert_array_equal(together.label == "elbow", together.track == 1)


def test_long_gaps_and_ends_stay_open():
    keep = np.ones((200, 2), bool)
    keep[100:140, 0] = False
    keep[150:, 1] = False
    tracks = tracks_of(motions(200, 2), keep)
    assert len(filled(tracks, SmoothSettings(longest_gap_s=0.25))) == len(tracks)


def test_nothing_to_smooth():
    assert len(filled(Tracks.none())) == len(smoothed(Tracks.none())) == 0
