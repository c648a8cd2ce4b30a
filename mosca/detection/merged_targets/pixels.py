"""Compiled gathering of the pixels of one or two regions that may be two targets, and where their fit starts.

``mosca.detection.merged_targets.split`` compiles this in.
"""

import math

import numpy as np

from mosca.data.arrays import Array
from mosca.detection.disc_fit.disc_image import FAST
from mosca.numba_support.decorators import bare_step, step

MARGIN_PX = 3
"""How far around the regions pixels are taken."""
OWN, SKIRT, FOREIGN = 1, 2, 3
"""Marks of pixels: the regions' own, those that fall off from them, those of others."""


@step(fastmath=FAST)
def gather_all(image: Array, own: Array, other: Array, floor: int, full: float) -> tuple[Array, int, float, float]:
    """Return the pixels (n, 3) x, y, grey value around two regions, how many, the dark level and the peak.

    Left out: saturated pixels, and those of other regions with 2 px around them.
    """
    height, width = image.shape
    left, right, top, bottom = width, 0, height, 0
    for part in (own, other):
        for i in range(len(part)):
            left, right = min(left, part[i, 1]), max(right, part[i, 2] - 1)
            top, bottom = min(top, part[i, 0]), max(bottom, part[i, 0])
    left, right = max(left - MARGIN_PX, 0), min(right + MARGIN_PX, width - 1)
    top, bottom = max(top - MARGIN_PX, 0), min(bottom + MARGIN_PX, height - 1)
    mark = np.zeros((bottom - top + 1, right - left + 1), np.uint8)
    for part in (own, other):
        for i in range(len(part)):
            for x in range(part[i, 1], part[i, 2]):
                mark[part[i, 0] - top, x - left] = OWN
    spread_downhill(image, mark, top, left, floor)
    for y in range(top, bottom + 1):
        for x in range(left, right + 1):
            if image[y, x] > floor and mark[y - top, x - left] in (0, FOREIGN):
                for v in range(max(y - 2, top), min(y + 3, bottom + 1)):
                    for u in range(max(x - 2, left), min(x + 3, right + 1)):
                        if mark[v - top, u - left] == 0:
                            mark[v - top, u - left] = FOREIGN
    pixels = np.empty((mark.size, 3))
    n, peak, dark, n_dark = 0, 0.0, 0.0, 0
    for y in range(top, bottom + 1):
        for x in range(left, right + 1):
            value = float(image[y, x])
            if mark[y - top, x - left] == OWN:
                peak = max(peak, value)
            if mark[y - top, x - left] == FOREIGN or value >= full:
                continue
            pixels[n, 0], pixels[n, 1], pixels[n, 2] = x, y, value
            n += 1
            if y in (top, bottom) or x in (left, right):
                dark += value
                n_dark += 1
    return pixels, n, dark / max(n_dark, 1), peak


@bare_step(fastmath=FAST)
def keep_near(pixels: Array, n: int, p: Array) -> int:
    """Move the pixels that two discs light, and a ring around them, to the front; return how many these are."""
    kept = 0
    for i in range(n):
        for a in range(2):
            reach = p[4 + a] + 4.0 * p[9] + 1.0
            if (pixels[i, 0] - p[a]) ** 2 + (pixels[i, 1] - p[2 + a]) ** 2 < reach * reach:
                for b in range(3):
                    pixels[kept, b] = pixels[i, b]
                kept += 1
                break
    return kept


@bare_step(fastmath=FAST)
def spread_downhill(image: Array, mark: Array, top: int, left: int, floor: int) -> None:
    """Mark pixels around the regions that fall off from them: where regions met, the floor was not reached."""
    spread = True
    while spread:
        spread = False
        for y in range(mark.shape[0]):
            for x in range(mark.shape[1]):
                value = image[top + y, left + x]
                if mark[y, x] != 0 or value <= floor:
                    continue
                for v in range(max(y - 1, 0), min(y + 2, mark.shape[0])):
                    for u in range(max(x - 1, 0), min(x + 2, mark.shape[1])):
                        if mark[v, u] in (OWN, SKIRT) and image[top + v, left + u] >= value and mark[y, x] == 0:
                            mark[y, x], spread = SKIRT, True


@step(fastmath=FAST)
def start_of(pixels: Array, n: int, own: Array, other: Array, level: float, peak: float, blur: float) -> Array:
    """Return x1, x2, y1, y2, R1, R2, A1, A2, b, s to start from: a region's ends, or the two regions' middles."""
    out = np.empty(10)
    mean = region_mean(own)
    xx, xy, yy = region_moments(own, mean)
    if len(other):
        far = region_mean(other)
        out[0], out[1], out[2], out[3] = mean[0], far[0], mean[1], far[1]
        out[4], out[5] = math.sqrt(area(own) / math.pi), math.sqrt(area(other) / math.pi)
    else:
        middle, half = 0.5 * (xx + yy), math.hypot(0.5 * (xx - yy), xy)
        angle = 0.5 * math.atan2(2.0 * xy, xx - yy)
        apart = math.sqrt(2.0 * half)  # two equal discs: the moments differ by a quarter of their squared distance
        dx, dy = apart * math.cos(angle), apart * math.sin(angle)
        out[0], out[1], out[2], out[3] = mean[0] - dx, mean[0] + dx, mean[1] - dy, mean[1] + dy
        out[4] = out[5] = 2.0 * math.sqrt(max(middle - half, 0.1))
    # a region reaches beyond the edge
    for a in range(2):
        out[4 + a] = max(out[4 + a] - 0.9 * blur, 0.5 * blur)
    out[6] = out[7] = peak - level
    out[8], out[9] = level, blur
    return out


@bare_step(fastmath=FAST)
def area(runs: Array) -> float:
    """Return the number of a region's pixels."""
    n = 0.0
    for i in range(len(runs)):
        n += runs[i, 2] - runs[i, 1]
    return n


@bare_step(fastmath=FAST)
def region_mean(runs: Array) -> tuple[float, float]:
    """Return the middle of a region's pixels."""
    n = sx = sy = 0.0
    for i in range(len(runs)):
        for x in range(runs[i, 1], runs[i, 2]):
            n, sx, sy = n + 1.0, sx + x, sy + runs[i, 0]
    return sx / n, sy / n


@bare_step(fastmath=FAST)
def region_moments(runs: Array, mean: tuple[float, float]) -> tuple[float, float, float]:
    """Return the central second moments (xx, xy, yy) of a region's pixels [px^2]."""
    n = sxx = sxy = syy = 0.0
    for i in range(len(runs)):
        dy = runs[i, 0] - mean[1]
        for x in range(runs[i, 1], runs[i, 2]):
            dx = x - mean[0]
            n, sxx, sxy, syy = n + 1.0, sxx + dx * dx, sxy + dx * dy, syy + dy * dy
    return sxx / n, sxy / n, syy / n
