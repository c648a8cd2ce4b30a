"""Acceptance tests of tracks: errors of known artefacts, decisions at the limit, premises, latency."""

import numpy as np
import pytest
from acceptance_takes import (
    NAMES,
    OFF,
    bar_file,
    bar_places,
    cluster_file,
    cluster_places,
    lines,
    seven_lines,
    tracks_of,
)
from scipy.integrate import quad
from scipy.stats import binom

from mosca.accuracy.acceptance.artefact import read_acceptance
from mosca.accuracy.acceptance.decision import decided, overall
from mosca.accuracy.acceptance.evaluate import accept_tracks
from mosca.accuracy.acceptance.latency import ResultArrivals, latency_result, read_arrivals
from mosca.accuracy.acceptance.series import sigma_of_mean
from mosca.errors import InputError


@pytest.mark.parametrize(("error", "limit", "sigma"), [(0.0, 2.0, 1.0), (0.9, 1.0, 0.2), (-1.3, 1.0, 0.2), (3, 1, 2)])
def test_the_probability_is_the_normal_density_between_the_limits(error, limit, sigma):
    density = quad(
        lambda x: np.exp(-(((x - error) / sigma) ** 2) / 2) / (sigma * np.sqrt(2 * np.pi)),
        -limit,
        limit,
        epsabs=1e-13,
    )[0]
    assert decided(error, limit, sigma).probability == pytest.approx(density, abs=1e-10)


def test_the_guard_band_is_two_standard_uncertainties_wide():
    # at the acceptance limit 2.275 % of the density lie beyond the limit
    at = decided(0.6, 1.0, 0.2)
    assert (at.decision, at.expanded) == ("conforming", 0.4)
    assert at.probability == pytest.approx(1 - 0.0227501319, abs=1e-9)
    assert [decided(e, 1.0, 0.2).decision for e in (-0.59, 0.61, 1.0, -1.39, 1.41, -1.41)] == [
        "conforming", "undecided", "undecided", "undecided", "not conforming", "not conforming"
    ]  # fmt: skip
    assert decided(0.0, 0.1, 0.2).decision == "undecided"
    assert [decided(e, 1.0, 0.0).probability for e in (1.0, 1.1)] == [1.0, 0.0]


def test_the_whole_is_as_its_parts():
    assert overall(["conforming", "conforming"]) == "conforming"
    assert overall(["conforming", "undecided"]) == "undecided"
    assert overall(["undecided", "not conforming"]) == "not conforming"
    assert overall([]) == "undecided"


def test_the_uncertainty_of_a_mean():
    rng = np.random.default_rng(5)
    values = rng.normal(0, 2e-4, 400)
    # independent values: the scatter over the root of their number, and not less than what is stated
    assert sigma_of_mean(values, np.full(400, 1e-10)) == pytest.approx(values.std(ddof=1) / 20, rel=0.15)
    assert sigma_of_mean(values, np.full(400, 1e-6)) == pytest.approx(1e-3 / 20)
    assert sigma_of_mean(values[:1], np.array([4e-8])) == pytest.approx(2e-4)
    assert sigma_of_mean(values, np.full(400, np.nan)) == pytest.approx(values.std(ddof=1) / 20, rel=0.15)
    # values of an AR(1) with 0.8: the mean is 3 times less sure, (1 + 0.8) / (1 - 0.8) in the square
    wander = np.zeros(4000)
    steps = rng.normal(0, 1, 4000)
    for k in range(1, 4000):
        wander[k] = 0.8 * wander[k - 1] + steps[k]
    assert sigma_of_mean(wander, np.full(4000, 1e-9)) == pytest.approx(1 / 0.2 / np.sqrt(4000), rel=0.2)


def test_lengths_of_a_rig_whose_scale_is_off():
    result = accept_tracks(seven_lines(1.0005), bar_file(), None, "take").lengths
    assert result.decision == "not conforming"
    assert len(result.errors) == 35
    for one in result.errors:
        assert one.error_m == pytest.approx(0.0005 * one.calibrated_m, abs=1e-9)
        assert one.permitted_m == pytest.approx(min(1e-4 + 1e-4 * one.calibrated_m, 2e-4))
        # two points of 10 um along the line, a mean of 20, and the certificate
        assert one.sigma_m == pytest.approx(np.hypot(np.sqrt(2) * 1e-5 / np.sqrt(20), 1e-6), rel=1e-6)
    assert result.share == pytest.approx(0.0006 / 2e-4)
    assert all(premise.met for premise in result.premises)


@pytest.mark.parametrize(
    ("scale", "decision"), [(1.00005, "conforming"), (1.00016, "undecided"), (0.9998, "not conforming")]
)
def test_decisions_on_lengths(scale, decision):
    # at 1.2 m 0.06, 0.192 and -0.24 mm; 0.2 mm are permitted, the expanded uncertainty is 21 um
    assert accept_tracks(seven_lines(scale), bar_file(sigma_m=1e-5), None, "take").decision == decision


def test_a_wrong_certificate_is_found():
    bar = bar_file().model_dump()["bar"]
    bar[0]["length"][-1]["length_m"] = 1.2005
    result = accept_tracks(seven_lines(), bar_file(bar=bar), None, "take").lengths
    wrong = [one for one in result.errors if one.decided.decision != "conforming"]
    assert {one.markers for one in wrong} == {("b0", "b5")}
    assert all(one.error_m == pytest.approx(-0.0005) for one in wrong)


def test_too_few_lines_decide_nothing():
    result = accept_tracks(seven_lines(), bar_file(count=6), None, "take").lengths
    assert result.decision == "undecided"
    assert [one.met for one in result.premises] == [False, True, False, True]
    # and broken limits are told all the same
    assert accept_tracks(seven_lines(1.001), bar_file(count=6), None, "take").decision == "not conforming"


def test_one_line_measured_seven_times_is_one_line():
    places = np.repeat(lines()[0][None], 140, axis=0)
    result = accept_tracks(tracks_of(places, names=[f"b{k}" for k in range(6)]), bar_file(), None, "take").lengths
    assert result.premises[0].text.startswith("1 different measuring lines")
    assert result.decision == "undecided"


def test_lines_that_avoid_the_corners_or_are_short_decide_nothing():
    middle = tracks_of(np.repeat(np.stack(lines()) * 0.4, 20, axis=0) / 0.4 * 0.3, names=[f"b{k}" for k in range(6)])
    bar = bar_file().model_dump()["bar"]
    for one in bar[0]["length"]:
        one["length_m"] *= 0.3
    result = accept_tracks(middle, bar_file(bar=bar), None, "take").lengths
    assert [one.met for one in result.premises] == [True, False, False, True]
    assert result.decision == "undecided"


def test_a_ball_that_is_hidden_leaves_its_length_unmeasured():
    kept = np.ones((140, 6), bool)
    kept[20:40, 5] = False
    result = accept_tracks(seven_lines(kept=kept), bar_file(), None, "take").lengths
    gone = [one for one in result.errors if one.error_m is None]
    assert [(one.line, one.markers, one.samples) for one in gone] == [("line 1", ("b0", "b5"), 0)]
    assert result.decision == "undecided"
    assert not result.complete


def test_the_scatter_at_rest():
    result = accept_tracks(
        seven_lines(noise_m=1e-4, per_line=400), bar_file(per_line=400, probing={"spread_m": 2e-3}), None, "take"
    ).lengths
    # 3D distances of normal errors from the mean
    assert result.spread.rms_m == pytest.approx(np.sqrt(3) * 1e-4, rel=0.02)
    assert result.spread.decided.decision == "conforming"
    tight = bar_file(per_line=400, probing={"spread_m": 2e-4})
    assert accept_tracks(seven_lines(noise_m=1e-4, per_line=400), tight, None, "take").decision == "not conforming"


def test_tracks_without_labels_are_named_by_the_artefact():
    places = np.stack(
        [np.vstack([line, line[0] + OFF[0] * _unit(line) + OFF[1] * _across(line)]) for line in lines()]
    )
    own = np.vstack([np.outer([0, 0.15, 0.4, 0.7, 0.95, 1.2], [1, 0, 0]), OFF])
    body = {"name": "bar", "markers": [f"b{k}" for k in range(7)], "positions_m": own.tolist(), "sigma_m": 1e-5}
    take = tracks_of(np.repeat(places, 20, axis=0) * 1.0001)
    result = accept_tracks(take, bar_file(body=[body]), None, "take").lengths
    assert [one.error_m for one in result.errors] == pytest.approx([1e-4 * e.calibrated_m for e in result.errors])
    with pytest.raises(InputError, match=r"take: no marker of the artefact is among the labels \(none\)"):
        accept_tracks(take, bar_file(), None, "take")


def _unit(line):
    return (line[-1] - line[0]) / np.linalg.norm(line[-1] - line[0])


def _across(line):
    across = np.cross(_unit(line), [0.3, 0.5, 0.8])
    return across / np.linalg.norm(across)


def test_clusters_that_stand_off_by_a_known_pose():
    frames = 7 * 60
    limits = {"distance_rms_m": 2e-4, "distance_max_m": 5e-5, "angle_rms_deg": 0.2, "missing": 0.01}
    given = cluster_file(frames, limits)
    result = accept_tracks(tracks_of(cluster_places(frames, 1e-4, 0.15), names=NAMES), given, None, "take").clusters
    found = {(one.group, one.quantity, one.statistic): one for one in result.figures}
    assert found["dynamic", "distance", "rms"].value == pytest.approx(1e-4, rel=1e-4)
    assert found["dynamic", "distance", "p997"].value == pytest.approx(1e-4, rel=1e-4)
    assert found["dynamic", "angle", "max"].value == pytest.approx(0.15, rel=1e-4)
    assert found["dynamic", "angle", "rms"].sigma == pytest.approx(0.001, rel=1e-3)
    assert found["static", "distance", "p997"].value is None
    assert found["dynamic", "frames", "missing"].value == 0.0
    assert [found["dynamic", "distance", n].decided.decision for n in ("rms", "max")] == [
        "conforming",
        "not conforming",
    ]
    assert result.decision == "not conforming"
    assert all(one.met for one in result.premises)
    assert result.share == pytest.approx(2.0, rel=1e-3)


def test_statistics_of_clusters_beside_numpy():
    frames = 7 * 100
    given = cluster_file(frames, {"distance_rms_m": 1e-3})
    kept = np.ones((frames, 8), bool)
    kept[210:230, :3] = False  # one marker is left of four: no pose
    take = tracks_of(cluster_places(frames), 5e-5, 5e-5, names=NAMES, kept=kept)
    result = accept_tracks(take, given, None, "take").clusters
    found = {(one.group, one.quantity, one.statistic): one for one in result.figures}
    dynamic = found["dynamic", "distance", "rms"]
    # middles of four markers: 5e-5 / 2 along the bar, two of them
    assert dynamic.value == pytest.approx(np.sqrt(2) * 5e-5 / 2, rel=0.08)
    # the rms of n independent values has a relative uncertainty of 1 / sqrt(2 n)
    assert dynamic.sigma == pytest.approx(np.hypot(3e-6, dynamic.value / np.sqrt(2 * 580)), rel=0.1)
    assert dynamic.samples == 580
    assert found["dynamic", "frames", "missing"].value == pytest.approx(20 / 600)
    # stated beside the largest error: that of its sample
    largest = found["dynamic", "distance", "max"]
    assert largest.sigma == pytest.approx(np.hypot(3e-6, np.sqrt(2) * 5e-5 / 2), rel=0.05)


def test_uncertainties_do_not_depend_on_the_artefacts_frame():
    frames = 7 * 20
    take = tracks_of(cluster_places(frames), 5e-5, 5e-5, names=NAMES)
    found = [
        accept_tracks(take, cluster_file(frames, origin=origin), None, "take").clusters
        for origin in ((0, 0, 0), (0.2, 1.0, -0.7))
    ]
    for one, other in zip(*(result.figures for result in found), strict=True):
        assert (one.value is None) == (other.value is None)
        if one.value is not None:
            assert one.value == pytest.approx(other.value, rel=1e-4, abs=1e-9)
            assert one.sigma == pytest.approx(other.sigma, rel=1e-3)


def test_clusters_that_are_not_300_mm_apart_decide_nothing():
    frames = 7 * 60
    given = cluster_file(frames, {"distance_rms_m": 1e-3})
    shift = np.array([0.02, 0.0, 0.0])
    left, right = given.body
    right = right.model_copy(update={"positions_m": tuple(map(tuple, np.array(right.positions_m) + shift))})
    places = cluster_places(frames, 0.02)
    result = accept_tracks(
        tracks_of(places, names=NAMES), given.model_copy(update={"body": (left, right)}), None, "take"
    ).clusters
    assert [one.met for one in result.premises] == [True, True, True, True, False]
    assert result.decision == "undecided"
    assert result.figures[0].value == pytest.approx(0.0, abs=1e-9)


def test_the_percentile_is_the_right_order_statistic():
    from mosca.accuracy.acceptance.clusters import _statistic

    values = np.random.default_rng(2).permutation(np.arange(1.0, 1001.0))
    assert _statistic("p997", values, np.zeros(1000), 0.0)[0] == 997.0
    assert _statistic("p997", values[:334], np.zeros(334), 0.0)[0] == np.sort(values[:334])[-2]
    assert _statistic("p997", values[:333], np.zeros(333), 0.0) == (None, None)


def test_a_bar_that_was_not_shown_at_rest_decides_nothing():
    frames = 7 * 60
    given = cluster_file(frames, {"distance_rms_m": 1e-3})
    clusters = given.clusters.model_copy(update={"path": given.clusters.path[:4]})
    given = given.model_copy(update={"clusters": clusters})
    result = accept_tracks(tracks_of(cluster_places(frames), names=NAMES), given, None, "take").clusters
    assert [one.met for one in result.premises] == [True, False, False, False, True]
    assert result.decision == "undecided"


def test_latency_is_available_less_mid_exposure(tmp_path):
    take = seven_lines()
    rng = np.random.default_rng(4)
    late_ns = rng.permutation(np.arange(140)) * 100_000 + 5_000_000
    lines_ = ["frame,available_ns", *(f"{k},{k * 10_000_000 + late}" for k, late in enumerate(late_ns))]
    path = tmp_path / "arrivals.csv"
    path.write_text("\n".join(lines_) + "\n")
    found = latency_result(take, read_arrivals(path), 0.03, "x")
    # ranks: the 139th of 140 is the 99th percentile
    assert (found.samples, found.p99_s, found.max_s) == (140, pytest.approx(0.0188), pytest.approx(0.0189))
    assert found.mean_s == pytest.approx(0.005 + 69.5e-4)
    reach = binom.std(140, 0.99)
    assert 0 < found.sigma_p99_s <= (np.ceil(reach) + 1) * 1e-4
    assert found.decided.decision == "conforming"
    told = accept_tracks(take, bar_file(latency={"p99_s": 0.01}), read_arrivals(path), "x")
    assert told.latency.decided.decision == told.decision == "not conforming"
    assert accept_tracks(take, bar_file(latency={"p99_s": 0.01}), None, "x").decision == "undecided"
    with pytest.raises(InputError, match=r"available 0\.1 s before its mid-exposure; both must be of one clock"):
        latency_result(take, ResultArrivals(np.array([10]), np.array([0])), None, "x")
    with pytest.raises(InputError, match="no frame of the tracks is in it"):
        latency_result(take, ResultArrivals(np.array([999]), np.array([0])), None, "x")
    path.write_text("frame,available_ns\n1,2\n1,3\n")
    with pytest.raises(InputError, match="frame 1 stands twice; give each frame once"):
        read_arrivals(path)


def test_tracks_without_covariances_rest_on_their_scatter():
    take = seven_lines(noise_m=1e-4, sigma_m=np.nan, per_line=100)
    result = accept_tracks(take, bar_file(per_line=100), None, "take")
    assert result.lengths.errors[0].sigma_m == pytest.approx(np.sqrt(2) * 1e-4 / 10, rel=0.35)
    assert result.notes[0].startswith("covariances: not told")


GOOD = """
title = "bar"
[volume]
size_m = [1.0, 1.0, 1.0]
[length_error]
A_m = 0.0001
K = 0.0001
B_m = 0.0002
[[bar]]
name = "bar"
[[bar.length]]
markers = ["a", "b"]
length_m = 1.0
sigma_m = 1e-6
[[line]]
name = "one"
bar = "bar"
"""


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("A_m", "A_mm", "unknown key 'length_error.A_mm'; did you mean 'A_m'?"),
        ("K = 0.0001", "K = -1", "key 'length_error.K': -1 given; a number greater than or equal to 0.0 is wanted"),
        ('["a", "b"]', '["a", "a"]', "markers: 'a' given twice; two different ones are wanted"),
        ('bar = "bar"', 'bar = "rod"', "line 'one': bar = 'rod' given; there are 'bar'"),
        ('name = "bar"', 'name = "bar"\nused_in_calibration = true', "'bar' set the scale of the calibration"),
        ('bar = "bar"', 'bar = "bar"\ntime_s = [2.0, 1.0]', "time_s = [2, 1] given; the earlier time first"),
        ("[length_error]\nA_m = 0.0001\nK = 0.0001\nB_m = 0.0002", "", "[[line]] needs [length_error]"),
        ('[[line]]\nname = "one"\nbar = "bar"', "", "neither [[line]] nor [clusters] given"),
        ("length_m = 1.0", "length_m = 0.0", "a number greater than 0.0 is wanted"),
    ],
)
def test_wrong_acceptance_files_are_told_in_one_line(tmp_path, old, new, told):
    path = tmp_path / "a.acceptance"
    path.write_text(GOOD)
    assert read_acceptance(path).line[0].name == "one"
    assert old in GOOD
    path.write_text(GOOD.replace(old, new))
    with pytest.raises(InputError) as error:
        read_acceptance(path)
    assert told in str(error.value)
    assert str(error.value).startswith(f"{path}: ")
    assert "\n" not in str(error.value)


def test_clusters_that_are_alike_are_refused(tmp_path):
    path = tmp_path / "a.acceptance"
    body = "\n".join(
        f'[[body]]\nname = "{name}"\nmarkers = ["{name}1", "{name}2", "{name}3"]\n'
        "positions_m = [[0, 0, 0], [0.1, 0, 0], [0, 0.15, 0]]"
        for name in "lr"
    )
    path.write_text(
        'title = "c"\n[volume]\nsize_m = [1, 1, 1]\n[clusters]\nleft = "l"\nright = "r"\ndistance_sigma_m = 0\n'
        'angle_sigma_deg = 0\n[[clusters.path]]\npath = "p"\norientation = "x"\n' + body
    )
    with pytest.raises(InputError, match=r"key 'body': "):
        read_acceptance(path)


def test_a_bar_on_a_line_reaches_into_a_corner():
    assert np.abs(bar_places(np.array([-0.48, -0.48, -0.48]))[0]).max() == 0.48
