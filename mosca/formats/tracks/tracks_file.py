"""Tracks to a file, in the format that its suffix names."""

from pathlib import Path

from mosca.data.files.whole_file import check_writable, whole_file
from mosca.data.tracks import Tracks, write_npz
from mosca.errors import InputError
from mosca.formats.tracks.c3d import write_c3d
from mosca.formats.tracks.marker_table import table_from_tracks
from mosca.formats.tracks.tracks_csv import write_tracks_csv
from mosca.formats.tracks.trc import write_trc

SUFFIXES = (".npz", ".csv", ".c3d", ".trc")


def check_tracks_file(path: Path) -> None:
    """Raise InputError where ``path`` is no file for tracks; ask before long work, not after it."""
    _check_suffix(path)
    check_writable(path)


def write_tracks(tracks: Tracks, path: Path, frame_rate_hz: float) -> None:
    """Write ``tracks`` to ``path`` as .npz, .csv, .c3d or .trc, whole or not at all.

    ``frame_rate_hz`` is stated in C3D and TRC files. Raises InputError for another suffix, a rate that is not
    above 0, or a place that cannot be written.
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
        case ".c3d":
            write_c3d(table_from_tracks(tracks, frame_rate_hz), path)
        case ".trc":
            write_trc(table_from_tracks(tracks, frame_rate_hz), path)


def _check_suffix(path: Path) -> None:
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path}: suffix '{path.suffix}' given; {', '.join(SUFFIXES)} are allowed")
