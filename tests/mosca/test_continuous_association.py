"""From what free-running cameras saw to observations: tracklets, clocks, identities, samples on a grid.

Points move on sums of sinusoids and are projected here by the pinhole equations; each camera exposes at instants of
its own and stamps them by a clock of its own.
"""

from dataclasses import replace

import numpy as np
import pytest
from continuous_sessions import DRIFT, POINTS, RATE_HZ, as_detections, pinhole, rig, session
from track_points import made_tracks

from mosca.continuous.association.associate import AssociationSettings, gather_seen
from mosca.continuous.association.coarse_sync import common_clock, tied_clocks
from mosca.continuous.association.frame_detections import check_rise
from mosca.continuous.association.interpolated_tracks import SampledCurves
from mosca.continuous.association.tracklet_merging import parts_in_time
from mosca.continuous.association.tracklets_2d import Tracklets, tracklets
from mosca.continuous.model.observations import TimedObservations, no_carriers
from mosca.continuous.resample import residuals_px, tracks_on_grid
from mosca.data.frames import CameraInfo
from mosca.data.tracks import Tracks
from mosca.errors import InputError


def test_a_strand_is_one_point():
    seen, names, _true = session()
    for one, point in zip(seen, names, strict=True):
        tracklet = tracklets(one)
        owners = [np.unique(point[tracklet == s]) for s in np.unique(tracklet)]
        assert all(len(o) == 1 for o in owners)
        assert len(owners) <= 1.2 * POINTS


def test_between_exposures_a_path_is_the_curve_itself_to_third_order():
    """On a parabola the Hermite polynomial is exact where neighbours give the parabola's own speeds."""
    t = np.array([0.0, 0.1, 0.25, 0.3, 0.42, 0.5])
    xy = np.column_stack([3 + 20 * t - 9 * t**2, 5 - 4 * t + 2 * t**2])
    n = len(t)
    info = CameraInfo("c", 10, 10, 8, 10.0)
    seen = as_detections(info, np.rint(t * 1e9).astype(np.int64), xy[:, None], 1.0)
    asked = np.array([0.11, 0.2, 0.3, 0.41])
    found = Tracklets.of(seen, np.zeros(n, np.int64), t).at(asked)
    np.testing.assert_array_equal(found.instant, [0, 1, 2, 3])
    wanted = np.column_stack([3 + 20 * asked - 9 * asked**2, 5 - 4 * asked + 2 * asked**2])
    np.testing.assert_allclose(found.xy_px, wanted, atol=1e-9)
    np.testing.assert_allclose(found.speed_px[2], [20 - 18 * 0.3, -4 + 4 * 0.3], atol=1e-9)


def test_clocks_that_know_nothing_of_each_other_are_tied_by_the_images():
    seen, _names, true_s = session(4.5)
    ties = tied_clocks(seen, [tracklets(one) for one in seen], rig(), 1.0)
    for k, (one, tie) in enumerate(zip(seen, ties, strict=True)):
        found = tie.common_s((one.frame_ns - tie.origin_ns) * 1e-9)
        # seconds of the first camera's clock, which began with the session and does not drift
        assert np.abs(found - true_s[k]).max() < 0.05 / RATE_HZ
        assert tie.drift == pytest.approx(-DRIFT[k], abs=60e-6)


def test_clocks_of_still_points_cannot_be_tied():
    seen, _names, _true = session(2.0)
    held = [replace(one, xy_px=np.full_like(one.xy_px, 100.0)) for one in seen]
    with pytest.raises(InputError, match="no time offset within 1 s makes its images meet"):
        tied_clocks(held, [tracklets(one) for one in held], rig(), 1.0)


@pytest.mark.parametrize("own_clock", [False, True])
def test_every_image_point_gets_its_marker(own_clock):
    seen, names, _true = session(4.5, own_clock)
    found = gather_seen(tuple(seen), rig(), AssociationSettings(search_s=1.0))
    assert found.searched is own_clock
    observations = found.observations
    of_marker = {}
    for c in range(3):
        own = np.flatnonzero(observations.camera == c)
        # index of the image point in its frame
        for k in own:
            one, frame = seen[c], observations.exposure[k]
            rows = np.arange(one.start[frame], one.start[frame + 1])
            row = rows[np.argmin(np.abs(one.xy_px[rows] - observations.xy_px[k]).sum(axis=1))]
            of_marker.setdefault(int(observations.point[k]), []).append(int(names[c][row]))
    wrong = sum(len(v) - np.bincount(v).max() for v in of_marker.values())
    assert wrong <= 0.001 * len(observations)
    assert len({int(np.bincount(v).argmax()) for v in of_marker.values()}) == POINTS
    assert len(observations) > 0.95 * sum(len(n) for n in names)


def test_clocks_taken_for_common_spoil_the_observations():
    """The control: free-running cameras that were started apart, believed to be of one clock."""
    seen, _names, _true = session(3.0)
    apart = tuple(replace(one, frame_ns=one.frame_ns - one.frame_ns[0]) for one in seen)
    with pytest.raises(InputError, match="no marker was followed by two cameras"):
        gather_seen(apart, rig(), AssociationSettings(clocks="common"))


def test_cameras_that_never_ran_together_are_told():
    seen, _names, _true = session(2.0, own_clock=False)
    late = replace(seen[2], frame_ns=seen[2].frame_ns + 100_000_000_000)
    with pytest.raises(InputError, match=r"camera 'c2': filmed from 100.* at no time together"):
        gather_seen((seen[0], seen[1], late), rig(), AssociationSettings())


def test_stamps_must_rise():
    check_rise("c", [4], [100], 5, 101)
    with pytest.raises(InputError, match="frames 4 and 5 have the same time stamp"):
        check_rise("c", [4], [100], 5, 100)
    with pytest.raises(InputError, match="frame 5 is stamped 1 ms before frame 4"):
        check_rise("c", [4], [1_000_000], 5, 0)


class _Straight:
    """Two points in straight motion, with a covariance that encodes the time."""

    points = ("a", "b")

    def at(self, time_s):
        t = np.asarray(time_s)[:, None, None]
        return np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.1]]) + t * np.array([0.2, 0.0, 0.0])

    def covariance_at(self, time_s):
        return np.asarray(time_s)[:, None, None, None] * np.eye(3) * np.ones((1, 2, 1, 1))


def test_samples_on_a_grid_say_what_vouches_for_them():
    cameras = rig()
    times = np.concatenate([np.arange(0.0, 0.3, 0.02), np.arange(0.6, 0.9, 0.02)])
    rows = [(c, p, k, t) for c in range(2) for p in range(2) for k, t in enumerate(times) if c == 0 or t < 0.3]
    camera, point, exposure, at = (np.array(column) for column in zip(*rows, strict=True))
    xyz = _Straight().at(at)[np.arange(len(at)), point.astype(int)]
    xy = np.array([pinhole(cameras.cameras[int(c)], x) for c, x in zip(camera, xyz, strict=True)])
    xy[:, 0] += 0.3
    given = TimedObservations(
        cameras.names, ("a", "b"), camera, point, exposure, at, xy, np.tile(np.eye(2), (len(at), 1, 1)),
        **no_carriers(("a", "b"))
    )  # fmt: skip
    np.testing.assert_allclose(residuals_px(_Straight(), given, cameras), [[0.3, 0.0]] * len(at), atol=1e-6)
    instants = np.array([-0.1, 0.105, 0.45, 0.7, 2.0])
    tracks = tracks_on_grid(_Straight(), given, cameras, instants, np.arange(5) * 10, [0.02, 0.02, 0.02])
    assert isinstance(tracks, Tracks)
    # no values before the first and after the last image point; between them the curve is continued
    np.testing.assert_array_equal(np.unique(tracks.frame), [1, 2, 3])
    assert tracks.status[tracks.frame == 1].tolist() == ["measured"] * 2
    assert tracks.status[tracks.frame == 2].tolist() == ["filled"] * 2
    assert tracks.status[tracks.frame == 3].tolist() == ["filled"] * 2
    np.testing.assert_array_equal(tracks.n_cameras[tracks.frame == 3], [1, 1])
    np.testing.assert_allclose(tracks.residual_px[tracks.frame == 1], 0.3 / np.sqrt(2), atol=1e-6)
    np.testing.assert_allclose(tracks.covariance[tracks.frame == 1], 0.105 * np.eye(3)[None].repeat(2, 0))
    assert tracks.label.tolist() == ["a", "b"] * 3


def test_curves_through_samples_end_where_their_samples_do():
    t = np.array([0, 10, 20, 80, 90, 100]) * 1_000_000
    n = len(t)
    tracks = made_tracks(np.arange(n), np.full(n, 7), np.outer(t * 1e-9, [1.0, 2.0, 3.0]), time_ns=t)
    curves = SampledCurves.of(tracks, 6, 0.03)
    assert curves.points == ("m000",)
    asked = np.array([-0.001, 0.013, 0.05, 0.095, 0.101])
    found = curves.at(asked)[:, 0]
    np.testing.assert_array_equal(np.isfinite(found[:, 0]), [False, True, False, True, False])
    np.testing.assert_allclose(found[[1, 3]], np.outer(asked[[1, 3]], [1.0, 2.0, 3.0]), atol=1e-12)
    assert SampledCurves.of(tracks, 7, 0.03).points == ()


def test_whiles_between_gaps():
    assert parts_in_time(np.array([0.0, 0.1, 0.5, 0.6]), 0.2) == [(0.0, 0.1), (0.5, 0.6)]
    assert parts_in_time(np.empty(0), 0.2) == []


def test_one_clock_counts_from_the_first_frame_of_all():
    seen, _names, _true = session(2.0, own_clock=False)
    assert {tie.origin_ns for tie in common_clock(seen)} == {0}
