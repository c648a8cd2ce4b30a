"""Compiled measurement of accepted regions: centroid, its covariance, diameter.

Called by ``mosca.detection.detect``, which states the formulas. Sums are whole numbers about the corner of the mask,
so that neither the order of summation nor a constant grey value changes a centroid.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from mosca.data.arrays import Array
from mosca.detection.images import ImageSet, image_of
from mosca.detection.search import DARK, END_RUN, FIRST_RUN, FLOOR, GAIN, IMAGE, THRESHOLD, FoundRegions, box_of
from mosca.numba_support.decorators import bare_step, step

X, Y, XX, XY, YY, DIAMETER, PEAK, ELONGATION, DIAMETER_SIGMA = range(9)
"""Columns of a table of measured regions: centre [px], its covariance [px^2], diameter [px], largest grey value [DN],
longer over shorter side of its box, standard deviation of the diameter [px] or 0."""
N_COLUMNS = 9


class Noise(NamedTuple):
    """Pixel noise: variance [DN^2] = dark_dn2 + gain_dn * (grey value - background)."""

    dark_dn2: float
    gain_dn: float


class CentroidRule(NamedTuple):
    """How the centroid of a region is computed."""

    local: bool
    """Whether the local background is subtracted and the mask grown; else the region is measured as it is."""
    dilation_px: int
    """How far the mask is grown."""


class Background(NamedTuple):
    """Sum [DN] and number of the pixels that give a background; (0, 1) for none."""

    total: Any
    n: Any


@step
def mask_rows(runs: Array, dilation: int, height: int, width: int) -> tuple[int, Array]:
    """Return the mask of a region: its first row, and (first column, end column, own pixels) of each row.

    The mask is the region's rows, filled from first to last pixel and grown by ``dilation`` px to all sides, corners
    included. The image's border cuts it off.
    """
    first_row = max(runs[0, 0] - dilation, 0)
    end_row = min(runs[-1, 0] + dilation + 1, height)
    rows = np.empty((end_row - first_row, 3), np.int32)
    for v in range(len(rows)):
        rows[v, 0], rows[v, 1], rows[v, 2] = width, 0, 0
    for i in range(len(runs)):
        y, first, end = runs[i, 0], runs[i, 1], runs[i, 2]
        rows[y - first_row, 2] += end - first
        for v in range(max(y - dilation, first_row) - first_row, min(y + dilation + 1, end_row) - first_row):
            rows[v, 0] = min(rows[v, 0], max(first - dilation, 0))
            rows[v, 1] = max(rows[v, 1], min(end + dilation, width))
    return first_row, rows


@bare_step
def ring_of(image: Array, limit: int, box: tuple[int, int, int, int]) -> tuple[Any, Any]:
    """Return sum and number of the pixels not above ``limit`` on the border of a box, as far as it is in the image.

    ``box`` is (left, right, top, bottom), all inclusive.
    """
    left, right, top, bottom = box
    height, width = image.shape
    total, n = np.int64(0), np.int64(0)
    for y in (top, bottom):
        if 0 <= y < height:
            for x in range(max(left, 0), min(right + 1, width)):
                dark = image[y, x] <= limit
                total += image[y, x] * dark
                n += dark
    for x in (left, right):
        if 0 <= x < width:
            for y in range(max(top + 1, 0), min(bottom, height)):
                dark = image[y, x] <= limit
                total += image[y, x] * dark
                n += dark
    return total, n


@bare_step
def disc_diameter(flux: float, contrast: float, spread_px2: float) -> float:
    """Return the diameter of the blurred disc that has this flux, contrast and mean squared radius.

    A disc of radius R and plateau A under a Gaussian blur s has the flux pi R^2 A, the contrast A (1 - exp(-R^2 / 2
    s^2)) at its centre, and the mean squared radius R^2 / 2 + 2 s^2. These are solved for R^2 by fixed-point
    iteration. The exponential is ((1 - t/16) / (1 + t/16))^8, right to 0.003 and the same on every machine.
    """
    ratio = flux / (math.pi * contrast)
    r2 = min(ratio, spread_px2)
    for _ in range(10):
        blur2 = max(0.5 * spread_px2 - 0.25 * r2, 1e-6)
        t = min(0.5 * r2 / blur2, 16.0) / 16.0
        power = ((1.0 - t) / (1.0 + t)) ** 2
        power *= power
        last, r2 = r2, ratio * (1.0 - power * power)
        if abs(r2 - last) < 1e-3 * r2:
            break
    return 2.0 * math.sqrt(r2)


@bare_step
def is_own(runs: Array, y: int, x: int) -> bool:
    """Return whether a pixel belongs to the region that has these runs."""
    own = False
    for i in range(len(runs)):
        own |= runs[i, 0] == y and runs[i, 1] <= x < runs[i, 2]
    return own


@bare_step
def squares_below(n: int) -> Any:
    """Return 0 + 1 + 4 + ... + (n - 1)^2."""
    return (n - 1) * n * (2 * n - 1) // 6


@bare_step
def moments(
    image: Array, runs: Array, threshold: int, filled: bool, first_row: int, rows: Array, left: int
) -> tuple[Any, Any, Any]:
    """Return the moments of a mask, those of the grey values in it, and the largest grey value.

    Moments are the sums of (1, x, y, xx, xy, yy) about column ``left`` and row ``first_row``. Pixels of the
    mask that are above the region's ``threshold`` without being its own belong to a neighbour and are left
    out; where the mask is not ``filled``, all pixels but the region's own are.
    """
    n = nx = ny = nxx = nxy = nyy = np.int64(0)
    s = sx = sy = sxx = sxy = syy = peak = np.int64(0)
    for v in range(len(rows)):
        row, first, end, n_own = first_row + v, rows[v, 0], rows[v, 1], rows[v, 2]
        a, b = np.int64(first - left), np.int64(end - left)
        m0, m1, m2 = b - a, (b * (b - 1) - a * (a - 1)) // 2, squares_below(b) - squares_below(a)
        r0 = r1 = r2 = n_bright = row_peak = np.int64(0)
        for column in range(first, end):
            u, value = np.int64(column - left), np.int64(image[row, column])
            n_bright += value > threshold
            r0 += value
            r1 += value * u
            r2 += value * u * u
            row_peak = max(row_peak, value)
        if n_bright != n_own or not (filled or m0 == n_own):
            row_peak = np.int64(0)
            for column in range(first, end):
                u, value = np.int64(column - left), np.int64(image[row, column])
                if value <= threshold and filled:
                    continue
                if is_own(runs, row, column):
                    row_peak = max(row_peak, value)
                else:
                    m0 -= 1
                    m1 -= u
                    m2 -= u * u
                    r0 -= value
                    r1 -= value * u
                    r2 -= value * u * u
        peak = max(peak, row_peak)
        n += m0
        nx += m1
        nxx += m2
        ny += v * m0
        nxy += v * m1
        nyy += v * v * m0
        s += r0
        sx += r1
        sxx += r2
        sy += v * r0
        sxy += v * r1
        syy += v * v * r0
    return (n, nx, ny, nxx, nxy, nyy), (s, sx, sy, sxx, sxy, syy), peak


@bare_step
def central(sums: tuple[Any, ...], x: float, y: float) -> tuple[float, float, float]:
    """Return the second moments (xx, xy, yy) about (x, y) from moments about the origin."""
    n, nx, ny, nxx, nxy, nyy = sums
    return (nxx - 2.0 * x * nx + x * x * n, nxy - x * ny - y * nx + x * y * n, nyy - 2.0 * y * ny + y * y * n)


@step
def measure(
    image: Array, runs: Array, threshold: int, background: Background, rule: CentroidRule, noise: Noise, out: Array
) -> None:
    """Write centroid, covariance, diameter and peak of one region to ``out``."""
    dilation, filled = rule.dilation_px, rule.local
    bg_sum, bg_n = background.total, background.n
    first_row, rows = mask_rows(runs, dilation, image.shape[0], image.shape[1])
    left, right = rows[0, 0], rows[0, 1]
    for v in range(1, len(rows)):
        left = min(left, rows[v, 0])
        right = max(right, rows[v, 1])
    mask, grey, peak = moments(image, runs, threshold, filled, first_row, rows, left)
    flux = grey[0] * bg_n - mask[0] * bg_sum
    x, y = -1.0, -1.0
    if flux > 0:
        x = (grey[1] * bg_n - mask[1] * bg_sum) / flux
        y = (grey[2] * bg_n - mask[2] * bg_sum) / flux
    if not (0.0 <= x < right - left and 0.0 <= y < len(rows)):
        # A surround brighter than the target: no background to subtract.
        bg_sum, bg_n, flux = 0, 1, grey[0]
        x, y = grey[1] / flux, grey[2] / flux
    out[X] = left + x
    out[Y] = first_row + y

    bg, flux_dn = bg_sum / bg_n, flux / bg_n
    mask_xx, mask_xy, mask_yy = central(mask, x, y)
    grey_xx, grey_xy, grey_yy = central(grey, x, y)
    above_xx, above_xy, above_yy = grey_xx - bg * mask_xx, grey_xy - bg * mask_xy, grey_yy - bg * mask_yy
    if above_xx <= 0.0 or above_yy <= 0.0 or above_xx * above_yy <= above_xy * above_xy:
        above_xx, above_xy, above_yy = grey_xx, grey_xy, grey_yy  # photons of the background count too
    lever_x, lever_y = mask[1] - x * mask[0], mask[2] - y * mask[0]
    dark, gain = noise.dark_dn2, noise.gain_dn
    bg_dn2 = dark / bg_n if bg_sum > 0 else 0.0
    flux2 = flux_dn * flux_dn
    out[XX] = (dark * mask_xx + gain * above_xx + bg_dn2 * lever_x * lever_x) / flux2
    out[XY] = (dark * mask_xy + gain * above_xy + bg_dn2 * lever_x * lever_y) / flux2
    out[YY] = (dark * mask_yy + gain * above_yy + bg_dn2 * lever_y * lever_y) / flux2
    out[DIAMETER_SIGMA] = 0.0
    out[DIAMETER] = disc_diameter(flux_dn, peak - bg, (above_xx + above_yy) / flux_dn)
    out[PEAK] = peak


@bare_step
def measure_region(
    image: Array, runs: Array, region: tuple[int, int], noise: Noise, rule: CentroidRule, out: Array
) -> bool:
    """Write the row of one region as ``measure_regions``; return False where it touches its image's border.

    ``region``: its threshold and its floor [DN].
    """
    threshold, floor = region
    height, width = image.shape
    (left, right, top, bottom), _ = box_of(runs, 0, len(runs))
    if top == 0 or left == 0 or bottom == height - 1 or right == width - 1:
        return False
    grow, bg_sum, bg_n = 0, np.int64(0), np.int64(1)
    if rule.local:
        # A region that ends above the lowest threshold ends where something else begins.
        grow = rule.dilation_px if threshold == floor else min(rule.dilation_px, 1)
        box = (left - grow - 1, right + grow + 1, top - grow - 1, bottom + grow + 1)
        bg_sum, bg_n = ring_of(image, floor, box)
        if bg_n == 0:
            bg_sum, bg_n = ring_of(image, threshold, box)
        if bg_n == 0:
            bg_sum, bg_n = np.int64(threshold), np.int64(1)
    measure(image, runs, threshold, Background(bg_sum, bg_n), CentroidRule(rule.local, grow), noise, out)
    size_x, size_y = right - left + 1, bottom - top + 1
    out[ELONGATION] = max(size_x, size_y) / min(size_x, size_y)
    return True


@bare_step
def lopsidedness(image: Array, own: Array, floor: int, row: Array) -> tuple[float, float]:
    """Return how far the centroid of a region's bright half is from its centre, along x and y [px].

    Bright: above half of the contrast between the region's peak and its ``floor``. In the image of a target both
    coincide; the light of a neighbour or of an edge ends below that level more often than not.
    """
    half = 0.5 * (row[PEAK] + floor)
    total, sx, sy = 0.0, 0.0, 0.0
    for i in range(len(own)):
        y = own[i, 0]
        for x in range(own[i, 1], own[i, 2]):
            above = max(float(image[y, x]) - half, 0.0)
            total += above
            sx += above * (x - row[X])
            sy += above * (y - row[Y])
    if total > 0.0:
        return sx / total, sy / total
    return 0.0, 0.0


@step
def measure_regions(images: ImageSet, found: FoundRegions, rule: CentroidRule) -> tuple[Array, Array]:
    """Measure every region that does not touch its image's border.

    Returns a table (n, N_COLUMNS) and the region of each row (n).
    """
    regions = found.regions
    table = np.empty((len(regions), N_COLUMNS))
    region_of = np.empty(len(regions), np.int32)
    n = 0
    for r in range(len(regions)):
        k = regions[r, IMAGE]
        own = found.runs[regions[r, FIRST_RUN] : regions[r, END_RUN]]
        noise = Noise(found.noise[r, DARK], found.noise[r, GAIN])
        limits = (regions[r, THRESHOLD], regions[r, FLOOR])
        if measure_region(image_of(images, k), own, limits, noise, rule, table[n]):
            region_of[n] = r
            n += 1
    return table[:n], region_of[:n]
