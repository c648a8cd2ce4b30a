"""What the fuzzer must know of a reader."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

DATA = Path(os.environ.get("MOSCA_DATA", "/nowhere"))
"""Real data sets, where there are any."""
MUTANT = "mutant"
"""What a mutant's folder is called."""


@dataclass(frozen=True)
class Reader:
    """A reader of files that users give."""

    name: str
    seeds: tuple[Callable[[Path], None], ...]
    """Each writes whole files into an empty folder."""
    files: tuple[str, ...]
    """Patterns of those that are mutated."""
    read: Callable[[Path], Any]
    """What the program reads from the folder, as nested plain values."""
    expect: Callable[[Path], Any] | None = None
    """The same by an independent reader; None: a file with a checksum, which is read as it was written or refused."""
    binary: tuple[str, ...] = (
        ".npz",
        ".parquet",
        ".c3d",
        ".mcap",
        ".tail",
        ".png",
        ".tif",
        ".bmp",
        ".mkv",
        ".avi",
        ".mp4",
    )

    def text(self, path: Path) -> bool:
        """Return whether a file of it has lines and numbers."""
        return path.suffix.lower() not in self.binary


def copied(source: Path, name: str) -> tuple[Callable[[Path], None], ...]:
    """Return a seed that is a copy of a file of another program; none where it is not there."""
    if not source.is_file():
        return ()
    return (lambda folder: (folder / name).write_bytes(source.read_bytes()) and None,)
