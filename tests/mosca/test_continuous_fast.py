"""Fast points at low frame rates: gates that follow from the motion, and what positions between exposures are worth.

Points move on sums of sinusoids (closed form), 2 m/s and 30 Hz: an image point goes 25 pixels from frame to frame and
changes its step by as much.
"""

import numpy as np
import pytest
from continuous_sessions import POINTS, Motion, as_detections, rig, session

from mosca.continuous.association import lone_sightings, tracklets_2d
from mosca.continuous.association.associate import AssociationSettings, gather_seen
from mosca.continuous.association.coarse_sync import common_clock
from mosca.continuous.association.image_motion import ImageMotion, learned_motion
from mosca.continuous.association.lone_sightings import with_lone
from mosca.continuous.association.tracklets_2d import Tracklets, tracklets
from mosca.continuous.estimator.estimate import estimate
from mosca.continuous.model.observations import TimedObservations, no_carriers
from mosca.continuous.reconstruct import reconstruct_gathered
from mosca.data.frames import CameraInfo

FAST, RATE_HZ = Motion(frequencies_hz=(1.5, 2.7, 3.9)), 30.0
INFO = CameraInfo("c", 656, 491, 8, RATE_HZ)
NONE = ImageMotion(1 / RATE_HZ, 0.1, 1.0, 1.0)


def _filmed(place, frames=40):
    """What a camera sees of points at ``place(frame)`` (p, 2), always in one order."""
    times = np.rint(np.arange(frames) / RATE_HZ * 1e9).astype(np.int64)
    return as_detections(INFO, times, [place(k) for k in range(frames)], 0.05)


def _wrong_links(names, tracklet, frame):
    order = np.lexsort((frame, tracklet))
    name, of = np.asarray(names)[order], tracklet[order]
    same = of[1:] == of[:-1]
    return int((same & (name[1:] != name[:-1])).sum()), int(same.sum())


def test_motion_of_constant_acceleration_is_predicted_exactly():
    rng = np.random.default_rng(1)
    at, speed, bend = (rng.normal(0, s, (9, 2)) for s in (100, 5, 0.4))
    seen = _filmed(lambda k: at + speed * k + bend * k**2)
    tracklet = np.tile(np.arange(9), 40)
    motion = learned_motion(seen, tracklet, NONE)
    np.testing.assert_allclose(motion.after_two, (1.0, 1.0), atol=1e-6)
    assert motion.share < 1e-6
    # from frame 10 to 11: s + 21 b
    now, last, middle = 11 / RATE_HZ, np.full(9, 10 / RATE_HZ), np.full(9, 9.5 / RATE_HZ)
    way, _sigma = motion.step((speed + 19 * bend) * RATE_HZ, 2 * bend * RATE_HZ**2, middle, last, now)
    np.testing.assert_allclose(way, speed + 21 * bend, atol=1e-6)


def test_motion_without_memory_is_not_extrapolated():
    """Steps of a random walk are independent: the last place is the best prediction, +- the steps' own size."""
    rng = np.random.default_rng(2)
    walk = np.cumsum(rng.normal(0, 7.0, (400, 9, 2)), axis=0)
    motion = learned_motion(_filmed(lambda k: walk[k], 400), np.tile(np.arange(9), 400), NONE)
    assert np.abs(motion.after_two).max() < 0.1
    assert motion.first_px == pytest.approx(7.0, rel=0.05)
    assert motion.one_px == pytest.approx(7.0, rel=0.05)


@pytest.mark.parametrize("learns", [True, False])
def test_strands_of_fast_points_hold(learns, monkeypatch):
    """The control: gates as wide as slow motion needs cut every strand to pieces."""
    if not learns:
        narrow = ImageMotion(1 / RATE_HZ, 5 / 4.5, 16 / 4.5, 5 / 4.5, 1.0, (1.0, 0.8), 5 / 4.5, 0.07)
        monkeypatch.setattr(tracklets_2d, "first_motion", lambda _seen: narrow)
        monkeypatch.setattr(tracklets_2d, "learned_motion", lambda _seen, _of, before: before)
    seen, names, _true = session(2.0, False, FAST, RATE_HZ)
    strands = wrong = links = 0
    for one, name in zip(seen, names, strict=True):
        tracklet = tracklets(one)
        bad, good = _wrong_links(name, tracklet, one.frame)
        strands, wrong, links = strands + len(np.unique(tracklet)), wrong + bad, links + good
    # thirty points leave and enter the images some times
    assert (strands < 60 and wrong < 0.03 * links) is learns


def test_positions_between_exposures_state_their_error():
    """Sinusoids of 3 and 5 Hz at 30 Hz, against the closed form."""
    phase = np.random.default_rng(3).uniform(0, 6, (2, 40, 2))

    def place(k):
        turn = 2 * np.pi * np.asarray(k)[..., None, None] / RATE_HZ
        a, b = np.sin(3 * turn + phase[0]), np.sin(5 * turn + phase[1])
        return 20 * a + 12 * b + 30 * np.arange(40)[:, None]

    seen = _filmed(place, 60)
    path = Tracklets.of(seen, np.tile(np.arange(40), 60), seen.time_s(0))
    found = path.at((np.arange(5, 55) + 0.5) / RATE_HZ)
    off = found.xy_px - place(np.arange(5, 55) + 0.5)[found.instant, found.tracklet]
    ratio = float(np.sqrt((off**2).mean() / found.variance_px2.mean()))
    assert 0.3 < ratio < 1.5
    assert found.variance_px2.min() > 0.0
    # nothing is interpolated at an exposure
    assert path.at(np.array([10 / RATE_HZ])).variance_px2.max() < 1e-6


def _named(seen, names, true_s):
    """The image points with their true names at their true instants."""
    camera = np.repeat(np.arange(len(seen)), [len(n) for n in names])
    exposure = np.concatenate([one.frame for one in seen])
    when = np.concatenate([t[one.frame] for one, t in zip(seen, true_s, strict=True)])
    xy, covariance = (np.concatenate([getattr(one, k) for one in seen]) for k in ("xy_px", "covariance_px2"))
    points = tuple(f"p{k}" for k in range(POINTS))
    return TimedObservations(
        rig().names, points, camera, np.concatenate(names), exposure, when, xy, covariance, **no_carriers(points)
    )


@pytest.mark.parametrize("frames", [lone_sightings.LONE_FRAMES, 2.5])
def test_one_camera_alone_goes_on_by_its_tracklets_before_two_see_a_point(frames, monkeypatch):
    """The first camera has four frames before the next begins, at 0.127 s, and one together with it at 4 / 30 s."""
    monkeypatch.setattr(lone_sightings, "LONE_FRAMES", frames)
    seen, names, true_s = session(2.0, False, FAST, RATE_HZ)
    whole = _named(seen, names, true_s)
    row = np.concatenate([np.arange(len(n)) for n in names])
    began = true_s[2][0]
    had = whole.time_s >= began
    known = np.full(POINTS, began - 1e-3), np.full(POINTS, 3.0)
    ties = common_clock(seen)
    found, number = with_lone(whole.only(had), row[had], known, seen, names, ties, np.zeros(3))
    new = slice(int(had.sum()), None)
    assert (found.camera[new] == 0).all()
    assert (found.point[new] == names[0][number[new]]).all()
    assert len(found.point[new]) == (~had & (whole.time_s > (4 - frames) / RATE_HZ)).sum() > 0


def test_fast_points_at_a_low_frame_rate_are_as_good_as_with_names_and_clocks_given():
    seen, names, true_s = session(2.0, True, FAST, RATE_HZ)
    found = reconstruct_gathered(gather_seen(tuple(seen), rig(), AssociationSettings(search_s=1.0)), rig())
    # with four frames of the first camera before the others began
    assert len(found.observations) > 0.97 * sum(len(n) for n in names)
    time = np.arange(0.4, 1.9, 0.01)
    true = FAST.at(time)
    # the first camera's clock is the truth's
    away = np.linalg.norm(found.estimated.curves.at(time)[:, :, None] - true[:, None], axis=3)
    off = np.nanmin(away, axis=2)
    assert np.isfinite(off).mean() > 0.97
    given = estimate(_named(seen, names, true_s), rig()).curves.at(time)
    bound = np.sqrt(np.nanmean(((given - true) ** 2).sum(axis=2)))
    assert np.sqrt(np.nanmean(off**2)) < 1.3 * bound
