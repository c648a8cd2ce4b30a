"""Readers that do what must not happen, each called as the failure that it is."""

import os
from pathlib import Path
from typing import Any

from fuzz.reader import MUTANT, Reader

from mosca.errors import InputError


class _TwoLinesError(InputError):
    """One that does not keep to a line."""

    def __str__(self) -> str:
        """Return two lines."""
        return "two\nlines"


def _seed(folder: Path) -> None:
    (folder / "a.txt").write_bytes(b"whole")


def _planted(name: str) -> Reader:
    def read(folder: Path) -> Any:
        if folder.name != MUTANT:
            return 2.0
        match name:
            case "hang":
                while True:
                    pass
            case "died":
                os.abort()
            case "memory":
                return len(bytearray(1 << 31))
            case "traceback":
                return {}["gone"]
            case "several lines":
                raise _TwoLinesError
        return 3.0

    return Reader(name, (_seed,), ("a.txt",), read, lambda folder: 2.0)


READERS = {name: _planted(name) for name in ("hang", "died", "memory", "traceback", "several lines", "differs")}
