"""What is a target and how it is measured: settings of ``mosca.detection.detect`` in the units of people and of
kernels.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

from mosca.detection.centroid import Noise
from mosca.detection.threshold_regions import Search
from mosca.errors import InputError


@dataclass(frozen=True)
class DetectionSettings:
    """What is a target and how it is measured.

    Grey values [DN] are those of an 8-bit image; for an image of more bits they are scaled by
    ``2**(bits - 8)``, so that the same settings serve the same scene.
    """

    contrast_dn: float = 24.0
    """B: a target's largest grey value exceeds its smallest by more than this. Keep it above five times the
    noise at a target's brightest, or its noise is split into targets."""
    step_dn: int = 1
    """s: from one threshold to the next. 1 parts close targets best and costs nothing."""
    lowest_dn: int = 16
    """h_min: all thresholds lie above it. Keep it at least four times the noise above the background."""
    minimum_size_px: float = 1.0
    """D_min: both sides of a target's box are longer than this."""
    maximum_size_px: float = 40.0
    """D_max: both sides of a target's box are shorter than this."""
    centroid: Literal["refined", "background", "paper"] = "refined"
    """Fit of a blurred disc (``mosca.detection.disc_fit.camera_statistics``), centroid above the local background
    over the grown mask, or as printed in the paper."""
    dilation_px: int = 1
    """How far the mask of the "background" centroid reaches beyond the region, 0 to 2. At 0 the centroid is
    drawn to pixel centres by up to 0.04 px; at 2 it gathers noise."""
    split_pairs: bool = False
    """Targets whose images have grown together or nearly touch are fitted together, which takes 0.1 to 0.5 ms a
    pair; else they keep the uncertain places of images that touch. With the refined centroid alone."""
    read_noise_dn: float = 0.13
    """Dark noise, standard deviation of a pixel without light (10 electrons of 20,000 in 255 DN)."""
    gain_dn_per_e: float = 0.0128
    """Grey values per electron (EMVA 1288: system gain K; 20,000 electrons in 255 DN)."""

    def __post_init__(self) -> None:
        if not 0 < self.contrast_dn < 255:
            raise _out_of_range("contrast_dn", self.contrast_dn, "more than 0 and less than 255")
        if not 0 <= self.lowest_dn < math.floor(255 - self.contrast_dn / 2):
            limit = f"0 to below 255 - contrast_dn / 2 = {math.floor(255 - self.contrast_dn / 2)}"
            raise _out_of_range("lowest_dn", self.lowest_dn, limit)
        if not (self.step_dn >= 1 and self.step_dn == int(self.step_dn)):
            raise _out_of_range("step_dn", self.step_dn, "a whole number from 1")
        if not 0 <= self.minimum_size_px < self.maximum_size_px:
            limit = f"0 to below maximum_size_px = {self.maximum_size_px:g}"
            raise _out_of_range("minimum_size_px", self.minimum_size_px, limit)
        if self.centroid not in ("refined", "background", "paper"):
            raise _out_of_range("centroid", self.centroid, "'refined', 'background' or 'paper'")
        if self.dilation_px not in (0, 1, 2):
            raise _out_of_range("dilation_px", self.dilation_px, "0, 1 or 2")
        for key in ("read_noise_dn", "gain_dn_per_e"):
            value = getattr(self, key)
            if not (value >= 0 and math.isfinite(value)):
                raise _out_of_range(key, value, "0 or more")


DEFAULTS = DetectionSettings()


def _out_of_range(key: str, value: object, allowed: str) -> InputError:
    return InputError(f"detection: key '{key}': {value!r} given; {allowed} is allowed")


@lru_cache
def search_of(settings: DetectionSettings, bit_depth: int) -> Search:
    """Return the search in grey values of images of this bit depth."""
    scale = 2 ** (bit_depth - 8)
    return Search(
        highest=math.floor(2**bit_depth - 1 - settings.contrast_dn * scale / 2),
        lowest=math.floor(settings.lowest_dn * scale),
        step=int(settings.step_dn) * scale,
        contrast=float(settings.contrast_dn * scale),
        smallest_px=float(settings.minimum_size_px),
        largest_px=float(settings.maximum_size_px),
    )


@lru_cache
def noise_of(settings: DetectionSettings, bit_depth: int) -> Noise:
    """Return the noise in grey values of images of this bit depth, with that of rounding to whole ones."""
    scale = 2 ** (bit_depth - 8)
    return Noise(
        dark_dn2=float((settings.read_noise_dn * scale) ** 2 + 1 / 12),
        gain_dn=float(settings.gain_dn_per_e * scale),
    )
