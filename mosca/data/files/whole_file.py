"""Files that are written whole or not at all, and checks before long work that a place can be written."""

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from mosca.errors import InputError

TRIED_BYTES = 1 << 16
"""Bytes written on trial, since an empty file can be made on a full disk, too."""


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path`` with the same suffix; renamed to ``path`` at the end.

    When the body raises, the temporary file is removed and an existing file at ``path`` is untouched. Raises
    InputError where the folder is missing or not writable, ``path`` is a folder, or the disk is full.
    """
    temporary = _begun(path)
    try:
        yield temporary
        temporary.chmod(0o644)
        temporary.replace(path)
    except OSError as error:
        # errors of writing name no file, or the temporary one; other names are files that the body reads
        if error.errno is None or error.filename not in (None, str(temporary)):
            raise
        raise InputError(f"{path}: not written: {error.strerror}; make room, or choose another place") from error
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def whole_folder(path: Path, needs_bytes: int = 0) -> Iterator[Path]:
    """Yield a temporary folder beside ``path``, which must not exist yet; it is renamed to ``path`` at the end.

    When the body raises, nothing is left. ``needs_bytes``: as for ``check_folder``. Raises InputError where ``path``
    exists, or cannot be made there.
    """
    if path.exists():
        raise InputError(f"{path}: is there already; choose a new folder")
    check_folder(path.parent, needs_bytes)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name}."))
    except OSError as error:
        raise _unwritable(path, error) from None
    try:
        yield part
        part.chmod(0o755)
        part.replace(path)
    finally:
        shutil.rmtree(part, ignore_errors=True)


def begin_part(path: Path) -> tuple[Path, TextIO]:
    """Create ``PATH.part.csv``, for rows of ``path`` until it is whole; return its path and the file open for text.

    Raises InputError where a part file of an earlier run exists, or where it cannot be written.
    """
    part = path.with_name(f"{path.name}.part.csv")
    try:
        return part, open(part, "x", encoding="utf-8", newline="")
    except FileExistsError:
        raise InputError(f"{part}: left by a run that was cut short; move it away or remove it") from None
    except OSError as error:
        raise InputError(f"{part}: cannot be written: {error.strerror}") from None


def write_text(path: Path, text: str) -> None:
    """Write ``text`` as UTF-8 to ``path`` as ``whole_file`` does."""
    with whole_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def check_writable(path: Path) -> None:
    """Raise InputError where ``whole_file`` could not write ``path``; to be called before long work."""
    with _removed(_begun(path)) as temporary:
        _try(temporary, path)


def check_own_folder(path: Path, result: str) -> None:
    """Raise InputError where ``path`` is a file, or a folder of other files without an earlier run's ``result``."""
    if path.is_file():
        raise InputError(f"{path}: is a file; choose a folder with --out")
    if path.exists() and not (path / result).exists() and any(path.iterdir()):
        raise InputError(f"{path}: holds other files and no {result}; choose a new folder with --out")


def check_folder(path: Path, needs_bytes: int = 0) -> None:
    """Raise InputError where files could not be written into the folder ``path``; to be called before long work.

    Parameters
    ----------
    path
        The folder; it, and those above it, may be missing.
    needs_bytes
        Approximate size of what will be written [B]; 0 where that is not known.
    """
    there = next((folder for folder in (path, *path.absolute().parents) if folder.exists()), path)
    if not there.is_dir():
        what = "is a file" if there == path else f"{there} is no folder"
        raise InputError(f"{path}: {what}; choose another place")
    try:
        tried = Path(tempfile.mkdtemp(dir=there, prefix=f".{path.name}."))
    except OSError as error:
        raise _unwritable(path, error) from error
    with _removed(tried):
        _try(tried / "tried", path)
    free = shutil.disk_usage(there).free
    if needs_bytes > free:
        raise InputError(
            f"{path}: {needs_bytes / 1e9:.3g} GB may be needed, {free / 1e9:.3g} GB are free there; make room, "
            "choose another place, or write less"
        )


@contextmanager
def _removed(path: Path) -> Iterator[Path]:
    """Yield ``path``; the file or folder is gone afterwards."""
    try:
        yield path
    finally:
        shutil.rmtree(path) if path.is_dir() else path.unlink()


def _try(file: Path, path: Path) -> None:
    """Write to ``file``; InputError names ``path``."""
    try:
        file.write_bytes(b"\0" * TRIED_BYTES)
    except OSError as error:
        raise _unwritable(path, error) from error


def _unwritable(path: Path, error: OSError) -> InputError:
    return InputError(f"{path}: cannot be written: {error.strerror}; make room, or choose another place")


def _begun(path: Path) -> Path:
    if path.is_dir():
        raise InputError(f"{path}: is a folder; name a file to write")
    if not path.parent.is_dir():
        raise InputError(f"{path}: there is no folder {path.parent}; make it first")
    try:
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.stem}.", suffix=path.suffix)
    except OSError as error:
        raise _unwritable(path, error) from error
    os.close(handle)
    return Path(name)
