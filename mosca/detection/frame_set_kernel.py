"""Detection in all images of a frame set, compiled as one kernel: scan, regions, centres, columns of the result.

Called by ``mosca.detection.detect``. Releases the GIL throughout: re-acquiring it between steps, against the thread
that matches and tracks, would take longer than most of the steps.
"""

import math
from typing import NamedTuple

import numpy as np

from mosca.data.arrays import Array
from mosca.data.detections import MERGED, UNREFINED
from mosca.detection.bright_runs import scan_set
from mosca.detection.centroid import (
    DIAMETER,
    DIAMETER_SIGMA,
    ELONGATION,
    PEAK,
    XX,
    XY,
    YY,
    CentroidRule,
    Noise,
    X,
    Y,
    lopsidedness,
    measure_region,
    measure_regions,
)
from mosca.detection.centroid import N_COLUMNS as N_MEASURED
from mosca.detection.disc_fit.fit_regions import refine_regions
from mosca.detection.disc_fit.light_offset import LEFT_OUT, StatisticsSums, no_sums_compiled
from mosca.detection.disc_fit.priors import Priors
from mosca.detection.disc_fit.row import ELLIPTIC_SIGMA, ELLIPTIC_X, ELLIPTIC_Y, FLAGS, N_COLUMNS, TOUCHING
from mosca.detection.images import ImageSet, image_of
from mosca.detection.merged_targets.pixels import region_mean, region_moments
from mosca.detection.noise_regions import decide_in_set, set_noise
from mosca.detection.pixel_noise import PixelNoise
from mosca.detection.search import CUT, DARK, END_RUN, FIRST_RUN, FLOOR, GAIN, IMAGE, THRESHOLD, FoundRegions, Search
from mosca.detection.threshold_regions import find_regions_in_set
from mosca.numba_support.copying import copy_rows
from mosca.numba_support.decorators import bare_step, kernel, short_kernel

REGIONS_ONLY, PAPER, BACKGROUND, REFINED = range(4)
"""How centres are found: not at all, else as the values of ``DetectionSettings.centroid``."""


class Measured(NamedTuple):
    """The targets of a frame set that were measured."""

    table: Array
    """(k, N_COLUMNS of ``mosca.detection.disc_fit.row``)."""
    region_of: Array
    """(k,) int32 region of each row."""
    image_of: Array
    """(k,) int32 image of each row."""


class Task(NamedTuple):
    """What is detected, and how it is measured; see ``DetectionSettings``."""

    search: Search
    by_noise: bool
    """Whether targets are found by the images' noise; else by the paper's rule."""
    method: int
    dilation_px: int
    full_dn: float
    """Pixels from here on are saturated."""


@kernel
def detect_frame_set(
    images: ImageSet, task: Task, noise: PixelNoise, priors: Priors
) -> tuple[FoundRegions, Measured, StatisticsSums]:
    """Find the targets of all images of a frame set and measure them.

    Also returns the sums for the cameras' statistics, zeros where nothing was refined.
    """
    bright = scan_set(images)
    left_out = np.zeros((len(images.addresses), 6))
    if task.by_noise:
        found = decide_in_set(images, bright, task.search, noise, left_out)
    else:
        found = find_regions_in_set(bright, task.search)
        set_noise(found, noise)
    if task.method == REFINED:
        table, region_of, sums = refine_regions(images, found, priors, task.full_dn)
        measure_unrefined(images, found, CentroidRule(True, task.dilation_px), table, region_of)
    else:
        sums = no_sums_compiled(len(images.addresses))
        some = found.regions if task.method != REGIONS_ONLY else found.regions[:0]
        rule = CentroidRule(task.method == BACKGROUND, task.dilation_px)
        measured, region_of = measure_regions(images, FoundRegions(found.runs, some, found.noise), rule)
        table = np.zeros((len(measured), N_COLUMNS))
        for n in range(len(measured)):
            for k in range(N_MEASURED):
                table[n, k] = measured[n, k]
            table[n, FLAGS] = UNREFINED
    image_of_row = np.empty(len(table), np.int32)
    # regions that are not measured touch the border
    for r in range(len(found.regions)):
        left_out[found.regions[r, IMAGE], CUT] += 1.0
    for n in range(len(table)):
        image_of_row[n] = found.regions[region_of[n], IMAGE]
        left_out[image_of_row[n], CUT] -= 1.0
    copy_rows(left_out[:, :5], sums.tallies[:, LEFT_OUT:])
    return found, Measured(table, region_of, image_of_row), sums


@bare_step
def measure_unrefined(
    images: ImageSet, found: FoundRegions, rule: CentroidRule, table: Array, region_of: Array
) -> None:
    """Replace the centre of rows of ``table`` whose fit failed by the centroid by ``rule``, above local background.

    Most of these targets touch a neighbour, whose light biases the centroid. The lopsidedness of the region is
    therefore part of the uncertainty. That of an isolated region grows with its elongation.
    """
    for n in range(len(table)):
        flags = int(table[n, FLAGS])
        if not flags & UNREFINED:
            continue
        region = found.regions[region_of[n]]
        own = found.runs[region[FIRST_RUN] : region[END_RUN]]
        noise = Noise(found.noise[region_of[n], DARK], found.noise[region_of[n], GAIN])
        limits = (region[THRESHOLD], region[FLOOR])
        image = image_of(images, region[IMAGE])
        measure_region(image, own, limits, noise, rule, table[n])
        drawn = (TOUCHING * table[n, DIAMETER]) ** 2
        dx, dy = lopsidedness(image, own, region[FLOOR], table[n])
        table[n, XX] += dx * dx
        table[n, XY] += dx * dy
        table[n, YY] += dy * dy
        if not flags & MERGED:
            xx, xy, yy = region_moments(own, region_mean(own))
            drawn += math.hypot(0.5 * (xx - yy), xy)
        table[n, XX] += drawn
        table[n, YY] += drawn


@short_kernel
def columns(table: Array, image_of: Array, n_images: int) -> tuple[Array, ...]:
    """Return the columns of ``Detections`` of all images, concatenated, and where each image's begin (n + 1).

    Keeps the GIL: re-acquiring it would take longer than this does.
    """
    n = len(table)
    xy, covariance, flags = np.empty((n, 2)), np.empty((n, 2, 2)), np.empty(n, np.uint8)
    diameter, peak, elongation, sigma = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    ellipticity, ellipticity_sigma = np.empty((n, 2)), np.empty(n)
    start = np.zeros(n_images + 1, np.int64)
    for i in range(n):
        xy[i, 0], xy[i, 1] = table[i, X], table[i, Y]
        covariance[i, 0, 0], covariance[i, 0, 1] = table[i, XX], table[i, XY]
        covariance[i, 1, 0], covariance[i, 1, 1] = table[i, XY], table[i, YY]
        diameter[i], peak[i], elongation[i] = table[i, DIAMETER], table[i, PEAK], table[i, ELONGATION]
        flags[i], sigma[i] = int(table[i, FLAGS]), table[i, DIAMETER_SIGMA]
        ellipticity[i, 0], ellipticity[i, 1] = table[i, ELLIPTIC_X], table[i, ELLIPTIC_Y]
        ellipticity_sigma[i] = table[i, ELLIPTIC_SIGMA]
        start[image_of[i] + 1] += 1
    for k in range(n_images):
        start[k + 1] += start[k]
    return xy, covariance, diameter, peak, elongation, flags, sigma, ellipticity, ellipticity_sigma, start
