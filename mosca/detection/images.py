"""Images of a frame set for compiled code: their addresses in memory, without a copy."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mosca.data.arrays import Array
from mosca.numba_support.decorators import step
from mosca.numba_support.intrinsics import array_at

_TEXTURE = np.empty(0, np.float32)
_LIKE: dict[object, Array] = {np.dtype(np.uint8): np.empty(0, np.uint8), np.dtype(np.uint16): np.empty(0, np.uint16)}


class ImageSet(NamedTuple):
    """Contiguous images of one size and type."""

    addresses: Array
    """Address of each image's first pixel (n,) uint64. The caller keeps the images alive."""
    limits: Array
    """Address of the first of each image's limits (n,) uint64, arrays of the images' size and type. Pixels above
    their limit are looked at."""
    behind: Array
    """Address of the first pixel of each image's background texture (n,) uint64, 0 where there is none. A texture (2,
    H, W) float32 is what was subtracted though targets hide it, and the standard deviation of its error [DN]."""
    like: Array
    """Empty array of the pixels' type (0,): uint8 or uint16."""
    height: int
    """Rows of each image."""
    width: int
    """Columns of each image."""


def image_set(images: Sequence[Array], limits: Sequence[Array], behind: Sequence[Array | None]) -> ImageSet:
    """Describe contiguous images (H, W), at least one, of one size and type (uint8 or uint16).

    ``limits``: one array for each image, of its size and type; ``behind``: for each image (2, H, W) float32, what was
    subtracted from it and the standard deviation of the error [DN], or None.
    """
    height, width = images[0].shape
    addresses = np.array(
        [[0 if part is None else part.ctypes.data for part in parts] for parts in (images, limits, behind)], np.uint64
    )
    return ImageSet(addresses[0], addresses[1], addresses[2], _LIKE[images[0].dtype], height, width)


@step
def image_of(images: ImageSet, k: int) -> Array:
    """Return image k (H, W) as a non-owning view."""
    result: Array = array_at(images.addresses[k], images.like, (images.height, images.width))
    return result


@step
def pixels_of(images: ImageSet, k: int) -> Array:
    """Return all pixels (H * W,) of image k, row by row, as a non-owning view."""
    result: Array = array_at(images.addresses[k], images.like, (images.height * images.width,))
    return result


@step
def behind_of(images: ImageSet, k: int) -> Array:
    """Return what was subtracted from image k and its error (2, H, W) float32 [DN], as a non-owning view.

    The view is empty where nothing was subtracted.
    """
    there = np.int64(images.behind[k] != 0)
    result: Array = array_at(images.behind[k], _TEXTURE, (2 * there, images.height, images.width))
    return result


@step
def limits_of(images: ImageSet, k: int) -> Array:
    """Return the limits (H * W,) of image k's pixels, row by row, as a non-owning view."""
    result: Array = array_at(images.limits[k], images.like, (images.height * images.width,))
    return result
