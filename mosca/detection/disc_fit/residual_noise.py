"""Compiled sums over the residuals of a fitted disc, from which a camera's gain is learned.

Photon transfer (EMVA 1288, 6.6) with two pixels at one distance from a target's centre in the place of two images:
what the model leaves of a round image (limbs, defocus, any radial profile) is the same in both, and is not in their
difference d, so that E d^2 / 2 = dark + gain s, with the signal s = A e. That less the dark variance is regressed on
s and on q = (A e')^2, what an error of the edge adds that is not round. Weights 1 / (2 var^2) are those of a normal
variable's square, with the gain so far. Solved by ``mosca.detection.pixel_noise``.
"""

import math

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
"""Squared differences count up to so many times their expectation, (4 sigma)^2, or the target's mean where more."""


PREDICTED, PARTNER, SLOPES = 5, 7, (0, 0, 3, 4, 1, 2)
"""Rows of a fit's image: for the variances of its values' differences; for the other pixel of each pair; with its
slopes by amplitude, -, radius, blur, x and y."""
PIXELS_A_RING = 4.0
"""Pixels are paired within rings about the centre that hold so many on average. With 2, 4 and 8 the gain learned of
Lambert balls of 5 to 30 px and of discs 5 px out of focus is 0.86 to 0.99, 0.87 to 1.04 and 0.91 to 1.22 of the true
one."""
LEAST_FREE = f32(0.1)
"""A pair counts where at least this share of its variance is left in its residuals' difference."""


@bare_step(fastmath=FAST)
def pair_pixels(n: int, pixels: Array, fit: DiscFit, work: Workspace) -> None:
    """Write to row ``PARTNER`` of the image the number of the pixel with which each of n makes a pair, or -1.

    That is the one before it in its ring about the fitted centre, if it has no partner yet.
    """
    x, y, there = pixels[0], pixels[1], pixels[3]
    partner, waiting = work.image[PARTNER], work.image[PREDICTED]
    farthest, count = 0.0, 0
    for i in range(n):
        partner[i], waiting[i] = -ONE, -ONE
        farthest = max(farthest, there[i] * ((x[i] - fit.x) ** 2 + (y[i] - fit.y) ** 2))
        count += there[i] > ZERO
    rings = max(int(count / PIXELS_A_RING), 1)
    per_px = (rings - 0.01) / math.sqrt(max(farthest, 1.0))
    for i in range(n):
        if there[i] == ZERO:
            continue
        ring = int(math.sqrt((x[i] - fit.x) ** 2 + (y[i] - fit.y) ** 2) * per_px)
        if waiting[ring] >= ZERO:
            partner[i], waiting[ring] = waiting[ring], -ONE
        else:
            waiting[ring] = f32(i)


@bare_step(fastmath=FAST)
def predict_variances(n: int, amplitude: float, work: Workspace) -> None:
    """Write the variances of a fit's difference between n pixels and their partners to row ``PREDICTED``.

    From the fit's factor. Pixels without a partner get any value.
    """
    image, factor = work.image, work.equations
    total, z, partner = image[PREDICTED], image[PREDICTED + 1], image[PARTNER]
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
            difference = z[i] - z[max(int(partner[i]), 0)]
            total[i] += difference * difference


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

    ``pixels``, ``shape``: as in ``disc_image``. The fit takes its own variance from that of the residuals.
    """
    image, v = work.image, pixels[4]
    dark, gain = f32(model.dark_dn2), f32(model.gain_dn)
    a = f32(fit.amplitude)
    at = (f32(fit.x), f32(fit.y), a, f32(fit.background), f32(fit.radius), f32(fit.blur))
    disc_image(n, pixels, (at[0], at[1], at[4], at[5]), shape, image)
    place, h, c, _ = sums_divided(n, pixels, at, dark, gain, image)
    cross = cross_sums_divided(n, pixels, at, dark, gain, image)
    information = 1.0 / (prior.blur_sigma * prior.blur_sigma)
    if not factor_all(place, h, cross, c, (information, 0.0), (0.0, 0.0), work.equations):
        return
    pair_pixels(n, pixels, fit, work)
    predict_variances(n, fit.amplitude, work)
    share, by_radius, predicted, partner = image[0], image[3], image[PREDICTED], image[PARTNER]
    # squared differences less the fit's own part, over two, and their expectation with the gain so far
    squares, expected, signal = image[1], image[2], image[4]
    total = count = ZERO
    for i in range(n):
        squares[i] = -ONE
        if partner[i] < ZERO:
            continue
        j = int(partner[i])
        d = v[i] - v[j] - a * (share[i] - share[j])
        signal[i] = HALF * a * (share[i] + share[j])
        expected[i] = dark + gain * signal[i]
        free = ONE - HALF * predicted[i] / expected[i]
        if free > LEAST_FREE:
            squares[i], predicted[i] = HALF * d * d / free, free
            total += squares[i] / expected[i]
            count += ONE
    steep, scale = a * f32(fit.blur), max(total / max(count, ONE), ONE)
    ss = sq = qq = rs = rq = ZERO
    for i in range(n):
        if squares[i] < ZERO:
            continue
        g, h = steep * by_radius[i], steep * by_radius[int(partner[i])]
        s, q, variance, free = signal[i], HALF * (g * g + h * h), expected[i], predicted[i]
        w = HALF * free * free / (variance * variance)
        r = min(squares[i], CLIP * scale * variance) - dark
        ss += w * s * s
        sq += w * s * q
        qq += w * q * q
        rs += w * s * r
        rq += w * q * r
    tally[NOISE_SUMS] += ss
    tally[NOISE_SUMS + 1] += sq
    tally[NOISE_SUMS + 2] += qq
    tally[NOISE_SUMS + 3] += rs
    tally[NOISE_SUMS + 4] += rq
    tally[NOISE_SUMS + 5] += count
