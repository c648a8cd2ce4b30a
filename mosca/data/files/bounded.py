"""How every reader opens a file that it did not write: a regular file, of a size that it can hold.

What is refused raises ``OSError`` with a text that says what to do, so that a reader reports it as any file that
cannot be read.
"""

import errno
import os
import stat
from io import BufferedReader
from pathlib import Path

_KINDS = (
    (stat.S_ISFIFO, "a named pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


def open_file(path: str | Path, most_bytes: int | None = None, *, links: bool = True) -> BufferedReader:
    """Open a regular file for reading, without waiting for anything.

    ``most_bytes``: OSError where it is larger; None for files that are read piece by piece. ``links``: whether
    ``path`` itself may be a symbolic link. Raises IsADirectoryError for a folder, OSError for other special files.
    """
    # a pipe without a writer would block open() for ever
    flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
    if not links and Path(path).is_symlink():
        raise OSError(errno.ELOOP, "is a symbolic link; put the file itself there", str(path))
    handle = os.open(path, flags | (0 if links else getattr(os, "O_NOFOLLOW", 0)))
    try:
        state = os.fstat(handle)
        if stat.S_ISDIR(state.st_mode):
            raise IsADirectoryError(errno.EISDIR, "is a folder; name a file", str(path))
        if not stat.S_ISREG(state.st_mode):
            kind = next((text for test, text in _KINDS if test(state.st_mode)), "something else")
            raise OSError(errno.EINVAL, f"is {kind}; name a regular file", str(path))
        if most_bytes is not None and state.st_size > most_bytes:
            text = f"has {state.st_size} bytes, at most {most_bytes} are read; name a file of the right kind"
            raise OSError(errno.EFBIG, text, str(path))
        return os.fdopen(handle, "rb")
    except BaseException:
        os.close(handle)
        raise
