"""Compiled sums over the residuals of a fitted disc, from which a camera's gain is learned.

Photon transfer (EMVA 1288, 6.6) with two points of a target's image at opposite sides of its centre in the place of
two images: what the model leaves of a symmetric image (limbs, defocus, motion, any profile) is the same in both, and
is not in their difference d, so that E d^2 = dark + gain s with the signal s. That less the dark variance is regressed
on s and on q = (A e')^2, what an error of the edge adds that is not symmetric. Weights 1 / (2 var^2) are those of a
normal variable's square, with the gain so far. Solved by ``mosca.detection.pixel_noise``.
"""

from mosca.data.arrays import Array
from mosca.detection.disc_fit.asymmetry import difference, lay_out
from mosca.detection.disc_fit.disc_image import FAST, HALF, ONE, ZERO, f32
from mosca.detection.disc_fit.gauss_newton import DiscFit, Model, Workspace
from mosca.detection.disc_fit.light_offset import NOISE_SUMS
from mosca.numba_support.decorators import bare_step

CLIP = f32(16.0)
"""Squared differences count up to so many times their expectation, (4 sigma)^2, or the target's mean where more."""
LEAST_FREE = f32(0.1)
"""A difference counts where at least this share of its variance is left in the residuals."""


@bare_step(fastmath=FAST)
def add_residuals(
    n: int,
    pixels: Array,
    fit: DiscFit,
    model: Model,
    shape: tuple[float, float, float],
    work: Workspace,
    tally: Array,
) -> None:
    """Add the residuals of n pixels of a target's fit to its camera's ``tally``; overwrites ``work``.

    ``pixels``, ``shape``: as in ``disc_image``. The centre takes its own variance from that of the differences.
    """
    grid = lay_out(n, pixels, fit, shape, work)
    if grid.side == 0:
        return
    image, dark, gain = work.image, f32(model.dark_dn2), f32(model.gain_dn)
    a, steep = f32(fit.amplitude), f32(fit.amplitude * fit.blur)
    cxx, cxy, cyy = f32(fit.covariance[0]), f32(fit.covariance[1]), f32(fit.covariance[2])
    total = count = ZERO
    for turn in range(2):
        # the mean first: of a target that fits badly all differences are large
        scale = max(total / max(count, ONE), ONE)
        for i in range(n):
            one = difference(i, pixels, grid, image)
            if not one.there:
                continue
            variance = dark * one.dark + gain * one.signal
            jx, jy = a * image[1, i], a * image[2, i]
            free = ONE - f32(4.0) * (cxx * jx * jx + f32(2.0) * cxy * jx * jy + cyy * jy * jy) / variance
            if not free > LEAST_FREE:
                continue
            square = one.value * one.value / free
            if turn == 0:
                total += square / variance
                count += ONE
                continue
            g = steep * image[3, i]
            s, q, w = one.signal, g * g, HALF * free * free / (variance * variance)
            r = min(square, CLIP * scale * variance) - dark * one.dark
            tally[NOISE_SUMS] += w * s * s
            tally[NOISE_SUMS + 1] += w * s * q
            tally[NOISE_SUMS + 2] += w * q * q
            tally[NOISE_SUMS + 3] += w * s * r
            tally[NOISE_SUMS + 4] += w * q * r
            tally[NOISE_SUMS + 5] += ONE
