"""Arrays from a user's .npz file, or an error in one line."""

import zipfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TypeVar

import numpy as np

from mosca.data.arrays import Array
from mosca.errors import InputError

Made = TypeVar("Made")


def from_npz(path: Path, make: Callable[[Mapping[str, Array]], Made], what: str, wrote: str) -> Made:
    """Return what ``make`` makes of the arrays in a file, by their names.

    Raises InputError for a missing or damaged file, and where ``make`` finds a name missing (KeyError) or arrays that
    do not fit (ValueError, TypeError). ``what`` is expected, e.g. "tracks"; ``wrote``: what writes such files.
    """
    try:
        # a file of our own: numpy leaves it open where it is no archive
        with open(path, "rb") as file:
            arrays = np.load(file, allow_pickle=False)
            if not isinstance(arrays, Mapping):
                raise ValueError("it is a single array")
            return make(arrays)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; a file of {what} is wanted") from None
    except IsADirectoryError:
        raise InputError(f"{path}: is a folder; a file of {what} is wanted") from None
    except KeyError as error:
        raise InputError(f"{path}: holds no {what}: {error.args[0]}; give what {wrote} wrote") from None
    except (OSError, ValueError, TypeError, EOFError, NotImplementedError, zipfile.BadZipFile, zlib.error) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{path}: holds no {what}: {reason}; give what {wrote} wrote") from None
