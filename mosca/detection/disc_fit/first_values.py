"""Compiled first values of a fit: sums over a region's light, and the disc that they suggest.

Compiled into the kernel in ``mosca.detection.disc_fit.fit_regions``.
"""

import math
from typing import Any, NamedTuple

from mosca.detection.disc_fit.disc_image import FAST, P0, P1, P2, P3, P4, parts_of
from mosca.numba_support.decorators import bare_step

ROUND, ROUND_PX, ROUND_SHARP_PX = 0.04, 1.5, 5.0
"""A region of n pixels whose second moments differ by less than ``ROUND + ROUND_PX / n`` of their mean is taken for
round: sampling and noise cause as much. ``ROUND_SHARP_PX`` takes the place of ``ROUND_PX`` where edges are sharper
than a pixel. Larger values correct fewer ellipses, smaller ones distort round targets."""
TOLD_PX = 3
"""Least side of a region whose shape is estimated from second moments where edges are sharper than a pixel: a disc of
one pixel lights one or two, depending on its position."""
MOST_STRETCHED = 0.85
"""Largest difference of moments that is corrected, as a share of their mean; beyond, pixels are too sparse."""
LEAST_RADIUS = 0.4
"""Least radius that a fit starts from, in blurs."""
NO_STRETCH = (1.0, 0.0, 1.0)
"""The map of a round target."""
CLIPPED_GAIN = 1.5
"""Factor from the peak of a saturated target to the amplitude that its fit starts from."""


class Region(NamedTuple):
    """A region of bright pixels in an image."""

    image: int
    left: int
    """First and last column and row of its bounding box [px]."""
    right: int
    top: int
    bottom: int
    n_px: int
    first_run: int
    """Its first run; the last is that before ``end_run``."""
    end_run: int
    threshold: int
    """Its pixels are above this [DN]."""
    floor: int
    """Pixels that are not above it are background [DN]."""
    slope: tuple[float, float]
    """Slope of the background by x and y [DN/px]."""


class Light(NamedTuple):
    """First sums over a region's light."""

    peak: Any
    """Largest grey value [DN]."""
    background: float
    """First estimate of the background [DN]."""
    x: float
    """Centroid about the middle pixel of the region's box [px]."""
    y: float
    shape: tuple[float, float, float]
    """Symmetric matrix (xx, xy, yy) in which the target is round."""
    pull: float
    """Difference of the principal second moments over their sum."""
    crowded: bool
    """Whether pixels of other regions lie in the window."""
    saturated: bool


@bare_step(fastmath=FAST)
def tail_point(share: float) -> float:
    """Return t at which the normal distribution leaves ``share`` (up to a half) above it.

    Abramowitz and Stegun 26.2.22, right to 0.003.
    """
    q = math.sqrt(-2.0 * math.log(min(max(share, 1e-6), 0.5)))
    return max(q - (2.30753 + 0.27061 * q) / (1.0 + q * (0.99229 + 0.04481 * q)), 0.0)


@bare_step(fastmath=FAST)
def below_edge(t: float) -> float:
    """Return the normal distribution's integral up to t >= 0, by the polynomial of the edge."""
    t = min(t, 3.0)
    u = t * t
    return float(0.5 + t * (P0 + u * (P1 + u * (P2 + u * (P3 + u * P4)))))


@bare_step(fastmath=FAST)
def central_moments(sums_of_light: Any) -> tuple[float, float, float, float, float]:
    """Return centroid and central second moments (xx, xy, yy) from sums (1, x, y, xx, xy, yy) of light."""
    flux = max(float(sums_of_light[0]), 1e-6)
    x, y = sums_of_light[1] / flux, sums_of_light[2] / flux
    xx, xy, yy = sums_of_light[3] / flux, sums_of_light[4] / flux, sums_of_light[5] / flux
    return x, y, xx - x * x, xy - x * y, yy - y * y


@bare_step(fastmath=FAST)
def least_difference(blur: float, n: int) -> float:
    """Return the relative difference of second moments from which a region of n pixels is not taken for round."""
    return ROUND + (ROUND_PX if parts_of(blur) == 1 else ROUND_SHARP_PX) / n


@bare_step(fastmath=FAST)
def stretch(xx: float, xy: float, yy: float, blur: float, n: int) -> tuple[float, float, float]:
    """Return the symmetric matrix (xx, xy, yy) of determinant 1 that makes an elliptic target round.

    It is computed from the target's second moments less those of the blur. Where sampling and noise explain their
    difference it is the unit matrix.
    """
    blur2 = 0.5 * blur * blur
    size = max(0.5 * (xx + yy) - blur2, 0.5 * blur2)
    p, q = 0.5 * (xx - yy) / size, xy / size
    if p * p + q * q < least_difference(blur, n) ** 2:
        return NO_STRETCH
    e = min(math.sqrt(p * p + q * q), MOST_STRETCHED)
    k = e / math.sqrt(p * p + q * q)
    # moments are proportional to [[1 + p, q], [q, 1 - p]]: its inverse root, by Cayley and Hamilton
    a, b, c = 1.0 - k * p, -k * q, 1.0 + k * p
    root = math.sqrt(a * c - b * b)
    a, b, c = a / root, b / root, c / root
    t = math.sqrt(a + c + 2.0)
    return (a + 1.0) / t, b / t, (c + 1.0) / t


@bare_step(fastmath=FAST)
def is_plain(shape: tuple[float, float, float]) -> bool:
    """Return whether a target is taken for round."""
    return shape[1] == 0.0 and shape[0] == shape[2]


@bare_step(fastmath=FAST)
def light_of(
    region: Region, background: float, peak: Any, sums: Any, crowded: bool, blur: float, full_dn: float
) -> Light:
    """Return a region's shape from the sums (1, x, y, xx, xy, yy) of its light above the background."""
    x, y, xx, xy, yy = central_moments(sums)
    pull_x, pull_y = (xx - yy) / (xx + yy), 2.0 * xy / (xx + yy)
    narrow = min(region.right - region.left, region.bottom - region.top) + 1 < TOLD_PX
    shape = NO_STRETCH if narrow and parts_of(blur) > 1 else stretch(xx, xy, yy, blur, region.n_px)
    return Light(
        peak, background, x, y, shape,
        math.sqrt(pull_x * pull_x + pull_y * pull_y), crowded, peak >= full_dn,
    )  # fmt: skip


@bare_step(fastmath=FAST)
def reshaped(light: Light, shape: tuple[float, float, float]) -> Light:
    """Return the same light with another shape."""
    return Light(
        light.peak, light.background, light.x, light.y, shape, light.pull, light.crowded, light.saturated
    )  # fmt: skip


@bare_step(fastmath=FAST)
def turned(
    x: float, y: float, before: tuple[float, float, float], now: tuple[float, float, float]
) -> tuple[float, float]:
    """Return the position in the map ``now`` of the point that is at (x, y) in the map ``before``."""
    det = before[0] * before[2] - before[1] * before[1]
    u, v = (before[2] * x - before[1] * y) / det, (before[0] * y - before[1] * x) / det
    return now[0] * u + now[1] * v, now[1] * u + now[2] * v


@bare_step(fastmath=FAST)
def first_disc(region: Region, light: Light, blur: float) -> tuple[float, float]:
    """Return amplitude and radius to start from, from the region's peak, area and threshold."""
    amplitude = float(light.peak - light.background)
    area_radius = math.sqrt(region.n_px / math.pi)
    radius = area_radius
    for _ in range(2):
        radius = area_radius - blur * tail_point((region.threshold + 0.5 - light.background) / amplitude)
        radius = max(radius, LEAST_RADIUS * blur)
        amplitude = (light.peak - light.background) / below_edge(radius / blur)
    if light.saturated:
        amplitude *= CLIPPED_GAIN
    return amplitude, radius
