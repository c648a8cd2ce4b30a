"""The files of a take: a file of tracks, or a run folder with tracks, poses of bodies and the rig."""

from dataclasses import dataclass
from pathlib import Path

from mosca.errors import InputError

TRACKS_FILES = ("tracks.npz", "tracks.csv")
POSES_FILE = "bodies.csv"
RIG_FILE = "rig.toml"
RECORD_FILE = "record.json"
JOINTS_FILE, ANGLES_FILE = "joints.csv", "angles.csv"


@dataclass(frozen=True)
class TakeFiles:
    """``tracks``, and other files: None where the folder does not have them, or a file was given."""

    tracks: Path
    bodies: Path | None = None
    rig: Path | None = None
    joints: Path | None = None
    angles: Path | None = None


def take_files(path: Path) -> TakeFiles:
    """Return the files of a take. InputError where the path does not exist, or is a folder without tracks."""
    if not path.exists():
        raise InputError(f"{path}: no such file or folder; a file of tracks or a run folder is wanted")
    if not path.is_dir():
        return TakeFiles(path)
    found = [path / name for name in TRACKS_FILES if (path / name).is_file()]
    if not found:
        raise InputError(f"{path}: holds no {' or '.join(TRACKS_FILES)}; give a file of tracks or a run folder")
    names = (POSES_FILE, RIG_FILE, JOINTS_FILE, ANGLES_FILE)
    return TakeFiles(found[0], *(path / name if (path / name).is_file() else None for name in names))
