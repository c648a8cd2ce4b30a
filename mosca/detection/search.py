"""What detection searches for and what it finds: tables shared by compiled functions.

A *run* is a row of adjoining pixels above a threshold. A *region* is an accepted target (``mosca.detection.detect``
defines which regions are accepted).
"""

import math
from typing import Any, NamedTuple

import numpy as np

from mosca.data.arrays import Array
from mosca.numba_support.decorators import bare_step

SEARCH_SIGMAS = 4.0
"""Standard deviations above the background beyond which a pixel is looked at: without a target, 3 in 100,000 pixels
are."""

ROW, FIRST, END, PLACE = range(4)
"""Columns of a table of runs: row, first column, end column, and index of its first pixel among the ``values``, the
grey values of all bright pixels of an image in raster order."""

IMAGE, FIRST_RUN, END_RUN, THRESHOLD, FLOOR = range(5)
"""Columns of a table of regions: number of the image, first and end run, THRESHOLD that its pixels exceed, and FLOOR,
up to which values are background [DN]."""


DARK, GAIN, SLOPE_X, SLOPE_Y = range(4)
"""Columns of a region's noise: variance [DN^2] = DARK + GAIN * (grey value - background), and the slopes of the
background [DN/px]."""


LEFT_OUT_REASONS = ("faint", "small", "large", "uneven", "cut")
"""Reasons why adjoining bright pixels are no target. Faint: the brightest pixel is below the limit of a target,
though several pixels are above the limit of the search. Small: the brightest pixel is above the limit of a target,
but the box is too short. Large: the box is too long. Uneven: the surroundings are as bright. Cut: the pixels touch
the image's border."""
FAINT, SMALL, LARGE, UNEVEN, CUT = range(5)
"""Columns of a table that counts the groups left out, by reason."""


class Search(NamedTuple):
    """Limits of the search, in grey values of the image [DN] and pixels; symbols as in ``mosca.detection.detect``."""

    highest: int
    """First threshold, Imax - B / 2."""
    lowest: int
    """h_min: thresholds lie above it."""
    step: int
    """s."""
    contrast: float
    """B."""
    smallest_px: float
    """D_min."""
    largest_px: float
    """D_max."""
    level: float
    """Background [DN] of a target, see ``is_compact``; below 0 every region counts as compact, as in the paper."""


class FoundRegions(NamedTuple):
    """The targets of a frame set's images."""

    runs: Array
    """(m, 3) int32 row, first and end column, sorted by image and region."""
    regions: Array
    """(r, 5) int32, columns IMAGE to FLOOR."""
    noise: Array
    """(r, 4) noise and slope of the background of each region, columns DARK to SLOPE_Y."""


@bare_step
def is_target(size_x: int, size_y: int, contrast: int, search: Search) -> bool:
    """Return whether a region passes the limits of size and contrast (step 6)."""
    return (
        search.smallest_px < size_x < search.largest_px
        and search.smallest_px < size_y < search.largest_px
        and contrast > search.contrast
    )


@bare_step
def is_compact(n: Any, core: Any) -> bool:
    """Return whether a region of n pixels is one spot; ``core`` of them have more than half of its contrast.

    Otherwise it is a target before something else that is brighter than the background. The image of a disc fades
    within the blur, and the softest is that of a point, a Gaussian. Its radius at 1/16 of the contrast, 2.35 sigma,
    is twice the radius at half of the contrast. A pixel and a half are added, since a small spot consists of few
    pixels.
    """
    result: bool = math.sqrt(n / math.pi) <= 2.0 * math.sqrt(core / math.pi) + 1.5
    return result


@bare_step
def box_of(runs: Array, begin: int, end: int) -> tuple[tuple[Any, Any, Any, Any], Any]:
    """Return left, right, top and bottom pixel of the region of these runs, and its number of pixels."""
    left, right, n = runs[begin, 1], runs[begin, 2], np.int64(0)
    for i in range(begin, end):
        left = min(left, runs[i, 1])
        right = max(right, runs[i, 2])
        n += runs[i, 2] - runs[i, 1]
    return (np.int64(left), np.int64(right - 1), np.int64(runs[begin, 0]), np.int64(runs[end - 1, 0])), n


@bare_step
def is_sure(over: Any, error: Any, dark_dn2: float) -> bool:
    """Return whether a pixel above the limit of noise alone is also above the background's error.

    ``over``: how far it is above that limit [DN]; ``error``: standard deviation of what was subtracted [DN];
    ``dark_dn2``: variance of a pixel [DN^2].
    """
    result: bool = over > SEARCH_SIGMAS * (math.sqrt(dark_dn2 + error * error) - math.sqrt(dark_dn2))
    return result
