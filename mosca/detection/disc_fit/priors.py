"""Compiled: priors of a disc's fit, learned from its camera's other targets, and what the fit adds to them."""

import math
from typing import NamedTuple

from mosca.data.arrays import Array
from mosca.detection.disc_fit.disc_image import FAST, Profile, even_as
from mosca.detection.disc_fit.gauss_newton import DiscFit, DiscPrior
from mosca.detection.disc_fit.light_offset import AMPLITUDE_SUMS, BLUR_SUM, BLUR_WEIGHT
from mosca.numba_support.decorators import bare_step

BLUR_SIGMA_2 = 9e-4
"""Variance (0.03 px)^2 added to a target's own, so that no single target outweighs others by its brightness."""
WELL_KNOWN_2, AMPLITUDE_SIGMA_2 = 0.0225, 0.04
"""Variances of the logarithm of an amplitude: up to the first, (0.15)^2, a target's own pixels determine it well
enough to learn from it; the second, (0.2)^2, is added to a target's own, so that no single one outweighs others."""
FAR_AMPLITUDE = 2.0
"""Standard deviations from the camera's line of amplitudes at which a target's weight is halved."""
MOST_BRIGHTER = 2.5
"""An amplitude is learned from up to so many times its brightest pixel: it is more where a target covers 0.4
pixels."""


class Priors(NamedTuple):
    """What the fits of n images start from."""

    blurs: Array
    """(n, 3) mean and standard deviation of the blur of even discs, and mean of that of discs with a profile [px]."""
    offsets: Array
    """(n, N_TERMS, 2) terms of the offset [px] from the fitted centre to the light's centroid."""
    roughness: Array
    """(n,) usual misfit beyond the noise, as a share of the squared amplitude."""
    amplitudes: Array
    """(n, 5) line of ln amplitude over ln flux of a camera's targets: means of both, slope, variance about the line
    and of the mean, variance of the slope; the variances are infinite where nothing was learned."""
    rims: Array
    """(n,) radius within which targets hide their background, over that of their light."""
    profiles: Array
    """(n, 3) limb, skew and tails, see ``Profile``."""
    smeared: Array
    """(n,) share of targets smeared by motion among the round ones that no disc fits; 1 before any was seen."""


@bare_step(fastmath=FAST)
def disc_prior(k: int, priors: Priors, flux: float) -> DiscPrior:
    """Return the prior of a target of camera k with this flux [DN px^2]."""
    means, line = priors.amplitudes[k, :2], priors.amplitudes[k, 2:]
    blur_sigma, blur, rim = priors.blurs[k, 1], priors.blurs[k, 2], priors.rims[k]
    profile = Profile(priors.profiles[k, 0], priors.profiles[k, 1], priors.profiles[k, 2], 0.0, 0.0)
    if not line[1] < math.inf:
        return DiscPrior(blur, blur_sigma, 1.0, math.inf, rim, profile)
    away = math.log(max(flux, 1.0)) - means[0]
    amplitude = math.exp(means[1] + line[0] * away)
    sigma = amplitude * math.sqrt(line[1] + line[2] * away * away)
    return DiscPrior(blur, blur_sigma, amplitude, sigma, rim, profile)


@bare_step(fastmath=FAST)
def with_profile(prior: DiscPrior, profile: Profile) -> DiscPrior:
    """Return ``prior`` for discs of another profile."""
    return DiscPrior(prior.blur, prior.blur_sigma, prior.amplitude, prior.amplitude_sigma, prior.rim, profile)


@bare_step(fastmath=FAST)
def even_prior(k: int, priors: Priors, prior: DiscPrior, fit: DiscFit) -> DiscPrior:
    """Return ``prior`` for an evenly bright disc of camera k with the motion of ``fit``."""
    blur, profile = priors.blurs[k, 0], even_as(fit.profile)
    return DiscPrior(blur, prior.blur_sigma, prior.amplitude, prior.amplitude_sigma, prior.rim, profile)


@bare_step(fastmath=FAST)
def add_learned(fit: DiscFit, first: float, flux: float, prior: DiscPrior, tally: Array) -> tuple[float, float]:
    """Add to the sums the blur and amplitude of a clean target as its data alone give them.

    ``first``: first value of the amplitude; ``flux`` [DN px^2]. Returns the blur [px] and its information [px^-2],
    both 0 where the data do not determine it.
    """
    a, variance = fit.own_amplitude
    if 0.0 < a < MOST_BRIGHTER * first and variance < WELL_KNOWN_2 * a * a:
        variance /= a * a
        w, log, f = 1.0 / (variance + AMPLITUDE_SIGMA_2), math.log(a), math.log(max(flux, 1.0))
        if prior.amplitude_sigma < prior.amplitude:
            # small sharp targets have false solutions, which are outliers
            usual = prior.amplitude_sigma / prior.amplitude
            w /= 1.0 + (math.log(a / prior.amplitude) / FAR_AMPLITUDE) ** 2 / (variance + usual * usual)
        tally[AMPLITUDE_SUMS] += w
        tally[AMPLITUDE_SUMS + 1] += w * f
        tally[AMPLITUDE_SUMS + 2] += w * f * f
        tally[AMPLITUDE_SUMS + 3] += w * log
        tally[AMPLITUDE_SUMS + 4] += w * f * log
        tally[AMPLITUDE_SUMS + 5] += w * log * log
        tally[AMPLITUDE_SUMS + 6] += w * variance
    if fit.blur_variance < 1.0:
        information = 1.0 / (fit.blur_variance + BLUR_SIGMA_2)
        known = 1.0 / (prior.blur_sigma * prior.blur_sigma)
        blur = (fit.blur * (1.0 / fit.blur_variance + known) - prior.blur * known) * fit.blur_variance
        tally[BLUR_SUM] += information * blur
        tally[BLUR_WEIGHT] += information
        return blur, information
    return 0.0, 0.0
