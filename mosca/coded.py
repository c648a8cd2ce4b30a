"""Identification of coded targets: from an image to numbered sub-pixel centres. Mosca paper, section 2.2.

A coded target is a dot within a ring of 20 sectors on a plate of the other colour (``mosca.data.targets``,
``target_codes``; the kind goes back to Schneider 1991 and, with this laboratory, to Knyaz and Sibiryakov 1998).

1. Patches. A pixel is bright when it exceeds the middle between the smallest and the largest grey value of the
   15 x 15 px around it and these differ by more than the contrast B: a threshold of its own for every target,
   whatever the light. Bright 8-connected patches that fill the ellipse of their second moments are dots, on
   the image itself for dots up to about 14 px and on copies reduced by 2, 4, ... for larger ones.
2. Frame. The dot's contour at half its own contrast, on 32 rays, gives the ellipse and with it the affine map of
   the plate into the image but for its roll. For dots that lean, five amounts of perspective along the shorter
   axis are tried and the best reading is kept.
3. Plate. Between dot and ring and outside the ring all must be plate, even or with light that changes evenly: at
   40 places within half of the dot's contrast.
4. Ring. 160 directions, at three radii. The sectors start where the squared change of light has its phase. No six
   sectors of a number are alike, so each is compared with the middle of the lightest and the darkest of the seven
   about it. The three radii must agree, the swing must be that of the dot, and the word must be one of the
   code's exactly: any two numbers differ in four sectors, nothing is put right.
5. Centre. The dot goes through the estimator of ``mosca.detect``: the pixels above half its contrast are the
   region, the mask reaches as far beyond as the gap allows.

A number that is read in two places is refused, both of them. A mirrored ring is refused but for 25 of the 507
numbers: 13 read the same and 12 as another one (``tests/mosca/test_coded.py``); no eye sees a plate from behind.
"""

import math
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import cv2
import numpy as np

from mosca.coded_kernels import (
    AXX, AXY, AYY, CONTRAST_DN, MARGIN, PLATE_DN, SECTORS, START, WORD, Reading, X, Y, read_targets,
)  # fmt: skip
from mosca.coded_measure import measure_dots
from mosca.data.arrays import Array
from mosca.data.found_targets import CodedDetections
from mosca.data.target_codes import ring_code
from mosca.data.targets import PLATE, RING_INNER, RING_OUTER
from mosca.errors import InputError

NEIGHBOURHOOD_PX = 15
LARGEST_DOT_PX = 13.0
"""Diameter of the largest dot that is sure to be one patch; larger ones are found on reduced images."""
LEAST_AREA_PX = 5
SAMPLED_ROWS = 16


@dataclass(frozen=True)
class CodedSettings:
    """What coded targets look like. Grey values [DN] are those of an 8-bit image, scaled with the bits."""

    colour: Literal["white", "black", "both"] = "white"
    """Of dot and sectors: white on black plates, black on white ones, or either."""
    numbers: frozenset[int] | None = None
    """Numbers that there are; others are refused. None: all of the code."""
    contrast_dn: float = 24.0
    """B: dot and plate differ by more than this, and by more than 4 times the noise."""
    maximum_dot_px: float = 100.0
    """Longer axis of the largest dot."""
    ring_inner: float = RING_INNER
    """Inner radius of the ring over the dot's radius."""
    ring_outer: float = RING_OUTER
    """Outer radius of the ring over the dot's radius."""
    plate: float = PLATE
    """Edge of the plate over the dot's radius."""
    flattest: float = 0.3
    """Shorter over longer axis of the flattest dot: 0.3 is 72 deg of tilt."""
    least_confidence: float = 0.25
    """Of the sector that is hardest to read; below, the target is refused."""
    read_noise_dn: float = 0.13
    """As in ``DetectionSettings``."""
    gain_dn_per_e: float = 0.0128
    """As in ``DetectionSettings``."""

    def __post_init__(self) -> None:
        if self.colour not in ("white", "black", "both"):
            raise _out_of_range("colour", self.colour, "'white', 'black' or 'both'")
        if self.numbers is not None:
            object.__setattr__(self, "numbers", frozenset(self.numbers))
        if not 0 < self.contrast_dn < 255:
            raise _out_of_range("contrast_dn", self.contrast_dn, "more than 0 and less than 255")
        if not 3 <= self.maximum_dot_px < math.inf:
            raise _out_of_range("maximum_dot_px", self.maximum_dot_px, "3 or more")
        if not 1.2 <= self.ring_inner < self.ring_outer <= 0.45 * self.plate < math.inf:
            given = (self.ring_inner, self.ring_outer, self.plate)
            raise _out_of_range(
                "ring_inner, ring_outer, plate", given, "1.2 <= ring_inner < ring_outer <= 0.45 plate"
            )
        if not 0 < self.flattest < 1:
            raise _out_of_range("flattest", self.flattest, "more than 0 and less than 1")
        if not 0 <= self.least_confidence < 1:
            raise _out_of_range("least_confidence", self.least_confidence, "0 to below 1")
        for key in ("read_noise_dn", "gain_dn_per_e"):
            value = getattr(self, key)
            if not (value >= 0 and math.isfinite(value)):
                raise _out_of_range(key, value, "0 or more")


DEFAULTS = CodedSettings()


def find_coded(
    image: Array, camera: str, settings: CodedSettings = DEFAULTS, bit_depth: int = 8
) -> CodedDetections:
    """Return the coded targets in an image (H, W) of uint8 or uint16 with ``bit_depth`` significant bits (8 to 16).

    ``camera``: the name that the detections carry. Raises InputError for another image or bit depth.
    """
    _check(image, camera, bit_depth)
    scale = 2.0 ** (bit_depth - 8)
    top = image.dtype.type(2**bit_depth - 1)
    noise = noise_of(image)
    found = []
    for dark in {"white": (False,), "black": (True,), "both": (False, True)}[settings.colour]:
        bright = top - np.minimum(image, top) if dark else image
        table = _read(np.ascontiguousarray(bright), settings, scale, noise)
        numbers, rolls = _numbers(table, settings.numbers)
        known = np.flatnonzero(numbers >= 0)
        known = known[_best_of_a_place(table[known], settings.ring_outer)]
        table, numbers, rolls = table[known], numbers[known], rolls[known]
        xy, covariance = measure_dots(
            bright,
            table,
            max(noise**2, (settings.read_noise_dn * scale) ** 2 + 1 / 12),
            settings.gain_dn_per_e * scale,
            float(top) if dark else None,
        )
        found.append((numbers, xy, covariance, table[:, [AXX, AXY, AYY]], rolls, table[:, MARGIN]))
    numbers, xy, covariance, shape, rolls, margin = (
        np.concatenate(parts) for parts in zip(*found, strict=True)
    )
    every, first, times = np.unique(numbers, return_index=True, return_counts=True)
    once = first[times == 1]
    semi_axes, angle = _ellipses(shape[once])
    return CodedDetections(
        camera,
        numbers[once],
        xy[once],
        covariance[once],
        semi_axes,
        angle,
        rolls[once],
        np.minimum(margin[once], 1.0),
        every[times > 1],
    )


def noise_of(image: Array) -> float:
    """Return the standard deviation of a pixel's noise [DN], at least that of rounding.

    The median of the second differences along rows, which edges hardly touch (after Immerkaer 1996).
    """
    rows = image[:: max(1, image.shape[0] // SAMPLED_ROWS)].astype(np.float32)
    bend = np.abs(rows[:, 2:] - 2 * rows[:, 1:-1] + rows[:, :-2])
    median = float(np.median(bend)) if bend.size else 0.0
    return max(1.4826 * median / math.sqrt(6.0), math.sqrt(1 / 12))


def _read(image: Array, settings: CodedSettings, scale: float, noise: float) -> Array:
    """Return what is read around white dots on the image and its reduced copies, in pixels of the image."""
    tables = []
    for level, (smaller, factor) in enumerate(_reductions(image, settings.maximum_dot_px)):
        contrast = settings.contrast_dn * scale
        own_noise = noise / 2**level
        labels, count = _patches(smaller, contrast, own_noise)
        reading = Reading(
            gap=0.5 * (1.0 + settings.ring_inner),
            ring_inner=settings.ring_inner,
            ring_outer=settings.ring_outer,
            outside=0.5 * (settings.ring_outer + 0.5 * settings.plate),
            contrast_dn=contrast,
            noise_dn=own_noise,
            least_area_px=LEAST_AREA_PX,
            least_axis_px=0.0 if level == 0 else LARGEST_DOT_PX / 4 - 0.25,
            flattest=settings.flattest,
            roughest=0.05,
            stain=0.4,
            least_swing=0.3,
            least_margin=settings.least_confidence,
            least_likeness=0.93,
        )
        table = read_targets(smaller, labels, count, reading)
        table[:, [X, Y]] = table[:, [X, Y]] * factor + (factor - 1) / 2
        table[:, [AXX, AXY, AYY]] *= factor
        tables.append(table)
    return np.concatenate(tables)


def _reductions(image: Array, maximum_dot_px: float) -> Iterator[tuple[Array, int]]:
    """Yield the image and copies reduced by 2, 4, ...: as many as the largest dot takes."""
    factor = 1
    yield image, factor
    while maximum_dot_px > LARGEST_DOT_PX * factor and min(image.shape) >= 4 * NEIGHBOURHOOD_PX:
        factor *= 2
        height, width = image.shape[0] // 2, image.shape[1] // 2
        image = cv2.resize(image[: 2 * height, : 2 * width], (width, height), interpolation=cv2.INTER_AREA)
        yield image, factor


def _patches(image: Array, contrast: float, noise: float) -> tuple[Array, int]:
    """Return labels (H, W) int32 of the patches brighter than the middle of what is around them, and their number.

    The background, label 0, counts as one.
    """
    if noise > contrast / 12:
        image = cv2.GaussianBlur(image, (3, 3), 0.6)
    window = np.ones((NEIGHBOURHOOD_PX, NEIGHBOURHOOD_PX), np.uint8)
    low, high = cv2.erode(image, window), cv2.dilate(image, window)
    middle = cv2.addWeighted(low, 0.5, high, 0.5, 0.0)
    bright = cv2.compare(image, middle, cv2.CMP_GT)
    wide = cv2.compare(cv2.subtract(high, low), contrast, cv2.CMP_GT)
    count, labels = cv2.connectedComponents(cv2.bitwise_and(bright, wide))
    return labels, count


def _numbers(table: Array, allowed: Collection[int] | None) -> tuple[Array, Array]:
    """Return number (n,), -1 for none, and roll (n,) [rad] of what was read."""
    numbers, rolls = np.full(len(table), -1), np.zeros(len(table))
    for i, row in enumerate(table):
        found = _found(int(row[WORD]))
        if found is None or (allowed is not None and found[0] not in allowed):
            continue
        number, start = found
        t = row[START] + 2 * math.pi * start / SECTORS
        u, v = math.cos(t), -math.sin(t)
        numbers[i] = number
        rolls[i] = math.atan2(row[AXY] * u + row[AYY] * v, row[AXX] * u + row[AXY] * v)
    return numbers, rolls


@lru_cache(maxsize=4096)
def _found(word: int) -> tuple[int, int] | None:
    """Return the number read in a word, bit k its k-th sector, and the sector where it starts."""
    return ring_code().find(tuple(bool(word >> k & 1) for k in range(SECTORS)))


def _best_of_a_place(table: Array, ring_outer: float) -> Array:
    """Return which rows remain (m,) where of readings on each other's plates only the surest is kept."""
    xx, xy, yy = (table[:, k] for k in (AXX, AXY, AYY))
    dx, dy = (table[:, None, k] - table[None, :, k] for k in (X, Y))
    away = np.hypot(yy * dx - xy * dy, xx * dy - xy * dx) / (xx * yy - xy**2)  # in radii of the second's dot
    order = np.empty(len(table), dtype=np.int64)
    order[np.argsort(-table[:, MARGIN], kind="stable")] = np.arange(len(table))
    return np.flatnonzero(~((away < ring_outer) & (order[None, :] < order[:, None])).any(axis=1))


def _ellipses(shape: Array) -> tuple[Array, Array]:
    """Return semi-axes (n, 2), the longer first, and the angle (n,) of the longer one of maps (n, 3)."""
    xx, xy, yy = shape.T
    middle, spread = 0.5 * (xx + yy), np.hypot(0.5 * (xx - yy), xy)
    return np.stack([middle + spread, middle - spread], axis=1), 0.5 * np.arctan2(2 * xy, xx - yy)


def _check(image: Array, camera: str, bit_depth: int) -> None:
    if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16) or 0 in image.shape:
        raise InputError(
            f"coded targets: camera '{camera}': image {image.shape} of {image.dtype} given; (H, W) of uint8 or "
            "uint16 is allowed: reduce colour to grey first"
        )
    if not 8 <= bit_depth <= 8 * image.dtype.itemsize:
        raise InputError(
            f"coded targets: camera '{camera}': bit_depth {bit_depth} given for an image of {image.dtype}; "
            f"8 to {8 * image.dtype.itemsize} is allowed"
        )


def _out_of_range(key: str, value: object, allowed: str) -> InputError:
    return InputError(f"coded targets: key '{key}': {value!r} given; {allowed} is allowed")
