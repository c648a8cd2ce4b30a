"""Images drawn on parts of pixels: blurred there, and averaged to pixels, one axis after the other."""

from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter1d


def averaged(parts: np.ndarray, per_pixel: int, blur_px: float, **how: Any) -> np.ndarray:
    """Return the image (H, W) of ``parts`` (H * per_pixel, W * per_pixel), blurred by ``blur_px`` before.

    ``how``: further options of ``scipy.ndimage.gaussian_filter1d``.
    """
    for _ in range(2):  # down, and across
        if blur_px > 0:
            parts = gaussian_filter1d(parts, blur_px * per_pixel, axis=0, **how)
        parts = parts.reshape(-1, per_pixel, parts.shape[1]).mean(axis=1).T
    return parts
