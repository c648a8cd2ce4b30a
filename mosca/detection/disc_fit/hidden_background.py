"""Compiled fit of a disc before a textured background, which was subtracted though the disc hides it.

Where a disc covers the share e of a pixel, the background g behind it shows with the share 1 - e. Subtracting g takes
away g e too much, which leaves a negative of the texture in the disc's image. This is added again with the coverage
of the fit so far, at first that of the region, until the fit no longer changes. The texture counts from its mean over
the window: the disc's amplitude is above the background around it.
"""

import math
from typing import Any

from mosca.data.arrays import Array
from mosca.detection.disc_fit.disc_image import FAST, ONE, ZERO, disc_image, even_as, f32
from mosca.detection.disc_fit.gauss_newton import LEAST_BLUR, DiscFit, DiscPrior, Model, Workspace, fit_disc
from mosca.detection.disc_fit.light_offset import N_RIMS, RIM_SUMS
from mosca.numba_support.decorators import bare_step

RIMS = (0.96, 1.0, 1.04, 1.08, 1.12)
"""Ratios that are tried of the radius within which a target hides its background to that of its light: a
retroreflective ball is dark towards its limb (1.1 from 65 degrees of entrance angle on). The least is there to find a
minimum at 1. With steps of 0.06 the ratio came out at 1.06 where 1.085 is true, and places erred by 1.4 times as
much."""
RIM_SIGMAS = 3.0
"""Standard deviations from which a ratio differs from 1."""
EVEN_SHARE = 0.05
"""A background whose variance behind a disc is less than this share of the pixels' dark noise is even."""
MOST_FITS, CLOSE_2 = 10, 0.01
"""Most fits, and the squared change of the centre, as a share of its variance, that ends them. The share of the error
that each fit leaves is about the ratio of texture and amplitude."""


@bare_step(fastmath=FAST)
def take_behind(
    n: int,
    pixels: Array,
    behind: Array,
    middle: tuple[int, int],
    slope: tuple[float, float],
    shape: tuple[float, float, float],
    threshold: int,
    dark_dn2: float,
    out: Array,
) -> None:
    """Write to ``out`` what was subtracted at n pixels, their grey values without its rounding, and its error.

    Also add it, less its mean, to the grey values of the region's pixels, and lower the others' weights by its error.

    Parameters
    ----------
    n, pixels, shape
        The pixels (5, n or more) of a fit and the symmetric matrix by which their offsets were mapped.
    behind
        (2, H, W) what was subtracted from the image, after rounding it, and its error [DN].
    middle
        Pixel (column, row) of the image at the offset (0, 0).
    slope
        Slope of the background there by x and y [DN/px], which ``level_pixels`` took out.
    threshold
        The region's pixels are above it [DN].
    dark_dn2
        Variance of a pixel [DN^2].
    out
        (4, n or more) float32. The last two: whether there is a pixel, and the error's variance over ``dark_dn2``.
    """
    x, y, there, v, present = pixels[0], pixels[1], pixels[3], pixels[4], out[2]
    m0, m1, m2 = shape
    det = m0 * m2 - m1 * m1
    mean = ZERO
    for i in range((n + 7) // 8 * 8):  # with their padding
        out[0, i], out[1, i], out[3, i] = ZERO, v[i], ZERO
        present[i] = there[i] = ONE if i < n else ZERO
        if i < n:
            column, row = round((m2 * x[i] - m1 * y[i]) / det), round((m0 * y[i] - m1 * x[i]) / det)
            texture = behind[0, middle[1] + int(row), middle[0] + int(column)]
            error = behind[1, middle[1] + int(row), middle[0] + int(column)]
            out[3, i] = error * error / f32(dark_dn2)
            out[0, i] = texture + f32(slope[0] * column + slope[1] * row)
            out[1, i] += f32(math.floor(texture + f32(0.5))) - texture
            mean += out[0, i]
    mean /= f32(n)
    for i in range(n):
        if v[i] > threshold:
            v[i] += out[0, i] - mean
        else:
            there[i] = ONE / (ONE + out[3, i])


@bare_step(fastmath=FAST)
def hiding_blur(fit: DiscFit, rim: float) -> Any:
    """Return the blur [px] of the edge within which a target hides its background, which no limb makes softer.

    The light falls off evenly about its radius, to both sides by the width that is hidden beyond it. This adds a
    third of the square of the width to the variance; the rest of the fitted blur is that of lens and pixel.
    """
    falls_off = (rim - 1.0) * fit.radius
    return f32(math.sqrt(max(fit.blur * fit.blur - falls_off * falls_off / 3.0, LEAST_BLUR * LEAST_BLUR)))


@bare_step(fastmath=FAST)
def uncover(
    n: int, pixels: Array, behind: Array, shape: tuple[float, float, float], fit: DiscFit, rim: float, work: Workspace
) -> None:
    """Write grey values less the background g in the share that a disc leaves, less its mean where the light is.

    ``rim``: see ``RIMS``; the others as in ``refit_before``.
    """
    there, v, coverage, present = pixels[3], pixels[4], work.image[0], behind[2]
    count = mean = ZERO
    for i in range(n):
        count += present[i]
        mean += behind[0, i]
    mean /= count
    x, y, radius, blur, level = f32(fit.x), f32(fit.y), f32(fit.radius), f32(fit.blur), f32(fit.background)
    even = even_as(fit.profile)
    if rim == 1.0:
        disc_image(n, pixels, (x, y, radius, blur), even, shape, work.image)
        for i in range(n):
            v[i] = behind[1, i] + coverage[i] * present[i] * (behind[0, i] - mean)
            there[i] = present[i] / (ONE + behind[3, i] * (ONE - coverage[i]) * (ONE - coverage[i]))
        return
    disc_image(n, pixels, (x, y, f32(rim) * radius, hiding_blur(fit, rim)), even, shape, work.image)
    for i in range(n):
        v[i] = behind[1, i] + coverage[i] * present[i] * (level + behind[0, i])
        there[i] = present[i] / (ONE + behind[3, i] * (ONE - coverage[i]) * (ONE - coverage[i]))
    disc_image(n, pixels, (x, y, radius, blur), even, shape, work.image)
    for i in range(n):
        v[i] -= coverage[i] * present[i] * (level + mean)


@bare_step(fastmath=FAST)
def is_even(n: int, behind: Array, dark_dn2: float) -> bool:
    """Return whether the variance of what was subtracted at n pixels is below ``EVEN_SHARE`` of their dark noise."""
    count = mean = square = ZERO
    for i in range(n):
        count += behind[2, i]
        mean += behind[0, i]
        square += behind[0, i] * behind[0, i]
    result: bool = float(square - mean * mean / count) < EVEN_SHARE * dark_dn2 * float(count)
    return result


@bare_step(fastmath=FAST)
def is_known(n: int, behind: Array, dark_dn2: float) -> bool:
    """Return whether something was subtracted at n pixels, with less error than their dark noise."""
    error = count = ZERO
    for i in range(n):
        error += behind[2, i] * behind[3, i]
        count += behind[2, i]
    result: bool = float(error) < float(count) and not is_even(n, behind, dark_dn2)
    return result


@bare_step(fastmath=FAST)
def refit_before(
    n: int,
    pixels: Array,
    behind: Array,
    shape: tuple[float, float, float],
    fit: DiscFit,
    prior: DiscPrior,
    model: Model,
    symmetric: bool,
    work: Workspace,
) -> DiscFit:
    """Fit a disc to n pixels again, with ``behind`` subtracted only where the disc does not hide it.

    ``behind`` (4, n or more): from ``take_behind``; the others as in ``fit_disc``. An even background leaves the fit
    as it is.
    """
    if is_even(n, behind, model.dark_dn2):
        return fit
    for _ in range(MOST_FITS):
        uncover(n, pixels, behind, shape, fit, prior.rim, work)
        x, y, covariance = fit.x, fit.y, fit.covariance
        start = (x, y, fit.amplitude, fit.background, fit.radius)
        fit = fit_disc(n, pixels, start, prior, model, symmetric, shape, work)
        dx, dy = fit.x - x, fit.y - y
        if not fit.converged or dx * dx + dy * dy < CLOSE_2 * (covariance[0] + covariance[2]):
            break
    return fit


@bare_step(fastmath=FAST)
def compare_rims(
    n: int,
    pixels: Array,
    behind: Array,
    shape: tuple[float, float, float],
    fit: DiscFit,
    prior: DiscPrior,
    model: Model,
    work: Workspace,
    tally: Array,
) -> None:
    """Add to ``tally`` the chi-squares of fits with each of the ``RIMS`` over their mean a pixel, where all converge.

    The division by the mean makes each pixel count alike, however well a disc fits. The pixels are left as they were.
    """
    each, good, mean = (0.0, 0.0, 0.0, 0.0, 0.0), True, 0.0
    for rim in RIMS:
        tried = DiscPrior(prior.blur, prior.blur_sigma, prior.amplitude, prior.amplitude_sigma, rim, prior.profile)
        other = refit_before(n, pixels, behind, shape, fit, tried, model, True, work)
        good &= other.converged and other.chi2 > 0.0
        each = (each[1], each[2], each[3], each[4], other.chi2)
        mean += other.chi2 / (N_RIMS * n)
    uncover(n, pixels, behind, shape, fit, prior.rim, work)
    for q in range(N_RIMS):
        tally[RIM_SUMS + q] += each[q] / mean if good else 0.0
