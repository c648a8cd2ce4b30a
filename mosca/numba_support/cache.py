"""Cache of compiled kernels, valid until a source that went into them changes.

Numba's own cache detects changes of a kernel's own file only, not of functions and constants that were compiled in
from other files: after an update it would run old code. Here the stamp that Numba compares also covers all files of
this project that the kernel's file imports, directly or not. Where the files lie is Numba's choice: ``__pycache__``
beside the source, a user's cache folder, or ``NUMBA_CACHE_DIR``.
"""

import functools
import hashlib
import re
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("mosca", "twin")
"""Packages that hold kernels."""
IMPORT = re.compile(
    rb"^\s*(?:from\s+((?:%b)(?:\.\w+)*)\s+import\s+(\([^)]*\)|[^\n]*)|import\s+((?:%b)[\w.]*))"
    % (("|".join(PACKAGES).encode(),) * 2),
    re.MULTILINE,
)


def kept(dispatcher: Any) -> Any:
    """Return a Numba dispatcher made with ``cache=True``, with a cache version that also covers what it imports.

    Numba compares the version of an index file before it reads the rest, which may name classes that an update has
    removed. Data files carry the digest too: a process that still runs older sources cannot replace them. Version and
    pattern are private attributes of Numba's index file (0.61 to 0.68 have them); the alternative, subclasses of five
    cache locators, touches more private names. ``tests/mosca/test_kernel_cache.py`` shows that it works.
    """
    digest = source_stamp(Path(dispatcher.py_func.__code__.co_filename))
    index = dispatcher._cache._cache_file
    index._version = (index._version, digest)
    index._data_name_pattern = index._data_name_pattern.replace(".{number", f".{digest[:12]}.{{number")
    return dispatcher


def is_compiled(dispatcher: Any) -> bool:
    """Return whether a kernel's code for this processor is kept and up to date."""
    if dispatcher.signatures:
        return True
    from numba.core.registry import cpu_target

    here = cpu_target.target_context.codegen().magic_tuple()
    return any(here in key for key in dispatcher._cache._cache_file._load_index())


@functools.cache
def source_stamp(path: Path, root: Path = ROOT) -> str:
    """Return a digest of a source file and of all files below ``root`` that it imports, directly or not."""
    digest = hashlib.sha256()
    for source in sources(path, root):
        digest.update(source.name.encode() + _read(source)[0])
    return digest.hexdigest()


def sources(path: Path, root: Path = ROOT) -> list[Path]:
    """Return a source file and the files below ``root`` that it imports, directly or not, in order of their names."""
    found, wanted = {path}, [path]
    while wanted:
        for file in _imported(wanted.pop(), root):
            if file not in found:
                found.add(file)
                wanted.append(file)
    return sorted(found)


@functools.cache
def _imported(path: Path, root: Path) -> tuple[Path, ...]:
    """Return the files below ``root`` that a file itself imports."""
    stems = [root.joinpath(*module.split(".")) for module in _read(path)[1]]
    files = [file for stem in stems for file in (stem.with_suffix(".py"), stem / "__init__.py")]
    return tuple(file for file in dict.fromkeys(files) if file.is_file())


@functools.cache
def _read(path: Path) -> tuple[bytes, tuple[str, ...]]:
    """Return a file's digest and the names of what it imports; of ``from a import b`` both ``a`` and ``a.b``."""
    text = path.read_bytes()
    names = []
    for package, members, module in IMPORT.findall(text):
        names.append((package or module).decode())
        names += [f"{package.decode()}.{m.split()[0]}" for m in members.decode().strip("()").split(",") if m.split()]
    return hashlib.sha256(text).digest(), tuple(names)
