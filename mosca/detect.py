"""Detection: from an image to sub-pixel targets. Mosca paper, section 3.1.

What a target is. The image is cut at falling thresholds h, from ``Imax - B/2`` (Imax: the largest value the
camera can give) in steps of s as long as h is above h_min; from a threshold that no pixel has, the count goes
on at the next lower grey value that occurs (step 3; the paper prints "until HIST[h] = 0", which must read
"while"). The regions of a threshold are the 8-connected components of ``I > h``. A region is accepted when
(step 6)

- both sides of its box, in pixels, lie strictly between D_min and D_max,
- ``Bmax - Bmin > B``, with the largest and smallest grey value inside it,
- ``N < 2``: of the targets accepted at higher thresholds, it holds at most one. N counts the connected
  components of the output image R so far that lie inside the region. So a target that grows from one
  threshold to the next stays one, and two that were accepted apart stay two when their regions merge lower
  down. (Counted against the previous threshold's regions alone, as step 5 can be read, the merged blob would
  be accepted one step later.)

R is the union of the accepted regions; its components are the targets (step 9): each is the largest accepted
region around its summit. A target that touches the image's border is cut off and is not reported.

Where it is. ``centroid = "paper"`` is step 10 as printed: ``x* = sum x I / sum I`` over the region.
``"background"`` takes the region's mask m, grown by ``dilation_px`` to all sides (a region that ends above
the lowest threshold has a neighbour and is grown by at most 1), and the local background b, the mean of the
pixels not above the lowest threshold on the border of the box around the mask:
``x* = sum_m x (I - b) / S``, ``S = sum_m (I - b)``. Pixels above the region's threshold that are not its own
belong to a neighbour and are left out.

How well. The pixel noise ``var(I) = read^2 + gain (I - b) + 1/12`` (EMVA 1288: dark noise, photon noise,
quantisation; gain in DN per electron) goes through the centroid at first order:
``C = sum_m (p - p*)(p - p*)^T var(I) / S^2 + g g^T var(b) / S^2`` with ``g = sum_m (p - p*)`` and
``var(b) = (read^2 + 1/12) / ring pixels``. The mask is taken as given: what it cuts off is not in C.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import cv2
import numpy as np

from mosca.data.arrays import Array
from mosca.data.detections import Detections
from mosca.detect_kernels import Packing, Search, find_regions_in_set
from mosca.detect_measure import DIAMETER, ELONGATION, PEAK, XX, XY, YY, Noise, X, Y, measure_regions
from mosca.errors import InputError


@dataclass(frozen=True)
class DetectionSettings:
    """What is a target and how it is measured.

    Grey values [DN] are those of an 8-bit image; for an image of more bits they are scaled by
    ``2**(bits - 8)``, so that the same settings serve the same scene.
    """

    contrast_dn: float = 24.0
    """B: a target's largest grey value exceeds its smallest by more than this. Keep it above five times the
    noise at a target's brightest, or its noise is split into targets."""
    step_dn: int = 1
    """s: from one threshold to the next. 1 parts close targets best and costs nothing."""
    lowest_dn: int = 16
    """h_min: all thresholds lie above it. Keep it at least four times the noise above the background."""
    minimum_size_px: float = 1.0
    """D_min: both sides of a target's box are longer than this."""
    maximum_size_px: float = 40.0
    """D_max: both sides of a target's box are shorter than this."""
    centroid: Literal["background", "paper"] = "background"
    """Centroid above the local background over the grown mask, or as printed in the paper."""
    dilation_px: int = 1
    """How far the mask of the "background" centroid reaches beyond the region, 0 to 2. At 0 the centroid is
    drawn to pixel centres by up to 0.04 px; at 2 it gathers noise."""
    read_noise_dn: float = 0.13
    """Dark noise, standard deviation of a pixel without light (10 electrons of 20,000 in 255 DN)."""
    gain_dn_per_e: float = 0.0128
    """Grey values per electron (EMVA 1288: system gain K; 20,000 electrons in 255 DN)."""

    def __post_init__(self) -> None:
        if not 0 < self.contrast_dn < 255:
            raise _out_of_range("contrast_dn", self.contrast_dn, "more than 0 and less than 255")
        if not 0 <= self.lowest_dn < math.floor(255 - self.contrast_dn / 2):
            limit = f"0 to below 255 - contrast_dn / 2 = {math.floor(255 - self.contrast_dn / 2)}"
            raise _out_of_range("lowest_dn", self.lowest_dn, limit)
        if not (self.step_dn >= 1 and self.step_dn == int(self.step_dn)):
            raise _out_of_range("step_dn", self.step_dn, "a whole number from 1")
        if not 0 <= self.minimum_size_px < self.maximum_size_px:
            limit = f"0 to below maximum_size_px = {self.maximum_size_px:g}"
            raise _out_of_range("minimum_size_px", self.minimum_size_px, limit)
        if self.centroid not in ("background", "paper"):
            raise _out_of_range("centroid", self.centroid, "'background' or 'paper'")
        if self.dilation_px not in (0, 1, 2):
            raise _out_of_range("dilation_px", self.dilation_px, "0, 1 or 2")
        for key in ("read_noise_dn", "gain_dn_per_e"):
            value = getattr(self, key)
            if not (value >= 0 and math.isfinite(value)):
                raise _out_of_range(key, value, "0 or more")


DEFAULTS = DetectionSettings()


def detect(
    image: Array,
    camera: str,
    settings: DetectionSettings = DEFAULTS,
    bit_depth: int = 8,
    background: Array | None = None,
) -> Detections:
    """Return the targets in an image (H, W) of uint8 or uint16, in the order of their topmost rows.

    ``bit_depth`` is the number of significant bits of a pixel (8 to 16), ``camera`` the name that the
    detections carry. ``background`` (H, W), of the image's type, is taken off first, negative values becoming
    0 (guide to motion capture, "Marker Detection"; see ``mean_background`` and ``minimum_background``).

    Raises InputError for an image, a background or a bit depth that do not fit each other.
    """
    return detect_set([image], [camera], settings, bit_depth, None if background is None else [background])[0]


def detect_set(
    images: Sequence[Array],
    cameras: Sequence[str],
    settings: DetectionSettings = DEFAULTS,
    bit_depth: int = 8,
    backgrounds: Sequence[Array | None] | None = None,
) -> list[Detections]:
    """Return the targets of each image of a frame set; ``detect`` for several cameras at once.

    Images of one size and type are worked off without the GIL in one go, so that several threads can each
    take a frame set; others one by one.
    """
    if len(images) != len(cameras) or (backgrounds is not None and len(backgrounds) != len(images)):
        n_backgrounds = len(images) if backgrounds is None else len(backgrounds)
        raise InputError(
            f"detection: {len(images)} images, {len(cameras)} cameras and {n_backgrounds} backgrounds given; "
            "give one of each for every camera"
        )
    if not images:
        return []
    pixels = [
        _foreground(image, camera, bit_depth, None if backgrounds is None else backgrounds[i])
        for i, (image, camera) in enumerate(zip(images, cameras, strict=True))
    ]
    if any(image.shape != pixels[0].shape or image.dtype != pixels[0].dtype for image in pixels):
        return [detect(image, name, settings, bit_depth) for image, name in zip(pixels, cameras, strict=True)]
    stack = _stack(pixels)
    runs, regions, lowest = _regions(stack, settings, bit_depth)
    local, noise = settings.centroid == "background", _noise(settings, bit_depth)
    table, image_of = measure_regions(stack, runs, regions, lowest, local, settings.dilation_px, noise)
    bounds = np.searchsorted(image_of, np.arange(len(images) + 1))
    return [_detections(name, table[bounds[i] : bounds[i + 1]]) for i, name in enumerate(cameras)]


def target_regions(image: Array, settings: DetectionSettings = DEFAULTS, bit_depth: int = 8) -> Array:
    """Return the output image R (H, W) int32: 0, or the number of the target from 1 (steps 6 and 9).

    Targets that touch the image's border are still in it.
    """
    stack = _stack([_foreground(image, "image", bit_depth, None)])
    runs, regions, _ = _regions(stack, settings, bit_depth)
    labels = np.zeros(image.shape, np.int32)
    for number, (_, first_run, end_run, _) in enumerate(regions, start=1):
        for row, first, end in runs[first_run:end_run]:
            labels[row, first:end] = number
    return labels


def mean_background(images: Iterable[Array]) -> Array:
    """Return the mean (H, W) of images without targets, rounded to their type (uint8 or uint16).

    Guide to motion capture, "Marker Detection": the mean of the first n frames. Raises InputError where there
    are none or where they differ in size or type.
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

    For bright targets that are in every image: whatever moves by its own size leaves no trace in it, while the
    mean keeps a share of slow targets. It lies below the mean by the noise. Raises InputError where there are
    none or where they differ in size or type.
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


def _out_of_range(key: str, value: object, allowed: str) -> InputError:
    return InputError(f"detection: key '{key}': {value!r} given; {allowed} is allowed")


def _foreground(image: Array, camera: str, bit_depth: int, background: Array | None) -> Array:
    """Return the image less its background, after checking that image, background and bit depth fit."""
    if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16) or 0 in image.shape:
        raise InputError(
            f"detection: camera '{camera}': image {image.shape} of {image.dtype} given; (H, W) of uint8 or "
            "uint16 is allowed: reduce colour to grey first"
        )
    if not 8 <= bit_depth <= 8 * image.dtype.itemsize:
        raise InputError(
            f"detection: camera '{camera}': bit_depth {bit_depth} given for an image of {image.dtype}; "
            f"8 to {8 * image.dtype.itemsize} is allowed"
        )
    if background is None:
        return image
    if background.shape != image.shape or background.dtype != image.dtype:
        raise InputError(
            f"detection: camera '{camera}': background {background.shape} of {background.dtype} given for an "
            f"image {image.shape} of {image.dtype}; make it from this camera's frames with mean_background"
        )
    return np.asarray(cv2.subtract(image, background))


def _stack(images: Sequence[Array]) -> Array:
    """Return images (n, H, W), contiguous and read-only; of one image without a copy."""
    stack = np.ascontiguousarray(images[0])[np.newaxis] if len(images) == 1 else np.stack(images)
    stack.setflags(write=False)
    return stack


def _regions(stack: Array, settings: DetectionSettings, bit_depth: int) -> tuple[Array, Array, Array]:
    """Return what ``find_regions_in_set`` finds in images (n, H, W)."""
    search = _search(settings, bit_depth)
    pixels_a_word = 8 // stack.itemsize
    words = stack
    if stack.shape[2] % pixels_a_word:
        words = np.pad(stack, ((0, 0), (0, 0), (0, -stack.shape[2] % pixels_a_word)))
    words = words.view(np.uint64)
    if not words.flags.aligned:
        words = words.copy()
    words.setflags(write=False)
    runs, regions, lowest = find_regions_in_set(
        stack, words, _packing(stack.itemsize, search.lowest + 2), search
    )
    return runs, regions, lowest


@lru_cache
def _search(settings: DetectionSettings, bit_depth: int) -> Search:
    """Return the search in grey values of images of this bit depth."""
    scale = 2 ** (bit_depth - 8)
    return Search(
        highest=math.floor(2**bit_depth - 1 - settings.contrast_dn * scale / 2),
        lowest=math.floor(settings.lowest_dn * scale),
        step=int(settings.step_dn) * scale,
        contrast=float(settings.contrast_dn * scale),
        smallest_px=float(settings.minimum_size_px),
        largest_px=float(settings.maximum_size_px),
    )


@lru_cache
def _noise(settings: DetectionSettings, bit_depth: int) -> Noise:
    """Return the noise in grey values of images of this bit depth, with that of rounding to whole ones."""
    scale = 2 ** (bit_depth - 8)
    return Noise(
        dark_dn2=float((settings.read_noise_dn * scale) ** 2 + 1 / 12),
        gain_dn=float(settings.gain_dn_per_e * scale),
    )


@lru_cache
def _packing(itemsize: int, value: int) -> Packing:
    """Return how words of pixels of 1 or 2 bytes are searched for grey values from ``value`` up.

    Values in the upper half of the range are searched as its middle: a few words too many.
    """
    lane_bits = 8 * itemsize
    ones = sum(1 << shift for shift in range(0, 64, lane_bits))
    half = 1 << (lane_bits - 1)
    addend = ones * (half - min(value, half))
    return Packing(np.uint64(ones * (half - 1)), np.uint64(addend), 3 if itemsize == 1 else 2)


def _detections(camera: str, table: Array) -> Detections:
    return Detections(
        camera=camera,
        xy_px=table[:, [X, Y]],
        covariance_px2=table[:, [XX, XY, XY, YY]].reshape(-1, 2, 2),
        diameter_px=table[:, DIAMETER],
        peak=table[:, PEAK],
        elongation=table[:, ELONGATION],
    )
