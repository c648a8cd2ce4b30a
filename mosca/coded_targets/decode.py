"""From an image to the words of coded rings, on the image itself and on reduced copies of it.

A part of ``mosca.coded_targets.detect``, which describes the method.
"""

from collections.abc import Iterator
from dataclasses import dataclass, fields

import cv2
import numpy as np

from mosca.coded_targets.blobs import NEIGHBOURHOOD_PX, bright_patches
from mosca.coded_targets.dots import AXX, AXY, AYY, CONTRAST_DN, GX, GY, TargetAppearance, X, Y, find_dots, light_at
from mosca.coded_targets.ring_sampling import MARGIN, Ring, read_rings
from mosca.data.arrays import Array, looked_at

LARGEST_DOT_PX = 13.0
"""Diameter of the largest dot that is always one patch; larger ones are found on reduced images."""
SMALLEST_REDUCED_PX = 6.0
"""Diameter of the smallest dot that is searched for on reduced images; smaller ones have been found before."""
PERSPECTIVES = (0.03, -0.03, 0.06, -0.06)
"""Perspectives tried after 0: relative change of depth over a radius of the dot."""
LEANING = 0.9
"""Ratio of axes below which a dot leans enough to have perspective."""
BAND_SPREAD = 0.22
"""Spacing of the radii at which a ring is sampled, as a share of the ring's width."""
SURE = 0.4
"""Margin from which no other perspective is tried."""


@dataclass(frozen=True, eq=False)
class Readings:
    """Readings of dots."""

    frames: Array
    """(n, FRAME) see ``mosca.coded_targets.dots``."""
    levels: Array
    """(n, LEVELS) likewise."""
    rings: Array
    """(n, 3) see ``mosca.coded_targets.ring_sampling.read_rings``."""

    def __getitem__(self, rows: Array) -> "Readings":
        return Readings(self.frames[rows], self.levels[rows], self.rings[rows])

    def __len__(self) -> int:
        return len(self.frames)

    @classmethod
    def joined(cls, parts: "list[Readings]") -> "Readings":
        """Return all readings of ``parts``, at least one, in their order."""
        return cls(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(cls)))


def read_codes(image: Array, target: TargetAppearance, maximum_dot_px: float, least_margin: float) -> Readings:
    """Return the readings of white dots in an image (H, W), in its pixels; some dots are read twice."""
    ring = Ring(0.5 * (target.ring_inner + target.ring_outer), least_margin)
    parts: list[Readings] = []
    for smaller, factor in _reductions(image, maximum_dot_px):
        least = 0.0 if factor == 1 else SMALLEST_REDUCED_PX / 2
        own = target._replace(noise_dn=target.noise_dn / factor, least_axis_px=least)
        frames = find_dots(smaller, bright_patches(smaller, own.contrast_dn, own.noise_dn), own)
        places = frames[:, [X, Y]] * factor + (factor - 1) / 2
        fresh = ~np.any([_within(places, part) for part in parts], axis=0) if parts else np.full(len(frames), True)
        found = _read(smaller, frames[fresh], own, ring)
        found.frames[:, [X, Y]] = found.frames[:, [X, Y]] * factor + (factor - 1) / 2
        found.frames[:, [AXX, AXY, AYY]] *= factor
        parts.append(found)
    return Readings.joined(parts)


def band_radii(target: TargetAppearance) -> Array:
    """Return the radii (BANDS,) at which a ring is sampled."""
    middle, width = 0.5 * (target.ring_inner + target.ring_outer), target.ring_outer - target.ring_inner
    return np.array([middle - BAND_SPREAD * width, middle, middle + BAND_SPREAD * width])


def ellipses_of(frames: Array) -> tuple[Array, Array]:
    """Return the dots' semi-axes (n, 2), the longer first, and the angle (n,) of the longer one [rad]."""
    xx, xy, yy = (frames[:, k] for k in (AXX, AXY, AYY))
    middle, spread = 0.5 * (xx + yy), np.hypot(0.5 * (xx - yy), xy)
    return np.stack([middle + spread, middle - spread], axis=1), 0.5 * np.arctan2(2 * xy, xx - yy)


def _within(places: Array, read: Readings) -> Array:
    """Return which positions (n, 2) [px] lie within a dot that was read with certainty."""
    sure = read[np.flatnonzero(read.rings[:, MARGIN] >= SURE)].frames
    reach = np.minimum(sure[:, AXX], sure[:, AYY]) / 2
    away = np.hypot(places[:, :1] - sure[:, X], places[:, 1:] - sure[:, Y])
    return np.asarray((away < reach).any(axis=1))


def _read(image: Array, frames: Array, target: TargetAppearance, ring: Ring) -> Readings:
    """Return the most certain reading of each dot that has one; tilted dots are tried with perspective too."""
    first = _tried(image, frames, target, ring)
    axes, angle = ellipses_of(frames)
    unsure = np.flatnonzero((first.rings[:, MARGIN] < SURE) & (axes[:, 1] < LEANING * axes[:, 0]))
    if not len(unsure):
        return first[first.rings[:, MARGIN] > 0]
    tries = [first[unsure]]
    for g in PERSPECTIVES:
        bent = frames[unsure]
        # the plate leans about the longer axis: along the shorter one its distance changes
        bent[:, GX], bent[:, GY] = -g * np.sin(angle[unsure]), g * np.cos(angle[unsure])
        tries.append(_tried(image, bent, target, ring))
    best = np.argmax([one.rings[:, MARGIN] for one in tries], axis=0)
    for k, one in enumerate(tries):
        rows = np.flatnonzero(best == k)
        for f in fields(Readings):
            getattr(first, f.name)[unsure[rows]] = getattr(one, f.name)[rows]
    return first[first.rings[:, MARGIN] > 0]


def _tried(image: Array, frames: Array, target: TargetAppearance, ring: Ring) -> Readings:
    """Return what is read in frames (n, FRAME), the margin -1 where nothing is."""
    light, levels = light_at(image, frames, target, band_radii(target))
    rings = np.full((len(frames), 3), -1.0)
    plates = np.flatnonzero(levels[:, CONTRAST_DN] > 0)
    rings[plates] = read_rings(light[plates], frames[plates], ring)
    return Readings(frames, levels, rings)


def _reductions(image: Array, maximum_dot_px: float) -> Iterator[tuple[Array, int]]:
    """Yield the image and copies reduced by 2, 4, ...: as many as the largest dot takes."""
    factor = 1
    yield looked_at(image), factor
    while maximum_dot_px > LARGEST_DOT_PX * factor and min(image.shape) >= 4 * NEIGHBOURHOOD_PX:
        factor *= 2
        height, width = image.shape[0] // 2, image.shape[1] // 2
        image = cv2.resize(image[: 2 * height, : 2 * width], (width, height), interpolation=cv2.INTER_AREA)
        yield looked_at(image), factor
