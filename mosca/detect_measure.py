"""Compiled measurement of detected regions: centroid, its covariance, diameter.

Called by ``mosca.detect``, which states the formulas. Sums are whole numbers about the corner of the mask,
so that a shift by whole pixels or a constant grey value changes nothing.
"""

import math
from typing import NamedTuple

import numpy as np

from mosca.data.arrays import Array
from mosca.detect_kernels import kernel, step

X, Y, XX, XY, YY, DIAMETER, PEAK, ELONGATION = range(8)
N_COLUMNS = 8


class Noise(NamedTuple):
    """Pixel noise: variance [DN^2] = dark_dn2 + gain_dn * (grey value - background)."""

    dark_dn2: float
    gain_dn: float


@step
def mask_rows(runs: Array, dilation: int, height: int, width: int) -> tuple[int, Array]:
    """Return the mask of a region: its first row, and (first column, end column, own pixels) of each row.

    The region's rows, filled from first to last pixel, grown by ``dilation`` px to all sides, corners
    included; the image's border cuts the mask off.
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


@step
def ring_of(image: Array, limit: int, left: int, right: int, top: int, bottom: int) -> tuple[int, int]:
    """Return sum and number of the pixels not above ``limit`` on the border of a box, as far as it is inside."""
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


@step
def disc_diameter(flux: float, contrast: float, spread_px2: float) -> float:
    """Return the diameter of the blurred disc that has this flux, contrast and mean squared radius.

    A disc of radius R and plateau A under a Gaussian blur s has the flux pi R^2 A, at its centre the
    contrast A (1 - exp(-R^2 / 2 s^2)) and the mean squared radius R^2 / 2 + 2 s^2: solved for R^2 by
    fixed-point iteration.
    """
    ratio = flux / (math.pi * contrast)
    r2 = min(ratio, spread_px2)
    for _ in range(5):
        blur2 = max(0.5 * spread_px2 - 0.25 * r2, 1e-6)
        r2 = ratio * (1.0 - math.exp(-0.5 * r2 / blur2))
    return 2.0 * math.sqrt(r2)


@step
def is_own(runs: Array, y: int, x: int) -> bool:
    """Tell whether a pixel belongs to the region that has these runs."""
    for i in range(len(runs)):
        if runs[i, 0] == y and runs[i, 1] <= x < runs[i, 2]:
            return True
    return False


@step
def measure(
    image: Array,
    runs: Array,
    threshold: int,
    dilation: int,
    bg_sum: int,
    bg_n: int,
    noise: Noise,
    out: Array,
) -> None:
    """Write centroid, covariance, diameter and peak of one region to ``out``.

    ``bg_sum`` / ``bg_n`` is the background's grey value. Pixels of the mask that are above the region's
    ``threshold`` without being its own belong to a neighbour and are left out.
    """
    first_row, rows = mask_rows(runs, dilation, image.shape[0], image.shape[1])
    left, right = rows[0, 0], rows[0, 1]
    for v in range(1, len(rows)):
        left = min(left, rows[v, 0])
        right = max(right, rows[v, 1])
    # Moments of the mask (n..) and of the grey values in it (s..) about its top left corner.
    n = nx = ny = nxx = nxy = nyy = np.int64(0)
    s = sx = sy = sxx = sxy = syy = peak = np.int64(0)
    for v in range(len(rows)):
        y = first_row + v
        m0 = m1 = m2 = r0 = r1 = r2 = n_bright = np.int64(0)
        for x in range(rows[v, 0], rows[v, 1]):
            u, value = np.int64(x - left), np.int64(image[y, x])
            n_bright += value > threshold
            r0 += value
            r1 += value * u
            r2 += value * u * u
            m1 += u
            m2 += u * u
            peak = max(peak, value)
        m0 += rows[v, 1] - rows[v, 0]
        if n_bright != rows[v, 2]:
            for x in range(rows[v, 0], rows[v, 1]):
                u, value = np.int64(x - left), np.int64(image[y, x])
                if value > threshold and not is_own(runs, y, x):
                    m0 -= 1
                    m1 -= u
                    m2 -= u * u
                    r0 -= value
                    r1 -= value * u
                    r2 -= value * u * u
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
    flux = s * bg_n - n * bg_sum
    x, y = -1.0, -1.0
    if flux > 0:
        x = (sx * bg_n - nx * bg_sum) / flux
        y = (sy * bg_n - ny * bg_sum) / flux
    if not (0.0 <= x < right - left and 0.0 <= y < len(rows)):  # a surround brighter than the target
        bg_sum, bg_n, flux = np.int64(0), np.int64(1), s
        x, y = sx / flux, sy / flux
    bg, flux_dn = bg_sum / bg_n, flux / bg_n
    out[X] = left + x
    out[Y] = first_row + y
    mask_xx = nxx - 2 * x * nx + x * x * n
    mask_xy = nxy - x * ny - y * nx + x * y * n
    mask_yy = nyy - 2 * y * ny + y * y * n
    grey_xx = sxx - 2 * x * sx + x * x * s - bg * mask_xx
    grey_xy = sxy - x * sy - y * sx + x * y * s - bg * mask_xy
    grey_yy = syy - 2 * y * sy + y * y * s - bg * mask_yy
    lever_x, lever_y = nx - x * n, ny - y * n
    dark, gain, bg_dn2 = noise.dark_dn2, noise.gain_dn, noise.dark_dn2 / bg_n
    flux2 = flux_dn * flux_dn
    out[XX] = (dark * mask_xx + gain * max(grey_xx, 0.0) + bg_dn2 * lever_x * lever_x) / flux2
    out[XY] = (dark * mask_xy + gain * grey_xy + bg_dn2 * lever_x * lever_y) / flux2
    out[YY] = (dark * mask_yy + gain * max(grey_yy, 0.0) + bg_dn2 * lever_y * lever_y) / flux2
    out[DIAMETER] = disc_diameter(flux_dn, peak - bg, (grey_xx + grey_yy) / flux_dn)
    out[PEAK] = peak


@kernel
def measure_regions(
    image: Array, runs: Array, start: Array, thresholds: Array, lowest: int, dilation: int, noise: Noise
) -> Array:
    """Measure every region that does not touch the image's border: a table (n, N_COLUMNS)."""
    height, width = image.shape
    table = np.empty((len(thresholds), N_COLUMNS))
    n = 0
    for r in range(len(thresholds)):
        own = runs[start[r] : start[r + 1]]
        top, bottom = own[0, 0], own[-1, 0]
        left, right = own[0, 1], own[0, 2] - 1
        for i in range(1, len(own)):
            left = min(left, own[i, 1])
            right = max(right, own[i, 2] - 1)
        if top == 0 or left == 0 or bottom == height - 1 or right == width - 1:
            continue
        grow = dilation if thresholds[r] == lowest else min(dilation, 1)
        far = grow + 1
        bg_sum, bg_n = ring_of(image, lowest, left - far, right + far, top - far, bottom + far)
        if bg_n == 0:
            bg_sum, bg_n = ring_of(image, thresholds[r], left - far, right + far, top - far, bottom + far)
        if bg_n == 0:
            bg_sum, bg_n = np.int64(thresholds[r]), np.int64(1)
        measure(image, own, thresholds[r], grow, bg_sum, bg_n, noise, table[n])
        size_x, size_y = right - left + 1, bottom - top + 1
        table[n, ELONGATION] = max(size_x, size_y) / min(size_x, size_y)
        n += 1
    return table[:n]
