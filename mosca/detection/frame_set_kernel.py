"""All that is done with the images of a frame set, compiled as one kernel: scan, regions, places.

Called by ``mosca.detection.detect``. Free of the GIL from the first pixel to the last: each return to Python has to
win the GIL back from the thread that matches and tracks, and would wait for that longer than most of these steps
take.
"""

import numpy as np

from mosca.data.arrays import Array
from mosca.data.detections import UNREFINED
from mosca.detection.bright_runs import regions_within, scan_set
from mosca.detection.centroid import N_COLUMNS as N_MEASURED
from mosca.detection.centroid import Noise, measure_regions
from mosca.detection.detect_finish import place_failed
from mosca.detection.disc_fit.fit_regions import FLAGS, N_COLUMNS, N_TALLIES, N_TERMS, refine_regions
from mosca.detection.disc_fit.gauss_newton import Model
from mosca.detection.threshold_regions import Search, find_regions_in_set
from mosca.numba_support.decorators import kernel

NOWHERE, PAPER, BACKGROUND, REFINED = range(4)
"""How regions are placed: not at all, else as the values of ``DetectionSettings.centroid`` say."""

Regions = tuple[Array, Array, Array]
"""Runs (m, 3), regions (r, 4) and each image's lowest threshold (n), as ``find_regions_in_set`` returns them."""
Places = tuple[Array, Array, Array]
"""Table (k, N_COLUMNS) of what was placed, and the region and the image (k) of each row."""
Lessons = tuple[Array, Array, Array]
"""What each image teaches, as ``refine_regions`` returns it; zeros where nothing was refined."""


@kernel
def detect_frame_set(
    addresses: Array,
    like: Array,
    size: tuple[int, int],
    boxes: Array,
    box_start: Array,
    search: Search,
    how: int,
    dilation: int,
    noise: Noise,
    blurs: Array,
    offsets: Array,
    roughness: Array,
    model: Model,
) -> tuple[Regions, Places, Lessons]:
    """Find the targets of all images of a frame set and place them.

    ``addresses``, ``like``, ``size``, ``boxes`` and ``box_start``: images and windows, as ``scan_set`` takes them;
    ``how``: as above; ``dilation`` [px] and ``noise``: of what is not refined; ``blurs``, ``offsets``, ``roughness``
    and ``model``: as ``refine_regions`` takes them.
    """
    n_images = len(addresses)
    bright, values, run_start, value_start = scan_set(
        addresses, like, size, search.lowest + 1, boxes, box_start
    )
    runs, regions, lowest = find_regions_in_set(bright, values, run_start, value_start, search)
    if len(box_start) > 0:
        regions = regions_within(runs, regions, boxes, box_start)
    if how == REFINED:
        table, region_of, tallies, normal, right_side = refine_regions(
            addresses, like, size, runs, regions, lowest, blurs, offsets, roughness, model
        )
    else:
        tallies = np.zeros((n_images, N_TALLIES))
        normal, right_side = np.zeros((n_images, N_TERMS, N_TERMS)), np.zeros((n_images, N_TERMS, 2))
        some = regions if how != NOWHERE else regions[:0]
        measured, region_of = measure_regions(
            addresses, like, size, runs, some, lowest, how == BACKGROUND, dilation, noise
        )
        table = np.zeros((len(measured), N_COLUMNS))
        for n in range(len(measured)):
            for k in range(N_MEASURED):
                table[n, k] = measured[n, k]
            table[n, FLAGS] = UNREFINED
    if how == REFINED:
        image_of = place_failed(
            addresses, like, size, runs, regions, lowest, dilation, noise, table, region_of
        )
    else:
        image_of = np.empty(len(table), np.int32)
        for n in range(len(table)):
            image_of[n] = regions[region_of[n], 0]
    return (runs, regions, lowest), (table, region_of, image_of), (tallies, normal, right_side)
