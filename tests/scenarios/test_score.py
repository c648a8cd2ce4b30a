"""Scoring against numbers computed by hand."""

from dataclasses import replace

import numpy as np
import pytest
from track_tables import measured_tracks

from mosca.data.bodies import BodyPoses, RigidBody
from mosca.data.truth import Truth
from scenarios.score.bodies import body_scores
from scenarios.score.cramer_rao import _image_errors
from scenarios.score.tracks import hota, identity_switches, metrics, pair

SPACE = 2.0


def truth(frames=4, visible=1.0, markers=((0, 0, 0), (1, 0, 0))):
    xyz = np.tile(np.array(markers, float), (frames, 1, 1))
    m = len(markers)
    seen = np.full((frames, m, 3), float(visible))
    return Truth(
        np.arange(frames) * 10_000_000,
        tuple(f"m{i}" for i in range(m)),
        xyz,
        seen,
        ("a", "b", "c"),
        np.zeros((frames, m, 3, 2)),
        np.ones((frames, m, 3)),
        np.zeros((frames, 3)),
    )


def tracks(rows):
    """rows: (frame, track, x, y, z)."""
    r = np.array(rows, float).reshape(-1, 5)
    return measured_tracks(r[:, 0], r[:, 1], r[:, 2:])


def both(frames=4, dx=0.001):
    return [(f, k, k + dx, 0, 0) for f in range(frames) for k in (0, 1)]


def test_the_calibrations_share_is_added_to_the_measurements_covariance():
    rows = [(f, 0, 0.002, 0, 0) for f in range(4)] + [(f, 1, 1.0, 0.001, 0) for f in range(4)]
    # a calibration that is 1.5 mm uncertain along x and not at all else: variances 1 + 2.25 mm^2 along x, 1 along y
    share = pair(tracks(rows), truth(), SPACE, lambda xyz: np.tile(np.diag([2.25e-6, 0, 0]), (len(xyz), 1, 1)))
    assert sorted(set(np.round(share.nees, 9))) == pytest.approx([1.0, 4 / 3.25])
    assert sorted(set(np.round(pair(tracks(rows), truth(), SPACE).nees, 9))) == pytest.approx([1.0, 4.0])


def test_coverage_is_of_the_ellipsoid_of_95_percent_in_space():
    # chi-square of 3 degrees of freedom: 7.815 at 0.95; three of four errors with a sigma of 1 mm lie below
    away = 1e-3 * np.sqrt([7.7, 7.7, 7.7, 7.9])
    m = metrics(pair(tracks([(f, 0, away[f], 0, 0) for f in range(4)]), truth(), SPACE), SPACE)
    assert m["coverage95"].value == pytest.approx(0.75)


def test_a_covariance_that_is_none_breaks_every_limit():
    """Not positive definite: its "error squared over variance" may be small, or negative, and lower the mean."""
    rows = both(dx=0.001)
    given = tracks(rows)
    wrong = np.array(given.covariance)
    wrong[0] = np.diag([-1e-6, 1e-6, 1e-6])
    right, broken = (metrics(pair(one, truth(), SPACE), SPACE) for one in (given, replace(given, covariance=wrong)))
    assert right["nees"].value == pytest.approx(1.0)
    assert broken["nees"].value > 1e6
    assert broken["coverage95"].value == pytest.approx(1.0 - 1.0 / len(rows))


def falling(frames=6, hidden=()):
    """Truth at 100 Hz of a marker that falls: z = -g t^2 / 2; not known in the frames ``hidden``."""
    at = truth(frames, markers=((0, 0, 0),))
    xyz = np.array(at.xyz)
    xyz[:, 0, 2] = -4.905 * (0.01 * np.arange(frames)) ** 2
    xyz[list(hidden)] = np.nan
    return replace(at, xyz=xyz)


def test_a_wrong_time_is_an_error_of_place():
    right = tracks([(f, 0, 0, 0, -4.905 * (0.01 * f) ** 2) for f in range(6)])
    early = replace(right, time_ns=right.time_ns - 4_000_000)
    assert pair(right, falling(), SPACE).distance_m.max() == 0.0
    # at t - 4 ms the marker was g (4 ms) (t - 2 ms) higher
    at = 0.01 * np.arange(6)
    assert pair(early, falling(), SPACE).distance_m == pytest.approx(9.81 * 0.004 * np.abs(at - 0.002), abs=1e-12)


def test_beside_an_unknown_instant_the_truth_is_a_straight_line():
    right = [(f, 0, 0, 0, -4.905 * (0.01 * f) ** 2) for f in (2, 3)]
    late = replace(tracks(right), time_ns=np.array([24_000_000, 34_000_000]))
    found = pair(late, falling(hidden=(1, 5)), SPACE).error_m[:, 2]
    # of the chord between two instants 10 ms apart 0.4 of the way
    chord = [-4.905e-4 * (0.6 * f**2 + 0.4 * (f + 1) ** 2) for f in (2, 3)]
    assert found == pytest.approx([z - c for (*_, z), c in zip(right, chord, strict=True)], abs=1e-12)
    lost = pair(tracks([(2, 0, 0, 0, 0.0)]), falling(hidden=(1, 3)), SPACE)
    assert lost.error_m[:, 2] == pytest.approx([4.905e-4 * 4], abs=1e-12)


def test_errors_of_one_and_two_millimetres():
    rows = [(f, 0, 0.001, 0, 0) for f in range(4)] + [(f, 1, 1.0, 0.002, 0) for f in range(4)]
    m = metrics(pair(tracks(rows), truth(), SPACE), SPACE)
    # rms of 1 and 2 mm: sqrt((1 + 4) / 2) = 1.5811 mm
    assert m["position_rms"].value == pytest.approx(1.5811388e-3)
    assert m["relative_accuracy"].value == pytest.approx(1.5811388e-3 / 2)
    assert m["position_max"].value == pytest.approx(2e-3)
    # chi-square with sigma 1 mm: (1 + 4) / 2
    assert m["nees"].value == pytest.approx(2.5)
    assert m["coverage95"].value == 1.0
    assert m["completeness"].value == 1.0
    assert m["ghosts_per_frame"].value == 0.0
    # similarity 0.95 and 0.9: all alphas up to 0.90 see both, 0.95 at most the better one of the two
    assert m["hota"].value < 1.0
    assert metrics(pair(tracks(both(dx=0.0005)), truth(), SPACE), SPACE)["hota"].value == pytest.approx(1.0)
    assert m["reprojection_rms"].value == pytest.approx(0.1)


def test_beyond_the_gate_is_a_ghost_and_a_miss():
    # gate: min(half of 1 m, 1 % of 2 m) = 20 mm
    rows = both() + [(0, 7, 0.5, 0.5, 0.5)]
    rows[0] = (0, 0, 0.021, 0, 0)
    scored = pair(tracks(rows), truth(), SPACE)
    assert scored.ghosts.tolist() == [2, 0, 0, 0]
    assert scored.missed.tolist() == [1, 0, 0, 0]
    assert metrics(scored, SPACE)["completeness"].value == pytest.approx(7 / 8)


def test_the_gate_is_half_the_smallest_distance_of_true_markers():
    close = truth(markers=((0, 0, 0), (0.01, 0, 0)))
    scored = pair(tracks([(0, 0, 0.0, 0.0051, 0)]), close, SPACE)
    assert scored.gate_m[0] == pytest.approx(0.005)
    assert scored.ghosts[0] == 1


def test_unseen_markers_are_no_misses_and_no_ghosts():
    hidden = truth(visible=0.4)
    scored = pair(tracks(both()[:3]), hidden, SPACE)
    assert scored.missed.sum() == 0
    assert scored.ghosts.sum() == 0
    assert metrics(scored, SPACE)["completeness"].value == 1.0


def test_seen_means_half_of_the_disc_in_two_cameras():
    one_camera = truth()
    visible = one_camera.visible.copy()
    visible[:, :, 1:] = 0.49
    half = replace(one_camera, visible=visible)
    assert pair(tracks([]), half, SPACE).seen.sum() == 0
    visible[:, :, 1] = 0.5
    half = replace(one_camera, visible=visible)
    assert pair(tracks([]), half, SPACE).seen.sum() == 8


def test_filled_samples_never_count():
    t = tracks(both())
    filled = replace(t, status=np.full(8, "filled"))
    assert metrics(pair(filled, truth(), SPACE), SPACE)["completeness"].value == 0.0


def test_identity_switches_and_hota_by_hand():
    rows = both(4, dx=0.0005)
    # the two tracks swap identities after two of four frames
    swapped = [(f, (1 - k) if f >= 2 else k, x, y, z) for f, k, x, y, z in rows]
    scored = pair(tracks(swapped), truth(), SPACE)
    assert identity_switches(scored) == 2
    # each pair (marker, track) is together in 2 frames, each marker and track lasts 4: A = 2 / (4 + 4 - 2) = 1/3
    # detection is perfect at every alpha up to the similarity 1 - 0.5/20 = 0.975
    assert hota(scored) == pytest.approx(np.sqrt(1 / 3), rel=1e-6)


def test_the_assignment_is_the_best_of_all_not_the_first():
    near = truth(frames=1, markers=((0, 0, 0), (0.03, 0, 0)))
    # greedy by order would give the first point the first marker and leave the second without one
    scored = pair(tracks([(0, 0, 0.014, 0, 0), (0, 1, 0.001, 0, 0)]), near, SPACE)
    assert sorted(zip(scored.marker.tolist(), scored.track.tolist(), strict=True)) == [(0, 1)]


def test_a_lost_frame_is_not_a_shift():
    # frame numbers of the tracks start at another pulse than the truth's: time decides
    t = tracks(both())
    moved = replace(t, frame=t.frame + 100)
    assert metrics(pair(moved, truth(), SPACE), SPACE)["completeness"].value == 1.0
    late = replace(t, time_ns=t.time_ns + 6_000_000)
    assert pair(late, truth(), SPACE).ghosts.sum() == 2


def test_no_tracks_at_all():
    m = metrics(pair(tracks([]), truth(), SPACE), SPACE)
    assert m["completeness"].value == 0.0
    assert "position_rms" not in m


def test_interval_holds_the_spread_of_blocks():
    rng = np.random.default_rng(0)
    frames = 400
    rows = [(f, k, k + rng.normal(0, 1e-3), 0, 0) for f in range(frames) for k in (0, 1)]
    m = metrics(pair(tracks(rows), truth(frames), SPACE), SPACE)["position_rms"]
    low, high = m.ci95
    # standard error of an rms of n independent errors: value / sqrt(2 n)
    expected = 1e-3 / np.sqrt(2 * 800)
    assert 0.5 * expected < (high - low) / 3.92 < 2 * expected
    assert low < 1e-3 < high


def test_a_body_that_is_turned_and_off_is_scored_so():
    positions = np.array([[0, 0, 0], [0.3, 0, 0], [0, 0.2, 0], [0, 0, 0.1]])
    body = RigidBody("box", ("m0", "m1", "m2", "m3"), positions)
    there = truth(3, markers=positions + [1.0, 2.0, 3.0])
    # 0.02 rad about z, 3 and 4 mm off
    quaternion = np.tile([np.cos(0.01), 0, 0, np.sin(0.01)], (3, 1))
    poses = BodyPoses(
        np.arange(3), there.time_ns, np.full(3, "box"), quaternion, np.tile([1.003, 2.004, 3.0], (3, 1)),
        np.tile(np.eye(6), (3, 1, 1)), np.full(3, 4), np.zeros(3), np.full(3, "measured"),
    )  # fmt: skip
    found = body_scores(poses, (body,), there)
    assert found["body_angle_rms"].value == pytest.approx(0.02, rel=1e-6)
    assert found["body_position_rms"].value == pytest.approx(5e-3, rel=1e-6)
    assert found["body_completeness"].value == 1.0


def test_an_image_in_which_nothing_was_found_has_no_errors():
    for bounds, true, found in ((2, 2, 0), (0, 0, 3)):
        least, reached = _image_errors(np.ones((bounds, 2, 2)), np.zeros((true, 2)), np.zeros((found, 2)))
        assert len(least) == len(reached) == 0
