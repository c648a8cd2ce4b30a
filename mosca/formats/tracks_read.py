"""Tracks from a file, in the format that its suffix names."""

import zipfile
from pathlib import Path

import numpy as np

from mosca.data.tracks import Tracks
from mosca.errors import InputError
from mosca.formats.c3d import read_c3d
from mosca.formats.marker_table import tracks_from_table
from mosca.formats.tracks_csv import read_tracks_csv
from mosca.formats.tracks_file import SUFFIXES
from mosca.formats.trc import read_trc


def read_tracks(path: Path) -> Tracks:
    """Read tracks from .npz, .csv, .c3d or .trc; C3D and TRC hold no covariances, which are NaN then.

    Raises InputError for another suffix, a missing file and one that is something else.
    """
    path = Path(path)
    match path.suffix.lower():
        case ".npz":
            return _npz(path)
        case ".csv":
            return read_tracks_csv(path)
        case ".c3d":
            return tracks_from_table(read_c3d(path))
        case ".trc":
            return tracks_from_table(read_trc(path))
    raise InputError(f"{path}: suffix '{path.suffix}' given; {', '.join(SUFFIXES)} are allowed")


def _npz(path: Path) -> Tracks:
    try:
        # a file of our own: numpy leaves it open where it is no archive
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as columns:
            return Tracks(**{name: columns[name] for name in Tracks.__dataclass_fields__})
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; a tracks file is wanted") from None
    except IsADirectoryError:
        raise InputError(f"{path}: is a folder; a tracks file is wanted") from None
    except (OSError, ValueError, KeyError, EOFError, TypeError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: holds no tracks: {error}; give what 'mosca reconstruct' wrote") from None
