"""Tracks from a file, in the format that its suffix names."""

from pathlib import Path

from mosca.data.tracks import Tracks, read_npz
from mosca.errors import InputError
from mosca.formats.tracks.c3d import read_c3d
from mosca.formats.tracks.marker_table import tracks_from_table
from mosca.formats.tracks.tracks_csv import read_tracks_csv
from mosca.formats.tracks.tracks_file import SUFFIXES
from mosca.formats.tracks.trc import read_trc


def read_tracks(path: Path) -> Tracks:
    """Read tracks from .npz, .csv, .c3d or .trc; C3D and TRC hold no covariances, which are NaN then.

    Raises InputError for another suffix, a missing file and one that is something else.
    """
    path = Path(path)
    match path.suffix.lower():
        case ".npz":
            return read_npz(path)
        case ".csv":
            return read_tracks_csv(path)
        case ".c3d":
            return tracks_from_table(read_c3d(path))
        case ".trc":
            return tracks_from_table(read_trc(path))
    raise InputError(f"{path}: suffix '{path.suffix}' given; {', '.join(SUFFIXES)} are allowed")
