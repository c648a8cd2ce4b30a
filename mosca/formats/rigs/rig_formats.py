"""Calibrations of other programs: one reader and one writer for all formats, each with notes for the person.

    rig, notes = read_any_rig(Path("calibration.qca.txt"))
    notes = write_any_rig(rig, Path("calibration.toml"), "aniposelib")

A lens model that a format lacks is fitted over the image. The notes state the residual; above
``RigFileOptions.max_residual_px`` it is refused. Fitted are Mosca lenses (by OpenCV's model), for QTM all lenses but
those of OpenCV's k1, k2, k3, p1, p2, and for OpenPTV cameras of different fx/fy. QTM's and OpenPTV's files hold no
fisheyes, Caliscope's no names, OpenPTV's only one image size. More than a stereo pair needs a folder of OpenCV's.
"""

from dataclasses import dataclass
from pathlib import Path

from mosca.data.files.bounded import open_file
from mosca.data.files.rig_file import write_rig
from mosca.data.rig import Camera, Rig
from mosca.errors import InputError
from mosca.formats.rigs.caliscope import read_toml_rig, write_aniposelib, write_caliscope
from mosca.formats.rigs.lens_conversion import Notes, Reader, RigFileOptions, Writer, checked_camera, named
from mosca.formats.rigs.opencv_yaml import SUFFIXES, read_opencv, write_opencv
from mosca.formats.rigs.openptv import read_openptv, write_openptv
from mosca.formats.rigs.qtm import read_qtm, write_qtm
from mosca.formats.rigs.selfcal import read_selfcal

__all__ = ["FORMATS", "Notes", "RigFileOptions", "RigFormat", "format_of", "read_any_rig", "write_any_rig"]
HEAD = 4096


@dataclass(frozen=True)
class RigFormat:
    """A file format: its ``name``, ``suffix`` ("" for a folder), reader and writer (None: there is none)."""

    name: str
    suffix: str
    read: Reader
    write: Writer | None


def _write_mosca(cameras: tuple[Camera, ...], path: Path, options: RigFileOptions) -> Notes:
    if path.suffix != ".toml":
        raise InputError(f"{path}: a rig file ends in .toml; for another format give --format ({', '.join(FORMATS)})")
    write_rig(Rig(cameras), path)
    return ()


_TABLE = (
    RigFormat("mosca", ".toml", read_toml_rig, _write_mosca),
    RigFormat("aniposelib", ".toml", read_toml_rig, write_aniposelib),
    RigFormat("caliscope", ".toml", read_toml_rig, write_caliscope),
    RigFormat("opencv", ".yml", read_opencv, write_opencv),
    RigFormat("qtm", ".qca.txt", read_qtm, write_qtm),
    RigFormat("openptv", "", read_openptv, write_openptv),
    RigFormat("multicamselfcal", "", read_selfcal, None),
)
FORMATS: dict[str, RigFormat] = {one.name: one for one in _TABLE}
"""Name -> format; "aniposelib" is Pose2Sim's too."""


def read_any_rig(path: Path, format: str | None = None, options: RigFileOptions | None = None) -> tuple[Rig, Notes]:
    """Read a calibration of any of ``FORMATS``; ``format``, or else the content, determines which one.

    Returns the rig and the notes on what was assumed or fitted. Raises InputError in one line naming file, key, value
    and what is allowed.
    """
    path, options = Path(path), options or RigFileOptions()
    chosen = FORMATS[_known(format)] if format is not None else FORMATS[format_of(path)]
    found, notes = chosen.read(path, options)
    cameras, renamed = named(found, path)
    for camera in cameras:
        checked_camera(camera, f"{path}: camera '{camera.name}'")
    return Rig(cameras), notes + renamed


def write_any_rig(rig: Rig, path: Path, format: str, options: RigFileOptions | None = None) -> Notes:
    """Write ``rig`` to ``path`` (a folder for "openptv", and for "opencv" without a suffix) in one of ``FORMATS``.

    Returns the notes on what was fitted or left out. Raises InputError for an unknown format, one that is only read,
    or a lens that it can hold only with a residual above the limit; files written before that are kept.
    """
    chosen = FORMATS[_known(format)]
    if chosen.write is None:
        written = ", ".join(one.name for one in _TABLE if one.write is not None)
        raise InputError(f"{path}: format '{format}' is only read; written are {written}")
    return chosen.write(rig.cameras, Path(path), options or RigFileOptions())


def format_of(path: Path) -> str:
    """Return the name of the format of a file or folder, from its content; InputError where it is none of them."""
    if path.is_dir():
        if any(path.glob("*.ori")):
            return "openptv"
        if (path / "basename1.rad").is_file():
            return "multicamselfcal"
        if any(one.suffix.lower() in SUFFIXES for one in path.iterdir()):
            return "opencv"
        raise InputError(f"{path}: no calibration in this folder ({_what()})")
    name = path.name.lower()
    if name.endswith(".toml"):
        return "mosca"
    if name.endswith(".ori"):
        return "openptv"
    try:
        with open_file(path) as file:
            head = file.read(HEAD)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    if b"<opencv_storage" in head or head.lstrip().startswith((b"%YAML", b"{")):
        return "opencv"
    if b"<calibration" in head or name.endswith(".qca.txt"):
        return "qtm"
    raise InputError(f"{path}: none of the calibrations that are read ({_what()})")


def _known(name: str) -> str:
    if name not in FORMATS:
        raise InputError(f"calibration format '{name}' is unknown; there are {', '.join(FORMATS)}")
    return name


def _what() -> str:
    return "; ".join(f"{one.name}: {one.suffix or 'a folder'}" for one in _TABLE)
