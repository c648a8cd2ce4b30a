"""Read-only arrays with a checked shape: the ground that every value of the vocabulary stands on."""

from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

Array = NDArray[Any]


def read_only(values: Any, shape: tuple[int | None, ...], name: str, dtype: DTypeLike = np.float64) -> Array:
    """Return ``values`` as a read-only contiguous array of ``dtype``, checked against ``shape``.

    ``None`` in ``shape`` stands for any length. A read-only array of the right type that owns its
    memory is returned as it is; anything else is copied, so that nobody else can write into it.

    Raises ValueError naming the quantity, the shape wanted and the shape given.
    """
    given = np.asarray(values, dtype=dtype)
    if given.size == 0 and given.ndim != len(shape):
        given = given.reshape([0 if n is None else n for n in shape])
    have = given.shape
    # a comparison in one go for what is nearly always right: this runs for every column of every frame set
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


def read_only_image(pixels: Any) -> Array:
    """Return an image (H, W) of uint8 or uint16 that nobody can write to.

    The memory is taken over without a copy (frames are large): the caller gives the array away.
    Raises ValueError for any other shape or type.
    """
    image: Array = np.asarray(pixels)
    if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"image: shape {image.shape} of {image.dtype} given, (H, W) of uint8 or uint16 wanted")
    image.setflags(write=False)
    return image


def looked_at(values: Array) -> Array:
    """Return a view of an array through which nobody can write.

    Compiled code is made anew for arrays that can be written and for those that cannot: what only looks at its
    arguments is handed views, and is compiled once.
    """
    view = values.view()
    view.setflags(write=False)
    return view
