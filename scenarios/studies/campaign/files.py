"""The files that a scenario names, by their content; they are sent to where the run is made."""

import hashlib
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePath
from typing import Any

from mosca.data.files.bounded import read_bytes

MOST_BYTES = 1 << 28
"""Largest size of one file that is sent."""
TEXT_BYTES = 1 << 22
"""Largest size of a file that is searched for names of other files: a model names its meshes."""
NAME = re.compile(rb"[\w./\\ -]+\.\w+")


@dataclass(frozen=True)
class FileSet:
    """Files around a scenario: their places, and the content of each."""

    folder: str = "."
    """Folder of the scenario, relative to the root of the places."""
    digests: Mapping[str, str] = field(default_factory=dict)
    """Place of a file, relative to the root -> SHA-256 of its content."""
    contents: Mapping[str, bytes] = field(default_factory=dict, repr=False, compare=False)
    """SHA-256 -> content."""

    def without_contents(self) -> "FileSet":
        """Return only the places and digests."""
        return FileSet(self.folder, self.digests)


def gathered(document: Mapping[str, Any], folder: Path) -> FileSet:
    """Return the files that a scenario's values name, those that these name, and so on.

    Values with an absolute path are changed in ``document`` to paths relative to ``folder``.
    """
    folder = folder.resolve()
    found: dict[Path, bytes] = {}
    wanted = [path for _, _, path in _named(document, folder)]
    while wanted:
        path = wanted.pop()
        if path in found:
            continue
        found[path] = content = read_bytes(path, MOST_BYTES)
        if len(content) <= TEXT_BYTES:
            wanted += _named_inside(content, path.parent)
    if not found:
        return FileSet()
    root = Path(os.path.commonpath([folder, *(path.parent for path in found)]))
    for table, key, path in _named(document, folder):
        if PurePath(table[key]).is_absolute():
            table[key] = os.path.relpath(path, folder)
    digests = {path.relative_to(root).as_posix(): hashlib.sha256(data).hexdigest() for path, data in found.items()}
    contents = {hashlib.sha256(data).hexdigest(): data for data in found.values()}
    return FileSet(os.path.relpath(folder, root), dict(sorted(digests.items())), contents)


def laid_out(files: FileSet, contents: Mapping[str, bytes], root: Path) -> Path:
    """Write the files below ``root`` and return the scenario's folder there."""
    folder = root / files.folder
    folder.mkdir(parents=True, exist_ok=True)
    for place, digest in files.digests.items():
        path = root / place
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(contents[digest])
    return folder


def _named(values: Any, folder: Path) -> Iterator[tuple[Any, Any, Path]]:
    """Yield table or list, key, and file of each value that names a file beside ``folder``."""
    pairs = values.items() if isinstance(values, dict) else enumerate(values) if isinstance(values, list) else ()
    for key, value in list(pairs):
        if isinstance(value, str) and (path := _file(value, folder)) is not None:
            yield values, key, path
        else:
            yield from _named(value, folder)


def _named_inside(content: bytes, folder: Path) -> list[Path]:
    """Return the files whose names are in a text."""
    names = {match.decode("ascii", "ignore").strip() for match in NAME.findall(content)}
    return [path for path in (_file(name, folder) for name in sorted(names)) if path is not None]


def _file(name: str, folder: Path) -> Path | None:
    if not name or len(name) > 500 or "\n" in name or "\0" in name:
        return None
    try:
        path = (folder / name).resolve()
        return path if path.is_file() else None
    except OSError:
        return None
