"""Calibrations of sessions, and other results, cached by the content of all their inputs.

Scenarios whose cameras are the same at rest share one session, and later runs find it in ``XDG_CACHE_HOME`` or
``~/.cache``, under ``mosca-testbench/calibrations``. A file begins with the digest of its remaining content; a
truncated file is made again. The folder may be removed at any time.
"""

import hashlib
import logging
import os
import pickle
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from pydantic import BaseModel

from mosca.data.files.bounded import read_bytes
from mosca.data.files.whole_file import whole_file
from mosca.errors import InputError
from mosca.numba_support.cache import source_stamp
from scenarios.run.provenance import numerics
from scenarios.session import estimated

LOG = logging.getLogger(__name__)
MOST_BYTES = 1 << 28
"""Most bytes of a cached calibration that is read."""
MOST_KEPT = 200
"""Most calibrations that are cached, the last used ones (a megabyte each)."""
SESSION_CODE = Path(estimated.__file__)
Kept = TypeVar("Kept")


def cache_folder(of: str = "calibrations") -> Path:
    """Return the folder of the cached calibrations, or of other cached results."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "mosca-testbench" / of


def kept(
    inputs: object,
    made: Callable[[], Kept],
    folder: Path | None = None,
    *,
    code: Path = SESSION_CODE,
    most: int | None = None,
) -> Kept:
    """Return the calibration of these inputs, from ``folder``, or ``made`` now and cached there.

    ``inputs``: all that it depends on besides the code and the processor: numbers, texts, arrays, dataclasses,
    tables, and tuples and mappings of these; ``code``: the source file that makes it, with all that it imports.
    Another process that makes the same calibration is waited for. Where the folder cannot be written, a warning is
    logged. ``most``: number that are cached (None: MOST_KEPT).
    """
    folder = folder or cache_folder()
    path = folder / f"{key_of(inputs, code)}.calibration"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        LOG.warning("%s: calibrations are not kept: %s", folder, error.strerror)
        return made()
    with _one_at_a_time(path.with_suffix(".lock")):
        found: Kept | None = read_kept(path)
        if found is not None:
            LOG.info("calibration kept in %s", path)
            return found
        result = made()
        try:
            write_kept(path, result)
            _remove_oldest(folder, MOST_KEPT if most is None else most)
        except (OSError, InputError) as error:
            LOG.warning("%s: the calibration is not kept: %s", path, error)
        return result


def key_of(inputs: object, code: Path = SESSION_CODE) -> str:
    """Return a digest of the inputs, of the code and of all else that affects last digits."""
    return digest_of((source_stamp(code), numerics(), inputs))


def digest_of(value: object) -> str:
    """Return a digest of numbers, texts, arrays, dataclasses, tables, and tuples and mappings of these."""
    digest = hashlib.sha256()
    _add(digest, value)
    return digest.hexdigest()[:32]


def _add(digest: Any, value: object) -> None:
    """Add a value to a digest, with its type, so that equal values give equal digests."""
    digest.update(f"{type(value).__qualname__}(".encode())
    if isinstance(value, np.ndarray):
        digest.update(f"{value.dtype}{value.shape}".encode() + np.ascontiguousarray(value).tobytes())
    elif isinstance(value, BaseModel):
        _add(digest, value.model_dump())
    elif is_dataclass(value):
        _add(digest, {one.name: getattr(value, one.name) for one in fields(value)})
    elif isinstance(value, Mapping):
        for key in sorted(value, key=repr):
            _add(digest, key)
            _add(digest, value[key])
    elif isinstance(value, tuple | list):
        for one in value:
            _add(digest, one)
    elif value is None or isinstance(value, str | int | float | np.generic):
        digest.update(repr(value).encode())
    else:
        raise TypeError(f"{type(value).__name__} has no digest")
    digest.update(b")")


def read_kept(path: Path) -> Any:
    """Return the result cached in a file; None where there is no file, or where it is truncated."""
    try:
        content = read_bytes(path, MOST_BYTES)
    except OSError:
        return None
    head, body = content[:32], content[32:]
    if hashlib.sha256(body).digest() != head:
        return None
    with suppress(OSError):  # the folder may be read-only
        os.utime(path)
    return pickle.loads(body)


def write_kept(path: Path, result: object) -> None:
    """Write a result that ``read_kept`` reads, whole or not at all."""
    body = pickle.dumps(result)
    with whole_file(path) as temporary:
        temporary.write_bytes(hashlib.sha256(body).digest() + body)


def _remove_oldest(folder: Path, most: int) -> None:
    last_used = sorted(folder.glob("*.calibration"), key=lambda path: path.stat().st_mtime)
    for path in last_used[:-most]:
        path.unlink(missing_ok=True)
        path.with_suffix(".lock").unlink(missing_ok=True)


@contextmanager
def _one_at_a_time(path: Path) -> Iterator[None]:
    """Hold the lock file as soon as no other process holds it; without flock (Windows) there is no lock."""
    try:
        import fcntl
    except ImportError:
        yield
        return
    try:
        file = path.open("w")
    except OSError:
        yield
        return
    with file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield
