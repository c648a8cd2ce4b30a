"""Read-only arrays with a checked shape, used by all data types of ``mosca.data``."""

from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

Array = NDArray[Any]


def read_only(values: Any, shape: tuple[int | None, ...], name: str, dtype: DTypeLike = np.float64) -> Array:
    """Return ``values`` as a read-only contiguous array of ``dtype``, checked against ``shape``.

    ``None`` in ``shape`` matches any length. A read-only array of the right type that owns its memory is returned as
    it is; anything else is copied, so that no other reference can write to it.

    Raises ValueError naming the quantity, the expected shape and the given one.
    """
    given = np.asarray(values, dtype=dtype)
    if given.size == 0 and given.ndim != len(shape):
        given = given.reshape([0 if n is None else n for n in shape])
    have = given.shape
    # whole shapes first, since they are nearly always equal: this runs for every column of every frame set
    if have != shape and (
        len(have) != len(shape) or any(n not in (None, m) for n, m in zip(shape, have, strict=True))
    ):
        wanted = "(" + ", ".join("n" if n is None else str(n) for n in shape) + ")"
        raise ValueError(f"{name}: shape {have} given, {wanted} wanted")
    flags = given.flags
    if flags.writeable or not flags.c_contiguous or given.base is not None:
        given = np.array(given, dtype=dtype, order="C", copy=True)
        given.setflags(write=False)
    return given


def set_read_only(owner: object, dtype: DTypeLike = np.float64, /, **shapes: tuple[int | None, ...]) -> None:
    """Make attributes of a frozen dataclass read-only arrays of ``dtype``, each checked against its shape."""
    for name, shape in shapes.items():
        object.__setattr__(owner, name, read_only(getattr(owner, name), shape, name, dtype))


def read_only_image(pixels: Any) -> Array:
    """Return an image (H, W) of uint8 or uint16, made read-only.

    The array is not copied, since frames are large: the caller must not write to it afterwards. Raises ValueError for
    any other shape or type.
    """
    image: Array = np.asarray(pixels)
    if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"image: shape {image.shape} of {image.dtype} given, (H, W) of uint8 or uint16 wanted")
    image.setflags(write=False)
    return image


def middle(ordered: Array) -> float:
    """Return the median of sorted values (n,), n >= 1; sorting included, it takes half of ``np.median``'s time."""
    n = len(ordered)
    return 0.5 * float(ordered[(n - 1) // 2] + ordered[n // 2])


def looked_at(values: Array) -> Array:
    """Return a read-only view of an array.

    Numba compiles a function separately for writable and read-only arrays; functions that only read are always passed
    read-only views, and so are compiled once.
    """
    view = values.view()
    view.setflags(write=False)
    return view
