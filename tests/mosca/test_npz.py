"""Damaged and foreign .npz files give one line, never another exception."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mosca.data.files.npz import from_npz
from mosca.data.tracks import Tracks, read_npz, write_npz
from mosca.data.truth import Truth, read_truth, write_truth
from mosca.errors import InputError

READERS = [read_npz, read_truth]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = tmp_path_factory.mktemp("npz") / "tracks.npz"
    rng = np.random.default_rng(1)
    n = 40
    tracks = Tracks(
        np.arange(n), 10 * np.arange(n), np.zeros(n, int), np.full(n, "a"), rng.normal(size=(n, 3)),
        np.ones((n, 3, 3)),
        np.full(n, 3), np.full(n, 0.1), np.full(n, "measured"),
    )  # fmt: skip
    write_npz(tracks, path)
    return path.read_bytes()


@pytest.mark.parametrize("read", READERS)
@given(data=st.binary(max_size=300))
@settings(max_examples=60, deadline=None)
def test_any_bytes(tmp_path_factory, read, data):
    path = tmp_path_factory.mktemp("any") / "some.npz"
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"some\.npz: holds no (tracks|truth): .*; give what"):
        read(path)


def told(path):
    """Return what is wrong with a file, nothing where it can be read."""
    try:
        read_npz(path)
    except InputError as error:
        return str(error)
    return ""


@given(data=st.data())
@settings(max_examples=150, deadline=None)
def test_bytes_changed_or_cut(tmp_path_factory, whole, data):
    path = tmp_path_factory.mktemp("bent") / "some.npz"
    bent = bytearray(whole[: data.draw(st.integers(0, len(whole)))])
    for at in data.draw(st.lists(st.integers(0, max(len(bent) - 1, 0)), max_size=4)) if bent else ():
        bent[at] = data.draw(st.integers(0, 255))
    path.write_bytes(bytes(bent))
    assert "\n" not in told(path)


@pytest.mark.parametrize("read", READERS)
def test_what_is_not_there_is_named(tmp_path, read):
    np.savez(tmp_path / "other.npz", frame=np.arange(3))
    with pytest.raises(InputError, match=r"other\.npz: holds no \w+: .*time_ns"):
        read(tmp_path / "other.npz")
    with pytest.raises(InputError, match=r"gone\.npz: no such file"):
        read(tmp_path / "gone.npz")
    with pytest.raises(InputError, match="is a folder"):
        read(tmp_path)
    np.save(tmp_path / "one.npy", np.arange(3))
    with pytest.raises(InputError, match="it is a single array"):
        read(tmp_path / "one.npy")


def test_pickles_are_not_opened(tmp_path):
    np.savez(tmp_path / "p.npz", x=np.array([{}], dtype=object))
    with pytest.raises(InputError, match="pickle"):
        from_npz(tmp_path / "p.npz", lambda arrays: arrays["x"], "tracks", "'mosca run'")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda a: a | {"xyz": a["xyz"] + 1e-12}, "its arrays are not those of its checksum"),
        (lambda a: a | {"frame": a["time_ns"], "time_ns": a["frame"]}, "its arrays are not those of its checksum"),
        (lambda a: a | {"track": a["track"].astype(np.int32)}, "its arrays are not those of its checksum"),
        (
            lambda a: {k: v for k, v in a.items() if k != "sha256"} | {"frame": a["frame"] + 0.5},
            "frame holds float64",
        ),
        (lambda a: {k: v for k, v in a.items() if k != "sha256"}, ""),
    ],
)
def test_tracks_are_read_as_they_were_written(tmp_path, whole, change, said):
    path = tmp_path / "t.npz"
    path.write_bytes(whole)
    read_npz(path)
    with np.load(path) as arrays:
        before = dict(arrays)
    np.savez(path, **change(before))
    assert said in told(path)
    assert bool(told(path)) == bool(said)


def test_a_truth_has_a_checksum(tmp_path):
    some = np.zeros((2, 1, 1))
    write_truth(
        Truth(
            np.arange(2),
            ("a",),
            np.ones((2, 1, 3)),
            some,
            ("c",),
            np.zeros((2, 1, 1, 2)),
            some,
            np.zeros((2, 1), int),
        ),
        tmp_path / "t.npz",
    )
    assert read_truth(tmp_path / "t.npz").xyz.max() == 1.0
    with np.load(tmp_path / "t.npz") as arrays:
        np.savez(tmp_path / "t.npz", **(dict(arrays) | {"xyz": np.full((2, 1, 3), 1.5)}))
    with pytest.raises(InputError, match="its arrays are not those of its checksum"):
        read_truth(tmp_path / "t.npz")
