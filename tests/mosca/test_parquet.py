"""Tracks as Parquet: what other programs see in it, and what is refused."""

import numpy as np
import pyarrow
import pytest
from pyarrow import parquet

from mosca.data.tracks import Tracks
from mosca.errors import InputError
from mosca.formats.tracks import parquet as tracks_parquet
from mosca.formats.tracks.tracks_csv import COLUMNS
from mosca.formats.tracks.tracks_file import read_tracks, write_tracks


def some_tracks() -> Tracks:
    """Return four samples: one without a covariance, one without a label, one filled."""
    covariance = np.array([np.diag([1.0, 2.0, 3.0]) * 1e-8] * 4)
    covariance[:, 0, 1] = covariance[:, 1, 0] = 5e-9
    covariance[2] = np.nan
    return Tracks(
        frame=np.array([3, 3, 4, 5]), time_ns=np.array([30, 30, 40, 50]) * 10**6, track=np.array([0, 1, 0, 1]),
        xyz=np.array([[0.1, 0.2, 0.3], [1.0, -2.0, 1 / 3], [0.1, 0.2, 0.4], [5.0, 6.0, 7.0]]), covariance=covariance,
        label=np.array(["LFHD", "", "LFHD", ""]), n_cameras=np.array([4, 3, 2, 0]),
        residual_px=np.array([0.1, 0.02, np.nan, np.nan]), status=np.array(["measured"] * 3 + ["filled"]),
    )  # fmt: skip


def test_all_comes_back_to_the_bit(tmp_path):
    write_tracks(some_tracks(), tmp_path / "a.parquet", 100.0)
    again = read_tracks(tmp_path / "a.parquet")
    for name in Tracks.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(again, name), getattr(some_tracks(), name))


def test_others_see_typed_columns_and_nulls(tmp_path):
    write_tracks(some_tracks(), tmp_path / "a.parquet", 100.0)
    table = parquet.read_table(tmp_path / "a.parquet")
    assert table.column_names[:7] == ["frame", "time_ns", "track", "label", "x", "y", "z"]
    assert table.schema.field("time_ns").type == pyarrow.int64()
    assert table.schema.field("x").type == pyarrow.float64()
    assert table.column("sxy").to_pylist() == [5e-9, 5e-9, None, 5e-9]
    assert table.column("residual_px").to_pylist() == [0.1, 0.02, None, None]
    assert table.column("label").to_pylist() == ["LFHD", "", "LFHD", ""]
    assert table.schema.metadata[b"unit of x, y, z"] == b"m"


def foreign(**columns):
    """Return the tracks as another program may write them: other order, narrower types, a column more."""
    table = {
        "speed": [1.0, 2.0], "status": pyarrow.array(["measured"] * 2).dictionary_encode(),
        **{name: pyarrow.array([1, 2], pyarrow.int16()) for name in ("frame", "time_ns", "track", "n_cameras")},
        **{name: [0.5, 0.25] for name in ("x", "y", "z", "residual_px")},
        **{name: pyarrow.array([None, 1e-8], pyarrow.float32()) for name in COLUMNS[7:13]},
        "label": pyarrow.array([None, "A"], pyarrow.large_string()),
    }  # fmt: skip
    return pyarrow.table({**table, **columns})


def test_a_table_of_another_program_is_read(tmp_path):
    parquet.write_table(foreign(), tmp_path / "a.parquet")
    tracks = read_tracks(tmp_path / "a.parquet")
    assert tracks.frame.tolist() == [1, 2]
    assert tracks.label.tolist() == ["", "A"]
    assert np.isnan(tracks.covariance[0]).all()
    assert tracks.covariance[1, 0, 2] == np.float32(1e-8)


@pytest.mark.parametrize(
    ("columns", "told"),
    [
        ({"frame": [1.5, 2.0]}, "cannot be read as Parquet: Float value 1.5"),
        ({"frame": [None, 2]}, "frame is missing in 1 rows"),
        ({"x": ["a", "b"]}, "cannot be read as Parquet: Failed to parse string"),
        ({"status": ["measured", "guessed"]}, "status 'guessed'; measured, filled, predicted, edited are allowed"),
    ],
)
def test_other_content_is_told_in_one_line(tmp_path, columns, told):
    parquet.write_table(foreign(**columns), tmp_path / "a.parquet")
    with pytest.raises(InputError, match=r"a\.parquet: ") as raised:
        read_tracks(tmp_path / "a.parquet")
    assert told in str(raised.value)
    assert "\n" not in str(raised.value)


def test_what_lacks_a_column_or_would_fill_the_memory_is_refused(tmp_path, monkeypatch):
    parquet.write_table(foreign().drop_columns(["syz"]), tmp_path / "a.parquet")
    with pytest.raises(InputError, match="no column 'syz'"):
        read_tracks(tmp_path / "a.parquet")
    # a million rows that are all the same take some kB
    monkeypatch.setattr(tracks_parquet, "SMALL_BYTES", 2**20)
    same = pyarrow.array(np.zeros(1_000_000, np.int8))
    parquet.write_table(pyarrow.table(dict.fromkeys(foreign().column_names, same)), tmp_path / "b.parquet")
    assert (tmp_path / "b.parquet").stat().st_size < 1e5
    with pytest.raises(InputError, match="bytes of memory; at most"):
        read_tracks(tmp_path / "b.parquet")


def test_a_changed_value_is_found_by_the_checksum(tmp_path):
    write_tracks(some_tracks(), tmp_path / "a.parquet", 100.0)
    table = parquet.read_table(tmp_path / "a.parquet")
    k = table.column_names.index("x")
    changed = table.set_column(k, "x", pyarrow.array([0.1, 1.0, 0.1, 5.001])).replace_schema_metadata(
        table.schema.metadata
    )
    parquet.write_table(changed, tmp_path / "b.parquet")
    with pytest.raises(InputError, match="damaged: its columns are not those of its checksum"):
        read_tracks(tmp_path / "b.parquet")
