"""Target detection written for reading, step by step from the Mosca paper, section 3.1.3.

Shares nothing with ``mosca.detection.detect`` and is slow: whole-image binarisation and labelling at each threshold.
"""

import numpy as np
from scipy import ndimage

EIGHT_NEIGHBOURS = np.ones((3, 3), dtype=int)


def target_regions(
    image: np.ndarray,
    largest_value: int,
    contrast: float,
    step: int,
    lowest: int,
    smallest_px: float,
    largest_px: float,
) -> list[frozenset[tuple[int, int]]]:
    """Return the targets as sets of (x, y), those at the image's border included."""
    histogram = np.bincount(image.ravel(), minlength=largest_value + 1)  # step 1
    output = np.zeros(image.shape, dtype=bool)
    h = int(np.floor(largest_value - contrast / 2))  # step 2
    while True:
        while h > 0 and histogram[h] == 0:  # step 3
            h -= 1
        binary = image > h  # step 4
        regions, count = ndimage.label(binary, structure=EIGHT_NEIGHBOURS)  # step 5
        earlier_targets, _ = ndimage.label(output, structure=EIGHT_NEIGHBOURS)
        accepted = np.zeros_like(output)
        for number in range(1, count + 1):
            region = regions == number
            ys, xs = np.nonzero(region)
            size_x = xs.max() - xs.min() + 1
            size_y = ys.max() - ys.min() + 1
            b_max = int(image[region].max())
            b_min = int(image[region].min())
            inside = np.unique(earlier_targets[region])
            n = np.count_nonzero(inside)
            if (  # step 6
                smallest_px < size_x < largest_px
                and smallest_px < size_y < largest_px
                and b_max - b_min > contrast
                and n < 2
            ):
                accepted |= region
        output |= accepted
        h -= step  # step 7
        if not h > lowest:  # step 8
            break
    targets, count = ndimage.label(output, structure=EIGHT_NEIGHBOURS)  # step 9
    return [frozenset((int(x), int(y)) for y, x in np.argwhere(targets == number)) for number in range(1, count + 1)]


def centroid(image: np.ndarray, region: frozenset[tuple[int, int]]) -> tuple[float, float]:
    """Return the centre of mass of a target (step 10)."""
    weights = {(x, y): int(image[y, x]) for x, y in region}
    total = sum(weights.values())
    x_star = sum(x * weight for (x, _), weight in weights.items()) / total
    y_star = sum(y * weight for (_, y), weight in weights.items()) / total
    return x_star, y_star
