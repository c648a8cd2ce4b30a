"""Compiled reading of coded rings: from the light along them to words of sectors.

Called by ``mosca.coded_targets.detect``, which describes the method, with what ``mosca.coded_targets.dots`` gathers.
"""

import math
from typing import NamedTuple

import numpy as np

from mosca.coded_targets.dots import AXX, AXY, AYY, BANDS, COS, PER_SECTOR, SECTORS, SIN, STEPS
from mosca.data.arrays import Array
from mosca.numba_support.decorators import kernel, step

WORD, START, MARGIN = range(3)

WINDOW = 3  # sectors to each side: of 7 in a row, one at least is white and one black (runs of at most 5)
LEAST_SWING = 0.3  # of white against black sectors, over the dot's contrast; and the dot's over theirs
BAND_TOLERANCE = 0.35  # of the swing, by which one radius may contradict the ring as a whole
LEAST_LIKENESS = 0.93  # correlation of the ring's light with that of its word, at least
USUAL_BLUR_PX, MOST_PEAKING = 0.8, 0.6  # blur assumed in sharpening, and the largest share that it adds
PICKS, PICK_STEP = 5, 0.15  # samples of a sector's level, and their spacing [sectors]


class Ring(NamedTuple):
    """``radius`` of the ring's middle in radii of the dot; ``least_margin`` of a sector."""

    radius: float
    least_margin: float


@step
def sector_lengths(frame: Array, start: float, radius: float, blur_px: float) -> Array:
    """Return the length of each sector (SECTORS,) in the image, at ``radius`` on the plate [``blur_px``].

    ``start``: start of the first sector [rad].
    """
    lengths = np.empty(SECTORS)
    for k in range(SECTORS):
        t = start + 2.0 * math.pi * (k + 0.5) / SECTORS
        c, s = math.cos(t), math.sin(t)
        along = math.hypot(frame[AXX] * s + frame[AXY] * c, frame[AXY] * s + frame[AYY] * c)
        lengths[k] = 2.0 * math.pi / SECTORS * radius * along / blur_px
    return lengths


@step
def sector_levels(light: Array, start: float, lengths: Array) -> Array:
    """Return the light (BANDS + 1, SECTORS) of each sector at each radius and, last, at all, sharpened.

    ``start``: in steps. Blur adds a share ``a = erfc(length / sqrt(8)) / 2`` of each neighbour's light to the middle
    of a sector. The first-order correction adds ``a / (1 - 4 a)`` times its differences from them.
    """
    raw = np.zeros((BANDS + 1, SECTORS))
    for j in range(PICKS):
        place = start + (0.5 + PICK_STEP * (j - PICKS // 2)) * PER_SECTOR
        below = math.floor(place)
        share = place - below
        i = int(below) % STEPS
        for k in range(SECTORS):
            after = i + 1 if i + 1 < STEPS else 0
            for b in range(BANDS):
                value = ((1.0 - share) * light[b, i] + share * light[b, after]) / PICKS
                raw[b, k] += value
                raw[BANDS, k] += value / BANDS
            i += PER_SECTOR
            if i >= STEPS:
                i -= STEPS
    levels = np.empty_like(raw)
    for k in range(SECTORS):
        a = 0.5 * math.erfc(lengths[k] / math.sqrt(8.0))
        peaking = min(a / max(1.0 - 4.0 * a, 1e-3), MOST_PEAKING)
        after = k + 1 if k + 1 < SECTORS else 0
        for b in range(BANDS + 1):
            levels[b, k] = raw[b, k] + peaking * (2.0 * raw[b, k] - raw[b, k - 1] - raw[b, after])
    return levels


@step
def sector_start(light: Array) -> float:
    """Return where sectors start [steps], from the phase of the squared change of light along the ring."""
    real = imaginary = 0.0
    for i in range(STEPS):
        after = i + 1 if i + 1 < STEPS else 0
        edge = 0.0
        for b in range(BANDS):
            edge += light[b, after] - light[b, i - 1]
        k = SECTORS * (i % PER_SECTOR)  # a sector is a full period
        real += edge * edge * COS[k]
        imaginary += edge * edge * SIN[k]
    return math.atan2(imaginary, real) / (2.0 * math.pi) * PER_SECTOR


@step
def decide(levels: Array, least_margin: float) -> tuple[int, float]:
    """Return the word of sector levels and its smallest margin, -1 where the ring is no ring of sectors."""
    word, margin = 0, 9.0
    around = np.empty(SECTORS + 2 * WINDOW)
    for b in range(BANDS, -1, -1):
        for k in range(len(around)):
            around[k] = levels[b, (k - WINDOW) % SECTORS]
        for k in range(SECTORS):
            low = high = around[k]
            for j in range(1, 2 * WINDOW + 1):
                low, high = min(low, around[k + j]), max(high, around[k + j])
            swing, above = 0.5 * (high - low), levels[b, k] - 0.5 * (high + low)
            if b == BANDS:
                if 2.0 * swing < LEAST_SWING or high > 1.0 / LEAST_SWING:
                    return 0, -1.0
                margin = min(margin, abs(above) / swing)
                word |= int(above > 0.0) << k
            elif above * (2 * (word >> k & 1) - 1) < -BAND_TOLERANCE * swing:
                return 0, -1.0  # a sector is of one colour from its inner to its outer edge
        if margin <= least_margin:
            return 0, -1.0
    return word, margin


@step
def model_light(word: int, start: float, lengths: Array, i: int) -> float:
    """Return the light at step ``i`` of the ring of ``word``, 0 to 1; ``lengths`` of sectors in units of the blur."""
    place = (i - start) / PER_SECTOR % SECTORS
    k = min(int(place), SECTORS - 1)
    share, length = place - k, lengths[k] / math.sqrt(2.0)
    before, after = 0.5 * math.erfc(share * length), 0.5 * math.erfc((1.0 - share) * length)
    light = before * (word >> (k - 1) % SECTORS & 1) + after * (word >> (k + 1) % SECTORS & 1)
    return light + (1.0 - before - after) * (word >> k & 1)


@step
def likeness(light: Array, word: int, start: float, lengths: Array) -> float:
    """Return the correlation of a ring's light with that of ``word``."""
    sx = sy = sxx = sxy = syy = 0.0
    for i in range(STEPS):
        x = model_light(word, start, lengths, i)
        y = 0.0
        for b in range(BANDS):
            y += light[b, i]
        sx += x
        sy += y
        sxx += x * x
        sxy += x * y
        syy += y * y
    spread = (STEPS * sxx - sx * sx) * (STEPS * syy - sy * sy)
    return (STEPS * sxy - sx * sy) / math.sqrt(spread) if spread > 0.0 else 0.0


@kernel
def read_rings(light: Array, frames: Array, ring: Ring) -> Array:
    """Return (n, 3) word, bit k for the k-th sector, where its first sector starts [rad], and smallest margin.

    ``light`` (n, BANDS, STEPS) and ``frames`` (n, FRAME): see ``mosca.coded_targets.dots``. The margin is -1 where
    the ring is no ring of sectors, or uncertain.
    """
    out = np.zeros((len(light), 3))
    for n in range(len(light)):
        out[n, MARGIN] = -1.0
        start = sector_start(light[n])
        turn = 2.0 * math.pi * start / STEPS
        lengths = sector_lengths(frames[n], turn, ring.radius, USUAL_BLUR_PX)
        word, margin = decide(sector_levels(light[n], start, lengths), ring.least_margin)
        if margin > 0.0 and likeness(light[n], word, start, lengths) > LEAST_LIKENESS:
            out[n, WORD], out[n, START], out[n, MARGIN] = word, turn, margin
    return out
