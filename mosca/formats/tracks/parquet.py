"""``tracks.parquet``: the columns of ``tracks.csv`` with types, for pandas, polars, DuckDB and the like.

Whole numbers are int64, positions [m], covariances [m^2] and residuals [px] float64, unknown ones null. Pages have
checksums; the schema's metadata state the units and, under ``sha256``, the digest of all columns. Files of other
programs with these columns are read without such metadata.
"""

from pathlib import Path
from typing import Any

import numpy as np

from mosca.data.arrays import Array
from mosca.data.files.bounded import open_file
from mosca.data.files.npz import DIGEST, MOST_RATIO, SMALL_BYTES, array_digest
from mosca.data.files.whole_file import whole_file
from mosca.data.tracks import STATUSES, Tracks
from mosca.errors import InputError
from mosca.formats.tracks.tracks_csv import COLUMNS, COVARIANCE_ELEMENTS

WHOLE, WORDS = ("frame", "time_ns", "track", "n_cameras"), ("label", "status")
UNITS = {"x, y, z": "m", "sxx ... syz": "m^2", "residual_px": "px", "time_ns": "ns"}


def write_tracks_parquet(tracks: Tracks, path: Path) -> None:
    """Write ``tracks`` to ``path``, whole or not at all. Raises InputError where that fails."""
    import pyarrow
    from pyarrow import parquet

    columns = _columns_of(tracks)
    table = pyarrow.table(
        {name: pyarrow.array(values, from_pandas=name not in WHOLE) for name, values in columns.items()}
    )
    stated = {DIGEST: array_digest(columns).tobytes().hex(), **{f"unit of {key}": one for key, one in UNITS.items()}}
    with whole_file(Path(path)) as temporary:
        parquet.write_table(
            table.replace_schema_metadata(stated), temporary, compression="zstd", write_page_checksum=True
        )


def read_tracks_parquet(path: Path) -> Tracks:
    """Read tracks from a Parquet file with the columns of ``tracks.csv``, in any order; others are ignored.

    Raises InputError where it cannot be read, lacks a column, is damaged, or would take far more memory than it has
    bytes.
    """
    import pyarrow
    from pyarrow import parquet

    path = Path(path)
    try:
        with open_file(path) as file:
            source = parquet.ParquetFile(file, read_dictionary=list(WORDS), page_checksum_verification=True)
            lacking = [name for name in COLUMNS if source.schema_arrow.names.count(name) != 1]
            if lacking:
                raise ValueError(f"it has no column '{lacking[0]}', or two; {', '.join(COLUMNS)} are wanted")
            most = max(SMALL_BYTES, MOST_RATIO * path.stat().st_size)
            _check_size(8 * len(COLUMNS) * source.metadata.num_rows, most)
            table = source.read(columns=list(COLUMNS))
            columns = {name: _values(table.column(name), name, most) for name in COLUMNS}
            stated = (source.schema_arrow.metadata or {}).get(DIGEST.encode())
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; a Parquet file of tracks is wanted") from None
    except (OSError, ValueError, TypeError, pyarrow.ArrowException, MemoryError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0].rstrip(".")
        raise InputError(f"{path}: cannot be read as Parquet: {getattr(error, 'strerror', None) or reason}") from None
    for word in set(columns["status"].tolist()) - set(STATUSES):
        raise InputError(f"{path}: status {word[:40]!r}; {', '.join(STATUSES)} are allowed")
    tracks = _tracks_of(columns)
    if stated is not None and stated != array_digest(_columns_of(tracks)).tobytes().hex().encode():
        raise InputError(f"{path}: damaged: its columns are not those of its checksum ({DIGEST})")
    return tracks


def _columns_of(tracks: Tracks) -> dict[str, Array]:
    """Return the columns (n,) of ``tracks`` by their names, as they are written."""
    elements = (tracks.covariance[:, i, j] for i, j in COVARIANCE_ELEMENTS)
    reals = zip(COLUMNS[4:13], (*tracks.xyz.T, *elements), strict=True)
    # one bit pattern for NaN, and one for zero
    floats = {
        name: np.where(np.isnan(one), np.nan, one + 0.0) for name, one in (*reals, (COLUMNS[14], tracks.residual_px))
    }
    whole = {name: getattr(tracks, name).astype(np.int64) for name in WHOLE}
    both = {**whole, **floats, **{name: getattr(tracks, name) for name in WORDS}}
    return {name: both[name] for name in COLUMNS}


def _values(column: Any, name: str, most: int) -> Array:
    """Return the values (n,) of one column; ValueError, TypeError or ArrowException where it holds something else."""
    import pyarrow

    if name in WORDS:
        longest = max((len(one) for chunk in column.chunks for one in chunk.dictionary.to_pylist()), default=1)
        _check_size(4 * longest * len(column), most)
        return np.array([one or "" for one in column.to_pylist()], dtype=np.str_)
    if name in WHOLE and column.null_count:
        raise ValueError(f"{name} is missing in {column.null_count} rows")
    wanted = pyarrow.int64() if name in WHOLE else pyarrow.float64()
    return np.array(column.cast(wanted).to_numpy())


def _check_size(n_bytes: int, most: int) -> None:
    if n_bytes > most:
        raise ValueError(f"it would take {n_bytes} bytes of memory; at most {most} are read from so small a file")


def _tracks_of(columns: dict[str, Array]) -> Tracks:
    covariance = np.empty((len(columns["x"]), 3, 3))
    for (i, j), name in zip(COVARIANCE_ELEMENTS, COLUMNS[7:13], strict=True):
        covariance[:, i, j] = covariance[:, j, i] = columns[name]
    return Tracks(
        xyz=np.stack([columns[name] for name in "xyz"], axis=1),
        covariance=covariance,
        **{name: columns[name] for name in (*WHOLE, *WORDS, "residual_px")},
    )
