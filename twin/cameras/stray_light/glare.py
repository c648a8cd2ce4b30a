"""Veiling glare: a share of all light on the image, which the lens scatters over it as a wide haze."""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

from mosca.data.arrays import Array
from mosca.errors import InputError

PART_PX = 8
"""Approximate edge of the parts of the image on which the haze, which is far wider, is computed [px]."""


@dataclass(frozen=True)
class Glare:
    """Veiling glare of a lens (ISO 9358)."""

    share: float = 0.0
    """Share of the light on the image that returns as haze; 0.005 to 0.05 for real lenses."""
    sigma: float = 0.125
    """Standard deviation of the haze's Gaussian, over the image's width."""

    def __post_init__(self) -> None:
        if not 0.0 <= self.share < 1.0 or not 0.0 < self.sigma < np.inf:
            raise InputError(
                f"glare: share = {self.share}, sigma = {self.sigma} given; a share from 0 to below 1 and a width "
                "above 0 are wanted"
            )


def veil(light: Array, glare: Glare) -> Array:
    """Return the haze (h, w) float32 [electrons a pixel] of ``light`` (H, W) float32.

    Values are at the centres of h x w equal parts of the image, as ``Ambient.with_extra`` takes them. Haze beyond the
    image is reflected at the borders, so that none is lost: the mean of the haze is share x the mean of the light.
    """
    height, width = light.shape
    rows, columns = -(-height // PART_PX), -(-width // PART_PX)
    parts = cv2.resize(light, (columns, rows), interpolation=cv2.INTER_AREA).astype(np.float64)
    sigma_px = glare.sigma * width
    haze = gaussian_filter(parts, (sigma_px * rows / height, sigma_px * columns / width), mode="reflect")
    return np.asarray(haze * glare.share, dtype=np.float32)
