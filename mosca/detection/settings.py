"""Settings of ``mosca.detection.detect``, in the units of users and of kernels."""

import math
from functools import lru_cache

from mosca.data.settings import DetectionSettings as DetectionSettings
from mosca.detection.centroid import Noise
from mosca.detection.search import Search

DEFAULTS = DetectionSettings()


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
        dark_dn2=float((settings.read_noise_dn * scale) ** 2 + 1 / 12), gain_dn=float(settings.gain_dn_per_e * scale)
    )
