"""C3D and TRC at their edges: damaged parameters, strange labels, more than 255 points, unknown content."""

import os
import struct
from pathlib import Path

import ezc3d
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mosca.data.tracks import Tracks
from mosca.errors import InputError
from mosca.formats.tracks.c3d import read_c3d, write_c3d
from mosca.formats.tracks.c3d_checks import fault_of
from mosca.formats.tracks.marker_table import MarkerTable, plain_names, table_from_tracks
from mosca.formats.tracks.trc import read_trc, write_trc

DATA = Path(os.environ.get("MOSCA_DATA", Path(__file__).parents[3] / "shared" / "data"))
REAL = sorted((DATA / "c3d_trc").rglob("*.c3d"))


def some_table(names: tuple[str, ...], deviation: float = np.nan) -> MarkerTable:
    xyz = np.random.default_rng(0).normal(0, 1, (6, len(names), 3))
    xyz[2, 0] = np.nan
    seen = np.asarray(np.isfinite(xyz).all(axis=2))
    return MarkerTable(names, xyz, seen, np.full(seen.shape, deviation), 1, 100.0)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("whole") / "a.c3d"
    write_c3d(some_table(("a", "b", "c")), path)
    return path.read_bytes()


@settings(max_examples=120, deadline=None)
@given(edits=st.lists(st.tuples(st.integers(0, 2047), st.integers(0, 255)), min_size=1, max_size=4))
def test_any_edit_of_a_c3d_is_read_or_an_input_error(
    tmp_path_factory: pytest.TempPathFactory, whole: bytes, edits: list[tuple[int, int]]
) -> None:
    data = bytearray(whole)
    for at, value in edits:
        data[at % len(data)] = value
    path = tmp_path_factory.mktemp("edit") / "a.c3d"
    path.write_bytes(bytes(data))
    try:
        table = read_c3d(path)
    except InputError as error:
        message = str(error)
    else:
        assert table.xyz.ndim == 3
        return
    assert "\n" not in message.strip()


@settings(max_examples=60, deadline=None)
@given(data=st.binary(max_size=3000))
def test_any_bytes_are_an_input_error(tmp_path_factory: pytest.TempPathFactory, data: bytes) -> None:
    path = tmp_path_factory.mktemp("any") / "a.c3d"
    path.write_bytes(data)
    with pytest.raises(InputError):
        read_c3d(path)


@pytest.mark.parametrize(("header_end", "frames"), [(2, 6), (300, 6), (65535, 6), (6, 2), (6, 300), (6, 65535)])
def test_a_stale_count_of_frames_is_read_as_ezc3d_reads_it(
    tmp_path: Path, whole: bytes, header_end: int, frames: int
) -> None:
    """Word 5 of the header or POINT:FRAMES (name, offset, type, dimensions, value) differs from the six written."""
    data = bytearray(whole)
    struct.pack_into("<H", data, 8, header_end)
    at = whole.index(b"FRAMES")
    dimensions = data[at + 9]
    assert struct.unpack_from("<H", data, at + 10 + dimensions) == (6,)
    struct.pack_into("<H", data, at + 10 + dimensions, frames)
    path = tmp_path / "stale.c3d"
    path.write_bytes(bytes(data))
    theirs = ezc3d.c3d(str(path))["data"]["points"][:3].transpose(2, 1, 0)
    np.testing.assert_allclose(read_c3d(path).xyz, theirs / 1000, rtol=1e-6)
    # the control: of the last block, which holds all frames (288 bytes), two are left; neither count says two
    path.write_bytes(bytes(data[: len(data) - 512 + 100]))
    if min(header_end, frames) == 6:
        with pytest.raises(InputError, match=r"cannot be read as C3D: cut short, \d+ of \d+ bytes"):
            read_c3d(path)


def test_faults_have_names(whole: bytes) -> None:
    assert fault_of(whole) == ""
    assert fault_of(whole[:100]) == "its first block is not a C3D header"
    assert "block 200" in fault_of(bytes([200]) + whole[1:])
    rate = whole.index(b"RATE")
    assert "POINT:RATE is missing" in fault_of(whole[:rate] + b"RATS" + whole[rate + 4 :])
    assert "in group 77" in fault_of(whole[: rate - 1] + bytes([77]) + whole[rate:])
    assert "overlaps" in fault_of(whole[: rate + 4] + b"\x01\x00" + whole[rate + 6 :])


@pytest.mark.data
@pytest.mark.skipif(not REAL, reason="needs c3d_trc of MOSCA_DATA")
def test_real_files_are_sound() -> None:
    assert [(path.name, fault_of(path.read_bytes())) for path in REAL] == [(path.name, "") for path in REAL]


@pytest.mark.parametrize("deviation", [np.nan, 4e-4])
def test_unknown_errors_stay_unknown(tmp_path: Path, deviation: float) -> None:
    table = some_table(("a", "b"), deviation)
    write_c3d(table, tmp_path / "a.c3d")
    again = read_c3d(tmp_path / "a.c3d")
    np.testing.assert_array_equal(again.measured, table.measured)
    np.testing.assert_allclose(again.deviation_m[table.measured], deviation, rtol=0.01)


STRANGE = ("a\tb", "a b", "", "line\nbreak", " padded ", "marker_3", "Zähler", "馬", "x" * 200, "x" * 200 + "y")


def test_strange_labels_come_back_plain_and_distinct(tmp_path: Path) -> None:
    table = some_table(STRANGE)
    write_trc(table, tmp_path / "a.trc")
    names = read_trc(tmp_path / "a.trc").names
    assert names[0] == "a b"
    assert names[3:5] == ("line break", "padded")
    assert len(set(names)) == len(STRANGE)
    write_c3d(table, tmp_path / "a.c3d")
    names = read_c3d(tmp_path / "a.c3d").names
    assert len(set(names)) == len(STRANGE)
    assert names[3:5] == ("line break", "padded")
    assert max(map(len, names)) <= 128


@settings(max_examples=100, deadline=None)
@given(names=st.lists(st.text(max_size=12), min_size=1, max_size=8, unique=True))
def test_plain_names(names: list[str]) -> None:
    plain = plain_names(tuple(names))
    assert len(set(plain)) == len(names)
    for name in plain:
        assert name == name.strip() != ""
        assert len(name.splitlines()) == 1
        assert "\t" not in name


def test_600_points_keep_their_labels(tmp_path: Path) -> None:
    names = tuple(f"m{k:03d}" for k in range(600))
    write_c3d(some_table(names), tmp_path / "a.c3d")
    assert read_c3d(tmp_path / "a.c3d").names == names


def test_a_table_that_no_memory_holds_is_an_input_error() -> None:
    tracks = Tracks([0, 10**12], [0, 1], [1, 2], ["", ""], np.zeros((2, 3)), np.zeros((2, 3, 3)), [2, 2], [0, 0],
                    ["measured"] * 2)  # fmt: skip
    with pytest.raises(InputError, match="make a table of more than"):
        table_from_tracks(tracks, 100.0)
