"""Compiled sums for a camera's bias: how far the light's centroids lie from the fitted centres.

The model: ``mosca.detection.disc_fit.camera_statistics``. Compiled into the kernel in
``mosca.detection.disc_fit.fit_regions``.
"""

import math
from typing import NamedTuple

import numpy as np

from mosca.data.arrays import Array
from mosca.detection.disc_fit.disc_image import FAST, ONE, f32
from mosca.detection.disc_fit.first_values import Region
from mosca.detection.disc_fit.gauss_newton import DiscFit
from mosca.detection.disc_fit.pixels import V, X, Y, gather
from mosca.numba_support.decorators import bare_step, step

# What an image adds to its camera's statistics: counts and sums, see mosca.detection.disc_fit.camera_statistics.
N_TARGETS, BLUR_SUM, BLUR_WEIGHT, ROUGH_SUM, N_LIGHT, NOISE_SUMS = range(6)
AMPLITUDE_SUMS = 15
RIM_SUMS, N_RIMS = 22, 5
PROFILE_SUMS, N_PROFILE_SUMS = RIM_SUMS + N_RIMS, 19
TRIED_SUM = PROFILE_SUMS + N_PROFILE_SUMS
SMEARED_SUM = TRIED_SUM + 1
LEFT_OUT = SMEARED_SUM + 1
N_TALLIES, N_TERMS = LEFT_OUT + 5, 12
"""From column NOISE_SUMS on: sums of the gain's least squares, ss, sq, su, qq, qu, uu, rs, rq, ru and their number,
see ``mosca.detection.disc_fit.residual_noise``. From column AMPLITUDE_SUMS on, of targets' l = ln amplitude, its
variance v, and f = ln flux, with weights w: w, w f, w f f, w l, w f l, w l l, w v. From column RIM_SUMS on: sums of
chi-square over its mean, for each of the ratios of ``mosca.detection.disc_fit.hidden_background.RIMS``. From column
PROFILE_SUMS on: those of ``mosca.detection.disc_fit.profile``. TRIED_SUM, SMEARED_SUM: how many round targets that
no disc fits were fitted with other shapes, and how many of them as smeared discs. From column LEFT_OUT on: how many
groups of bright pixels were left out, see ``mosca.detection.search.LEFT_OUT_REASONS``."""
N_OFFSET_TERMS = 9
"""Terms of the offset that are added to the fitted centre; those in R are shading."""

LIGHT_BLURS, EDGE_BLURS = 4.5, 3.0
"""Distances beyond the disc's edge, in blurs: up to which a target's whole light is summed, and where its edge
ends."""
RING_PX, FEWEST_IN_RING = 1.2, 8.0
"""Width of the outermost ring of that window, which gives the background and lies beyond the edge, and the fewest
pixels in it."""
HALF_DIAGONAL = 0.71
"""Half the diagonal of a pixel [px]: how far a centre lies from that of its pixel."""
OFFSET_SIGMA_2, FAR_2 = 1e-4, 0.04
"""Variance [px^2] added to that of an offset of the light, and the squared offset from which its weight falls."""


class StatisticsSums(NamedTuple):
    """What n images add to the statistics of their cameras."""

    tallies: Array
    """(n, N_TALLIES) counts and sums."""
    normal: Array
    """(n, N_TERMS, N_TERMS) normal matrices of the offsets."""
    right_side: Array
    """(n, N_TERMS, 2) right sides of the offsets."""


def no_sums(n: int) -> StatisticsSums:
    """Return sums of n images to which nothing was added yet."""
    return StatisticsSums(np.zeros((n, N_TALLIES)), np.zeros((n, N_TERMS, N_TERMS)), np.zeros((n, N_TERMS, 2)))


no_sums_compiled = step(no_sums)
"""``no_sums`` for kernels."""


@bare_step(fastmath=FAST)
def moved(image: Array, x: float, y: float, radius: float, offsets: Array, terms: Array) -> tuple[float, float]:
    """Return a fitted centre plus its camera's offset there and at this size, from its ``offsets`` (N_TERMS, 2)."""
    set_terms(image, x, y, radius, terms)
    for k in range(N_OFFSET_TERMS):
        x += offsets[k, 0] * terms[k]
        y += offsets[k, 1] * terms[k]
    return x, y


@bare_step(fastmath=FAST)
def set_terms(image: Array, x: float, y: float, radius: float, terms: Array) -> None:
    """Write (1, 1 / R, 1 / R^2, R) x (1, u, v) to ``terms``, u and v from the image's middle in half widths."""
    height, width = image.shape
    u, v = 2.0 * x / width - 1.0, (2.0 * y - height) / width
    size = 1.0
    for k in range(4):
        terms[3 * k], terms[3 * k + 1], terms[3 * k + 2] = size, size * u, size * v
        size = 0.25 * radius if k == 2 else size * 2.0 / radius


@bare_step(fastmath=FAST)
def add_light(
    image: Array,
    region: Region,
    most: float,
    fit: DiscFit,
    radius: float,
    pixels: Array,
    terms: Array,
    sums: StatisticsSums,
) -> None:
    """Add how far the centroid of a target's whole light lies from its fit, unless other regions are in the window.

    ``most``: how far from the middle the buffer holds pixels.
    """
    way = math.hypot(fit.profile.smear_x, fit.profile.smear_y)
    reach = min(
        radius + 0.5 * way + max(LIGHT_BLURS * fit.blur, EDGE_BLURS * fit.blur + RING_PX), most - HALF_DIAGONAL
    )
    # the same distance to all sides of the centre: light beyond it would shift the centroid to one of them
    column, row = math.floor(fit.x + 0.5), math.floor(fit.y + 0.5)
    middle = (
        (region.left + region.right + 1) // 2 + int(column), (region.top + region.bottom + 1) // 2 + int(row)
    )  # fmt: skip
    ax, ay, base = f32(fit.x - column), f32(fit.y - row), f32(fit.background)
    n = gather(image, middle, (reach + HALF_DIAGONAL) ** 2, pixels)
    x, y, v = pixels[X], pixels[Y], pixels[V]
    bright, limit, reach2 = 0, f32(region.floor), f32(reach * reach)
    for i in range(n):
        bright += v[i] > limit
    if bright != region.n_px:
        return
    # the background from the outer ring
    inner2 = f32((reach - RING_PX) ** 2)
    ring = n_ring = f32(0)
    for i in range(n):
        far2 = (x[i] - ax) ** 2 + (y[i] - ay) ** 2
        outside = (far2 > inner2) & (far2 <= reach2)
        ring += (v[i] - base) * outside
        n_ring += ONE * outside
    if n_ring < FEWEST_IN_RING:
        return
    base += ring / n_ring
    s = sx = sy = f32(0)
    for i in range(n):
        light = (v[i] - base) * ((x[i] - ax) ** 2 + (y[i] - ay) ** 2 <= reach2)
        s += light
        sx += light * (x[i] - ax)
        sy += light * (y[i] - ay)
    dx, dy = float(sx / s), float(sy / s)
    off2 = dx * dx + dy * dy
    if not off2 < 1.0:
        return
    # about the inverse variance of the difference, with a floor
    variance = fit.covariance
    weight = 1.0 / ((variance[0] + variance[2] + OFFSET_SIGMA_2) * (1.0 + off2 / FAR_2))
    k = region.image
    set_terms(image, middle[0] + ax, middle[1] + ay, radius, terms)
    for i in range(N_TERMS):
        for j in range(N_TERMS):
            sums.normal[k, i, j] += weight * terms[i] * terms[j]
        sums.right_side[k, i, 0] += weight * terms[i] * dx
        sums.right_side[k, i, 1] += weight * terms[i] * dy
    sums.tallies[k, N_LIGHT] += 1.0
