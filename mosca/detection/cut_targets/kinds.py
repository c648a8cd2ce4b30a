"""Which images of matched points are of whole targets, cut ones, or two grown together: compiled.

They are classified by area: the area of an image follows from its target's size and distance.
"""

import numpy as np

from mosca.data.arrays import Array
from mosca.data.detections import MERGED, PARTIAL, SATURATED, UNREFINED
from mosca.data.rays import ANGLE as SUBTENDED
from mosca.data.rays import FLAGS, RADIUS
from mosca.numba_support.decorators import kernel

WHOLE, CUT, BESIDE, GROWN = 1, 2, 3, 4
"""Kinds of images; 0 is none of them. Images of the third kind are beside another one, and no disc fits them."""
MISSING = 0.07
"""Missing share of an image's area from which its target may be hidden in part; whole ones lack less."""
MOST_CUT = 0.4
"""Share of images that are too small above which these are taken for images of flat targets at a slant."""
TWO_TARGETS, MOST_OF_TWO = 1.2, 2.6
"""Least and largest area, over that of one target, of images that may be of two grown together."""
ENOUGH_WHOLE = 2
"""Number of whole images of a point from which its other images are not mended: they would add little."""
_FLAGS = SATURATED | MERGED | PARTIAL | UNREFINED


@kernel
def kinds_of(
    rays_of: Array, xyz: Array, rays: Array, start: Array, views: Array, typical_m: float
) -> tuple[Array, Array, Array, Array]:
    """Return the kinds (n, c) of the images of n points in c cameras, areas over a target's, and radii expected [px].

    Also return the distances of the points from the cameras (n, c) [m], where they have an image.

    ``rays_of`` (n, c): ``Points.rays``; ``xyz`` (n, 3) [m]; ``rays``, ``start``, ``views``: of the ``RayTable``;
    ``typical_m``: diameter of the targets. Radii are those of whole images.
    """
    n, cameras = rays_of.shape
    kinds, share = np.zeros((n, cameras), np.uint8), np.ones((n, cameras))
    radius, distance = np.zeros((n, cameras)), np.zeros((n, cameras))
    seen = cut = 0
    for i in range(n):
        whole = 0
        for c in range(cameras):
            if rays_of[i, c] < 0:
                continue
            ray, away = rays[start[c] + rays_of[i, c]], 0.0
            for k in range(3):
                away += (xyz[i, k] - views[c, k]) ** 2
            distance[i, c] = np.sqrt(away)
            size = ray[SUBTENDED] * distance[i, c] / typical_m
            share[i, c], radius[i, c] = size * size, ray[RADIUS] / size
            flags, missing = int(ray[FLAGS]) & _FLAGS, 1.0 - share[i, c]
            merged = flags & (MERGED | UNREFINED | SATURATED)
            seen += 1
            if flags == 0 and abs(missing) < MISSING:
                kinds[i, c] = WHOLE
                whole += 1
            elif (
                flags & SATURATED == 0
                and share[i, c] < MOST_OF_TWO
                and (share[i, c] > TWO_TARGETS or merged == MERGED)
            ):
                kinds[i, c] = GROWN
            elif merged == MERGED | UNREFINED:
                kinds[i, c] = BESIDE
            elif flags & (MERGED | SATURATED) == 0 and (missing > MISSING or flags & (PARTIAL | UNREFINED) > 0):
                kinds[i, c] = CUT
                cut += 1
        for c in range(cameras):
            if whole >= ENOUGH_WHOLE and kinds[i, c] != WHOLE:
                kinds[i, c] = 0
    if cut > MOST_CUT * seen:
        every = kinds.ravel()
        every[every == CUT] = 0
    return kinds, share, radius, distance
