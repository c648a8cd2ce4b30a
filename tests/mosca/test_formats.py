"""Tracks to files and back: csv, npz, C3D, TRC."""

import csv
import os
from contextlib import suppress
from pathlib import Path

import ezc3d
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mosca.data.tracks import Tracks, read_npz
from mosca.errors import InputError
from mosca.formats.tracks.c3d import read_c3d, write_c3d
from mosca.formats.tracks.marker_table import MarkerTable, table_from_tracks, tracks_from_table
from mosca.formats.tracks.tracks_csv import COLUMNS, read_tracks_csv
from mosca.formats.tracks.tracks_file import write_tracks
from mosca.formats.tracks.trc import read_trc, write_trc

DATA = Path(os.environ.get("MOSCA_DATA", Path(__file__).parents[3] / "shared" / "data"))
LABELS = ["", "LASI", 'wei"rd, name', "Zähler\nneu", "x"]


def random_tracks(n_frames: int, n_tracks: int, seed: int = 0) -> Tracks:
    rng = np.random.default_rng(seed)
    frame = np.repeat(np.arange(n_frames), n_tracks)
    track = np.tile(np.arange(n_tracks), n_frames)
    n = len(frame)
    half = rng.normal(0, 1e-4, (n, 3, 3))
    residual = rng.uniform(0, 1, n)
    residual[::7] = np.nan
    return Tracks(
        frame=frame + 3,
        time_ns=1_790_000_000_000_000_001 + frame * 10_000_000,
        track=track,
        label=np.array([LABELS[t] if t < len(LABELS) else f"m{t}" for t in track.tolist()]),
        xyz=rng.normal(0, 2, (n, 3)),
        covariance=half @ half.transpose(0, 2, 1),
        n_cameras=rng.integers(2, 9, n),
        residual_px=residual,
        status=rng.choice(["measured", "filled", "predicted"], n),
    )


def assert_same(a: Tracks, b: Tracks) -> None:
    for name in Tracks.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


def one_sample(label: str, xyz: tuple[float, float, float], status: str = "measured", **other: int) -> Tracks:
    covariance = np.diag([4e-8, 9e-8, 36e-8])[None]
    return Tracks(
        [other.get("frame", 0)], [5], [other.get("track", 1)], [label], [xyz], covariance, [2], [np.nan], [status]
    )


def joined(*parts: Tracks) -> Tracks:
    columns = [np.concatenate([getattr(p, name) for p in parts]) for name in Tracks.__dataclass_fields__]
    order = np.lexsort((columns[2], columns[0]))
    return Tracks(*(column[order] for column in columns))


def test_csv_by_hand(tmp_path: Path) -> None:
    path = tmp_path / "tracks.csv"
    write_tracks(one_sample("a,b", (1.5, -0.1, 0.3)), path, 100)
    header, line = path.read_text(encoding="utf-8").splitlines()
    assert header == ("frame,time_ns,track,label,x,y,z,sxx,syy,szz,sxy,sxz,syz,n_cameras,residual_px,status")
    assert line == '0,5,1,"a,b",1.5,-0.1,0.3,4e-08,9e-08,3.6e-07,0.0,0.0,0.0,2,,measured'


@pytest.mark.parametrize("suffix", [".csv", ".npz", ".CSV"])
def test_csv_and_npz_to_the_last_bit(tmp_path: Path, suffix: str) -> None:
    tracks = random_tracks(40, 7)
    symmetric = (tracks.covariance + tracks.covariance.transpose(0, 2, 1)) / 2
    tracks = Tracks(*(symmetric if n == "covariance" else getattr(tracks, n) for n in Tracks.__dataclass_fields__))
    path = tmp_path / f"tracks{suffix}"
    write_tracks(tracks, path, 100)
    assert_same(read_npz(path) if suffix == ".npz" else read_tracks_csv(path), tracks)
    write_tracks(Tracks.none(), path, 100)
    assert_same(read_npz(path) if suffix == ".npz" else read_tracks_csv(path), Tracks.none())
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


GOOD_CSV = ",".join(COLUMNS) + "\n0,5,1,a,1.5,-0.1,0.3,1,1,1,0,0,0,2,,measured\n1,6,1,,,,,,,,,,,0,0.5,filled\n"


def test_other_suffixes_rates_and_places_are_errors(tmp_path: Path) -> None:
    tracks = one_sample("a", (0, 0, 0))
    with pytest.raises(InputError, match=r"suffix '.xlsx' given; .npz, .csv, .parquet, .c3d, .trc are allowed"):
        write_tracks(tracks, tmp_path / "tracks.xlsx", 100)
    with pytest.raises(InputError, match="one above 0 is wanted"):
        write_tracks(tracks, tmp_path / "tracks.c3d", 0)
    with pytest.raises(InputError, match="there is no folder"):
        write_tracks(tracks, tmp_path / "none" / "tracks.csv", 100)
    for suffix in ("c3d", "trc"):
        with pytest.raises(InputError, match="no track to write"):
            write_tracks(Tracks.none(), tmp_path / f"tracks.{suffix}", 100)
    assert list(tmp_path.iterdir()) == []


def test_a_failed_write_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "tracks.c3d"
    write_tracks(one_sample("a", (1, 2, 3)), path, 100)
    before = path.read_bytes()
    with pytest.raises(InputError, match="a C3D file counts to 65535"):
        write_tracks(joined(one_sample("a", (1, 2, 3)), one_sample("a", (1, 2, 3), frame=70_000)), path, 100)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["tracks.c3d"]


def test_markers_are_named_by_label_and_found_again() -> None:
    tracks = joined(
        one_sample("head", (1, 0, 0), frame=2, track=4),
        one_sample("head", (2, 0, 0), frame=5, track=9),  # lost and found again: the same marker
        one_sample("knee", (3, 0, 0), frame=5, track=1),
        one_sample("knee", (4, 0, 0), frame=5, track=2),  # two at once: distinguished by number
        one_sample("", (5, 0, 0), frame=3, track=7, status="filled"),
    )
    table = table_from_tracks(tracks, 50.0)
    assert table.names == ("knee_1", "knee_2", "head", "track_7")
    assert (table.first_frame, table.xyz.shape) == (2, (4, 4, 3))
    np.testing.assert_array_equal(table.xyz[:, 2, 0], [1, np.nan, np.nan, 2])
    np.testing.assert_array_equal(table.xyz[3, :2, 0], [3, 4])
    assert table.measured.sum() == 4
    assert table.deviation_m[0, 2] == pytest.approx(7e-4)  # sqrt(4 + 9 + 36) * 1e-4
    again = tracks_from_table(table)
    assert list(again.time_ns) == [40_000_000, 60_000_000, 100_000_000, 100_000_000, 100_000_000]


def test_c3d_as_ezc3d_reads_it(tmp_path: Path) -> None:
    tracks = joined(
        one_sample("a", (0.1, -0.2, 1.2345678), frame=10, track=1),
        one_sample("a", (0.1, -0.2, 1.3), frame=12, track=1, status="filled"),
        one_sample("b", (1, 2, 3), frame=11, track=2),
    )
    path = tmp_path / "tracks.c3d"
    write_tracks(tracks, path, 59.94)
    document = ezc3d.c3d(str(path))
    point = document["parameters"]["POINT"]
    assert point["RATE"]["value"][0] == pytest.approx(59.94, rel=1e-7)
    assert point["UNITS"]["value"] == ["mm"]
    assert point["LABELS"]["value"] == ["a", "b"]
    assert document["header"]["points"]["first_frame"] == 10
    points = document["data"]["points"]
    np.testing.assert_allclose(points[:3, 0, 0], [100, -200, 1234.5678], rtol=1e-7)
    assert np.isnan(points[:3, 0, 1]).all()
    # sqrt(4 + 9 + 36) * 0.1 mm = 0.7 mm of deviation; filled is 0; absent is -1.
    np.testing.assert_allclose(
        document["data"]["meta_points"]["residuals"][0], [[0.7, -1, 0], [-1, 0.7, -1]], atol=0.01
    )


@pytest.mark.parametrize("suffix", ["c3d", "trc"])
@pytest.mark.parametrize("n_tracks", [1, 300])
def test_tables_come_back(tmp_path: Path, suffix: str, n_tracks: int) -> None:
    rng = np.random.default_rng(2)
    xyz = rng.normal(0, 2, (20, n_tracks, 3))
    xyz[rng.random((20, n_tracks)) < 0.3] = np.nan
    seen = np.isfinite(xyz).all(axis=2)
    measured = seen & (rng.random((20, n_tracks)) < 0.8)
    names = tuple(f"marker{k}" for k in range(n_tracks))
    table = MarkerTable(names, xyz, measured, np.where(seen, 5e-4, np.nan), 7, 120.0)
    path = tmp_path / f"t.{suffix}"
    (write_c3d if suffix == "c3d" else write_trc)(table, path)
    again = (read_c3d if suffix == "c3d" else read_trc)(path)
    assert again.names == names
    assert (again.first_frame, again.rate_hz) == (7, 120.0)
    # float32 millimetres: half a unit in the last place at 8 m is 0.24 um. TRC: one rounding each way.
    np.testing.assert_allclose(again.xyz, xyz, atol=3e-7 if suffix == "c3d" else 1e-15)
    if suffix == "c3d":
        np.testing.assert_array_equal(again.measured, measured)
        np.testing.assert_allclose(again.deviation_m[measured], 5e-4, rtol=0.01)


TRC = (
    "PathFileType\t4\t(X/Y/Z)\ta.trc\n"
    "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames\n"
    "50.0\t50.0\t2\t2\tmm\t50.0\t1\t2\n"
    "Frame#\tTime\tA\t\t\tB\t\t\n"
    "\t\tX1\tY1\tZ1\tX2\tY2\tZ2\n"
    "\n"
    "1\t0.02\t1.0\t2.0\t-3E+01\t\t\t\n"
    "2\t0.04\tNaN\tnan\tNAN\t4.0\t5.0\t6.0\n"
)


def test_trc_by_hand(tmp_path: Path) -> None:
    path = tmp_path / "a.trc"
    path.write_text(TRC, encoding="utf-8")
    table = read_trc(path)
    assert table.names == ("A", "B")
    np.testing.assert_allclose(table.xyz[0, 0], [0.001, 0.002, -0.03])
    np.testing.assert_allclose(table.xyz[1, 1], [0.004, 0.005, 0.006])
    assert np.isnan(table.xyz[1, 0]).all()
    assert np.isnan(table.xyz[0, 1]).all()
    written = tmp_path / "b.trc"
    write_trc(table, written)
    assert written.read_text(encoding="utf-8").splitlines()[2:5] == TRC.splitlines()[2:5]
    assert written.read_text(encoding="utf-8").splitlines()[7].split("\t")[:2] == ["2", "0.04"]


@pytest.mark.parametrize(
    ("good", "old", "new", "message"),
    [
        (GOOD_CSV, "frame,time_ns", "frame,time", "first line is not that of a tracks.csv"),
        (GOOD_CSV, "1.5", "1.5m", r"row 2: x = '1.5m'; a number or nothing"),
        (GOOD_CSV, "0,5,1", "0.0,5,1", r"row 2: frame = '0.0'; a whole number"),
        (GOOD_CSV, "0,5,1", "0,99999999999999999999,1", "row 2: time_ns"),
        (GOOD_CSV, "filled", "guessed", "row 3: status 'guessed'; measured, filled, predicted, edited are allowed"),
        (GOOD_CSV, ",filled", "", "row 3: 15 values given, 16 wanted"),
        (TRC, "PathFileType", "Path", "not a TRC file"),
        (TRC, "\tmm\t", "\tfurlong\t", "Units = 'furlong'"),
        (TRC, "50.0\t50.0\t2\t2", "x\t50.0\t2\t2", "line 3: DataRate is 'x'"),
        (TRC, "2\t2\tmm", "2\t3\tmm", r"line 4: 2 marker names .2 of them distinct., NumMarkers = 3"),
        (TRC, "A\t\t\tB", "A\t\t\tA", "1 of them distinct"),
        (TRC, "1.0\t2.0", "1.0\ttwo", "line 7: a coordinate is 'two'"),
        (TRC, "6.0", "6.0\t7.0", "line 8: 7 values given, 6 wanted"),
        (TRC, "2\t0.04", "7\t0.04", "do not rise one by one"),
    ],
)
def test_faults_of_text(tmp_path: Path, good: str, old: str, new: str, message: str) -> None:
    path, read = tmp_path / "a.txt", read_trc if good is TRC else read_tracks_csv
    path.write_text(good, encoding="utf-8")
    read(path)
    assert old in good
    path.write_text(good.replace(old, new), encoding="utf-8")
    with pytest.raises(InputError, match=message):
        read(path)


@settings(max_examples=120, deadline=None)
@given(
    place=st.floats(0, 1),
    length=st.integers(0, 20),
    data=st.binary(max_size=10),
    good=st.sampled_from([TRC, GOOD_CSV]),
)
def test_any_edit_of_text_is_read_or_an_input_error(
    tmp_path_factory: pytest.TempPathFactory, place: float, length: int, data: bytes, good: str
) -> None:
    text, at = good.encode(), int(place * len(good.encode()))
    path = tmp_path_factory.mktemp("edit") / "a.txt"
    path.write_bytes(text[:at] + data + text[at + length :])
    with suppress(InputError):
        assert (read_trc(path) if good is TRC else read_tracks_csv(path)) is not None


@pytest.mark.parametrize("kept", [0, 3, 100, 512, 600, 1500, 3000, 7000])
def test_a_c3d_cut_short_is_an_input_error(tmp_path: Path, kept: int) -> None:
    path = tmp_path / "a.c3d"
    write_tracks(random_tracks(50, 8), path, 100)
    data = path.read_bytes()
    path.write_bytes(data[:kept])
    with pytest.raises(InputError, match="cannot be read as C3D"):
        read_c3d(path)


REAL_C3D = sorted((DATA / "c3d_trc").rglob("*.c3d"))
REAL_TRC = sorted((DATA / "c3d_trc").rglob("*.trc"))
needs_files = pytest.mark.skipif(not REAL_C3D, reason="needs c3d_trc of MOSCA_DATA")


@pytest.mark.data
@needs_files
@pytest.mark.parametrize("path", REAL_C3D, ids=lambda p: p.name)
def test_real_c3d_through_tracks_and_back(tmp_path: Path, path: Path) -> None:
    table = read_c3d(path)
    raw = ezc3d.c3d(str(path))["data"]["points"]
    assert table.xyz.shape == (raw.shape[2], raw.shape[1], 3)
    assert np.nanmax(np.abs(table.xyz)) < 20  # a volume in metres
    tracks = tracks_from_table(table)
    write_tracks(tracks, tmp_path / "a.c3d", table.rate_hz)
    again = read_c3d(tmp_path / "a.c3d")
    kept = [k for k in range(len(table.names)) if np.isfinite(table.xyz[:, k]).any()]
    start = again.first_frame - table.first_frame
    expected = table.xyz[start : start + len(again.xyz), kept]
    assert again.names == tuple(table.names[k] for k in kept)
    assert again.rate_hz == pytest.approx(table.rate_hz)
    np.testing.assert_allclose(again.xyz, expected, atol=1e-6)


@pytest.mark.data
@needs_files
@pytest.mark.parametrize("path", REAL_TRC, ids=lambda p: p.name)
def test_real_trc_and_back(tmp_path: Path, path: Path) -> None:
    table = read_trc(path)
    head = path.read_text(encoding="utf-8").splitlines()[2].split("\t")
    assert len(table.names) == int(head[3])
    assert table.rate_hz == float(head[0])
    with open(path, encoding="utf-8", newline="") as file:
        cells = [cell for row in list(csv.reader(file, delimiter="\t"))[5:] for cell in row[2:]]
    numbers = [c for c in cells if c.strip() and c.strip().lower() != "nan"]
    assert np.isfinite(table.xyz).sum() == len(numbers)
    write_trc(table, tmp_path / "a.trc")
    again = read_trc(tmp_path / "a.trc")
    assert again.names == table.names
    np.testing.assert_allclose(again.xyz, table.xyz, rtol=1e-15, atol=0)
