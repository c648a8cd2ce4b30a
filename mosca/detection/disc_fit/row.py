"""What the fit of a disc writes to its row of the table of targets: columns, whether it is good, its uncertainty.

Compiled steps of ``mosca.detection.disc_fit.fit_regions``.
"""

import math
from typing import NamedTuple

from mosca.data.arrays import Array
from mosca.data.detections import MERGED, PARTIAL, SATURATED, UNREFINED
from mosca.detection.centroid import DIAMETER, DIAMETER_SIGMA, ELONGATION, PEAK, XX, XY, YY
from mosca.detection.disc_fit.asymmetry import asymmetry
from mosca.detection.disc_fit.disc_image import FAST, part_blur, parts_of
from mosca.detection.disc_fit.first_values import Light, Region
from mosca.detection.disc_fit.gauss_newton import DiscFit, Model, Workspace
from mosca.numba_support.decorators import bare_step

FLAGS, BLUR, BLUR_INFO, MISFIT, ROUGH, PULL, ELLIPTIC_X, ELLIPTIC_Y, ELLIPTIC_SIGMA = range(9, 18)
"""Columns of the table after those of ``mosca.detection.centroid``: flags, the blur that the target's own pixels
give [px] and its information [px^-2], chi-square per degree of freedom, its excess over the noise as a share of the
squared amplitude, the difference of the region's principal moments over their sum, and the ellipticity with its
standard deviation (``mosca.data.detections.Detections``)."""
N_COLUMNS = 18

TOUCHING = 0.03
"""Standard deviation of a centroid biased by a neighbour's light, as a share of the diameter (measured)."""
WORST_FIT = 2.0
"""A fit with a standard deviation above so many times that of such a centroid is replaced by the centroid."""
FITTED_RADII = (1.3, 1.35, 1.4, 1.5, 1.6, 1.8, 2.0, 2.3, 2.7, 3.3, 4.0)
"""Radii over the blur of discs that are fitted with a straight edge."""
BY_EVEN_NOISE = (-0.619, -0.244, -0.025, 0.247, 0.418, 0.627, 0.742, 0.85, 0.917, 0.959, 0.977)
"""What the squares of their true radii are larger by: fits to exact images, all pixels weighted alike
(``tests/mosca/test_disc_diameter.py``)."""
BY_SHOT_NOISE = (0.01, 0.14, 0.241, 0.392, 0.503, 0.654, 0.746, 0.842, 0.908, 0.953, 0.974)
"""The same, pixels weighted by 1 / (light + 2 % of all)."""
STRAY_PX, STRAY_SHARE = 0.3, 0.15
"""A fit that ends farther from its region's light than this [px] plus this share of the region's size is rejected."""
MISFIT_MEAN, MISFIT_SIGMAS = 1.3, 5.0
"""The disc does not fit where chi-square per pixel exceeds the first plus so many of its standard deviations. Where
the ratio of chi-square to the camera's usual one exceeds that limit, the centre's covariance is scaled by the
ratio."""
MISFIT_FACTOR, MISFIT_LEAST = 8.0, 0.01
"""The disc is rejected, and the covariance scaled by all of chi-square, where the excess is also more than so many
times the camera's usual one (at least the first guess), and more than (10 %)^2 of the squared amplitude."""
FIRST_ROUGHNESS = 4e-4
"""Misfit beyond the noise of a camera without statistics, over the squared amplitude: (2 %)^2."""
LONG = 0.2
"""Difference of principal moments over their sum from which a region that no disc fits may be two targets."""


class Centre(NamedTuple):
    """A fitted disc in the image, [px] and [px^2]."""

    x: float
    y: float
    xx: float
    xy: float
    yy: float
    radius: float
    """Radius with the blur."""


@bare_step(fastmath=FAST)
def centre_of(middle: tuple[int, int], light: Light, fit: DiscFit) -> Centre:
    """Return a fitted disc in image coordinates, undoing the map in which it is round."""
    m0, m1, m2 = light.shape
    det = m0 * m2 - m1 * m1
    i0, i1, i2 = m2 / det, -m1 / det, m0 / det
    c = fit.covariance
    u0, u1, w0, w1 = (i0 * c[0] + i1 * c[1], i0 * c[1] + i1 * c[2], i1 * c[0] + i2 * c[1], i1 * c[1] + i2 * c[2])
    return Centre(
        middle[0] + i0 * fit.x + i1 * fit.y, middle[1] + i1 * fit.x + i2 * fit.y,
        u0 * i0 + u1 * i1, u0 * i1 + u1 * i2, w0 * i1 + w1 * i2,
        math.sqrt(fit.radius * fit.radius + fit.blur * fit.blur),
    )  # fmt: skip


@bare_step(fastmath=FAST)
def is_good(region: Region, light: Light, fit: DiscFit, centre: Centre) -> bool:
    """Return whether a fit converged, on its region's light, and is better than that light's centroid."""
    size = max(region.right - region.left + 1, region.bottom - region.top + 1)
    middle = ((region.left + region.right + 1) // 2, (region.top + region.bottom + 1) // 2)
    shift = math.sqrt((centre.x - middle[0] - light.x) ** 2 + (centre.y - middle[1] - light.y) ** 2)
    good = fit.converged and shift < STRAY_PX + STRAY_SHARE * size
    # where most pixels are masked as a neighbour's, the fit may be less certain than the centroid; where pixels are
    # coarse, the centroid is no measure of a place
    c = fit.covariance
    coarse = parts_of(fit.blur) > 1 and not light.crowded
    return good and (coarse or c[0] + c[2] < 2.0 * (WORST_FIT * TOUCHING * fit.radius) ** 2)


@bare_step(fastmath=FAST)
def misfit_by_chance(n: int) -> float:
    """Return the chi-square per pixel up to which chance explains the misfit of a disc to n pixels."""
    return MISFIT_MEAN + MISFIT_SIGMAS * math.sqrt(2.0 / n)


@bare_step(fastmath=FAST)
def write_row(
    region: Region,
    light: Light,
    fit: DiscFit,
    centre: Centre,
    told: tuple[bool, int, float],
    model: Model,
    out: Array,
) -> tuple[bool, float]:
    """Write all but centre and diameter of a fit to its row of the table; return whether it is rejected as odd.

    Also return chi-square per degree of freedom over the camera's usual one, 1 where chance explains it. ``told``:
    whether the fit is good, its number of pixels, and the camera's usual misfit.
    """
    good, n, usual = told
    misfit, contrast_2 = fit.chi2 / max(n - 6, 1), fit.amplitude * fit.amplitude
    variance = model.dark_dn2 + model.gain_dn * fit.amplitude
    rough = max(misfit - 1.0, 0.0) * variance / contrast_2
    out[MISFIT], out[ROUGH], out[PULL] = misfit, rough, light.pull
    out[XX], out[XY], out[YY] = centre.xx, centre.xy, centre.yy
    out[PEAK] = light.peak
    size_x, size_y = region.right - region.left + 1, region.bottom - region.top + 1
    out[ELONGATION] = max(size_x, size_y) / min(size_x, size_y)
    out[FLAGS] = (SATURATED if light.saturated else 0) + (0 if good else UNREFINED + (MERGED if light.crowded else 0))
    out[BLUR_INFO] = out[BLUR] = 0.0
    chance = misfit_by_chance(n)
    least = max(MISFIT_FACTOR * max(usual, FIRST_ROUGHNESS), MISFIT_LEAST)
    odd = good and not light.saturated and misfit > chance and rough > least
    if odd:
        out[FLAGS] += PARTIAL + (MERGED if out[PULL] > LONG else 0)
    # where a side is missing, the misfit that all targets have in common moves the centre, too
    excess = misfit if odd or light.crowded else misfit / (1.0 + usual * contrast_2 / variance)
    return odd, excess if good and excess > chance else 1.0


@bare_step(fastmath=FAST)
def write_diameter(fit: DiscFit, model: Model, out: Array) -> None:
    """Write the diameter of an even disc to a row of the table: with profiles, diameters differ between cameras."""
    blur = part_blur(fit.blur, parts_of(fit.blur))
    dark = model.dark_dn2 / (model.dark_dn2 + model.gain_dn * max(fit.amplitude, 0.0))
    radius, slope = true_radius(fit.radius / blur, dark)
    out[DIAMETER] = 2.0 * blur * radius
    out[DIAMETER_SIGMA] = 2.0 * math.sqrt(fit.radius_variance) * slope


@bare_step(fastmath=FAST)
def true_radius(fitted: float, dark: float) -> tuple[float, float]:
    """Return the radius of a blurred disc from the one ``fitted`` with a straight edge, and its slope by the latter.

    Both radii over the fitted blur. A disc has its blurred edge inside of its radius, and a small one is less bright
    in its middle than the model: the square of the radius exceeds that of the fitted one by ``BY_EVEN_NOISE``, or
    ``BY_SHOT_NOISE``. ``dark``: share of the noise that does not grow with the light.
    """
    at = min(max(fitted, FITTED_RADII[0]), FITTED_RADII[-1])
    k = 0
    while at > FITTED_RADII[k + 1]:
        k += 1
    step = FITTED_RADII[k + 1] - FITTED_RADII[k]
    low = BY_SHOT_NOISE[k] + dark * (BY_EVEN_NOISE[k] - BY_SHOT_NOISE[k])
    high = BY_SHOT_NOISE[k + 1] + dark * (BY_EVEN_NOISE[k + 1] - BY_SHOT_NOISE[k + 1])
    far = max(fitted, at)
    radius = math.sqrt(far * far + low + (high - low) * (at - FITTED_RADII[k]) / step)
    return radius, (far + (0.5 * (high - low) / step if far == at else 0.0)) / radius


@bare_step(fastmath=FAST)
def widen(
    excess: float,
    may_be_even: bool,
    n: int,
    pixels: Array,
    fit: DiscFit,
    model: Model,
    shape: tuple[float, float, float],
    work: Workspace,
    out: Array,
) -> None:
    """Scale the covariance of a target that fits worse than others: hidden in part, or no disc.

    ``may_be_even``: scale it only by the misfit that differs between the sides of the centre; the rest does not move
    it.
    """
    if excess > 1.0 and may_be_even:
        excess = min(excess, asymmetry((n + 7) // 8 * 8, pixels, fit, model, shape, work))
        excess = excess if excess > misfit_by_chance(n // 2) else 1.0
    out[XX], out[XY], out[YY] = excess * out[XX], excess * out[XY], excess * out[YY]
