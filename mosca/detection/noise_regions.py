"""Compiled decision on targets by the image's own noise.

Called by ``mosca.detection.frame_set_kernel``; ``mosca.detection.detect`` defines what a target is. A *blob* is an
8-connected set of pixels above their limits.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from mosca.data.arrays import Array
from mosca.detection.bright_runs import BrightPixels
from mosca.detection.images import ImageSet, behind_of, image_of
from mosca.detection.local_background import nearest_cell, plane_at
from mosca.detection.pixel_noise import PixelNoise
from mosca.detection.region_growth import grow_regions
from mosca.detection.search import (
    DARK,
    END,
    END_RUN,
    FAINT,
    FIRST,
    FIRST_RUN,
    FLOOR,
    GAIN,
    IMAGE,
    LARGE,
    PLACE,
    ROW,
    SEARCH_SIGMAS,
    SLOPE_X,
    SLOPE_Y,
    SMALL,
    THRESHOLD,
    UNEVEN,
    FoundRegions,
    Search,
    box_of,
    is_compact,
    is_sure,
)  # fmt: skip
from mosca.detection.threshold_regions import blobs_of, passes_below, runs_above, survey, write_grown, write_whole
from mosca.numba_support.decorators import bare_step, step
from mosca.numba_support.order import median_in_place

CUT_SHARE = 1 / 16
"""Share of a blob's contrast below which its pixels are left out: the skirts of a lens' point spread function, which
join the images of targets that stand apart. At 1/10 the outlines of oblique discs, whose shape comes from the
region's moments, cost 7 % in position."""
NOISE, WHOLE, UNCERTAIN = range(5, 8)
"""Verdicts on a part, besides the reasons ``FAINT`` and ``SMALL``: noise alone, one target, to be examined."""
NEAR_LIMIT = 4.0
"""Targets with up to so many times the least contrast must have this contrast over the pixels around them too, since
the background is known only as planes between cells."""
LEAST_MARGIN_PX = 2
"""Distance from a faint target's box to the pixels around it; the box's longer side where that is more (its
skirts)."""

BODY_SHARE = 0.25
"""Share of bright pixels around a target from which it stands on a body: pixels brighter than the background but no
part of a target. The skirts of a neighbouring target are fewer."""


class Blob(NamedTuple):
    """Properties of a blob before it is cut, in grey values [DN]."""

    level: float
    """Background."""
    variance: float
    """Variance of a pixel of the background [DN^2]."""
    spread: float
    """Standard deviation of the background, with its own texture."""
    slope: tuple[float, float]
    """Slope of the background by x and y [DN/px]."""
    peak: Any
    """Largest of three grey values in each row; all are looked at once the blob is cut."""
    cut: Any
    """Pixels that are not above it are left out."""


class BlobPart(NamedTuple):
    """A connected part of a cut blob."""

    left: Any
    """First column."""
    right: Any
    """End column."""
    longer: Any
    """Longer side of its box [px]."""
    darkest: Any
    """Smallest and largest grey value, and a bound of the dips between summits, see ``survey``."""
    peak: Any
    dip: Any
    compact: Any
    """See ``is_compact``."""


class Place(NamedTuple):
    """Where the targets of an image are written."""

    image: Any
    """Its number."""
    pixels: Array
    """(H, W) grey values."""
    behind: Array
    """(2, H, W), see ``mosca.detection.images.ImageSet``."""
    found: Array
    """(m, 3) runs, as in ``FoundRegions``."""
    regions: Array
    """(r, 5)."""
    noise: Array
    """(r, 4)."""
    left_out: Array
    """(6,) how many of the image's parts were left out, by ``LEFT_OUT_REASONS``, and of noise alone."""


@bare_step
def blob_of(runs: Array, values: Array, noise: PixelNoise, k: int, shape: tuple[int, int]) -> Blob:
    """Return background, noise and threshold of a blob of image k, at its middle row."""
    peak, middle = np.int32(0), len(runs) // 2
    for i in range(len(runs)):
        n = np.uint32(runs[i, END] - runs[i, FIRST])
        at = np.uint64(runs[i, PLACE])
        peak = max(peak, values[at + n // 4], values[at + n // 2], values[at + n - n // 4 - 1])
    x, y = 0.5 * (runs[middle, FIRST] + runs[middle, END]), float(runs[middle, ROW])
    i, j = nearest_cell(x, y, shape, noise.levels.shape)
    level, slope_x, slope_y = plane_at(noise.levels[k], x, y, shape)
    variance = noise.variances[k, i, j]
    spread = math.sqrt(variance + noise.textures[k, i, j])
    cut = math.floor(level + max(SEARCH_SIGMAS * spread, CUT_SHARE * (peak - level)))
    return Blob(level, variance, spread, (slope_x, slope_y), peak, np.int32(cut))


@bare_step
def trim_runs(runs: Array, values: Array, limit: int, cut: Array) -> tuple[Any, Any]:
    """Write the runs to ``cut``, trimmed at both ends of pixels not above ``limit``; return how many are left.

    Also return whether there are some and they adjoin for certain: one in each row, which touches that of the row
    before.
    """
    n, joined = np.int64(0), True
    for i in range(len(runs)):
        first, end, row = runs[i, FIRST], runs[i, END], runs[i, ROW]
        place = runs[i, PLACE] - first
        while first < end and values[place + first] <= limit:
            first += 1
        while end > first and values[place + end - 1] <= limit:
            end -= 1
        if first == end:
            continue
        if n > 0:
            joined &= row == cut[n - 1, ROW] + 1 and first <= cut[n - 1, END] and cut[n - 1, FIRST] <= end
        cut[n, ROW], cut[n, FIRST], cut[n, END], cut[n, PLACE] = row, first, end, place + first
        n += 1
    return n, joined and n > 0


@bare_step
def contrast_of(peak: float, level: float, variance: float, gain: float, sigmas: float) -> float:
    """Return the least difference at which two grey values near ``peak`` are distinct: each has its own noise."""
    return math.sqrt(2.0 * (variance + gain * max(peak - level, 0.0))) * sigmas


@step
def falling_thresholds(peak: int, least: int, step: int) -> Array:
    """Return thresholds from below ``peak`` down to ``least``, the last one."""
    n = max((peak - 1 - least) // step, 0) + 1
    thresholds = np.empty(n, np.int32)
    for i in range(n):
        thresholds[i] = least + (n - 1 - i) * step
    return thresholds


@bare_step
def middle_column(runs: Array, values: Array, left: int, right: int) -> Any:
    """Return the middle of the columns from ``left`` to before ``right``; of two, that brighter in the middle row."""
    column = (left + right) // 2
    half = len(runs) // 2
    first, end, place = runs[half, FIRST], runs[half, END], runs[half, PLACE]
    if (right - left) % 2 == 0 and first < column < end:
        column -= values[place + column - 1 - first] > values[place + column - first]
    return column


@bare_step
def is_spot(runs: Array, values: Array, level: float, peak: int) -> bool:
    """Return whether the pixels of these runs are one compact spot over the background (``is_compact``)."""
    n = core = 0
    for i in range(len(runs)):
        n += runs[i, END] - runs[i, FIRST]
    if is_compact(n, 1):
        return True
    half = 0.5 * (level + peak)
    for i in range(len(runs)):
        for k in range(runs[i, PLACE], runs[i, PLACE] + runs[i, END] - runs[i, FIRST]):
            core += values[k] > half
    result: bool = is_compact(n, core)
    return result


@bare_step
def part_of(runs: Array, values: Array, lowest: int, level: float) -> BlobPart:
    """Return the connected part of these runs, of pixels above ``lowest`` over a background ``level``."""
    left, right = runs[0, FIRST], runs[0, END]
    for i in range(1, len(runs)):
        left = min(left, runs[i, FIRST])
        right = max(right, runs[i, END])
    darkest, peak, dip = survey(runs, 0, len(runs), values, lowest, middle_column(runs, values, left, right))
    longer = max(right - left, runs[-1, ROW] - runs[0, ROW] + 1)
    return BlobPart(left, right, longer, darkest, peak, dip, is_spot(runs, values, level, peak))


@bare_step
def write_noise(blob: Blob, gain: float, out: Array) -> None:
    """Write a region's noise and the slope of its background."""
    out[DARK], out[GAIN], out[SLOPE_X], out[SLOPE_Y] = blob.variance, gain, blob.slope[0], blob.slope[1]


@step
def ring_values(image: Array, box: tuple[int, int, int, int], margin: int) -> Array:
    """Return the grey values on the border of a box (left, right, top, bottom; ends excluded) wider by ``margin``.

    Pixels outside the image are left out.
    """
    left, right, top, bottom = box[0] - margin - 1, box[1] + margin, box[2] - margin - 1, box[3] + margin
    values = np.empty(2 * (right - left + bottom - top), np.float32)
    n = 0
    for x in range(max(left, 0), min(right, image.shape[1] - 1) + 1):
        for y in (top, bottom):
            if 0 <= y < image.shape[0]:
                values[n] = image[y, x]
                n += 1
    for y in range(max(top + 1, 0), min(bottom, image.shape[0])):
        for x in (left, right):
            if 0 <= x < image.shape[1]:
                values[n] = image[y, x]
                n += 1
    return values[:n]


@bare_step
def verdict_of(part: BlobPart, blob: Blob, search: Search, gain: float, sigmas: float) -> Any:
    """Return the verdict on a connected part of a cut blob: one target, to be examined, or why it is none.

    A part that is both short and faint is noise: single pixels exceed ``SEARCH_SIGMAS`` in any image.
    """
    over, least = part.peak - blob.level, sigmas * blob.spread
    short, faint = part.longer <= search.smallest_px, over <= least
    if short and faint:
        return NOISE
    contrast = contrast_of(float(part.peak), blob.level, blob.variance, gain, sigmas)
    if part.peak < blob.peak and part.peak - blob.cut <= contrast:
        return NOISE  # in the skirt of a brighter one
    if short or faint:
        return SMALL if short else FAINT
    certain = over > NEAR_LIMIT * least and part.longer < search.largest_px and part.dip <= contrast + 1
    certain &= part.compact
    return WHOLE if certain else UNCERTAIN


@bare_step
def write_target(runs: Array, blob: Blob, gain: float, place: Place, n: int, r: int) -> tuple[int, int]:
    """Write a part as one target, from run n and region r on; return where both end."""
    write_noise(blob, gain, place.noise[r])
    n, r = write_whole(runs, 0, len(runs), (place.image, blob.cut, blob.cut), place.found, place.regions, n, r)
    return n, r


@step
def stand_on_body(blob: Blob, gain: float, pixels: Array, runs: Array, region: Array, noise: Array) -> None:
    """Take what surrounds a target as its background where that is brighter than the image's background.

    It is not as bright as the target, so it is no neighbour, and adds the noise of its own light. ``runs``: of the
    region; ``pixels``: of the image (H, W).
    """
    (left, right, top, bottom), _ = box_of(runs, 0, len(runs))
    values = ring_values(pixels, (left, right + 1, top, bottom + 1), LEAST_MARGIN_PX)
    total = body = count = 0.0
    for value in values:
        if value <= region[THRESHOLD]:
            total += value
            count += 1.0
            body += value > blob.cut
    if body >= BODY_SHARE * len(values):
        region[FLOOR] = region[THRESHOLD]
        noise[DARK] += gain * max(total / count - blob.level, 0.0)
        noise[SLOPE_X] = noise[SLOPE_Y] = 0.0


@step
def examine(
    runs: Array,
    part: BlobPart,
    values: Array,
    blob: Blob,
    search: Search,
    noise: PixelNoise,
    place: Place,
    n: int,
    r: int,
) -> tuple[int, int]:
    """Write the targets of a part whose verdict is uncertain, from run n and region r on; return where both end."""
    box = (part.left, part.right, runs[0, ROW], runs[-1, ROW] + 1)
    least, gain = noise.sigmas * blob.spread, noise.gains[place.image]
    if part.peak - blob.level <= NEAR_LIMIT * least:
        around = ring_values(place.pixels, box, max(part.longer, LEAST_MARGIN_PX))
        if len(around) > 0 and part.peak - median_in_place(around) <= least:
            place.left_out[UNEVEN] += 1.0
            return n, r
    contrast = contrast_of(float(part.peak), blob.level, blob.variance, gain, noise.sigmas)
    whole = part.longer < search.largest_px and part.compact
    if whole and part.dip > contrast + 1:
        # the noise of a bright target makes simple paths dip: find the best path
        whole = not passes_below(runs, values, box, contrast + 1)
    if whole:
        n, r = write_target(runs, blob, gain, place, n, r)
        return n, r
    step = max(1, int(0.5 * math.sqrt(blob.variance)))
    # types as in ``search``: otherwise all of the growth is compiled twice
    cut: Any = np.int64(blob.cut)
    finer = Search(search.highest, cut, step, contrast, search.smallest_px, search.largest_px, blob.level)
    grown_thresholds, grown_runs = grow_regions(runs, values, falling_thresholds(part.peak, blob.cut, step), finer)
    first = r
    n, r = write_grown(grown_thresholds, grown_runs, (place.image, blob.cut), place.found, place.regions, n, r)
    if r == first:
        place.left_out[LARGE if part.longer >= search.largest_px else SMALL] += 1.0
    for q in range(first, r):
        write_noise(blob, gain, place.noise[q])
        own = place.found[place.regions[q, FIRST_RUN] : place.regions[q, END_RUN]]
        stand_on_body(blob, gain, place.pixels, own, place.regions[q], place.noise[q])
    return n, r


@bare_step
def has_sure_pixel(runs: Array, values: Array, blob: Blob, behind: Array) -> bool:
    """Return whether one of a blob's pixels is also above the error of what was subtracted from the image."""
    limit = blob.level + SEARCH_SIGMAS * math.sqrt(blob.variance)
    for i in range(len(runs)):
        for k in range(runs[i, END] - runs[i, FIRST]):
            if is_sure(
                values[runs[i, PLACE] + k] - limit, behind[1, runs[i, ROW], runs[i, FIRST] + k], blob.variance
            ):
                return True
    return False


@step
def decide(
    runs: Array, values: Array, search: Search, noise: PixelNoise, place: Place, n: int, r: int
) -> tuple[int, int]:
    """Write the targets of one image, from run n and region r on; return where both end."""
    runs, start = blobs_of(runs)
    cut = np.empty((len(runs), 4), np.int32)
    gain, sigmas = noise.gains[place.image], noise.sigmas
    for b in range(len(start) - 1):
        own = runs[start[b] : start[b + 1]]
        blob = blob_of(own, values, noise, place.image, place.pixels.shape)
        if len(place.behind) > 0 and not has_sure_pixel(own, values, blob, place.behind):
            place.left_out[NOISE] += 1.0
            continue
        m, joined = trim_runs(own, values, blob.cut, cut)
        if joined:
            part = part_of(cut[:m], values, blob.cut, blob.level)
            if part.darkest > blob.cut:
                verdict = verdict_of(part, blob, search, gain, sigmas)
                if verdict == WHOLE:
                    n, r = write_target(cut[:m], blob, gain, place, n, r)
                elif verdict == UNCERTAIN:
                    n, r = examine(cut[:m], part, values, blob, search, noise, place, n, r)
                else:
                    place.left_out[verdict] += 1.0
                continue
        parts, part_start = blobs_of(runs_above(own, values, blob.cut))
        for q in range(len(part_start) - 1):
            one = parts[part_start[q] : part_start[q + 1]]
            part = part_of(one, values, blob.cut, blob.level)
            verdict = verdict_of(part, blob, search, gain, sigmas)
            if verdict == WHOLE:
                n, r = write_target(one, blob, gain, place, n, r)
            elif verdict == UNCERTAIN:
                n, r = examine(one, part, values, blob, search, noise, place, n, r)
            else:
                place.left_out[verdict] += 1.0
    return n, r


@step
def decide_in_set(
    images: ImageSet, bright: BrightPixels, search: Search, noise: PixelNoise, left_out: Array
) -> FoundRegions:
    """Find the targets of all images of a frame set among the pixels above their limits.

    Adds to ``left_out`` (n, 6) how many parts were no target, see ``Place``.
    """
    values, run_start, value_start = bright.values, bright.run_start, bright.value_start
    found, regions = np.empty((len(values), 3), np.int32), np.empty((len(values), 5), np.int32)
    of_regions = np.empty((len(values), 4))
    n, r = np.int64(0), np.int64(0)
    for k in range(len(run_start) - 1):
        own_runs = bright.runs[run_start[k] : run_start[k + 1]]
        own_values = values[value_start[k] : value_start[k + 1]]
        place = Place(k, image_of(images, k), behind_of(images, k), found, regions, of_regions, left_out[k])
        n, r = decide(own_runs, own_values, search, noise, place, n, r)
    return FoundRegions(found[:n], regions[:r], of_regions[:r])


@step
def set_noise(found: FoundRegions, noise: PixelNoise) -> None:
    """Write each region's noise for images whose noise is uniform and whose background is even."""
    for r in range(len(found.regions)):
        k = found.regions[r, IMAGE]
        found.noise[r, DARK], found.noise[r, GAIN] = noise.variances[k, 0, 0], noise.gains[k]
        found.noise[r, SLOPE_X] = found.noise[r, SLOPE_Y] = 0.0
