"""Measures of the difference of two images, shared by the checks."""

import numpy as np

from mosca.data.arrays import Array
from witness.render import image_centroid


def centroids_apart(image: Array, other: Array) -> float:
    """Return the distance of two images' centres of light [px]."""
    return float(np.hypot(*(image_centroid(image) - image_centroid(other))))


def pixels_apart(image: Array, wanted: Array) -> float:
    """Return the largest difference of a pixel, over the peak of ``wanted``."""
    return float(np.abs(image - wanted).max() / wanted.max())


def rms(values: Array) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def about(error: float, unit: str) -> str:
    """Return a bound on an error in words: below 3e-07 px."""
    return f"below {error:.0e} {unit}".rstrip().replace("e-0", "e-")
