"""Identification of coded targets: from an image to numbered sub-pixel centres. Mosca paper, section 2.2.

A coded target is a dot within a ring of 20 sectors on a plate of the other colour (``mosca.data.targets``,
``target_codes``); targets of this kind automated the paper's calibration (its reference Knyaz and Sibiryakov 1998).

1. Patches (``coded_patches``). A pixel is bright when it exceeds the middle between the smallest and the largest
   grey value of the 15 x 15 px around it and these differ by more than the contrast B: a threshold of its own
   for every target, whatever the light. Bright 8-connected patches that fill the ellipse of their second
   moments are dots, on the image itself for dots up to about 13 px and on copies reduced by 2, 4, ... for
   larger ones.
2. Frame (``coded_dots``). The dot's contour at half its own contrast, on 24 rays, gives the ellipse and with it
   the affine map of the plate into the image but for its roll. For tilted dots with uncertain readings, four amounts
   of perspective along the shorter axis are tried too, and the most certain reading is kept.
3. Plate. At 40 points between dot and ring and outside the ring the grey value must follow a plane, within 0.4 of
   the dot's contrast.
4. Ring (``coded_rings``). It is sampled in 120 directions, at three radii. The sectors start at the phase of the
   squared change of light. The blur between sectors is corrected. No six successive sectors of a number are alike, so
   each is thresholded at the middle of the lightest and the darkest of the seven about it. The three radii must
   agree, the contrast must be that of the dot, the ring's light must correlate with that of the word by 0.93, and the
   word must be one of the code's exactly: any two numbers differ in four sectors, and no errors are corrected.
5. Centre (``mosca.coded_targets.centre``). An ellipse is fitted to the pixels of dot and plate, with light that is
   uneven or saturated. The circle's eccentricity is not corrected here: that needs the camera's pose
   (``mosca.camera.eccentricity``).

Where readings lie on one another's plates, only the most certain is kept. A number that is read twice is refused in
both cases. A mirrored ring is refused but for 25 of the 507 numbers: 13 of them read the same and 12 as another. Only
mirrors show these: where there are mirrors, restrict ``numbers``. Occlusion of up to three sectors cannot make
another number; four or five neighbours, covered exactly and in the ring's own black, do in 0.09 % and 0.2 % of all
cases, more than five never. (Counted over the whole code in the tests.)
"""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np

from mosca.coded_targets.centre import measure_dots
from mosca.coded_targets.decode import Readings, ellipses_of, read_codes
from mosca.coded_targets.dots import AXX, AXY, AYY, SECTORS, TargetAppearance, X, Y
from mosca.coded_targets.pixel_noise import noise_of, pixel_noise
from mosca.coded_targets.ring_sampling import MARGIN, START, WORD
from mosca.data.arrays import Array
from mosca.data.found_targets import CodedDetections
from mosca.data.target_codes import ring_code
from mosca.data.targets import PLATE, RING_INNER, RING_OUTER, CodedTarget
from mosca.detection.local_background import ROUNDING_DN2
from mosca.errors import InputError


@dataclass(frozen=True)
class CodedSettings:
    """Appearance of coded targets. Grey values [DN] are those of an 8-bit image, scaled with the bits."""

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
    """Least margin of a sector; below, the target is refused."""
    read_noise_dn: float | None = None
    """Dark noise of a pixel; None: learned from the image."""
    gain_dn_per_e: float | None = None
    """Grey values an electron; None: learned from the image."""

    def __post_init__(self) -> None:
        if self.numbers is not None:
            object.__setattr__(self, "numbers", frozenset(self.numbers))
        ring = 1.2 <= self.ring_inner < self.ring_outer <= 0.45 * self.plate < math.inf
        for keys, sound, allowed in (
            (("colour",), self.colour in ("white", "black", "both"), "'white', 'black' or 'both'"),
            (("contrast_dn",), 0 < self.contrast_dn < 255, "more than 0 and less than 255"),
            (("maximum_dot_px",), 3 <= self.maximum_dot_px < math.inf, "3 or more"),
            (("ring_inner", "ring_outer", "plate"), ring, "1.2 <= ring_inner < ring_outer <= 0.45 plate"),
            (("flattest",), 0 < self.flattest < 1, "more than 0 and less than 1"),
            (("least_confidence",), 0 <= self.least_confidence < 1, "0 to below 1"),
            (("read_noise_dn",), 0 <= (self.read_noise_dn or 0.0) < math.inf, "0 or more"),
            (("gain_dn_per_e",), 0 <= (self.gain_dn_per_e or 0.0) < math.inf, "0 or more"),
        ):
            if not sound:
                values = tuple(getattr(self, key) for key in keys)
                given = values if len(keys) > 1 else values[0]
                raise InputError(f"coded targets: key '{', '.join(keys)}': {given!r} given; {allowed} is allowed")


DEFAULTS = CodedSettings()


def settings_of(coded: Sequence[CodedTarget], colour: Literal["white", "black", "both"] = "both") -> CodedSettings:
    """Return the settings that find ``coded`` targets, one or more of one size, and no others."""
    first = coded[0]
    r = first.dot_radius_m
    return CodedSettings(
        colour=colour,
        numbers=frozenset(one.number for one in coded),
        ring_inner=first.ring_inner_m / r,
        ring_outer=first.ring_outer_m / r,
        plate=first.plate_m / r,
    )


def find_coded(image: Array, camera: str, settings: CodedSettings = DEFAULTS, bit_depth: int = 8) -> CodedDetections:
    """Return the coded targets in an image (H, W) of uint8 or uint16 with ``bit_depth`` significant bits (8 to 16).

    ``camera``: the name that the detections carry. Raises InputError for another image or bit depth.
    """
    _check(image, camera, bit_depth)
    scale = 2.0 ** (bit_depth - 8)
    top = image.dtype.type(2**bit_depth - 1)
    noise = noise_of(image)
    target = _appearance(settings, scale, noise)
    told = settings.read_noise_dn, settings.gain_dn_per_e
    dark_dn2 = None if told[0] is None else (told[0] * scale) ** 2 + ROUNDING_DN2
    gain_dn = None if told[1] is None else told[1] * scale
    found = []
    for dark in {"white": (False,), "black": (True,), "both": (False, True)}[settings.colour]:
        bright = np.ascontiguousarray(top - np.minimum(image, top) if dark else image)
        dots = read_codes(bright, target, settings.maximum_dot_px, settings.least_confidence)
        numbers, rolls = _numbers(dots, settings.numbers)
        known = np.flatnonzero(numbers >= 0)
        known = known[_surest(dots[known], settings.ring_outer)]
        dots, numbers, rolls = dots[known], numbers[known], rolls[known]
        of_pixels = pixel_noise(image, dots.frames, int(top), dark_dn2, gain_dn)
        xy, covariance, frames = measure_dots(bright, dots, target, of_pixels, float(top), dark)
        axes, angle = ellipses_of(frames)
        confidence = np.minimum(dots.rings[:, MARGIN], 1.0)
        sound = np.isfinite(xy[:, 0])  # a dot without a centre is none
        parts = (numbers, xy, covariance, axes, angle, rolls, confidence)
        found.append(tuple(part[sound] for part in parts))
    number, xy, covariance, axes, angle, rolls, confidence = (
        np.concatenate(column) for column in zip(*found, strict=True)
    )
    every, first, times = np.unique(number, return_index=True, return_counts=True)
    once = first[times == 1]
    return CodedDetections(
        camera=camera,
        number=number[once],
        xy_px=xy[once],
        covariance_px2=covariance[once],
        semi_axes_px=axes[once],
        angle_rad=angle[once],
        roll_rad=rolls[once],
        confidence=confidence[once],
        twice=every[times > 1],
    )


def _appearance(settings: CodedSettings, scale: float, noise: float) -> TargetAppearance:
    """Return the targets' appearance in an image of ``scale`` times the grey values of 8 bits."""
    return TargetAppearance(
        gap=0.5 * (1.0 + settings.ring_inner),
        ring_inner=settings.ring_inner,
        ring_outer=settings.ring_outer,
        outside=0.5 * (settings.ring_outer + 0.5 * settings.plate),
        contrast_dn=settings.contrast_dn * scale,
        noise_dn=noise,
        flattest=settings.flattest,
        least_axis_px=0.0,
    )


def _numbers(dots: Readings, allowed: Collection[int] | None) -> tuple[Array, Array]:
    """Return number (n,), -1 for none, and roll (n,) [rad] of what was read."""
    numbers, rolls = np.full(len(dots), -1), np.zeros(len(dots))
    for i, (frame, ring) in enumerate(zip(dots.frames, dots.rings, strict=True)):
        found = _found(int(ring[WORD]))
        if found is None or (allowed is not None and found[0] not in allowed):
            continue
        number, start = found
        t = ring[START] + 2 * math.pi * start / SECTORS
        u, v = math.cos(t), -math.sin(t)
        numbers[i] = number
        rolls[i] = math.atan2(frame[AXY] * u + frame[AYY] * v, frame[AXX] * u + frame[AXY] * v)
    return numbers, rolls


@lru_cache(maxsize=4096)
def _found(word: int) -> tuple[int, int] | None:
    """Return the number read in a word, bit k its k-th sector, and the sector where it starts."""
    return ring_code().find(tuple(bool(word >> k & 1) for k in range(SECTORS)))


def _surest(dots: Readings, ring_outer: float) -> Array:
    """Return which readings remain (m,): only the most certain of those on each other's plates."""
    x, y, xx, xy, yy = (dots.frames[:, k] for k in (X, Y, AXX, AXY, AYY))
    dx, dy = x[:, None] - x, y[:, None] - y
    away = np.hypot(yy * dx - xy * dy, xx * dy - xy * dx) / (xx * yy - xy**2)  # in radii of the second's dot
    order = np.empty(len(dots), dtype=np.int64)
    order[np.argsort(-dots.rings[:, MARGIN], kind="stable")] = np.arange(len(dots))
    return np.flatnonzero(~((away < ring_outer) & (order < order[:, None])).any(axis=1))


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
