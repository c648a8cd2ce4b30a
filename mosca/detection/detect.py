"""Detection: from an image to sub-pixel targets.

What a target is. Each camera's background, its noise and its gain are learned from its images
(``mosca.detection.local_background``, ``mosca.detection.pixel_noise``). Pixels more than 4 standard deviations of the
background above it form 8-connected blobs. In each blob, pixels below 1/16 of its contrast are left out, since the
skirts of a point spread function join targets that stand apart. A connected part of the remaining pixels is a target
when

- its brightest pixel is so far above the background that the noise of all pixels of an image exceeds it
  ``false_alarms`` times on average (for 0.01 in 320,000 pixels 5.4 standard deviations),
- the longer side of its box is longer than D_min and both are shorter than D_max.

A part is split into several targets where a dip between two summits exceeds the noise of their difference by the same
number of standard deviations. The parts are grown by the paper's rule below, with this contrast in the place of B.

``thresholds = "paper"`` is the rule of the Mosca paper, section 3.1. The image is thresholded at falling h, from
``Imax - B/2`` (Imax: the largest value the camera can give) in steps of s as long as h is above h_min. A threshold
that no pixel has is replaced by the next lower grey value that occurs (step 3; the paper prints "until HIST[h] = 0",
which must read "while"). The regions of a threshold are the 8-connected components of ``I > h``. A region is accepted
when (step 6)

- both sides of its box, in pixels, lie strictly between D_min and D_max,
- ``Bmax - Bmin > B``, with the largest and smallest grey value inside it,
- ``N < 2``: it holds at most one of the targets accepted at higher thresholds. N counts the connected components of
  the output image R so far that lie inside the region. Thus a target that grows from one threshold to the next stays
  one target. Two that were accepted separately stay two when their regions merge at a lower threshold. (If N were
  counted from the previous threshold's regions alone, as step 5 can be read, the merged blob would be accepted one
  step later.)

R is the union of the accepted regions; its components are the targets (step 9): each is the largest accepted region
around its summit. A target that touches the image's border is cut off and is not reported.

Where it is. ``centroid = "refined"``, the default, fits a blurred disc to the pixels around the target:
``mosca.detection.disc_fit.camera_statistics``. ``"paper"`` is step 10 as printed: ``x* = sum x I / sum I`` over the
region. ``"background"`` takes the region's mask m, grown by ``dilation_px`` to all sides (a region that ends above
the lowest threshold has a neighbour and is grown by at most 1). The local background b is the mean of the pixels not
above the lowest threshold on the border of the box around the mask: ``x* = sum_m x (I - b) / S``,
``S = sum_m (I - b)``. Pixels above the region's threshold that are not its own belong to a neighbour and are left
out.

How well. The pixel noise ``var(I) = dark + gain (I - b)`` is that of EMVA 1288. The dark part is dark noise,
quantisation and the background's photon noise; the gain, in DN per electron, gives the target's photon noise. This
noise is propagated through the centroid to first order:
``C = sum_m (p - p*)(p - p*)^T var(I) / S^2 + g g^T var(b) / S^2`` with ``g = sum_m (p - p*)`` and
``var(b) = dark / ring pixels``. The mask is taken as given: C does not include the error of the light that it cuts
off.
"""

from collections.abc import Collection, Sequence
from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np

from mosca.data.arrays import Array
from mosca.data.detections import Detections
from mosca.detection.background import mean_background, minimum_background
from mosca.detection.disc_fit.camera_statistics import NO_STATISTICS, CameraStatistics
from mosca.detection.disc_fit.light_offset import StatisticsSums, no_sums
from mosca.detection.frame_set_kernel import (
    BACKGROUND,
    PAPER,
    REFINED,
    REGIONS_ONLY,
    Measured,
    Task,
    columns,
    detect_frame_set,
)
from mosca.detection.images import image_set
from mosca.detection.local_background import LocalBackground
from mosca.detection.merged_targets.split import split_pairs
from mosca.detection.pixel_noise import gains_changed, measured_backgrounds, noise_of_set
from mosca.detection.search import SEARCH_SIGMAS
from mosca.detection.settings import DEFAULTS, DetectionSettings, search_of
from mosca.detection.static_background import one_image, subtracted
from mosca.errors import InputError

__all__ = [
    "DEFAULTS",
    "NO_STATISTICS",
    "CameraStatistics",
    "DetectionSettings",
    "detect",
    "detect_set",
    "detect_with_statistics",
    "mean_background",
    "minimum_background",
    "target_regions",
]

_METHODS = {"paper": PAPER, "background": BACKGROUND, "refined": REFINED}
BLURS = 3.0
"""Assumed reach of a target's light beyond its disc, in blurs of its camera."""


def detect(
    image: Array,
    camera: str,
    settings: DetectionSettings = DEFAULTS,
    bit_depth: int = 8,
    background: Array | None = None,
    statistics: CameraStatistics = NO_STATISTICS,
) -> Detections:
    """Return the targets in an image (H, W) of uint8 or uint16, in the order of their topmost rows.

    Raises InputError for an image, a background or a bit depth that do not fit each other.

    Parameters
    ----------
    image
        (H, W) uint8 or uint16.
    camera
        Name in the detections.
    settings
        Thresholds, sizes and the kind of centre.
    bit_depth
        Number of significant bits of a pixel (8 to 16).
    background
        (H, W), of the image's type. It is subtracted first, and negative values become 0 (guide to motion capture,
        "Marker Detection"; see ``mean_background`` and ``minimum_background``).
    statistics
        Statistics of earlier frames, see ``detect_with_statistics``.
    """
    backgrounds = None if background is None else [background]
    return detect_set([image], [camera], settings, bit_depth, backgrounds, statistics)[0]


def detect_set(
    images: Sequence[Array],
    cameras: Sequence[str],
    settings: DetectionSettings = DEFAULTS,
    bit_depth: int = 8,
    backgrounds: Sequence[Array | None] | None = None,
    statistics: CameraStatistics = NO_STATISTICS,
) -> list[Detections]:
    """Return the targets of each image of a frame set; ``detect`` for several cameras at once.

    Images of one size and type are processed in one call without the GIL, so that several threads can each take a
    frame set; other images are processed one by one.
    """
    return detect_with_statistics(images, cameras, settings, bit_depth, backgrounds, statistics)[0]


def detect_with_statistics(
    images: Sequence[Array],
    cameras: Sequence[str],
    settings: DetectionSettings = DEFAULTS,
    bit_depth: int = 8,
    backgrounds: Sequence[Array | None] | None = None,
    statistics: CameraStatistics = NO_STATISTICS,
    refresh: Collection[str] = (),
) -> tuple[list[Detections], CameraStatistics]:
    """Do as ``detect_set``, and also return what these images alone add to the statistics of their cameras.

    Pass the sum ``statistics.plus(new)`` to a later call. The same images with the same ``statistics`` give the same
    centres, with any number of threads. Without ``statistics`` a call starts afresh and learns noise and background
    from the one image. ``refresh``: cameras whose backgrounds are measured again though ``statistics`` hold them.
    """
    n = len(images)
    n_backgrounds = n if backgrounds is None else len(backgrounds)
    if not n == len(cameras) == n_backgrounds:
        raise InputError(
            f"detection: {n} images, {len(cameras)} cameras and {n_backgrounds} backgrounds given; give one of each "
            "for every camera"
        )
    if not images:
        return [], NO_STATISTICS
    first = images[0]
    if any(image.shape != first.shape or image.dtype != first.dtype for image in images):
        found, added = [], NO_STATISTICS
        for i, (image, name) in enumerate(zip(images, cameras, strict=True)):
            background = None if backgrounds is None else [backgrounds[i]]
            part, new = detect_with_statistics([image], [name], settings, bit_depth, background, statistics, refresh)
            found += part
            added = added.plus(new)
        return found, added
    names, task = tuple(cameras), _task(settings, bit_depth, _METHODS[settings.centroid])
    given = [None] * n if backgrounds is None else backgrounds
    for image, camera, own in zip(images, cameras, given, strict=True):
        _check(image, camera, bit_depth, own)
    behind = [None if own is None else _exactly_behind(own, task.by_noise) for own in given]
    dark = [None if own is None else own[0] for own in behind]
    pixels = [_foreground(image, off, task) for image, off in zip(images, dark, strict=True)]
    measured = measured_backgrounds(images, dark, names, settings, statistics, refresh)
    known = statistics.plus(CameraStatistics(names, no_sums(n), measured)) if measured else statistics
    learns = [background is None and task.by_noise for background in dark]
    for k, name in enumerate(names):
        static = known.backgrounds[name].usable if learns[k] and name in known.backgrounds else None
        if static is not None and static.behind.shape == first.shape:
            shown = behind[k] = known.backgrounds[name].shown_behind(pixels[k])
            pixels[k] = subtracted(pixels[k], shown[0], int(task.full_dn))
    found, sums = _detect_alike(pixels, behind, names, settings, task, known)
    for k, name in enumerate(names):
        if name in measured and learns[k] and known.backgrounds[name].textured:
            bright = _bright(pixels[k], found[k], known.blur_px(name), known.backgrounds[name])
            vote = one_image(images[k], measured[name].planes(first.shape), bright)
            measured[name] = replace(measured[name], pixels=vote)
    added = CameraStatistics(names, sums, measured)
    if again := gains_changed(statistics, added, settings):
        # a guessed gain splits bright targets, or joins faint ones: detect again with the learned one
        learned, sums = statistics.plus(added), StatisticsSums(*(part.copy() for part in sums))
        for k in again:
            (found[k],), own_sums = _detect_alike(
                pixels[k : k + 1], behind[k : k + 1], names[k : k + 1], settings, task, learned
            )
            for total, one in zip(sums, own_sums, strict=True):
                total[k] = one[0]
    return found, CameraStatistics(names, sums, measured)


def _exactly_behind(background: Array, by_noise: bool) -> Array:
    """Return (2, H, W) float32 [DN]: what is subtracted of a given background (H, W), and its error of 0.

    Where thresholds are grey values, all of the background is subtracted. Otherwise only its difference from about
    its median is: values below zero would be lost, and with them half of the noise.
    """
    behind = np.zeros((2, *background.shape), np.float32)
    behind[0] = background
    if by_noise:
        behind[0] -= np.floor(np.median(background[::8, ::8]))
    return behind


def _detect_alike(
    pixels: Sequence[Array],
    behind: Sequence[Array | None],
    names: tuple[str, ...],
    settings: DetectionSettings,
    task: Task,
    statistics: CameraStatistics,
) -> tuple[list[Detections], StatisticsSums]:
    """Return the detections of images of one size and type, and their sums for the cameras' statistics."""
    noise, limits = noise_of_set(statistics, names, settings, pixels[0], task.full_dn)
    images = image_set(pixels, limits, behind)
    priors = statistics.priors(names)
    found, measured, sums = detect_frame_set(images, task, noise, priors)
    if settings.centroid == "refined" and settings.split_pairs:
        measured = split_pairs(measured, images, found, priors, task.full_dn)
    return _detections(names, measured), sums


def _bright(image: Array, found: Detections, blur_px: float, background: LocalBackground) -> Array:
    """Return 1 for the pixels (H, W) uint8 that may show a target or another light, 0 for the others.

    These are the pixels of detected discs, with their blur, and those above the search's limits.
    """
    bright = (image > background.limits(SEARCH_SIGMAS, image.shape, image.dtype)).astype(np.uint8)
    radii = 0.5 * found.diameter_px * np.sqrt(found.elongation) + BLURS * blur_px
    for (x, y), radius in zip(
        np.rint(found.xy_px).astype(int).tolist(), np.ceil(radii).astype(int).tolist(), strict=True
    ):
        cv2.circle(bright, (x, y), radius, 1, cv2.FILLED)
    return bright


def target_regions(image: Array, settings: DetectionSettings = DEFAULTS, bit_depth: int = 8) -> Array:
    """Return the output image R (H, W) int32: 0, or the number of the target from 1 (steps 6 and 9).

    Targets that touch the image's border are included.
    """
    _check(image, "image", bit_depth, None)
    names, task = ("image",), _task(settings, bit_depth, REGIONS_ONLY)
    pixels = _foreground(image, None, task)
    statistics = CameraStatistics(
        names, no_sums(1), measured_backgrounds([pixels], [None], names, settings, NO_STATISTICS)
    )
    noise, limits = noise_of_set(statistics, names, settings, pixels, task.full_dn)
    (runs, regions, _), _, _ = detect_frame_set(
        image_set([pixels], limits, [None]), task, noise, statistics.priors(names)
    )
    labels = np.zeros(image.shape, np.int32)
    for number, (_, first_run, end_run, _, _) in enumerate(regions, start=1):
        for row, first, end in runs[first_run:end_run]:
            labels[row, first:end] = number
    return labels


def _check(image: Array, camera: str, bit_depth: int, background: Array | None) -> None:
    """Raise InputError unless image, background and bit depth fit."""
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
        return
    if background.shape != image.shape or background.dtype != image.dtype:
        raise InputError(
            f"detection: camera '{camera}': background {background.shape} of {background.dtype} given for an "
            f"image {image.shape} of {image.dtype}; make it from this camera's frames with mean_background"
        )


def _foreground(image: Array, off: Array | None, task: Task) -> Array:
    """Return the image (H, W) less ``off``, of the image's type, with 0 for negative values."""
    if off is None:
        return image if image.flags.c_contiguous else np.ascontiguousarray(image)
    if not task.by_noise:
        return np.ascontiguousarray(cv2.subtract(image, off.astype(image.dtype)))
    return subtracted(image, off, int(task.full_dn))


@lru_cache
def _task(settings: DetectionSettings, bit_depth: int, method: int) -> Task:
    """Return the task of detection in images of this bit depth."""
    by_noise = settings.thresholds == "noise"
    return Task(search_of(settings, bit_depth), by_noise, method, settings.dilation_px, float(2**bit_depth - 1))


def _detections(cameras: Sequence[str], measured: Measured) -> list[Detections]:
    """Return each camera's part of the targets of a frame set."""
    *found, start = columns(measured.table, measured.image_of, len(cameras))
    for column in found:
        column.setflags(write=False)
    bounds = start.tolist()
    return [
        Detections.handed_over(name, [column[first:end] for column in found])
        for name, first, end in zip(cameras, bounds, bounds[1:], strict=False)
    ]
