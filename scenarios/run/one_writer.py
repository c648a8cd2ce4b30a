"""A lock beside a folder, so that one run at a time writes into it; the lock file names its holder."""

import json
import logging
import os
import platform
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any, TextIO

from mosca.data.files.bounded import parse_json
from mosca.data.files.whole_file import check_folder
from mosca.errors import InputError

LOG = logging.getLogger(__name__)
HOLDER_BYTES = 4096
"""Most bytes of a lock file that are read: the text on the holder takes some hundred."""


@contextmanager
def one_writer(out: Path) -> Iterator[None]:
    """Hold the lock of the folder ``out``; InputError names a present holder.

    The operating system releases the lock of a process that died; it is taken over with a warning. The folders above
    ``out`` are made, and removed again where nothing was written. Without flock (Windows) there is no lock.
    """
    try:
        import fcntl  # noqa: F401
    except ImportError:
        yield
        return
    out = out.absolute()
    check_folder(out.parent)
    missing = [folder for folder in out.parents if not folder.exists()]
    path = out.with_name(f".{out.name}.lock")
    file = _locked(path, out)
    try:
        left = _holder(file)
        if left:
            LOG.warning("%s: taken over from process %s which did not end its work here", out, _who(left))
        file.seek(0)
        file.truncate()
        started = datetime.now().astimezone().isoformat(timespec="seconds")
        json.dump({"pid": os.getpid(), "host": platform.node(), "started": started}, file)
        file.flush()
        yield
    finally:
        path.unlink(missing_ok=True)
        file.close()
        for folder in missing:
            try:
                folder.rmdir()
            except OSError:  # something was written there
                break


def _locked(path: Path, out: Path) -> TextIO:
    """Return the lock file, open and locked."""
    import fcntl

    while True:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            file = open(path, "a+", encoding="utf-8")  # noqa: SIM115 (closed by the caller)
        except FileNotFoundError:  # another run removed the folder that it had made
            continue
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            held = _holder(file)
            file.close()
            raise InputError(
                f"{out}: process {_who(held)} writes there now; wait until it has ended, or choose another folder"
            ) from None
        # the holder may have removed the file between opening and locking: then the lock has no effect
        if path.exists() and os.path.samestat(os.fstat(file.fileno()), path.stat()):
            return file
        file.close()


def _holder(file: TextIO) -> dict[str, Any]:
    file.seek(0)
    try:
        found = parse_json(file.read(HOLDER_BYTES) or "{}")
    except ValueError:  # cut short
        return {"pid": "unknown"}
    return found if isinstance(found, dict) else {}


def _who(held: dict[str, Any]) -> str:
    return f"{held.get('pid', 'unknown')} on {held.get('host', 'unknown')}, started {held.get('started', 'unknown')},"
