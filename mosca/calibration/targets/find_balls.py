"""Find a wand's balls among the targets of one image.

The image of a straight wand is straight, up to the lens. The position of an inner ball between the outer ones follows
from the wand and from the ratio of the distances of its two ends. Three balls leave this ratio free, so it must be
one that is possible for a wand before a camera; each further ball is a check (the cross-ratio).
"""

import numpy as np

from mosca.data.arrays import Array
from mosca.data.detections import Detections
from mosca.data.sightings import Part
from mosca.data.wands import Wand

ALIKE_ENDS = 0.05
"""A wand symmetric within this share of its length has ends that cannot be distinguished."""


LARGEST_DEPTH_RATIO = 1.6
"""Largest ratio of the far end's distance to the near end's."""
BEND, SLACK_PX = 0.02, 1.0
"""Largest distance of an inner ball's image from the line of the outer ones: a share of the outer balls' distance,
plus so many px; lenses bend lines a little."""
LARGEST_DIAMETER_RATIO = 1.8
"""Largest ratio of the diameters of the balls' images beyond that explained by their distances."""
CLEAR = 2.0
"""Factor by which the second best choice must be worse than the best."""


def read_wand(detections: Detections, wand: Wand, camera: int, frame: int) -> Part | None:
    """Return the wand's balls in one image, or None where it is not seen whole or is ambiguous.

    Rows are in their order along the wand; ``mark`` is their number, or -1 where the two ends cannot be distinguished
    (two balls, or a symmetric wand).
    """
    balls, n = len(wand.along_m), len(detections)
    if n < balls:
        return None
    along = (np.array(wand.along_m) - wand.along_m[0]) / (wand.along_m[-1] - wand.along_m[0])
    symmetric = bool(np.abs(along - (1 - along[::-1])).max() < ALIKE_ENDS)
    found = [
        choice
        for first in range(n)
        for second in range(n)
        if first != second and not (symmetric and first > second)
        for choice in _between(detections, first, second, along)
    ]
    if not found:
        return None
    found.sort()
    # choices that share balls are rivals; other choices mean that two wands are seen
    if len(found) > 1 and found[1][0] < CLEAR * max(found[0][0], 0.25):
        return None
    rows = np.array(found[0][1])
    mark = np.full(balls, -1) if symmetric else np.arange(balls)
    return Part(
        camera,
        frame,
        mark,
        detections.xy_px[rows],
        detections.covariance_px2[rows],
        detections.diameter_px[rows],
        detections.ellipticity[rows],
        detections.ellipticity_sigma[rows],
    )


def _between(detections: Detections, first: int, second: int, along: Array) -> list[tuple[float, tuple[int, ...]]]:
    """Return the choices of balls with these two as ends, each with its badness (1: at the limit of the allowed)."""
    start, end = detections.xy_px[first], detections.xy_px[second]
    line = end - start
    length = float(np.linalg.norm(line))
    if length < 3 * SLACK_PX:
        return []
    relative = (detections.xy_px - start) / length
    unit = line / length
    u = relative @ unit
    beside = np.abs(relative @ np.array([-unit[1], unit[0]]))
    off = BEND + SLACK_PX / length
    inner = np.flatnonzero((u > 0) & (u < 1) & (beside <= off))
    inner = inner[(inner != first) & (inner != second)]
    diameter = detections.diameter_px
    most = np.log(LARGEST_DEPTH_RATIO)
    limit = np.log(LARGEST_DIAMETER_RATIO)
    choices: list[tuple[int, ...]] = [()]
    for t in along[1:-1]:
        # range of the ball's position, with either end as the nearer one
        low, high = (t * k / (1 - t + t * k) for k in (np.exp(-most), np.exp(most)))
        fits = inner[(u[inner] >= low - off) & (u[inner] <= high + off)]
        choices = [(*one, int(k)) for one in choices for k in fits if not one or u[k] > u[one[-1]]]
    out = []
    for one in choices:
        rows = (first, *one, second)
        sizes = np.log(diameter[list(rows)])
        size = 0.0 if not np.isfinite(sizes).all() else float(np.ptp(sizes)) / (limit + most)
        badness = [size]
        if one:
            t, v = along[1:-1], np.clip(u[list(one)], 1e-6, 1 - 1e-6)
            depth = np.log(v * (1 - t) / (t * (1 - v)))
            middle = float(depth.mean())
            if abs(middle) > most + off:
                continue
            predicted = t * np.exp(middle) / (1 - t + t * np.exp(middle))
            badness += [
                abs(middle) / most,
                float(beside[list(one)].max()) / off,
                float(np.abs(v - predicted).max()) / off,
            ]
        if max(badness) <= 1:
            out.append((float(np.sqrt(np.mean(np.square(badness)))), rows))
    return out
