"""Identities through long occlusion, by the limb; order, completeness and uniqueness as properties."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation
from track_points import STEP_NS, follow, points

from mosca.data.tracks import table
from mosca.numba_support.decorators import kernel
from mosca.tracking import assignment
from mosca.tracking.motion_models import motion
from mosca.tracking.nearest_neighbour import NearestTracker
from mosca.tracking.tracker import Tracker, TrackSettings

best_pairs = kernel(assignment.best_pairs.py_func)
"""Callable from here; the tracker compiles it into its kernel."""
LIMB = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.15, 0], [0.02, 0.03, 0.12]])


def limb_path(frames):
    """A limb that swings 60 degrees and travels: (frames, 4, 3) [m]."""
    t = np.arange(frames) * 0.01
    turn = Rotation.from_euler("zx", np.column_stack([60 * np.sin(4 * t), 30 * np.sin(2.5 * t)]), degrees=True)
    move = np.column_stack([0.8 * t, 0.2 * np.sin(3 * t), 1 + 0 * t])
    return np.array([r.apply(LIMB) + m for r, m in zip(turn, move, strict=True)])


def identity_at(tracks, frame, place):
    rows = np.flatnonzero(tracks.frame == frame)
    return tracks.track[rows[np.linalg.norm(tracks.xyz[rows] - place, axis=1).argmin()]]


def test_a_marker_hidden_for_a_second_is_expected_by_its_limb_and_keeps_its_identity():
    path = limb_path(320)
    rng = np.random.default_rng(0)
    tracker, samples, errors = Tracker(TrackSettings()), [], []
    for k, xyz in enumerate(path + rng.normal(0, 2e-4, path.shape)):
        shown = xyz[[0, 1, 2]] if 150 <= k < 270 else xyz
        predicted = tracker.predict(k * 0.01)
        if 150 <= k < 270:
            # one expectation more than there are points: that of the hidden marker
            assert len(predicted.xyz) == 4
            away = predicted.xyz - path[k, 3]
            nearest = np.linalg.norm(away, axis=1).argmin()
            form = away[nearest] @ np.linalg.solve(predicted.covariance[nearest], away[nearest])
            errors.append((np.linalg.norm(away[nearest]), form))
        samples.append(tracker.update(points(shown), k, k * STEP_NS))
    distance, nees = np.array(errors).T
    # coasting alone would be off by decimetres
    assert distance.max() < 0.01
    assert nees.mean() < 3.0
    tracks = table(samples)
    assert len(np.unique(tracks.track)) == 4
    assert identity_at(tracks, 310, path[310, 3]) == identity_at(tracks, 100, path[100, 3])


def test_without_limb_mates_the_returning_marker_is_a_new_one():
    path = limb_path(320)
    frames = [points(x[[0, 1, 2]] if 150 <= k < 270 else x) for k, x in enumerate(path)]
    tracks = follow(frames, Tracker(TrackSettings(limb_m=0.0)))
    assert len(np.unique(tracks.track)) == 5


def test_a_stray_point_near_the_limb_is_not_the_hidden_marker():
    path = limb_path(320)
    frames = []
    for k, x in enumerate(path):
        # 4 cm beside the hidden marker, for half a second
        frames.append(points(np.vstack([x[:3], x[3] + [0, 0.04, 0]]) if 200 <= k < 250 else x[:3] if k >= 150 else x))
    tracks = follow(frames)
    hidden = identity_at(tracks, 100, path[100, 3])
    assert not np.any((tracks.track == hidden) & (tracks.frame >= 150))


def leaving_its_limb(acceleration):
    """The fist of a boxer: from 1 s on a marker's distances break, only its path predicts it (140, 4, 3)."""
    t = np.arange(140) * 0.01
    path = np.tile(LIMB, (140, 1, 1))
    path[:, 3, 0] += 0.5 * acceleration * np.maximum(t - 1.0, 0.0) ** 2
    return path + np.random.default_rng(0).normal(0, 2e-4, path.shape)


@pytest.mark.parametrize("hidden", [1, 2, 3])
@pytest.mark.parametrize("acceleration", [10.0, 20.0, 40.0])
def test_a_marker_that_leaves_its_limb_and_is_hidden_for_a_moment_is_still_itself(acceleration, hidden):
    path = leaving_its_limb(acceleration)
    frames = [points(x[:3] if 110 <= k < 110 + hidden else x) for k, x in enumerate(path)]
    tracks = follow(frames)
    assert len(np.unique(tracks.track)) == 4
    assert identity_at(tracks, 130, path[130, 3]) == identity_at(tracks, 50, path[50, 3])


def punch(push, reach):
    """An arm before a trunk: still for a second, then pushed forward while its elbow opens (140, 9, 3).

    ``push`` [m/s^2] for 30 ms, ``reach``: how fast the forearm leaves the upper arm [m/s]. Marker 4 is on the upper
    arm, 5 beside the elbow, 6 to 8 on the forearm.
    """
    t = np.arange(140) * 0.01
    sway = 0.01 * np.sin(5 * t)
    since = np.maximum(t - 1.0, 0.0)
    forward = np.where(since < 0.03, 0.5 * push * since**2, push * 0.03 * (since - 0.015))
    trunk = [[-0.2, 0.1, 0.3], [-0.25, -0.1, 0.3], [-0.3, 0.1, 0.0], [-0.3, -0.1, 0.05]]
    arm = [[0, 0, 0.2], [0.14, 0, 0.1], [0.2, 0.02, 0.25], [0.26, -0.03, 0.28], [0.25, 0.03, 0.33]]
    path = np.tile(np.array(trunk + arm), (len(t), 1, 1))
    path[:, 4:, 0] += forward[:, None]
    path[:, 6:, 0] += (sway + reach * np.minimum(since, 0.2))[:, None]
    return path + np.random.default_rng(0).normal(0, 2e-4, path.shape)


@pytest.mark.parametrize("push", [60.0, 80.0, 100.0])
def test_a_marker_that_is_hidden_when_its_limb_is_pushed_is_still_itself(push):
    # in a second of rest distances across the elbow hardly change; in the punch they do by centimetres
    path = punch(push, 1.0)
    frames = [points(np.delete(x, 4, axis=0) if k == 101 else x) for k, x in enumerate(path)]
    tracks = follow(frames)
    assert len(np.unique(tracks.track)) == 9
    assert identity_at(tracks, 130, path[130, 4]) == identity_at(tracks, 50, path[50, 4])


def test_a_poor_sighting_off_its_limb_is_not_the_hidden_marker():
    path = leaving_its_limb(20.0)
    frames = [points(x[:3] if k == 110 else x) for k, x in enumerate(path)]
    for k in range(111, 140):  # two cameras, of which one shows an image of odd size
        frames[k] = replace(frames[k], n_cameras=np.array([4, 4, 4, 2]), trusted=np.array([4.0, 4.0, 4.0, 1.2]))
    tracks = follow(frames)
    fist = identity_at(tracks, 100, path[100, 3])
    assert not np.any((tracks.track == fist) & (tracks.frame > 110))


def test_hand_over_shoulder():
    # the guide's collision: a hand passes 3 cm from a shoulder, which it hides meanwhile
    k = np.arange(200)
    body = np.array([[0, 0, 1.4], [0.2, 0, 1.4], [0.1, 0.05, 1.2], [0.1, 0.1, 1.5]])
    frames, hand = [], np.column_stack([-0.8 + 0.008 * k, 0 * k - 0.03, 1.4 + 0 * k])
    for j in k:
        shown = body[1:] if 90 <= j < 110 else body
        frames.append(points(np.vstack([shown, hand[j]])))
    tracks = follow(frames)
    shoulder = identity_at(tracks, 50, body[0])
    assert len(np.unique(tracks.track)) == 5
    assert identity_at(tracks, 190, body[0]) == shoulder
    assert identity_at(tracks, 190, hand[190]) == identity_at(tracks, 50, hand[50]) != shoulder
    # the guide's own tracker lets the shoulder go with the hand
    guide = follow(frames, NearestTracker())
    rows = guide.select((guide.frame == 100) & (np.linalg.norm(guide.xyz - hand[100], axis=1) < 1e-9))
    assert len(rows) == 2


@pytest.mark.parametrize("model", ["acceleration", "velocity"])
def test_dropped_frames_and_irregular_times(model):
    rng = np.random.default_rng(1)
    tracker, samples = Tracker(TrackSettings(model=model)), []
    times = np.cumsum(rng.choice([0.01, 0.01, 0.01, 0.05], 200))
    for k, t in enumerate(times):
        tracker.predict(t)
        xyz = np.array([[np.sin(2 * t), 0.3 * t, 0], [np.sin(2 * t), 0.3 * t, 0.1]])
        samples.append(tracker.update(points(xyz), k, round(t * 1e9)))
    tracks = table(samples)
    assert np.unique(tracks.track).tolist() == [0, 1]
    assert len(tracks) == 400


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 12), st.floats(0.0, 0.3))
def test_order_does_not_matter_nothing_is_lost_and_identities_are_unique(seed, markers, hidden):
    rng = np.random.default_rng(seed)
    start, velocity = rng.uniform(-1, 1, (markers, 3)), rng.uniform(-1, 1, (markers, 3))
    frames, shuffled, given_out = [], [], 0
    for k in range(30):
        xyz = (start + 0.01 * k * velocity)[rng.random(markers) >= hidden]
        frames.append(points(xyz))
        order = rng.permutation(len(xyz))
        shuffled.append(points(xyz[order]))
        given_out += len(xyz)
    one, other = follow(frames), follow(shuffled)
    for tracks in (one, other):
        keys = np.column_stack([tracks.frame, tracks.track])
        assert len(np.unique(keys, axis=0)) == len(tracks)
        places = np.column_stack([tracks.frame, tracks.xyz])
        assert len(np.unique(places, axis=0)) == len(tracks) <= given_out

    def partition(tracks):
        # identities are numbered in the order of the points: compare who belongs together
        return {
            frozenset((f, *x) for f, x in zip(t.frame.tolist(), t.xyz.tolist(), strict=True))
            for t in (tracks.select(tracks.track == i) for i in np.unique(tracks.track))
        }

    assert partition(one) == partition(other)


def test_every_point_of_a_lasting_target_is_handed_out():
    path = limb_path(100)
    tracks = follow([points(x) for x in path])
    assert len(tracks) == 400
    assert np.bincount(tracks.frame).tolist() == [4] * 100


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 9), st.integers(1, 9), st.floats(0.05, 1.0))
def test_the_assignment_is_the_best_there_is(seed, lefts, rights, density):
    rng = np.random.default_rng(seed)
    worth = np.where(rng.random((lefts, rights)) < density, rng.uniform(0.1, 10, (lefts, rights)), 0.0)
    left, right = np.nonzero(worth)
    partner = best_pairs(left, right, worth[left, right], lefts, rights)
    mine = sum(worth[p, r] for r, p in enumerate(partner) if p >= 0)
    assert all(worth[p, r] > 0 for r, p in enumerate(partner) if p >= 0)
    chosen = partner[partner >= 0]
    assert len(np.unique(chosen)) == len(chosen)
    rows, columns = linear_sum_assignment(-worth)
    assert mine == pytest.approx(worth[rows, columns].sum(), abs=1e-9)


@pytest.mark.parametrize("step", [1e-4, 1e-3, 1e-2, 0.1])
def test_singer_step_is_the_integral_of_its_noise(step):
    # Q = integral of F(s) G G' F(s)' with spectral density 2 / memory, by Gauss-Legendre
    memory = 0.1
    nodes, weights = np.polynomial.legendre.leggauss(24)
    total = np.zeros((3, 3))
    for s, w in zip((nodes + 1) * step / 2, weights * step / 2, strict=True):
        x, e = s / memory, np.exp(-s / memory)
        # written with expm1: no digits are lost
        g = np.array([memory**2 * (x + np.expm1(-x)), -memory * np.expm1(-x), e])
        total += w * 2 / memory * np.outer(g, g)
    m = motion("acceleration", step, memory)
    mine = np.array([[m.qpp, m.qpv, m.qpa], [m.qpv, m.qvv, m.qva], [m.qpa, m.qva, m.qaa]])
    np.testing.assert_allclose(mine, total, rtol=2e-2 if step < 1e-3 + 1e-9 else 1e-5)
    assert m.pa == pytest.approx(memory**2 * (step / memory + np.expm1(-step / memory)), rel=1e-3)
