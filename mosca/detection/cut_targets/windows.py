"""Windows of images that are fitted anew, and which of their pixels count: compiled."""

import math
from typing import NamedTuple

import numpy as np

from mosca.camera.ray_table import HEIGHT, WIDTH
from mosca.data.arrays import Array
from mosca.data.detections import SATURATED
from mosca.data.rays import AREA_RADIUS, FLAGS
from mosca.detection.cut_targets.kinds import BESIDE, GROWN, WHOLE
from mosca.numba_support.decorators import bare_step, kernel

READY, LEARNING, BLUR_PX, SIZE, SIZE_SIGMA, USUAL_MISFIT, LOG_LIGHT, MOST_LOG_LIGHT, LEARNED = range(9)
"""Columns of what is learned from a camera's whole discs: whether they are enough to fit others, and whether learning
goes on; blur [px], size over the expected one and its relative standard deviation, misfit, logarithm of the amplitude
[DN] and how far that of others may differ from it."""
AT_ONCE = 10
"""Largest number of an image's whole discs that are learned from."""
REACH_BLURS, OTHERS_BLURS, APART_PX = 3.0, 2.0, 2.5
"""Distances beyond the rim, in blurs, up to which a disc's own pixels are taken, and those of others are left out;
and the least distance [px], rim to rim, of others from a whole disc that is learned from."""


class Windows(NamedTuple):
    """Images that are fitted, one a row."""

    kind: Array
    """(n,) kind of each, of ``mosca.detection.cut_targets.kinds``."""
    camera: Array
    """(n,) camera of each."""
    point: Array
    """(n,) point of which each is an image."""
    rays: Array
    """(n, 2) rows of the ray table: the image and the one beside it, or itself again."""
    corner: Array
    """(n, 2) first pixel of the patch about it, x and y."""
    radius: Array
    """(n, 2) expected radii of both targets [px]."""
    share: Array
    """(n,) area of the image over a target's."""


@kernel
def windows_of(
    kinds: Array,
    images: tuple[Array, Array, Array],
    table: tuple[Array, Array, Array],
    learned: Array,
    cameras: Array,
) -> tuple[Windows, int]:
    """Return the windows of all cameras' images, by camera and kind, and the side of their patches [px].

    ``kinds`` (n, c); ``images``: ``Points.rays`` (n, c), areas over a target's and radii expected (n, c); ``table``:
    ``rays``, ``start``, ``xy_px`` of a ``RayTable``; ``learned`` (c, LEARNED); ``cameras``: of the ``RayTable``.
    Windows that reach over the edge of the image are left out.
    """
    (rays_of, share, radius), (rays, start, xy) = images, table
    n, many_cameras = kinds.shape
    most = 2 * n * many_cameras
    found, at, size = np.empty((most, 7), np.int64), np.empty((most, 3)), np.empty(len(rays))
    point = np.empty(len(rays), np.int64)
    many = half = 0
    for c in range(many_cameras):
        if learned[c, READY] == 0.0 and learned[c, LEARNING] == 0.0:
            continue
        own, blur = learned[c], learned[c, BLUR_PX]
        for ray in range(start[c], start[c + 1]):
            point[ray], size[ray] = -1, 0.0
        for i in range(n - 1, -1, -1):
            if rays_of[i, c] >= 0:
                size[start[c] + rays_of[i, c]] = radius[i, c]
            if kinds[i, c] > 0:
                point[start[c] + rays_of[i, c]] = i
        for kind in range(WHOLE, GROWN + 1):
            whole, before = 0, many
            if own[LEARNING if kind == WHOLE else READY] == 0.0:
                continue
            for ray in range(start[c], start[c + 1]):
                i = point[ray]
                if i < 0 or kinds[i, c] != kind:
                    continue
                first = radius[i, c] if kind == WHOLE else radius[i, c] * own[SIZE]
                second, other, x, y, reach = first, ray, xy[ray, 0], xy[ray, 1], first
                if kind == WHOLE:
                    whole += 1
                    if whole > AT_ONCE or not _apart(ray, first, start[c], start[c + 1], rays, xy):
                        continue
                elif kind == BESIDE:
                    other, gap = _nearest(ray, start[c], start[c + 1], rays, xy)
                    if other < 0:
                        continue
                    second = size[other] * own[SIZE] if size[other] > 0.0 else first
                    taken = False
                    for k in range(before, many):
                        taken = taken or found[k, 3] in (ray, other) or found[k, 4] in (ray, other)
                    if taken or not gap < first + second + 2.0 * REACH_BLURS * blur:
                        continue
                    x, y, reach = 0.5 * (x + xy[other, 0]), 0.5 * (y + xy[other, 1]), 0.5 * gap + max(first, second)
                elif kind == GROWN:
                    reach = 2.0 * first
                    half = max(half, math.ceil(1.5 * reach + REACH_BLURS * blur) + 1)  # two expected beside it
                need = math.ceil(reach + REACH_BLURS * blur) + 1
                left, up = round(x), round(y)
                if left < need or up < need or left >= cameras[c, WIDTH] - need or up >= cameras[c, HEIGHT] - need:
                    continue
                half = max(half, need)
                found[many, 0], found[many, 1], found[many, 2], found[many, 3] = kind, c, i, ray
                found[many, 4], found[many, 5], found[many, 6] = other, left, up
                at[many, 0], at[many, 1], at[many, 2] = first, second, share[i, c]
                many += 1
    found, at = found[:many].copy(), at[:many].copy()
    return Windows(
        found[:, 0].copy(), found[:, 1].copy(), found[:, 2].copy(), found[:, 3:5].copy(), found[:, 5:7] - half,
        at[:, :2].copy(), at[:, 2].copy(),
    ), 2 * half + 1  # fmt: skip


@bare_step
def _apart(ray, radius, first, last, rays, xy):
    """Return whether no other detection of the camera is near a disc, rim to rim."""
    for other in range(first, last):
        gap = math.hypot(xy[other, 0] - xy[ray, 0], xy[other, 1] - xy[ray, 1])
        if other != ray and not gap - radius - rays[other, AREA_RADIUS] > APART_PX:
            return False
    return True


@bare_step
def _nearest(ray, first, last, rays, xy):
    """Return the nearest other detection of the camera that is not saturated, -1 for none, and how far it is [px]."""
    best, least = -1, np.inf
    for other in range(first, last):
        if other == ray or int(rays[other, FLAGS]) & SATURATED:
            continue
        gap = math.hypot(xy[other, 0] - xy[ray, 0], xy[other, 1] - xy[ray, 1])
        if gap < least:
            best, least = other, gap
    return best, least


@kernel
def own_pixels(patch: Array, there: Array, place: Array, own: Array, seen: Array, beyond_px: float) -> int:
    """Mark in ``there`` (h, h) the pixels near a place and of no detection but ``own`` (2,); return how many.

    ``patch`` (h, h) is NaN where the image ends. ``place`` (3,): x, y and how far pixels are taken; ``seen`` (m, 3):
    x, y and radius of all detections of the camera. Pixels of the others are left out up to ``beyond_px`` beyond the
    radius, none if it is negative. All are from the patch's first pixel [px].
    """
    side = there.shape[0]
    x, y, reach = place[0], place[1], place[2]
    for i in range(side):
        for j in range(side):
            there[i, j] = (j - x) ** 2 + (i - y) ** 2 <= reach**2 and not math.isnan(patch[i, j])
    for other in range(len(seen)):
        left, up, most = seen[other, 0], seen[other, 1], seen[other, 2] + beyond_px
        if beyond_px < 0.0 or other == own[0] or other == own[1]:
            continue
        if not (-most < left < side + most and -most < up < side + most):
            continue
        for i in range(side):
            for j in range(side):
                if (j - left) ** 2 + (i - up) ** 2 <= most**2:
                    there[i, j] = False
    count = 0
    for i in range(side):
        for j in range(side):
            count += there[i, j]
    return count
