"""Which images of matched points are of whole targets, cut ones, or two grown together, and their pixels: compiled.

By area: a target's size and distance say how large its image must be.
"""

import numpy as np

from mosca.data.arrays import Array
from mosca.data.detections import MERGED, PARTIAL, SATURATED, UNREFINED
from mosca.data.rays import ANGLE as SUBTENDED
from mosca.data.rays import FLAGS, RADIUS
from mosca.numba_support.decorators import kernel

WHOLE, CUT, GROWN, BESIDE = 1, 2, 3, 4
"""Kinds of images; 0 is none of them. The last are beside another one, and no disc fits them."""
MISSING = 0.07
"""Share of its area that an image lacks from which its target may be hidden in part; whole ones lack less."""
MOST_CUT = 0.4
"""Share of images that are too small from which they are of flat targets at a slant."""
TWO_TARGETS, MOST_OF_TWO = 1.2, 2.6
"""Areas over a target's of images that may be of two grown together."""
ENOUGH_WHOLE = 2
"""Whole images of a point beside which others are not mended: they would tell little more."""
_FLAGS = SATURATED | MERGED | PARTIAL | UNREFINED


@kernel
def kinds_of(
    rays_of: Array, xyz: Array, rays: Array, start: Array, views: Array, typical_m: float
) -> tuple[Array, Array, Array, Array]:
    """Return the kinds (n, c) of the images of n points in c cameras, areas over a target's, and radii expected [px].

    And how many images of each kind each camera has (c, 5).

    ``rays_of`` (n, c): ``Points.rays``; ``xyz`` (n, 3) [m]; ``rays``, ``start``, ``views``: of the ``RayTable``;
    ``typical_m``: diameter of the targets. Radii are those of whole images.
    """
    n, cameras = rays_of.shape
    kinds, share, radius = np.zeros((n, cameras), np.uint8), np.ones((n, cameras)), np.zeros((n, cameras))
    seen = cut = 0
    for i in range(n):
        whole = 0
        for c in range(cameras):
            if rays_of[i, c] < 0:
                continue
            ray, away = rays[start[c] + rays_of[i, c]], 0.0
            for k in range(3):
                away += (xyz[i, k] - views[c, k]) ** 2
            size = ray[SUBTENDED] * np.sqrt(away) / typical_m
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
    count = np.zeros((cameras, BESIDE + 1), np.int64)
    for i in range(n):
        for c in range(cameras):
            count[c, kinds[i, c]] += 1
    return kinds, share, radius, count


@kernel
def own_pixels(
    side: int, corner: Array, rows: Array, place: Array, reach: Array, seen_xy: Array, seen_reach: Array
) -> Array:
    """Return which pixels (n, side, side) of patches are near places (n, 2) and of no detection but ``rows`` (n, k).

    ``corner`` (n, 2): the patches' first pixels; ``reach`` (n,): how far from the place pixels are taken;
    ``seen_xy`` (m, 2), ``seen_reach`` (m,): of all detections, and how far from theirs pixels are left out [px], none
    where that is negative.
    """
    there = np.empty((len(rows), side, side), np.bool_)
    for k in range(len(rows)):
        x, y = place[k, 0] - corner[k, 0], place[k, 1] - corner[k, 1]
        for i in range(side):
            for j in range(side):
                there[k, i, j] = (j - x) ** 2 + (i - y) ** 2 <= reach[k] ** 2
        for other in range(len(seen_xy)):
            most = seen_reach[other]
            left, up = seen_xy[other, 0] - corner[k, 0], seen_xy[other, 1] - corner[k, 1]
            if most < 0.0 or not (-most < left < side + most and -most < up < side + most):
                continue
            if (rows[k] == other).any():
                continue
            for i in range(side):
                for j in range(side):
                    if (j - left) ** 2 + (i - up) ** 2 <= most**2:
                        there[k, i, j] = False
    return there
