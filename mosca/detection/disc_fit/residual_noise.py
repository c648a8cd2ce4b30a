"""Compiled sums over the residuals of a fitted disc, from which a camera's gain is learned.

Photon transfer (EMVA 1288, 6.6) with the fit in the place of the mean image: squared residuals d^2 less the dark
variance are regressed on the signal s = A e and on q = (A e')^2, what an error of the edge adds. Weights
1 / (2 var^2) are those of a normal variable's square, with the variance scaled by the fit's chi-square, since the
gain is a guess at first. Solved by ``mosca.detection.pixel_noise``.
"""

from mosca.data.arrays import Array
from mosca.detection.disc_fit.disc_image import (
    FAST,
    HALF,
    ONE,
    ZERO,
    cross_sums_divided,
    disc_image,
    f32,
    sums_divided,
)
from mosca.detection.disc_fit.gauss_newton import DiscFit, DiscPrior, Model, Workspace
from mosca.detection.disc_fit.light_offset import NOISE_SUMS
from mosca.detection.disc_fit.solve_step import factor_all
from mosca.numba_support.decorators import bare_step

CLIP = f32(16.0)
"""Squared residuals count up to so many times their expected variance: (4 sigma)^2."""


PREDICTED, SLOPES = 5, (0, 0, 3, 4, 1, 2)
"""Rows of a fit's image: for the variances of its values; with its slopes by amplitude, -, radius, blur, x and y."""
LEAST_FREE = f32(0.1)
"""A pixel counts where at least this share of its variance is left in its residual."""


@bare_step(fastmath=FAST)
def predict_variances(n: int, amplitude: float, work: Workspace) -> None:
    """Write the variances of a fit's values at n pixels to row ``PREDICTED`` of the image, from its factor."""
    image, factor = work.image, work.equations
    total, z = image[PREDICTED], image[PREDICTED + 1]
    for i in range(n):
        total[i] = ZERO
    for k in range(6):
        for i in range(n):
            z[i] = ZERO
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
            if q == 1:
                for i in range(n):
                    z[i] += c
            else:
                for i in range(n):
                    z[i] += c * row[i]
        for i in range(n):
            total[i] += z[i] * z[i]


@bare_step(fastmath=FAST)
def add_residuals(
    n: int,
    pixels: Array,
    fit: DiscFit,
    prior: DiscPrior,
    model: Model,
    shape: tuple[float, float, float],
    misfit: float,
    work: Workspace,
    tally: Array,
) -> None:
    """Add the residuals of n pixels of a target's fit to its camera's ``tally``; overwrites ``work``.

    ``pixels``, ``shape``: as in ``disc_image``. The fit takes its own variance from that of a residual.
    """
    image, there, v = work.image, pixels[3], pixels[4]
    dark, gain = f32(model.dark_dn2), f32(model.gain_dn)
    a, b = f32(fit.amplitude), f32(fit.background)
    at = (f32(fit.x), f32(fit.y), a, b, f32(fit.radius), f32(fit.blur))
    disc_image(n, pixels, (at[0], at[1], at[4], at[5]), shape, image)
    place, h, c, _ = sums_divided(n, pixels, at, dark, gain, image)
    cross = cross_sums_divided(n, pixels, at, dark, gain, image)
    information = 1.0 / (prior.blur_sigma * prior.blur_sigma)
    if not factor_all(place, h, cross, c, (information, 0.0), (0.0, 0.0), work.equations):
        return
    predict_variances(n, fit.amplitude, work)
    share, by_radius, predicted = image[0], image[3], image[PREDICTED]
    steep, scale = a * f32(fit.blur), f32(max(misfit, 1.0))
    ss = sq = qq = rs = rq = count = ZERO
    for i in range(n):
        s, g = a * share[i], steep * by_radius[i]
        q = g * g
        d = v[i] - b - s
        variance = dark + gain * s
        free = max(ONE - predicted[i] / variance, LEAST_FREE)
        counts = there[i] if free > LEAST_FREE else ZERO
        variance *= scale
        w = counts * HALF * free * free / (variance * variance)
        r = min(d * d / free, CLIP * variance) - dark
        ss += w * s * s
        sq += w * s * q
        qq += w * q * q
        rs += w * s * r
        rq += w * q * r
        count += counts
    tally[NOISE_SUMS] += ss
    tally[NOISE_SUMS + 1] += sq
    tally[NOISE_SUMS + 2] += qq
    tally[NOISE_SUMS + 3] += rs
    tally[NOISE_SUMS + 4] += rq
    tally[NOISE_SUMS + 5] += count
