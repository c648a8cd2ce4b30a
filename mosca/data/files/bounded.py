"""Opening of files that a reader did not write: regular files only, of a size that it can hold.

A refused file raises ``OSError`` with a text that states the remedy; readers report it like any unreadable file.
``tests/reader_law.py`` lists the few other places that open or parse files that they did not write.
"""

import errno
import json
import os
import re
import stat
from io import BufferedReader, TextIOWrapper
from pathlib import Path
from typing import Any

from mosca.errors import InputError

MOST_TEXT_BYTES = 1 << 23
"""Largest text file that is parsed as a whole [B]: parsed, it takes some twenty times its size in memory."""
MOST_TABLE_BYTES = 1 << 27
"""Largest text file of rows of numbers [B]: parsed, it takes 14 to 27 times its size, since cells are objects."""
MOST_IMAGE_BYTES = 3 << 27
"""Largest image, as a file and decoded [B]: the largest sensors have 151 million pixels of 16 bit, 302 MB."""
MOST_DEPTH = 64
"""Deepest nesting of tables and lists; no file of this project needs more than ten."""

_KINDS = (
    (stat.S_ISFIFO, "a named pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)
_TOKENS = re.compile(r'"(?:[^"\\]|\\.)*"|[\[\]{}]', re.DOTALL)


def open_file(path: str | Path, most_bytes: int | None = None, *, links: bool = True) -> BufferedReader:
    """Open a regular file for reading, without waiting for anything.

    ``most_bytes``: OSError where the file is larger; None for files read piece by piece. ``links``: whether
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


def read_bytes(path: str | Path, most_bytes: int = MOST_TEXT_BYTES) -> bytes:
    """Return the content of a regular file; raises OSError as ``open_file`` does."""
    with open_file(path, most_bytes) as file:
        return file.read(os.fstat(file.fileno()).st_size)  # of a growing file, what it holds now


def read_text(path: str | Path, what: str, encoding: str = "utf-8", most_bytes: int = MOST_TEXT_BYTES) -> str:
    """Return the text of a regular file with line ends \\n; one-line InputError where it cannot be read as text.

    ``what``: the kind of file that is wanted, e.g. "a BVH file".
    """
    try:
        with TextIOWrapper(open_file(path, most_bytes), encoding=encoding) as file:
            return file.read()
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; {what} is wanted") from None
    except IsADirectoryError:
        raise InputError(f"{path}: is a folder; {what} is wanted") from None
    except UnicodeDecodeError as error:
        reason = f"no {encoding} text ({error.reason} at byte {error.start})"
        raise InputError(f"{path}: cannot be read: {reason}; {what} is wanted") from None
    except (OSError, UnicodeError) as error:
        raise InputError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None


def parse_json(text: str | bytes) -> Any:
    """Return the value of a JSON text; ValueError where it is not JSON, too deep, or a number has too many digits."""
    if isinstance(text, bytes):
        text = text.decode("utf-8")
    check_brackets(text)
    return json.loads(text)


def check_brackets(text: str) -> None:
    """Raise ValueError where brackets and braces of JSON or YAML are nested deeper than ``MOST_DEPTH``.

    To be called before a recursive parser, whose stack would overflow. Brackets in strings are not counted.
    """
    depth = 0
    for token in _TOKENS.finditer(text):
        if token[0] in "[{":
            depth += 1
            if depth > MOST_DEPTH:
                raise ValueError(f"lists and tables stand more than {MOST_DEPTH} deep inside each other")
        elif token[0] in "]}":
            depth = max(depth - 1, 0)
