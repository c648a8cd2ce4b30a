"""Compiled sums over the residuals of a fitted disc, from which a camera's gain is learned.

Photon transfer (EMVA 1288, 6.6) with the fit in the place of the mean image: squared residuals d^2 less the dark
variance are regressed on the signal s = A e and on q = (A e')^2, what an error of the edge adds. Weights
1 / (2 var^2) are those of a normal variable's square, with the variance scaled by the fit's chi-square, since the
gain is a guess at first. Solved by ``mosca.detection.pixel_noise``.
"""

import math

from mosca.data.arrays import Array
from mosca.detection.disc_fit.gauss_newton import (
    FAST,
    HALF,
    ONE,
    P0,
    P1,
    P2,
    P3,
    P4,
    Q0,
    Q1,
    Q2,
    Q3,
    Q4,
    REACH,
    TINY,
    ZERO,
    DiscFit,
    Model,
    f32,
)  # fmt: skip
from mosca.detection.disc_fit.light_offset import NOISE_SUMS
from mosca.numba_support.decorators import bare_step

CLIP = f32(16.0)
"""Squared residuals count up to so many times their expected variance: (4 sigma)^2."""


@bare_step(fastmath=FAST)
def add_residuals(n: int, pixels: Array, fit: DiscFit, model: Model, misfit: float, tally: Array) -> None:
    """Add the residuals of n pixels (rows as in ``sums``) of a round target's fit to its camera's ``tally``."""
    x, y, there, v = pixels[0], pixels[1], pixels[3], pixels[4]
    x0, y0, a, b, radius = f32(fit.x), f32(fit.y), f32(fit.amplitude), f32(fit.background), f32(fit.radius)
    sharp = f32(1.0 / fit.blur)
    dark, gain, scale = f32(model.dark_dn2), f32(model.gain_dn), f32(max(misfit, 1.0))
    ss = sq = qq = rs = rq = count = ZERO
    for i in range(n):
        dx, dy = x[i] - x0, y[i] - y0
        t = (math.sqrt(dx * dx + dy * dy + TINY) - radius) * sharp
        t = min(max(t, -REACH), REACH)
        u = t * t
        s = a * (HALF - t * (P0 + u * (P1 + u * (P2 + u * (P3 + u * P4)))))
        g = a * (Q0 + u * (Q1 + u * (Q2 + u * (Q3 + u * Q4))))
        q = g * g
        d = v[i] - b - s
        variance = (dark + gain * s) * scale
        w = HALF * there[i] / (variance * variance)
        r = min(d * d, CLIP * variance) - dark
        ss += w * s * s
        sq += w * s * q
        qq += w * q * q
        rs += w * s * r
        rq += w * q * r
        count += there[i] * ONE
    tally[NOISE_SUMS] += ss
    tally[NOISE_SUMS + 1] += sq
    tally[NOISE_SUMS + 2] += qq
    tally[NOISE_SUMS + 3] += rs
    tally[NOISE_SUMS + 4] += rq
    tally[NOISE_SUMS + 5] += count
