"""Files that are written whole or not at all."""

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from mosca.errors import InputError


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path`` with the same suffix; renamed to ``path`` at the end.

    When the body raises, the temporary file is removed and an existing file at ``path`` is untouched. Raises
    InputError where the folder is missing or not writable, or ``path`` is a folder.
    """
    temporary = _begun(path)
    try:
        yield temporary
        temporary.chmod(0o644)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write ``text`` as UTF-8 to ``path`` as ``whole_file`` does."""
    with whole_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def check_writable(path: Path) -> None:
    """Raise InputError where ``whole_file`` could not write ``path``: asked before long work, not after it."""
    _begun(path).unlink()


def check_folder(path: Path) -> None:
    """Raise InputError where the folder ``path``, and those above it that are missing, could not be made."""
    there = next((folder for folder in (path, *path.absolute().parents) if folder.exists()), path)
    if not there.is_dir():
        raise InputError(f"{path}: {there} is no folder; choose another place")
    try:
        Path(tempfile.mkdtemp(dir=there, prefix=f".{path.name}.")).rmdir()
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from None


def _begun(path: Path) -> Path:
    if path.is_dir():
        raise InputError(f"{path}: is a folder; name a file to write")
    if not path.parent.is_dir():
        raise InputError(f"{path}: there is no folder {path.parent}; make it first")
    try:
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.stem}.", suffix=path.suffix)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from None
    os.close(handle)
    return Path(name)
