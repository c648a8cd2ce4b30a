"""Compiled last steps of detection: places of what no disc fits, and the columns of ``Detections``.

Called by ``mosca.detection.frame_set_kernel``, after ``mosca.detection.disc_fit.fit_regions``, and by
``mosca.detection.detect``.
"""

import math

import numpy as np

from mosca.data.arrays import Array
from mosca.data.detections import MERGED, UNREFINED
from mosca.detection.centroid import DIAMETER, ELONGATION, PEAK, XX, XY, YY, Noise, X, Y, measure_region
from mosca.detection.disc_fit.fit_regions import FLAGS, TOUCHING
from mosca.detection.merged_targets.pixels import region_mean, region_moments
from mosca.numba_support.decorators import short_kernel, step
from mosca.numba_support.intrinsics import image_at


@step
def place_failed(
    addresses: Array,
    like: Array,
    size: tuple[int, int],
    runs: Array,
    regions: Array,
    lowest: Array,
    dilation: int,
    noise: Noise,
    table: Array,
    region_of: Array,
) -> Array:
    """Give rows of ``table`` whose fit failed the centroid above the local background; return each row's image (n,).

    What cannot be fitted mostly touches a neighbour, whose light draws the centroid. A region that stands alone is
    as uncertain as it is longer than wide: its middle is that of no target.
    """
    image_of = np.empty(len(table), np.int32)
    for n in range(len(table)):
        r = region_of[n]
        image_of[n] = regions[r, 0]
        flags = int(table[n, FLAGS])
        if not flags & UNREFINED:
            continue
        image = image_at(addresses[image_of[n]], like, size[0], size[1])
        own = runs[regions[r, 1] : regions[r, 2]]
        measure_region(image, own, regions[r, 3], lowest[image_of[n]], True, dilation, noise, table[n])
        drawn = (TOUCHING * table[n, DIAMETER]) ** 2
        if not flags & MERGED:
            xx, xy, yy = region_moments(own, region_mean(own))
            drawn += math.hypot(0.5 * (xx - yy), xy)
        table[n, XX] += drawn
        table[n, YY] += drawn
    return image_of


@short_kernel
def columns(
    table: Array, image_of: Array, n_images: int
) -> tuple[Array, Array, Array, Array, Array, Array, Array]:
    """Return the columns of ``Detections`` of all images in turn, and where each image's begin (n + 1).

    Keeps the GIL: to win it back from another thread would take longer than this does.
    """
    n = len(table)
    xy, covariance, flags = np.empty((n, 2)), np.empty((n, 2, 2)), np.empty(n, np.uint8)
    diameter, peak, elongation = np.empty(n), np.empty(n), np.empty(n)
    start = np.zeros(n_images + 1, np.int64)
    for i in range(n):
        xy[i, 0], xy[i, 1] = table[i, X], table[i, Y]
        covariance[i, 0, 0], covariance[i, 0, 1] = table[i, XX], table[i, XY]
        covariance[i, 1, 0], covariance[i, 1, 1] = table[i, XY], table[i, YY]
        diameter[i], peak[i], elongation[i] = table[i, DIAMETER], table[i, PEAK], table[i, ELONGATION]
        flags[i] = int(table[i, FLAGS])
        start[image_of[i] + 1] += 1
    for k in range(n_images):
        start[k + 1] += start[k]
    return xy, covariance, diameter, peak, elongation, flags, start
