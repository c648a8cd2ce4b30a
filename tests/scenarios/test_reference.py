"""A user's own reference: read, interpolated, scored against; what it cannot judge is reported."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from track_tables import measured_tracks

from mosca.data.rig import Rig
from mosca.errors import InputError
from mosca.synchronisation import Assembly
from scenarios.run.record import record_of
from scenarios.score.reference import read_reference, read_reference_csv, requested_truth
from scenarios.score.score_run import scored
from scenarios.spec.catalog import find
from scenarios.spec.scenario import load_scenario
from scenarios.types import Collected, MeasuredTracks, RunOptions, Score

STEP_NS = 10_000_000


def written(path, rows, header="label,time_ns,x,y,z"):
    path.write_text(header + "\n" + "".join(",".join(map(str, row)) + "\n" for row in rows))
    return path


def wave(t_s, k=0):
    return np.column_stack([np.sin(3 * t_s + k), np.cos(2 * t_s) + k, 0.2 * t_s])


def test_it_is_interpolated_between_instants_and_never_over_a_gap(tmp_path):
    own = np.r_[0:50, 60:100] * 4_000_000
    rows = [("a", t, *xyz) for t, xyz in zip(own, wave(own * 1e-9), strict=True)]
    np.random.default_rng(1).shuffle(rows)
    given_ns = np.arange(-1, 42) * STEP_NS + 1_234_567
    truth = read_reference_csv(written(tmp_path / "truth.csv", rows)).at(given_ns)
    ms = given_ns * 1e-6
    there = (ms >= 0) & (ms <= 196) | (ms >= 240) & (ms <= 396)
    np.testing.assert_array_equal(np.isfinite(truth.xyz[:, 0]).all(axis=1), there)
    np.testing.assert_allclose(truth.xyz[there, 0], wave(given_ns[there] * 1e-9), atol=2e-7)
    assert truth.names == ("a",)


def test_points_that_never_move_need_no_time(tmp_path):
    path = written(tmp_path / "truth.csv", [("a", 0, 1, 2, 1e-4), ("b", 1, 1, 2, 3e-4)], "label,x,y,z,sigma_m")
    found = read_reference_csv(path)
    truth = found.at(np.array([5, 10**12]))
    np.testing.assert_array_equal(truth.xyz, [[[0, 1, 2], [1, 1, 2]]] * 2)
    np.testing.assert_allclose(found.share(None)(np.zeros((2, 3))), [5e-8 * np.eye(3)] * 2)
    np.testing.assert_allclose(
        found.share(lambda p: np.ones((len(p), 3, 3)))(np.zeros((1, 3)))[0, 0], [1 + 5e-8, 1, 1]
    )


def test_a_tracks_file_of_another_system_serves(tmp_path):
    header = "frame,time_ns,track,label,x,y,z,sxx,syy,szz,sxy,sxz,syz,n_cameras,residual_px,status"
    rows = [(k, k * STEP_NS, 1, "a", k, 0, 0, *[""] * 6, "", "", "measured") for k in range(4)]
    rows[2] = (2, 2 * STEP_NS, 1, "a", *[""] * 9, "", "", "measured")
    truth = read_reference_csv(written(tmp_path / "t.csv", rows, header)).at(np.array([STEP_NS]))
    np.testing.assert_allclose(truth.xyz[0, 0], [1, 0, 0])


@pytest.mark.parametrize(
    ("header", "rows", "told"),
    [
        ("label,x,y", [], "lacks the column 'z'; a truth.csv has label, x, y, z, and may have time_ns, sigma_m"),
        ("label,x,x,y,z", [], "has more than one of the column 'x'"),
        ("label,x,y,z", [], "no row is in it"),
        ("label,x,y,z", [("a", 1, 2)], "row 2: 3 values given, 4 wanted"),
        ("label,x,y,z", [("a", 1, 2, 3), ("", 1, 2, 3)], "row 3: label is empty"),
        ("label,x,y,z", [("a", 1, "zwei", 3)], "row 2: y = 'zwei'; a number or nothing is wanted"),
        ("label,x,y,z", [("a", 1, "", 3)], "row 2: x, y, z: three numbers are wanted, or none"),
        ("label,x,y,z", [("a", 1, "inf", 3)], "row 2: x, y, z: three numbers"),
        ("label,x,y,z", [("a", "", "", "")], "no row has x, y and z"),
        ("label,x,y,z", [("a", 1, 2, 3), ("a", 1, 2, 4)], "marker 'a' stands twice; leave one, or add a column"),
        ("label,time_ns,x,y,z", [("a", 7, 1, 2, 3), ("a", 7, 1, 2, 4)], "marker 'a' stands twice at 7 ns; leave one"),
        ("label,time_ns,x,y,z", [("a", 0.5, 1, 2, 3)], "row 2: time_ns = '0.5'; a whole number"),
        ("label,x,y,z,sigma_m", [("a", 1, 2, 3, -1)], "row 2: sigma_m: a number of 0 or more"),
        ("label,x,y,z,sigma_m", [("a", 1, 2, 3, "")], "row 2: sigma_m: a number of 0 or more"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_told_with_its_row(tmp_path, header, rows, told):
    with pytest.raises(InputError) as error:
        read_reference_csv(written(tmp_path / "truth.csv", rows, header))
    assert told in str(error.value)
    assert str(error.value).startswith(str(tmp_path / "truth.csv"))


def told(path):
    """Return what is wrong with a file, nothing where it can be read."""
    try:
        read_reference_csv(path)
    except InputError as error:
        return str(error)
    return ""


@given(data=st.one_of(st.binary(max_size=200), st.text("label,xyz\n0123456789.-e\"'", max_size=200).map(str.encode)))
@settings(max_examples=150, deadline=None)
def test_any_bytes(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("any") / "truth.csv"
    path.write_bytes(b"label,x,y,z\n" + data)
    assert "\n" not in told(path)


def test_what_lies_beside_a_recording_is_taken(tmp_path):
    assert requested_truth(RunOptions(source=f"recording:{tmp_path}")) is None
    written(tmp_path / "truth.csv", [("a", 0, 1, 2)], "label,x,y,z")
    assert requested_truth(RunOptions(source=f"recording:{tmp_path}")).names == ("a",)
    assert requested_truth(RunOptions(source=f"hardware:{tmp_path}")) is None
    with pytest.raises(InputError, match=r"suffix '\.txt' given; a truth is a \.npz .* or a \.csv"):
        read_reference(tmp_path / "truth.txt")


def measured(shift_m=0.0, seed=3):
    """Tracks of two markers on waves, with noise of 0.1 mm as stated, ``shift_m`` off."""
    rng = np.random.default_rng(seed)
    frame = np.repeat(np.arange(200), 2)
    track = np.tile([4, 8], 200)
    xyz = np.where((track == 4)[:, None], wave(frame * 0.01), wave(frame * 0.01, 2)) + rng.normal(0, 1e-4, (400, 3))
    tracks = measured_tracks(frame, track, xyz + [shift_m, 0, 0], sigma_m=1e-4)
    collected = Collected(tracks, (), 0, Assembly(), {}, {})
    return MeasuredTracks(collected, Rig(()), (), lambda: tracks)


SPEC = load_scenario(find("rigs/wand_lengths")).model_copy(
    update={"limits": {"position_rms": 0.0003, "reprojection_rms": 0.2, "completeness": 0.9}}
)


@pytest.fixture
def given_truth(tmp_path):
    own = np.arange(-5, 1000) * 2_500_000 + 300
    rows = [
        (name, t, *xyz) for k, name in ((0, "a"), (2, "b")) for t, xyz in zip(own, wave(own * 1e-9, k), strict=True)
    ]
    return read_reference_csv(written(tmp_path / "truth.csv", rows))


def test_noise_is_measured_and_a_shift_is_seen(given_truth):
    worth = scored(SPEC, "s", measured(), given_truth, None, None)
    assert worth.scores["position_rms"].value == pytest.approx(np.sqrt(3) * 1e-4, rel=0.06)
    assert worth.scores["nees"].value == pytest.approx(3.0, abs=0.4)
    assert worth.scores["identity_switches"].value == 0
    assert set(worth.scores).isdisjoint({"completeness", "ghosts_per_frame", "hota"})
    assert worth.not_judged == ("completeness",)
    off = scored(SPEC, "s", measured(1e-3), given_truth, None, None)  # the control
    assert off.scores["position_rms"].value == pytest.approx(1e-3, rel=0.05)


def test_a_reference_in_another_frame_says_so(given_truth):
    run = measured(0.5)
    worth = scored(SPEC, "s", run, given_truth, None, None)
    assert "position_rms" not in worth.scores
    assert "no measured point lies within 10 mm" in run.collected.assembly.notes["reference"]


class NoGap:
    gap_rms_px = gap_max_px = 0.0


@pytest.mark.parametrize(
    ("truth", "not_judged", "limits", "verdict", "passed"),
    [
        (False, ("position_rms", "completeness"), SPEC.limits,
         "met: reprojection_rms; not judged, for want of a truth: position_rms, completeness", False),
        (True, ("completeness",), SPEC.limits,
         "met: position_rms, reprojection_rms; not judged, for want of a truth: completeness", False),
        (False, ("position_rms",), {"position_rms": 1.0}, "not judged, for want of a truth: position_rms", False),
        (False, (), {"reprojection_rms": 0.2}, "every limit is met", True),
        (False, ("position_rms",), {"reprojection_rms": 0.01, "position_rms": 1.0},
         "broken: reprojection_rms; not judged, for want of a truth: position_rms", False),
    ],
)  # fmt: skip
def test_what_cannot_be_judged_does_not_pass(given_truth, truth, not_judged, limits, verdict, passed):
    spec = SPEC.model_copy(update={"limits": limits})
    run = measured()
    worth = scored(spec, "s", run, given_truth if truth else None, None, None)
    assert worth.not_judged == not_judged
    scores = {"reprojection_rms": Score(0.1, 400), **worth.scores}
    record = record_of(spec, "s", "recording:x", replace(worth, scores=scores), {}, NoGap())
    assert (record.verdict, record.passed) == (verdict, passed)
    assert record.not_judged == not_judged


def test_a_wide_table_is_a_reference(tmp_path):
    path = tmp_path / "truth.csv"
    path.write_text("time,a.x,a.y,a.z,b.x,b.y,b.z\n0.0,0,1,2,,,\n0.5,1,1,2,5,6,7\n")
    found = read_reference(path)
    assert found.names == ("a", "b")
    assert [one.tolist() for one in found.time_ns] == [[0, 500_000_000], [500_000_000]]
    np.testing.assert_allclose(found.at(np.array([250_000_000])).xyz[0, 0], [0.5, 1, 2])
    path.write_text("time,a.x,a.y\n0.0,0,1\n")
    with pytest.raises(InputError, match=r"time,NAME\.x,NAME\.y,NAME\.z"):
        read_reference(path)
