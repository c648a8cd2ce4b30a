"""Compiled sums over the residuals of a fitted disc, from which a camera's gain is learned.

Photon transfer (EMVA 1288, 6.6) with two points of a target's image at opposite sides of its centre in the place of
two images. What the model does not fit of a symmetric image (limbs, defocus, motion, any profile) is the same in
both, and cancels in their difference d. Thus E d^2 = dark + gain s with the signal s. d^2 less the dark variance is
regressed on three terms. They are s; q = (A e')^2, for an error of the edge that is not symmetric; and u = s^2, for
pixels whose responses differ (PRNU) and light from one side. Weights 1 / (2 var^2) are those of a normal variable's
square, with the gain so far. ``mosca.detection.pixel_noise`` solves without u, for the variance that fits use;
``mosca.diagnostics.sensor`` solves with u, for the gain alone.
"""

import math

from mosca.data.arrays import Array
from mosca.detection.disc_fit.asymmetry import NUMBER, Grid, difference, has_opposite, lay_out, less_opposite
from mosca.detection.disc_fit.disc_image import FAST, HALF, ONE, ZERO, cross_sums_divided, f32, sums_divided
from mosca.detection.disc_fit.gauss_newton import DiscFit, DiscPrior, Model, Workspace
from mosca.detection.disc_fit.light_offset import NOISE_SUMS
from mosca.detection.disc_fit.solve_step import factor_all
from mosca.numba_support.decorators import bare_step

GRID, PREDICTED, PART, SLOPES = 9, 10, 11, (0, 0, 3, 4, 1, 2)
"""Rows of a fit's image: one part of the fit's errors on the grid of pixels; the variance of each pixel's difference,
negative where it has none; that part pixel by pixel; and the rows with its slopes by amplitude, -, radius, blur, x
and y."""

CLIP = f32(16.0)
"""Squared differences count up to so many times their expectation, (4 sigma)^2, or times the target's mean where that
is more."""
FEWEST_LIT = 2
"""Least number of a target's differences with more photon noise than dark noise: with fewer, place, size and
brightness follow the lit pixels with their noise."""
BY_CHANCE = f32(3.0)
"""Standard deviations by which a target's mean squared difference may be off by chance."""
LEAST_FREE = f32(0.25)
"""A difference counts where at least this share of its variance is left in the residuals: most lit pixels of a target
of one pixel are fitted exactly. With 0.1, and all targets, 1.2 px gave gains of 0; with 0.5, 2 px gave half of
them."""


@bare_step(fastmath=FAST)
def predict_variances(n: int, amplitude: float, grid: Grid, work: Workspace) -> None:
    """Write the variances of a fit's differences between n pixels and their opposites to row ``PREDICTED``.

    They are computed from the factor of the fit's normal equations.
    """
    image, factor = work.image, work.equations
    total, part, number, on_grid = image[PREDICTED], image[PART], image[NUMBER], image[GRID]
    for i in range(n):
        total[i] = ZERO if has_opposite(int(number[i]), grid, image) else -ONE
    for k in range(6):
        for i in range(n):
            part[i] = ZERO
        # row k of the inverse factor, kept above its diagonal
        for q in range(k + 1):
            rest = 1.0 if q == k else 0.0
            for m in range(q, k):
                rest -= factor[k, m] * (factor[q, m] if m > q else 1.0 / factor[q, q])
            own = rest / factor[k, k]
            if q < k:
                factor[q, k] = own
            c = f32(own * factor[q, 7] * (amplitude if q > 1 else 1.0))
            row = image[SLOPES[q]]
            for i in range(n):
                part[i] += c if q == 1 else c * row[i]
        for i in range(n):
            if number[i] >= ZERO:
                on_grid[int(number[i])] = part[i]
        for i in range(n):
            if total[i] >= ZERO:
                total[i] += less_opposite(int(number[i]), on_grid, grid) ** 2


@bare_step(fastmath=FAST)
def add_residuals(
    n: int,
    pixels: Array,
    fit: DiscFit,
    prior: DiscPrior,
    model: Model,
    shape: tuple[float, float, float],
    work: Workspace,
    tally: Array,
) -> None:
    """Add the residuals of n pixels of a target's fit to its camera's ``tally``; overwrites ``work``.

    ``pixels``, ``shape``: as in ``disc_image``. The fit reduces the variance of the differences by its own.
    """
    grid = lay_out(n, pixels, fit, shape, work)
    if grid.side == 0:
        return
    image, dark, gain = work.image, f32(model.dark_dn2), f32(model.gain_dn)
    at = (f32(fit.x), f32(fit.y), f32(fit.amplitude), f32(fit.background), f32(fit.radius), f32(fit.blur))
    place, h, c, _ = sums_divided(n, pixels, at, dark, gain, image)
    cross = cross_sums_divided(n, pixels, at, dark, gain, image)
    information = 1.0 / (prior.blur_sigma * prior.blur_sigma)
    if not factor_all(place, h, cross, c, (information, 0.0), (0.0, 0.0), work.equations):
        return
    predict_variances(n, fit.amplitude, grid, work)
    steep = f32(fit.amplitude * fit.blur)
    total, count, lit = ZERO, ZERO, 0
    for turn in range(2):
        if turn == 1 and lit < FEWEST_LIT:
            return
        # the mean first: all differences of a target that is not symmetric are large, and count less
        count = max(count, ONE)
        scale = max(total / (count + BY_CHANCE * math.sqrt(f32(2.0) * count)), ONE)
        for i in range(n):
            one = difference(i, grid, image)
            if not one.there:
                continue
            variance = dark * one.dark + gain * one.signal
            free = ONE - image[PREDICTED, i] / variance
            if not free > LEAST_FREE:
                continue
            square = one.value * one.value / free
            if turn == 0:
                total += square / variance
                count += ONE
                lit += gain * one.signal > dark * one.dark
                continue
            g = steep * image[3, i]
            s, q, u = one.signal, g * g, one.signal * one.signal / one.dark
            w = HALF * (free / (scale * variance)) ** 2
            r = min(square, CLIP * scale * variance) - dark * one.dark
            tally[NOISE_SUMS] += w * s * s
            tally[NOISE_SUMS + 1] += w * s * q
            tally[NOISE_SUMS + 2] += w * s * u
            tally[NOISE_SUMS + 3] += w * q * q
            tally[NOISE_SUMS + 4] += w * q * u
            tally[NOISE_SUMS + 5] += w * u * u
            tally[NOISE_SUMS + 6] += w * s * r
            tally[NOISE_SUMS + 7] += w * q * r
            tally[NOISE_SUMS + 8] += w * u * r
            tally[NOISE_SUMS + 9] += ONE
