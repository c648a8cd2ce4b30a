"""Reading and writing of tracks in the format that the file's suffix names, also while they are measured."""

import csv
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Self

import numpy as np

from mosca.data.files.whole_file import begin_part, check_writable, whole_file
from mosca.data.tracks import Samples, Tracks, read_npz, table, write_npz
from mosca.errors import InputError
from mosca.formats.tracks.c3d import read_c3d, write_c3d
from mosca.formats.tracks.marker_table import table_from_tracks, tracks_from_table
from mosca.formats.tracks.parquet import read_tracks_parquet, write_tracks_parquet
from mosca.formats.tracks.tracks_csv import COLUMNS, cells_of, read_tracks_csv, write_tracks_csv
from mosca.formats.tracks.trc import read_trc, write_trc

SUFFIXES = (".npz", ".csv", ".parquet", ".c3d", ".trc")


def check_tracks_file(path: Path) -> None:
    """Raise InputError where ``path`` is no file for tracks; to be called before long work."""
    _check_suffix(path)
    check_writable(path)


def read_tracks(path: Path) -> Tracks:
    """Read tracks from .npz, .csv, .parquet, .c3d or .trc; C3D and TRC hold no covariances, which are NaN then.

    Raises InputError for another suffix, a missing file and one that is something else.
    """
    path = Path(path)
    match path.suffix.lower():
        case ".npz":
            return read_npz(path)
        case ".csv":
            return read_tracks_csv(path)
        case ".parquet":
            return read_tracks_parquet(path)
        case ".c3d":
            return tracks_from_table(read_c3d(path))
        case ".trc":
            return tracks_from_table(read_trc(path))
    raise _wrong_suffix(path)


def write_tracks(tracks: Tracks, path: Path, frame_rate_hz: float) -> None:
    """Write ``tracks`` to ``path`` as .npz, .csv, .parquet, .c3d or .trc, whole or not at all.

    ``frame_rate_hz`` is stated in C3D and TRC files. Raises InputError for another suffix, a rate that is not above
    0, or a path that cannot be written.
    """
    path = Path(path)
    _check_suffix(path)
    if not 0 < frame_rate_hz < float("inf"):
        raise InputError(f"{path}: a frame rate of {frame_rate_hz:g}/s given; one above 0 is wanted")
    match path.suffix.lower():
        case ".npz":
            with whole_file(path) as temporary:
                write_npz(tracks, temporary)
        case ".csv":
            write_tracks_csv(tracks, path)
        case ".parquet":
            write_tracks_parquet(tracks, path)
        case ".c3d":
            write_c3d(table_from_tracks(tracks, frame_rate_hz), path)
        case ".trc":
            write_trc(table_from_tracks(tracks, frame_rate_hz), path)


class TracksLog:
    """Tracks written to disk while they are measured, so that they survive the end of the program.

    Samples are appended to ``PATH.part.csv``, in the order in which they become certain.

    ``finish`` writes them, sorted, to ``path`` in the format of its suffix and removes the part file; without it the
    part file stays. InputError for another suffix and where a part file of an earlier run still exists.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        check_tracks_file(self.path)
        self.part, self._file = begin_part(self.path)
        self._writer = csv.writer(self._file, lineterminator="\n")
        self._writer.writerow(COLUMNS)
        self.samples = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def write(self, samples: Samples, label_of: Mapping[tuple[int, int], str] | None = None) -> None:
        """Append samples; ``label_of``: (frame, track) -> label of those that have one."""
        if len(samples):
            tracks = table([samples])
            if label_of:
                keys = zip(tracks.frame.tolist(), tracks.track.tolist(), strict=True)
                tracks = replace(tracks, label=np.array([label_of.get(key, "") for key in keys], dtype=np.str_))
            self._writer.writerows(zip(*cells_of(tracks), strict=True))
            self.samples += len(samples)

    def flush(self) -> None:
        """Hand what was written to the operating system."""
        self._file.flush()

    def close(self) -> None:
        """Close the part file; it stays. May be called twice."""
        self._file.close()

    def finish(self, frame_rate_hz: float) -> int:
        """Write the tracks to their final path and remove the part file; return how many tracks there are."""
        self.close()
        tracks = read_tracks_csv(self.part)
        tracks = tracks.select(np.lexsort((tracks.track, tracks.frame)))
        write_tracks(tracks, self.path, frame_rate_hz)
        self.part.unlink()
        return len(np.unique(tracks.track))


def _check_suffix(path: Path) -> None:
    if path.suffix.lower() not in SUFFIXES:
        raise _wrong_suffix(path)


def _wrong_suffix(path: Path) -> InputError:
    return InputError(f"{path}: suffix '{path.suffix}' given; {', '.join(SUFFIXES)} are allowed")
