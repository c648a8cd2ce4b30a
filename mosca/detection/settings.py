"""Settings of ``mosca.detection.detect``, in the units of users and of kernels."""

import math
from functools import lru_cache

from mosca.data.settings import DetectionSettings as DetectionSettings
from mosca.detection.search import Search

DEFAULTS = DetectionSettings()


@lru_cache
def search_of(settings: DetectionSettings, bit_depth: int) -> Search:
    """Return the search in grey values of images of this bit depth."""
    scale = 2 ** (bit_depth - 8)
    contrast, step, lowest = settings.paper_thresholds()
    return Search(
        highest=math.floor(2**bit_depth - 1 - contrast * scale / 2),
        lowest=math.floor(lowest * scale),
        step=int(step) * scale,
        contrast=float(contrast * scale),
        smallest_px=float(settings.minimum_size_px),
        largest_px=float(settings.maximum_size_px),
        level=-1.0,
    )
