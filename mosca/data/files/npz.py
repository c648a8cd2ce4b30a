"""Arrays written to and read from .npz files, with a checksum; errors are one line.

The checksums of a zip file cover neither the arrays' names nor bytes behind the last one that is read. So a further
array ``sha256`` holds the digest of names, types, shapes and values. Files without it are read, too.
"""

import hashlib
import math
import zipfile
import zlib
from collections.abc import Callable, Mapping
from io import BufferedReader
from pathlib import Path
from typing import TypeVar

import numpy as np

from mosca.data.arrays import Array
from mosca.data.files.bounded import open_file
from mosca.errors import InputError

Made = TypeVar("Made")
SMALL_BYTES = 1 << 28
"""Arrays up to this size are read at any compression ratio [B]."""
MOST_RATIO = 100
"""Largest ratio of the size of larger arrays to the archive's; deflate reaches 1000 where all bytes are the same."""
_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
DIGEST = "sha256"
_ENCRYPTED = 1
"""Bit 0 of the flags of a zip file's member (APPNOTE 4.4.4)."""


def write_npz_file(path: Path, arrays: Mapping[str, Array]) -> None:
    """Write arrays under their names, compressed, without pickles, with their checksum."""
    with open(path, "wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays, **{DIGEST: array_digest(arrays)})


def array_digest(arrays: Mapping[str, Array]) -> Array:
    """Return the digest (32,) of names, types, shapes and values of arrays."""
    total = hashlib.sha256()
    for name in sorted(arrays):
        values = np.ascontiguousarray(arrays[name])
        total.update(f"{name}\0{values.dtype.str}\0{np.shape(arrays[name])}\0".encode())
        total.update(values.tobytes())
    return np.frombuffer(total.digest(), np.uint8)


def _checked(arrays: Mapping[str, Array]) -> Mapping[str, Array]:
    """Return the arrays; ValueError where they have a checksum that does not match."""
    if DIGEST not in arrays:
        return arrays
    loaded = dict(arrays)  # loaded once: numpy's mapping reads the file at every access
    if not np.array_equal(loaded.pop(DIGEST), array_digest(loaded)):
        raise ValueError(f"damaged: its arrays are not those of its checksum ({DIGEST})")
    return loaded


def whole_numbers(arrays: Mapping[str, Array], *names: str) -> None:
    """Raise ValueError where a named array is not of an integer type, since its numbers would be cut off."""
    for name in names:
        values = np.asarray(arrays[name])
        if values.size and values.dtype.kind not in "iu":
            raise ValueError(f"{name} holds {values.dtype}; whole numbers (int64) are wanted")


def from_npz(path: Path, make: Callable[[Mapping[str, Array]], Made], what: str, wrote: str) -> Made:
    """Return what ``make`` builds from a file's arrays, a mapping by their names.

    Raises InputError for a missing or damaged file, and where ``make`` finds a name missing (KeyError) or arrays that
    do not fit (ValueError, TypeError). ``what``: the expected content, e.g. "tracks"; ``wrote``: its usual writer.
    """
    try:
        # opened here, since numpy leaves a file open that is no archive
        with open_file(path) as file:
            _check_sizes(file)
            arrays = np.load(file, allow_pickle=False)
            if not isinstance(arrays, Mapping):
                raise ValueError("it is a single array")
            return make(_checked(arrays))
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; a file of {what} is wanted") from None
    except IsADirectoryError:
        raise InputError(f"{path}: is a folder; a file of {what} is wanted") from None
    except KeyError as error:
        raise InputError(f"{path}: holds no {what}: {error.args[0]}; give what {wrote} wrote") from None
    except (OSError, ValueError, TypeError, EOFError, NotImplementedError, zipfile.BadZipFile, zlib.error) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{path}: holds no {what}: {reason}; give what {wrote} wrote") from None


def _check_sizes(file: BufferedReader) -> None:
    """Raise ValueError where arrays would take more memory than an archive of this size plausibly holds."""
    if not zipfile.is_zipfile(file):
        file.seek(0)
        single = file.read(len(np.lib.format.MAGIC_PREFIX)) == np.lib.format.MAGIC_PREFIX
        raise ValueError("it is a single array" if single else "it is no archive of arrays")
    with zipfile.ZipFile(file) as archive:
        members = archive.infolist()
        n_bytes, most = sum(member.file_size for member in members), max(SMALL_BYTES, MOST_RATIO * _packed(members))
        if n_bytes > most:
            raise ValueError(f"its arrays would take {n_bytes} bytes; at most {most} are read from so small a file")
        for member in members:
            if member.flag_bits & _ENCRYPTED:
                raise ValueError(f"{member.filename} is encrypted")
            with archive.open(member) as array:
                version = np.lib.format.read_magic(array)
                if version not in _HEADERS:
                    raise ValueError(f"{member.filename} is an array of format {version}")
                shape, _, dtype = _HEADERS[version](array)
                if array.tell() + math.prod(shape) * dtype.itemsize > member.file_size:
                    raise ValueError(f"{member.filename} states the shape {shape} and holds {member.file_size} bytes")
    file.seek(0)


def _packed(members: list[zipfile.ZipInfo]) -> int:
    return sum(member.compress_size for member in members)
