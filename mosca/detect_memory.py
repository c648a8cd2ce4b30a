"""Images where they lie in memory, for compiled kernels.

Kernels in other files compile this in, and Numba keeps a cached kernel as long as *its own* file is unchanged:
after a change here, remove the ``__pycache__`` folder beside this file.
"""

from typing import Any

import numba
import numpy as np
from numba import carray  # type: ignore[attr-defined]
from numba.core import types
from numba.extending import intrinsic

from mosca.data.arrays import Array


@intrinsic
def _pointer(_context: Any, address: Any, like: Any) -> Any:
    """Return ``address`` (uint64) as a pointer to values of the type of the array ``like``."""

    def code(_context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], _context.get_value_type(signature.return_type))

    return types.CPointer(like.dtype)(types.uint64, like), code


_INNER: dict[str, Any] = {"nogil": True, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}


@numba.njit(**_INNER)
def image_at(address: np.uint64, like: Array, height: int, width: int) -> Array:
    """Return the image (H, W) of the type of ``like`` that lies in memory at ``address``, row after row.

    So a kernel takes all images of a frame set without anyone copying them into one array; the caller keeps
    them alive and has checked that they are contiguous and of one size and type.
    """
    return carray(_pointer(address, like), (height, width))  # type: ignore[call-arg]
