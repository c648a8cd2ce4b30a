"""Metrics without ground truth: lengths, rigidity, static noise, residuals, against numbers computed by hand."""

from dataclasses import replace

import numpy as np
import pytest
from track_tables import measured_tracks

from mosca.data.bodies import BodyPoses
from mosca.data.tracks import Tracks
from mosca.errors import InputError
from scenarios.score.without_truth import about_own_mean, lengths_found, self_checks
from scenarios.spec.catalog import find
from scenarios.spec.scenario import LengthSpec, load_scenario

BAR = LengthSpec(name="bar", length_m=0.4)
RNG = np.random.default_rng(4)


def tracks_of(places, labels=None, first=0):
    """places: track number -> (n, 3), NaN where it is not seen."""
    rows = [(f, k, *xyz) for k, own in places.items() for f, xyz in enumerate(own) if np.isfinite(xyz).all()]
    table = np.array(rows)
    frame, track = table[:, :2].astype(int).T
    label = np.array([(labels or {}).get(k, "") for k in track.tolist()])
    return measured_tracks(frame + first, track, table[:, 2:], label=label, sigma_m=1e-4)


def waved(n, length, seed=0):
    """Both ends (n, 3) of a bar that is moved and rotated."""
    rng = np.random.default_rng(seed)
    middle = np.cumsum(rng.normal(0, 0.01, (n, 3)), axis=0)
    along = np.cumsum(rng.normal(0, 0.2, (n, 3)), axis=0) + [3.0, 0, 0]
    along *= np.broadcast_to(np.asarray(length), (n,))[:, None] / (2 * np.linalg.norm(along, axis=1)[:, None])
    return middle - along, middle + along


def test_a_bar_is_found_among_others_and_measured():
    true = 0.4 + 1e-4 * np.sin(np.arange(100))
    a, b = waved(100, true)
    passing = b + np.linspace(-1, 1, 100)[:, None] * [0.3, 0.2, 0.1]
    frame, distance, note = lengths_found(tracks_of({3: a, 7: b, 9: passing, 11: passing + 5}), BAR)
    np.testing.assert_array_equal(frame, np.arange(100))
    np.testing.assert_allclose(distance, true, atol=1e-12)
    assert note == ""


def test_a_measurement_far_off_is_not_left_out_of_its_own_bar():
    a, b = waved(100, 0.4)
    b[50] = a[50] + [0.43, 0, 0]
    _, distance, _ = lengths_found(tracks_of({3: a, 7: b}), BAR)
    assert distance.max() == pytest.approx(0.43)


def test_a_bar_whose_track_begins_anew_is_still_one():
    a, b = waved(100, 0.4)
    before, after = b.copy(), b.copy()
    before[40:] = np.nan
    after[:45] = np.nan
    frame, _, note = lengths_found(tracks_of({1: a, 2: before, 3: after}), BAR)
    assert (len(frame), note) == (95, "")


def test_two_bars_at_once_cannot_be_told_apart_unless_they_are_named():
    a, b = waved(60, 0.4)
    c, d = waved(60, 0.401, seed=5)
    c[30:] = np.nan
    labels = {0: "bar/1", 1: "bar/2"}
    found = tracks_of({0: a, 1: b, 2: c + 4, 3: d + 4}, labels)
    frame, _, note = lengths_found(found, BAR)
    np.testing.assert_array_equal(frame, np.arange(30, 60))
    assert "in 30 of 60 frames several pairs of markers are 0.4 m apart" in note
    frame, distance, note = lengths_found(found, LengthSpec(name="x", length_m=0.4, markers=("bar/1", "bar/2")))
    assert (len(frame), note) == (60, "")
    np.testing.assert_allclose(distance, 0.4, atol=1e-12)


@pytest.mark.parametrize(
    ("given", "told"),
    [
        (BAR, "length 'bar': no two markers stay 0.4 m apart"),
        (LengthSpec(name="x", length_m=0.4, markers=("a", "b")), "length 'x': a and b were not seen together"),
    ],
)
def test_a_length_that_is_not_there_is_said(given, told):
    a, b = waved(60, 0.5)
    frame, _, note = lengths_found(tracks_of({0: a, 1: b}), given)
    assert (len(frame), note) == (0, told)


def test_still_markers_scatter_by_what_was_put_on_them():
    noise = RNG.normal(0, 1e-4, (4, 500, 3))
    frame, away = about_own_mean(tracks_of({k: noise[k] + k for k in range(4)} | {9: noise[0, :5]}))
    assert len(frame) == 2000  # five samples alone are no scatter
    assert np.sqrt(np.mean(away**2)) == pytest.approx(np.sqrt(3) * 1e-4, rel=0.03)


def scores_of(limits, tracks, poses=None, **more):
    spec = load_scenario(find("rigs/wand_lengths"))
    return self_checks(spec.model_copy(update={"limits": limits, **more}), tracks, poses, SECONDS, 100)


SECONDS = {"latency_p99": 0.004, "frames_to_tracks": 2.0}


def test_scores_and_what_each_is_made_of():
    a, b = waved(100, 0.4002)
    tracks = tracks_of({0: a, 1: b}, first=1000)
    tracks = replace(tracks, residual_px=np.where(tracks.track == 0, 0.3, 0.4))
    scores, notes = scores_of({"length_rms": 1.0}, tracks, length=(BAR,))
    assert set(scores) == {"reprojection_rms", "length_rms", "length_max"}
    assert notes == []
    assert scores["length_rms"].value == pytest.approx(2e-4)
    assert scores["length_max"].value == pytest.approx(2e-4)
    assert scores["reprojection_rms"].value == pytest.approx(np.sqrt(0.125))
    assert len(scores["length_rms"].sums) == 40
    timed, _ = scores_of({"latency_p99": 1.0, "frame_rate": 1.0, "static_noise": 1.0}, tracks, length=())
    assert timed["latency_p99"].value == 0.004
    assert timed["frame_rate"].value == 50.0
    assert timed["static_noise"].value > 0.05  # it was waved


def test_rigidity_is_of_measured_poses_alone():
    n = 4
    poses = BodyPoses(
        np.arange(n), np.arange(n), np.full(n, "b"), np.zeros((n, 4)), np.zeros((n, 3)), np.zeros((n, 6, 6)),
        np.full(n, 4), np.array([3e-4, 4e-4, 9.0, np.nan]),
        np.array(["measured", "measured", "withheld", "measured"]),
    )  # fmt: skip
    a, _ = waved(30, 0.4)
    scores, _ = scores_of({"rigidity_rms": 1.0}, tracks_of({0: a}), poses, length=())
    assert scores["rigidity_rms"].value == pytest.approx(np.sqrt(12.5e-8))
    assert scores["rigidity_rms"].n == 2


def test_nothing_measured_scores_nothing():
    assert scores_of({"length_rms": 1.0}, Tracks.none()) == ({}, [])


@pytest.mark.parametrize(
    ("override", "told"),
    [
        ("length=[]", r"limits\.length_rms needs a \[\[length\]\]"),
        ("limits.rigidity_rms=0.001", r"limits\.rigidity_rms needs rigid bodies; set pipeline\.bodies"),
        ("length=[{name='a', length_m=-1.0}]", "length_m"),
    ],
)
def test_claims_that_cannot_be_judged_are_refused_before_the_run(override, told):
    with pytest.raises(InputError, match=told):
        load_scenario(find("rigs/wand_lengths"), (override,))
