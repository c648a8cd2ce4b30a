"""Operations on tracks against closed forms and hand numbers; what cannot be done is refused in one line."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mosca.data.tracks import Tracks
from mosca.editing.edit_file import TRACK_OPERATIONS, read_track_edits
from mosca.editing.fill_gaps import FillGaps
from mosca.editing.low_pass import low_pass
from mosca.editing.marker_operations import (
    DeleteSamples,
    FilterTracks,
    OffsetMarkers,
    RenameMarkers,
    SwapLabels,
    TrimTracks,
)
from mosca.editing.operation import EditError, OffsetKeyframe
from mosca.errors import InputError

RATE = 100.0


def take_of(paths, sigma_m=1e-3):
    """Tracks of label -> (t, 3) [m], NaN where a marker is not seen, at 100 Hz."""
    rows = [
        (f, k, name, xyz)
        for k, (name, path) in enumerate(paths.items())
        for f, xyz in enumerate(path)
        if np.isfinite(xyz).all()
    ]
    rows.sort(key=lambda row: row[:2])
    n, frame = len(rows), np.array([row[0] for row in rows])
    return Tracks(
        frame, frame * 10_000_000, [row[1] for row in rows], [row[2] for row in rows], [row[3] for row in rows],
        np.tile(sigma_m**2 * np.eye(3), (n, 1, 1)), np.full(n, 4), np.full(n, 0.1), np.full(n, "measured"),
    )  # fmt: skip


def path_of(tracks, label):
    rows = tracks.label == label
    return tracks.frame[rows], tracks.xyz[rows]


def two(t=40):
    """Two markers: A at x = 0 to 1, B at x = 5; both move along y."""
    y = np.linspace(0, 1, t)
    return take_of({"s:A": np.stack([y, y, 0 * y], 1), "s:B": np.stack([5 + y, y, 0 * y], 1)})


def test_trim_and_delete_keep_the_frames_that_are_said():
    take = two()
    kept = TrimTracks((10, 19)).apply(take)
    assert len(kept) == 20
    assert kept.frame.min() == 10
    assert kept.frame.max() == 19
    assert set(kept.time_ns.tolist()) == {f * 10_000_000 for f in range(10, 20)}
    left = DeleteSamples(("A",), (5, 9)).apply(take)
    assert path_of(left, "s:A")[0].tolist() == [*range(5), *range(10, 40)]
    assert len(path_of(left, "s:B")[0]) == 40
    assert set(DeleteSamples(("s:A",)).apply(take).label.tolist()) == {"s:B"}
    assert len(take) == 80


def test_swapped_markers_come_back_with_their_tracks():
    good = two()
    inside = (good.frame >= 20) & (good.frame <= 29)
    bad = replace(
        good,
        label=np.where(inside, np.where(good.label == "s:A", "s:B", "s:A"), good.label),
        track=np.where(inside, 1 - good.track, good.track),
    )
    bad = bad.select(np.lexsort((bad.track, bad.frame)))
    assert np.ptp(path_of(bad, "s:A")[1][:, 0]) > 4  # control: they are swapped
    mended = SwapLabels(("A", "B"), (20, 29)).apply(bad)
    for name in Tracks.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(mended, name), getattr(good, name))


def test_a_swap_of_a_marker_that_is_alone_in_a_frame():
    take = DeleteSamples(("B",), (25, 39)).apply(two())
    swapped = SwapLabels(("A", "B"), (20, 39)).apply(take)
    frames, xyz = path_of(swapped, "s:B")
    assert frames.tolist() == list(range(40))
    assert (xyz[:20, 0] >= 5).all()
    assert (xyz[20:, 0] <= 1).all()
    assert set(swapped.track[swapped.label == "s:B"].tolist()) == {1}


def test_rename_of_a_whole_marker_and_of_a_part():
    take = two()
    named = RenameMarkers({"A": "LKNE"}).apply(take)
    assert set(named.label.tolist()) == {"LKNE", "s:B"}
    np.testing.assert_array_equal(named.track, take.track)
    part = RenameMarkers({"A": "C"}, (30, 39)).apply(take)
    assert path_of(part, "C")[0].tolist() == list(range(30, 40))
    assert set(part.track[part.label == "C"].tolist()) == {2}
    nameless = replace(take, label=np.where(take.track == 1, "", take.label))
    assert set(RenameMarkers({"#1": "B"}).apply(nameless).label.tolist()) == {"s:A", "B"}


def test_offsets_are_blended_held_and_marked():
    take = two()
    keys = (OffsetKeyframe(10, (0.0, 0.0, 0.0)), OffsetKeyframe(20, (0.0, 0.0, 0.02)))
    for blend, quarter in (("smooth", 3 / 16 - 2 / 64), ("linear", 0.25), ("step", 0.0)):
        z = path_of(OffsetMarkers(("A",), keys, blend).apply(replace(take, time_ns=take.time_ns)), "s:A")[1][:, 2]
        np.testing.assert_array_equal(z[:11], 0.0)
        np.testing.assert_array_equal(z[20:], 0.02)
        five = path_of(OffsetMarkers(("A",), (keys[0], OffsetKeyframe(30, (0, 0, 0.02))), blend).apply(take), "s:A")
        assert five[1][15, 2] == pytest.approx(0.02 * quarter, abs=1e-12)
    moved = OffsetMarkers(("A",), keys).apply(take)
    edited = moved.status == "edited"
    assert set(moved.label[edited].tolist()) == {"s:A"}
    assert moved.frame[edited].min() == 11
    assert edited.sum() == 29


@pytest.mark.parametrize("cutoff", [3.0, 8.0, 20.0])
def test_an_oscillation_at_the_cutoff_loses_its_half_power_and_no_phase(cutoff):
    t = np.arange(600) / RATE
    path = np.stack([np.sin(2 * np.pi * cutoff * t + p) for p in (0.0, 1.0, 2.0)], axis=1)
    done = path_of(FilterTracks(cutoff).apply(take_of({"A": path})), "A")[1]
    middle = slice(200, 400)
    np.testing.assert_allclose(done[middle], path[middle] / np.sqrt(2), atol=2e-3)
    slow = np.stack([np.sin(2 * np.pi * 0.05 * cutoff * t)] * 3, axis=1)
    np.testing.assert_allclose(path_of(FilterTracks(cutoff).apply(take_of({"A": slow})), "A")[1], slow, atol=0.02)


@pytest.mark.parametrize("n", [30, 90, 700])
def test_the_covariance_is_that_of_many_filtered_draws(n):
    made = low_pass(12.0, RATE)
    given_m2 = np.linspace(1.0, 4.0, n)
    draws = np.random.default_rng(1).normal(size=(4000, n)) * np.sqrt(given_m2)
    found = made.filtered(draws.T).var(axis=1)
    stated = made.covariance(given_m2)
    assert np.abs(found / stated - 1).max() < 0.15  # 4000 draws: 2.2 % standard error, largest of 700 some 8 %
    assert np.abs(np.mean(found / stated) - 1) < 0.02
    assert (np.abs(found / given_m2 - 1) > 0.15).any()  # control: the unfiltered one is not it


def test_long_runs_have_the_covariance_of_the_whole_sum():
    made = low_pass(12.0, RATE)
    n = 6 * made.memory + 100
    exact = made.filtered(np.eye(n)) ** 2 @ np.linspace(1, 4, n)
    np.testing.assert_allclose(made.covariance(np.linspace(1, 4, n)), exact, rtol=1e-4)


def test_a_filter_stops_at_gaps():
    path = np.random.default_rng(0).normal(size=(60, 3))
    path[30:33] = np.nan
    take = take_of({"A": path, "B": np.zeros((60, 3))})
    done = path_of(FilterTracks(10.0, ("A",)).apply(take), "A")[1]
    alone = path_of(FilterTracks(10.0).apply(take_of({"A": path[:30]})), "A")[1]
    np.testing.assert_array_equal(done[:30], alone)
    np.testing.assert_array_equal(path_of(FilterTracks(10.0, ("A",)).apply(take), "B")[1], 0.0)


def rigid(t=80, gap=slice(40, 50)):
    """Four markers on a body that turns and moves; D is lost in the gap. Returns the tracks and D's true path."""
    s = np.arange(t) / RATE
    turn = np.stack(
        [[np.cos(3 * s), -np.sin(3 * s), 0 * s], [np.sin(3 * s), np.cos(3 * s), 0 * s], [0 * s, 0 * s, 1 + 0 * s]]
    )
    body = {"A": (0.1, 0, 0), "B": (0, 0.1, 0), "C": (0, 0, 0.1), "D": (0.1, 0.1, 0.05)}
    paths = {k: np.einsum("ijt,j->ti", turn, v) + np.stack([s, np.sin(5 * s), 0 * s], 1) for k, v in body.items()}
    truth = paths["D"].copy()
    paths["D"][gap] = np.nan
    return take_of(paths, 1e-4), truth


@pytest.mark.parametrize(("cluster", "within_m"), [(("A", "B", "C"), 1e-9), (None, 5e-3)])
def test_a_gap_is_filled_where_the_marker_was(cluster, within_m):
    take, truth = rigid()
    full = FillGaps(("D",), 0.2, cluster).apply(take)
    frames, xyz = path_of(full, "D")
    assert frames.tolist() == list(range(80))
    np.testing.assert_allclose(xyz, truth, atol=within_m)
    new = full.status == "filled"
    assert new.sum() == 10
    assert (full.n_cameras[new] == 0).all()
    assert np.isnan(full.residual_px[new]).all()
    assert np.isfinite(full.covariance[new]).all()
    assert set(full.track[new].tolist()) == {3}
    lengths = len(full) - len(take)
    assert lengths == 10


def test_the_error_of_a_cluster_that_bends_is_measured():
    take, _ = rigid(gap=slice(0, 0))
    rows = take.label == "D"
    xyz = np.array(take.xyz)
    xyz[rows] += np.random.default_rng(2).normal(0, 2e-3, (80, 3))
    lost = DeleteSamples(("D",), (40, 49)).apply(replace(take, xyz=xyz))
    new = FillGaps(("D",), 0.2, ("A", "B", "C")).apply(lost)
    variance = new.covariance[new.status == "filled"][0, 0, 0]
    # the mean of two ends, each 2 mm off, against one 2 mm off: 1.3 to 1.4 times 2 mm
    assert 2e-3 < np.sqrt(variance) < 3.5e-3


@pytest.mark.parametrize(
    ("operation", "key", "told"),
    [
        (TrimTracks((10, 40)), "frames", "[10, 40] given; a first and a last frame from 0 to 39 are wanted"),
        (TrimTracks((20, 10)), "frames", "[20, 10] given"),
        (DeleteSamples(("Q",)), "labels", "'Q' given; there is no such marker; there are s:A, s:B"),
        (SwapLabels(("A", "A")), "labels", "two markers"),
        (RenameMarkers({"A": "s:B"}), "labels", "it has a sample in frame 0 already"),
        (FilterTracks(50.0), "cutoff_hz", "50 given; from 0.233 to below 50, half of the frame rate, is allowed"),
        (FillGaps(("A",)), "labels", "'A' given; it has no gap"),
        (OffsetMarkers(("A",), (OffsetKeyframe(90, (0, 0, 0)),)), "keyframes", "frame 90 given; frames from 0 to 39"),
    ],
)
def test_what_cannot_be_done_names_key_and_value(operation, key, told):
    with pytest.raises(EditError) as error:
        operation.apply(two())
    assert error.value.key == key
    assert told in str(error.value)


@pytest.mark.parametrize(
    ("operation", "key", "told"),
    [
        (FillGaps(("D",), 0.05), "longest_s", "0.05 given; the gaps of 'D' are longer: frames 40 to 49 (0.11 s)"),
        (FillGaps(("D",), 0.2, ("A", "B")), "cluster", "3 or more other markers than 'D' are wanted"),
        (FillGaps(("D",), 0.2, ("A", "B", "D")), "cluster", "3 or more other markers"),
    ],
)
def test_a_gap_that_cannot_be_filled_is_told(operation, key, told):
    with pytest.raises(EditError) as error:
        operation.apply(rigid()[0])
    assert (error.value.key, told in str(error.value)) == (key, True), str(error.value)


def test_a_sample_without_a_position_is_a_gap():
    whole, truth = rigid(gap=slice(0, 0))
    lost = (whole.label == "D") & (whole.frame >= 40) & (whole.frame < 50)
    take = replace(whole, xyz=np.where(lost[:, None], np.nan, whole.xyz))
    frames, xyz = path_of(FillGaps(("D",), 0.2, ("A", "B", "C")).apply(take), "D")
    assert frames.tolist() == list(range(80))
    np.testing.assert_allclose(xyz, truth, atol=1e-9)


def test_a_marker_that_slipped_in_the_gap_is_met_at_both_ends():
    take, truth = rigid()
    slipped = replace(take, xyz=take.xyz + np.where(((take.label == "D") & (take.frame >= 50))[:, None], 0.011, 0.0))
    xyz = path_of(FillGaps(("D",), 0.2, ("A", "B", "C")).apply(slipped), "D")[1]
    turned = np.linalg.norm(xyz - truth, axis=1)[40:50] / np.linalg.norm([0.011] * 3)
    np.testing.assert_allclose(turned, np.arange(1, 11) / 11, atol=1e-9)


def test_a_cluster_in_a_line_fills_nothing():
    take, _ = rigid()
    line = {"A": 0.0, "B": 0.1, "C": 0.25}
    xyz = np.array(take.xyz)
    for name, x in line.items():
        xyz[take.label == name] = [x, 0, 0]
    with pytest.raises(EditError, match="not in a line"):
        FillGaps(("D",), 0.2, ("A", "B", "C")).apply(replace(take, xyz=xyz))


def test_names_that_look_alike_are_suggested():
    take = take_of({"Walker:LKNE": np.zeros((3, 3)), "Walker:RKNE": np.ones((3, 3))})
    with pytest.raises(EditError, match="did you mean 'Walker:LKNE'"):
        DeleteSamples(("LKNEE",)).apply(take)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("[[edit]]\nfiltr = { cutoff_hz = 6 }", "unknown key 'edit[0].filtr'; did you mean 'filter'?"),
        ("[[edit]]\nfoot_lock = {}", "unknown key 'edit[0].foot_lock'"),
        ("[[edit]]\n", "0 operations stand in one [[edit]]; 1 is wanted"),
        ("[[edit]]\ntrim={frames=[1,2]}\ndelete={labels=['A']}", "2 operations stand in one [[edit]]"),
        ("", "key 'edit' is missing"),
        ("edit = []", "key 'edit': [] given; a list of 1 or more is wanted"),
        ("[[edit]]\nfilter = { cutoff_hz = -1 }", "'edit[0].filter.cutoff_hz': -1 given; a number greater than 0"),
        ("[[edit]]\ntrim = { frames = [1] }", "key 'edit[0].trim.frames[1]' is missing"),
        (
            "[[edit]]\noffset = { labels=['A'], keyframes=[{frame=3,xyz_m=[0,0,0]},{frame=3,xyz_m=[0,0,1]}] }",
            "frame 3 follows frame 3; keyframes in rising order, one a frame, are wanted",
        ),
        (
            "[[edit]]\noffset = { labels=['A'], keyframes=[{frame=3,xyz_m=[0,0,1e308]}] }",
            "'edit[0].offset.keyframes[0].xyz_m[2]': 1e+308 given; a number less than or equal to 1000000",
        ),
        ("[[edit]]\nswap = { labels = ['A'] }", "key 'edit[0].swap.labels[1]' is missing"),
        ("kind = 'wand'", "is a target file, not a file of edits"),
    ],
)
def test_a_wrong_file_is_one_line(tmp_path, text, told):
    (tmp_path / "e.toml").write_text(text)
    with pytest.raises(InputError) as error:
        read_track_edits(tmp_path / "e.toml")
    assert told in str(error.value)
    assert str(error.value).startswith(f"{tmp_path / 'e.toml'}: ")


def test_an_edit_that_fails_names_file_number_and_key(tmp_path):
    (tmp_path / "e.toml").write_text("[[edit]]\ntrim={frames=[0,9]}\n[[edit]]\nswap={labels=['A','C']}\n")
    with pytest.raises(
        InputError, match=r"e\.toml: key 'edit\[1\]\.swap\.labels': 'C' given; there is no such marker"
    ):
        read_track_edits(tmp_path / "e.toml").states(two())
    (tmp_path / "e.toml").write_text("[[edit]]\ndelete={labels=['A','B']}\n[[edit]]\ntrim={frames=[0,9]}\n")
    with pytest.raises(InputError, match=r"'edit\[1\]\.trim': no sample is left to edit"):
        read_track_edits(tmp_path / "e.toml").states(two())


@settings(max_examples=40, deadline=None)
@given(
    st.lists(st.tuples(st.integers(0, 39), st.floats(-1, 1)), min_size=1, max_size=5, unique_by=lambda one: one[0]),
    st.sampled_from(["smooth", "linear", "step"]),
)
def test_offsets_pass_through_every_keyframe(keys, blend):
    keys = sorted(keys)
    made = OffsetMarkers(("A",), tuple(OffsetKeyframe(f, (0.0, 0.0, z)) for f, z in keys), blend)
    z = path_of(made.apply(two()), "s:A")[1][:, 2]
    for frame, value in keys:
        assert z[frame] == pytest.approx(value, abs=1e-12)
    values = [value for _, value in keys]
    assert min(values) - 1e-12 <= z.min()
    assert z.max() <= max(values) + 1e-12


def test_every_operation_is_a_frozen_value():
    for operation in TRACK_OPERATIONS.values():
        assert operation.__dataclass_params__.frozen
