"""Where compiled kernels are kept: a folder for each state of the sources that went into them.

numba's own cache notices a change of a kernel's own file only, not of the functions and constants from other files
that it has compiled in: after an update it would run old code. So the folder's name is made of all files that hold
kernels and all that those import. A change elsewhere costs no compilation.
"""

import ast
import os
import re
import shutil
import time
import zlib
from collections.abc import Iterator
from pathlib import Path

ROOMS = ("mosca", "twin")
"""Packages that hold kernels."""
KERNEL = re.compile(rb"\bnumba\b|^@\w*(njit|kernel)", re.MULTILINE)
"""A file that holds kernels says so somewhere."""
KEPT_DAYS = 14
"""Folders of older states that nobody has used for so long are removed."""


def keep_kernels_fresh(root: Path) -> None:
    """Point numba to the folder for the present state of the sources in ``root``, where one can be written.

    Must come before numba is imported. A user's own ``NUMBA_CACHE_DIR`` is left alone.
    """
    if "NUMBA_CACHE_DIR" in os.environ or not os.access(root, os.W_OK):
        return
    kept = root / ".kernels"
    # reading all sources takes a tenth of a second: done once for each state of their sizes and times
    note = kept / f"{_stamp(root):08x}.state"
    try:
        state = note.read_text(encoding="ascii")
    except FileNotFoundError:
        state = f"{kernel_state(root):08x}"
        kept.mkdir(exist_ok=True)
        _forget_old(kept, state)
        # whole or not at all: another process may be reading
        part = note.with_suffix(f".{os.getpid()}")
        part.write_text(state, encoding="ascii")
        part.replace(note)
    os.environ["NUMBA_CACHE_DIR"] = str(kept / state)


def kernel_state(root: Path) -> int:
    """Return a checksum of all sources in ``root`` that compiled kernels can depend on."""
    state = 0
    for path in kernel_sources(root):
        state = zlib.crc32(path.relative_to(root).as_posix().encode() + path.read_bytes(), state)
    return state


def kernel_sources(root: Path) -> list[Path]:
    """Return the files with kernels and all files that they import, directly or not, in order of their names."""
    text = {path: path.read_bytes() for path in _sources(root)}
    wanted = [path for path, content in text.items() if KERNEL.search(content)]
    found = set(wanted)
    while wanted:
        for module in _imported(text[wanted.pop()]):
            stem = root.joinpath(*module.split("."))
            for path in (stem.with_suffix(".py"), stem / "__init__.py"):
                if path in text and path not in found:
                    found.add(path)
                    wanted.append(path)
    return sorted(found)


def _imported(source: bytes) -> Iterator[str]:
    """Yield the names of what a source imports; of ``from a import b`` both ``a`` and ``a.b``."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (one.name for one in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            yield node.module
            yield from (f"{node.module}.{one.name}" for one in node.names)


def _sources(root: Path) -> list[Path]:
    return [path for room in ROOMS for path in sorted((root / room).rglob("*.py"))]


def _stamp(root: Path) -> int:
    state = 0
    for path in _sources(root):
        told = path.stat()
        state = zlib.crc32(f"{path.name}{told.st_size}{told.st_mtime_ns}".encode(), state)
    return state


def _forget_old(kept: Path, state: str) -> None:
    """Remove what was kept for states other than ``state`` that nobody has compiled for in a while."""
    oldest = time.time() - KEPT_DAYS * 86400
    for path in kept.iterdir():
        try:
            if path.name != state and path.stat().st_mtime < oldest:
                shutil.rmtree(path) if path.is_dir() else path.unlink()
        except FileNotFoundError:
            continue  # another process tidies up at the same time
