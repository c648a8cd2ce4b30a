"""Each operation on a real take, undone: equal to the start to the bit."""

import os
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import tomli_w
from hypothesis import given, settings
from hypothesis import strategies as st

from mosca.data.motion.bvh import read_bvh
from mosca.data.motion.motion import Motion
from mosca.data.tracks import Tracks
from mosca.editing.edit_file import MOTION_OPERATIONS, TRACK_OPERATIONS, read_motion_edits, read_track_edits
from mosca.editing.history import TakeFormat, read_edited, sidecars, write_edited
from mosca.editing.record import change, fingerprint, undone
from mosca.errors import InputError
from mosca.formats.bodies.bvh_writer import write_bvh
from mosca.formats.tracks.tracks_file import read_tracks, write_tracks

DATA = Path(os.environ.get("MOSCA_DATA", Path(__file__).parents[3] / "shared" / "data"))
C3D = DATA / "people/cmu_02_01.c3d"
BVH = DATA / "cmu_mocap/bvh/02/02_03.bvh"
OTHER = DATA / "cmu_mocap/bvh/16/16_01.bvh"
LEG = ["lThigh", "lShin", "lFoot"]
TRACKS = TakeFormat(read_tracks, partial(write_tracks, frame_rate_hz=120.0), read_track_edits)
MOTION = TakeFormat(read_bvh, write_bvh, read_motion_edits)
KEYS = [{"frame": 150, "xyz_m": [0, 0, 0]}, {"frame": 170, "xyz_m": [0, 0, 0.02]}, {"frame": 190, "xyz_m": [0, 0, 0]}]
TURNS = [{"frame": 60, "rotation_vector_deg": [0, 0, 0]}, {"frame": 90, "rotation_vector_deg": [10, 0, 5]}]
LOST = {"delete": {"labels": ["LWRA"], "frames": [200, 209]}}
ON_TRACKS = [
    {"trim": {"frames": [120, 380]}},
    {"swap": {"labels": ["LKNE", "RKNE"], "frames": [200, 230]}},
    {"rename": {"labels": {"LKNE": "knee"}}},
    {"rename": {"labels": {"LKNE": "knee"}, "frames": [200, 230]}},
    {"filter": {"labels": ["LKNE", "LANK"], "cutoff_hz": 12.0}},
    {"offset": {"labels": ["LFIN"], "keyframes": KEYS, "blend": "smooth"}},
    LOST,
    {"fill": {"labels": ["LWRA"], "longest_s": 0.2}},
    {"fill": {"labels": ["LWRA"], "longest_s": 0.2, "cluster": ["LWRB", "LFIN", "LFRM"]}},
]
ON_MOTIONS = [
    {"trim": {"frames": [20, 150]}},
    {"filter": {"cutoff_hz": 10.0}},
    {"rotate": {"joint": "lShin", "keyframes": TURNS}},
    {"foot_lock": {"leg": LEG}},
    {"retarget": {"skeleton": str(OTHER), "feet": ["lFoot"], "joints": {
        "lfemur": "lThigh", "ltibia": "lShin", "lfoot": "lFoot"}}},
]  # fmt: skip


def need(*paths):
    for path in paths:
        if not path.is_file():
            pytest.skip(f"no {path}")


def edits_in(folder, *tables):
    path = folder / "edits.toml"
    path.write_text(tomli_w.dumps({"edit": list(tables)}))
    return path


def equal_to_the_bit(one, other):
    """Return whether all arrays of two takes are the same bytes, types and shapes."""
    if isinstance(one, Motion):
        pairs = [(getattr(one, n), getattr(other, n)) for n in ("root_xyz", "rotations")]
        pairs += [(getattr(one.skeleton, n), getattr(other.skeleton, n)) for n in ("parents", "offsets")]
        names = [(m.skeleton.names, m.skeleton.orders, m.frame_rate_hz) for m in (one, other)]
        if names[0] != names[1]:
            return False
    else:
        pairs = [(getattr(one, n), getattr(other, n)) for n in Tracks.__dataclass_fields__]
    return all(a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes() for a, b in pairs)


def done_and_undone(folder, source, form, out, tables):
    """Edit through files, forget the source, undo all through files; return start, edited take and end."""
    start = form.read(source)
    copy = folder / f"copy{source.suffix}"
    copy.write_bytes(source.read_bytes())
    before = read_edited(copy, form)
    write_edited(before.edited(form.read_edits(edits_in(folder, *tables))), out, form)
    copy.unlink()
    back = read_edited(out, form)
    assert [next(iter(one)) for one in back.edits] == [next(iter(one)) for one in tables]
    return start, back.take, back.undone(len(back.edits)).take


@pytest.mark.data
@pytest.mark.parametrize(
    ("table", "suffix"),
    [*((one, ".npz") for one in ON_TRACKS), (ON_TRACKS[5], ".c3d"), (ON_TRACKS[1], ".trc")],
    ids=lambda one: one if isinstance(one, str) else next(iter(one)),
)
def test_an_operation_on_a_real_take_is_undone_to_the_bit(tmp_path, table, suffix):
    need(C3D)
    tables = [LOST, table] if "fill" in table else [table]
    start, edited, end = done_and_undone(tmp_path, C3D, TRACKS, tmp_path / f"out{suffix}", tables)
    assert not equal_to_the_bit(start, edited)
    assert equal_to_the_bit(start, end)


@pytest.mark.data
@pytest.mark.parametrize("table", ON_MOTIONS, ids=lambda one: next(iter(one)))
def test_an_operation_on_a_real_motion_is_undone_to_the_bit(tmp_path, table):
    need(BVH, OTHER)
    start, edited, end = done_and_undone(tmp_path, BVH, MOTION, tmp_path / "out.bvh", [table])
    assert not equal_to_the_bit(start, edited)
    assert equal_to_the_bit(start, end)


def test_each_operation_stands_in_a_real_take():
    assert {next(iter(one)) for one in ON_TRACKS} == set(TRACK_OPERATIONS)
    assert {next(iter(one)) for one in ON_MOTIONS} == set(MOTION_OPERATIONS)


@pytest.mark.data
def test_some_edits_are_undone_and_others_done_in_their_place(tmp_path):
    need(C3D)
    tables = [one for one in ON_TRACKS if "trim" not in one and "rename" not in one][:3]
    out, again, last = (tmp_path / f"{n}.npz" for n in ("out", "again", "last"))
    done_and_undone(tmp_path, C3D, TRACKS, out, tables)
    one_less = read_edited(out, TRACKS).undone(1)
    states = read_track_edits(edits_in(tmp_path, *tables)).states(read_tracks(C3D))
    assert equal_to_the_bit(one_less.take, states[2])
    write_edited(one_less, again, TRACKS)
    more = read_edited(again, TRACKS).edited(read_track_edits(edits_in(tmp_path, {"trim": {"frames": [100, 300]}})))
    write_edited(more, last, TRACKS)
    found = read_edited(last, TRACKS)
    assert [next(iter(one)) for one in found.edits] == [*(next(iter(one)) for one in tables[:2]), "trim"]
    assert equal_to_the_bit(found.undone(3).take, states[0])
    assert found.source == "copy.c3d"
    write_edited(found.undone(3), last, TRACKS)
    assert not any(one.exists() for one in sidecars(last))


def some_tracks(n=12, seed=0):
    rng = np.random.default_rng(seed)
    return Tracks(
        np.arange(n) // 2, np.arange(n) // 2 * 10**7, np.arange(n) % 2, np.where(np.arange(n) % 2, "B", "A"),
        rng.normal(size=(n, 3)), np.full((n, 3, 3), np.nan), np.full(n, 3), np.full(n, -0.0), np.full(n, "measured"),
    )  # fmt: skip


@settings(max_examples=60, deadline=None)
@given(st.lists(st.integers(0, 11), max_size=20), st.sampled_from(["", "A", "a longer label"]), st.booleans())
def test_any_change_leads_back(rows, label, moved):
    """Rows left out, doubled, in another order, renamed, moved; NaN and -0.0 come back as they were."""
    start = some_tracks()
    after = start.select(np.array(rows, int))
    names = np.where(np.arange(len(after)) % 3 == 0, label, after.label)
    xyz = after.xyz + 1e-16 * moved
    after = Tracks(**{**{n: getattr(after, n) for n in Tracks.__dataclass_fields__}, "label": names, "xyz": xyz})
    made = change(start, after)
    assert equal_to_the_bit(undone(after, made), start)
    assert fingerprint(undone(after, made)) == fingerprint(start)


def test_what_did_not_change_is_not_kept():
    start = some_tracks(2000)
    after = start.select(np.arange(2000) != 700)
    assert change(start, after).rows == 1
    renamed = replace(start, label=np.where(start.label == "A", "A longer name", "B"))
    assert change(start, renamed).rows == 1000


def written(folder):
    write_tracks(some_tracks(), folder / "start.csv", 100.0)
    edits = edits_in(folder, {"delete": {"labels": ["A"], "frames": [2, 3]}})
    write_edited(
        read_edited(folder / "start.csv", TRACKS).edited(read_track_edits(edits)), folder / "out.csv", TRACKS
    )
    return folder / "out.csv", *sidecars(folder / "out.csv")


def test_a_file_that_was_changed_by_something_else_is_refused(tmp_path):
    out, edits, record = written(tmp_path)
    text = out.read_text()
    out.write_text(text.replace("measured", "predicted", 1))
    with pytest.raises(
        InputError, match=r"out\.csv: is not as 'mosca edit' wrote it, by the sha256 in out\.csv\.edits"
    ):
        read_edited(out, TRACKS)
    out.write_text(text)
    read_edited(out, TRACKS)
    kept = record.read_bytes()
    record.unlink()
    with pytest.raises(InputError, match=r"out\.csv\.edits\.npz: no such file; a file of recorded edits is wanted"):
        read_edited(out, TRACKS)
    record.write_bytes(kept[:-40])
    with pytest.raises(InputError, match="holds no recorded edits"):
        read_edited(out, TRACKS)
    record.write_bytes(kept)
    whole = edits.read_text()
    edits.write_text(whole + '[[edit]]\nrename = { labels = { A = "C" } }\n')
    with pytest.raises(InputError, match=r"2 edits are recorded, 3 are wanted"):
        read_edited(out, TRACKS)
    edits.write_text(whole[whole.index("[[edit]]") :])
    with pytest.raises(InputError, match="key 'history' is missing"):
        read_edited(out, TRACKS)
    edits.unlink()
    with pytest.raises(InputError, match=r"out\.csv\.edits\.toml: no such file"):
        read_edited(out, TRACKS)


def test_the_record_of_another_file_is_refused(tmp_path):
    (tmp_path / "a").mkdir(), (tmp_path / "b").mkdir()
    out, _, record = written(tmp_path / "a")
    write_tracks(some_tracks(seed=1), tmp_path / "b/start.csv", 100.0)
    edits = read_track_edits(edits_in(tmp_path, {"delete": {"labels": ["A"], "frames": [2, 3]}}))
    write_edited(read_edited(tmp_path / "b/start.csv", TRACKS).edited(edits), tmp_path / "b/out.csv", TRACKS)
    record.write_bytes((tmp_path / "b/out.csv.edits.npz").read_bytes())
    with pytest.raises(InputError, match=r"it is not that of out\.csv as it is read now"):
        read_edited(out, TRACKS)
