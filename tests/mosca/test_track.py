"""Tracking: identities through noise, occlusion and crossing; uncertain points are withheld."""

import numpy as np
import pytest
from track_points import STEP_NS, follow, points

from mosca.tracking.kalman import _predict_one
from mosca.tracking.motion_models import motion
from mosca.tracking.nearest_neighbour import NearestTracker
from mosca.tracking.tracker import Tracker, TrackSettings


def test_a_moving_target_is_one_track_from_its_first_frame():
    path = np.array([[0.02 * k, 0.1 * np.sin(0.1 * k), 0] for k in range(60)])
    tracks = follow([points(p) for p in path])
    assert np.unique(tracks.track).tolist() == [0]
    assert tracks.frame.tolist() == list(range(60))
    # measured points are returned unchanged
    np.testing.assert_array_equal(tracks.xyz, path)


def test_two_cameras_need_longer_to_convince():
    # weight 5: 4 cameras weigh 3 a sighting -> the second convinces; 2 cameras weigh 1 -> the fifth
    assert len(follow([points([0, 0, 0], 4)])) == 0
    assert len(follow([points([0, 0, 0], 4)] * 2)) == 2
    assert len(follow([points([0, 0, 0], 2)] * 4)) == 0
    assert len(follow([points([0, 0, 0], 2)] * 5)) == 5


def test_samples_without_a_name_are_counted_until_they_leave():
    tracker, nearest = Tracker(TrackSettings()), NearestTracker()
    left = []
    # two cameras convince with the fifth sighting; a target that was seen once is given up after two misses
    for k in range(8):
        places = [[0.0, 0.0, 0.0]] + ([[1.0, 0.0, 0.0]] if k == 0 else [])
        for one in (tracker, nearest):
            one.predict(k * STEP_NS * 1e-9)
            handed = one.update(points(places, 2), k, k * STEP_NS)
            assert one is tracker or (len(handed) == len(places) and one.waiting == 0)
        left.append(tracker.waiting)
    assert left == [2, 3, 3, 4, 0, 0, 0, 0]


def test_flashes_are_never_handed_out():
    rng = np.random.default_rng(0)
    flashes = [points(rng.uniform(-1, 1, (3, 3)), 2) for _ in range(200)]
    assert len(follow(flashes)) == 0


def test_identity_survives_a_short_occlusion():
    path = np.array([[0.01 * k, 0, 0] for k in range(80)])
    frames = [points([]) if 30 <= k < 45 else points(p) for k, p in enumerate(path)]
    tracks = follow(frames)
    assert np.unique(tracks.track).tolist() == [0]
    assert len(tracks) == 65


def test_a_long_absence_ends_a_track():
    frames = [points([0, 0, 0])] * 20 + [points([])] * 40 + [points([0, 0, 0])] * 20
    assert np.unique(follow(frames).track).tolist() == [0, 1]


def test_crossing_targets_keep_their_identities():
    # two targets pass at 3 cm, their nearest neighbours exchanged at each frame's old positions
    k = np.arange(100)[:, None]
    one = np.hstack([0.02 * (k - 50), 0 * k + 0.015, 0 * k])
    two = np.hstack([-0.02 * (k - 50), 0 * k - 0.015, 0 * k])
    tracks = follow([points(np.array([a, b])) for a, b in zip(one, two, strict=True)])
    first = tracks.select(tracks.track == 0)
    assert len(first) == 100
    assert np.ptp(first.xyz[:, 1]) < 1e-9


def test_time_cannot_run_backwards():
    tracker = Tracker(TrackSettings())
    tracker.predict(1.0)
    with pytest.raises(ValueError, match="in order"):
        tracker.predict(0.9)


def test_a_predicted_filter_is_that_of_the_dense_equations():
    rng, variance, m = np.random.default_rng(4), 3.0, motion("acceleration", 0.01, 0.05)
    mean, root = rng.normal(size=9), rng.normal(size=(9, 9))
    covariance = root @ root.T * 1e-4
    step = np.kron([[1, m.pv, m.pa], [0, 1, m.va], [0, 0, m.aa]], np.eye(3))
    noise = np.kron([[m.qpp, m.qpv, m.qpa], [m.qpv, m.qvv, m.qva], [m.qpa, m.qva, m.qaa]], np.eye(3))
    expected = step @ mean, step @ covariance @ step.T + variance * noise
    # noise of position alone is small beside what is known: here it is not
    for scale in (1.0, 1e-9):
        x, p = mean.copy(), scale * covariance
        wanted = scale * (expected[1] - variance * noise) + variance * noise
        _predict_one.py_func(x, p, m, variance)
        np.testing.assert_allclose(x, expected[0], rtol=1e-12)
        np.testing.assert_allclose(p, wanted, rtol=1e-7, atol=1e-18)


def test_jitter_of_the_triggers_spreads_points_along_their_path():
    # 2 m/s along x, 1 ms a camera, 4 cameras: (2 mm)^2 / 4 beside (0.2 mm)^2
    tracker, samples = Tracker(TrackSettings()), []
    for k in range(60):
        tracker.predict(k * STEP_NS * 1e-9)
        samples.append(tracker.update(points([0.02 * k, 0, 0]), k, k * STEP_NS, 1e-3))
    last = samples[-1].covariance[0]
    np.testing.assert_allclose(np.diag(last), [1e-6 + 4e-8, 4e-8, 4e-8], rtol=0.02, atol=1e-12)
