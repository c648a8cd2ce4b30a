"""Images of the static scene that are subtracted before detection. Guide to motion capture, "Marker Detection"."""

from collections.abc import Iterable, Iterator

import numpy as np

from mosca.data.arrays import Array
from mosca.errors import InputError


def mean_background(images: Iterable[Array]) -> Array:
    """Return the mean (H, W) of images without targets, rounded to their type (uint8 or uint16).

    Guide to motion capture, "Marker Detection": the mean of the first n frames. Raises InputError where there are no
    images or where they differ in size or type.
    """
    alike = _alike(images)
    first = next(alike)
    total, n = first.astype(np.float64), 1
    for image in alike:
        total += image
        n += 1
    mean: Array = np.rint(total / n).astype(first.dtype)
    return mean


def minimum_background(images: Iterable[Array]) -> Array:
    """Return the smallest value (H, W) that each pixel has in images of one camera, in their type.

    For bright targets that are in every image. A target that moves by its own size leaves no trace in the minimum,
    while the mean keeps a share of slow targets. The minimum lies below the mean by the noise. Raises InputError
    where there are no images or where they differ in size or type.
    """
    alike = _alike(images)
    least = next(alike).copy()
    for image in alike:
        np.minimum(least, image, out=least)
    return least


def _alike(images: Iterable[Array]) -> Iterator[Array]:
    """Yield the images, at least one, all of one size and type."""
    first: Array | None = None
    for n, image in enumerate(images):
        first = image if first is None else first
        if image.shape != first.shape or image.dtype != first.dtype:
            raise InputError(
                f"background: image {n} is {image.shape} of {image.dtype}, the first {first.shape} of "
                f"{first.dtype}; give images of one camera"
            )
        yield image
    if first is None:
        raise InputError("background: no images given; give at least one frame of the camera")
