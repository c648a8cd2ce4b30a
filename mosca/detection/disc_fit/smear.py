"""Compiled: the way of a target in the image during the exposure, from the residuals of the disc fitted to it.

A disc that moves at an even speed has the second moments of a disc that stands still plus those of its way. The
search starts from an ellipse of the same moments. Both are symmetric about their centre. An ellipse is therefore not
biased, but weights pixels by slopes that are elsewhere (error 1.2 of the bound where images are smeared by up to 6
px, 1.08 as smeared discs). Ways are written as ``(way^2 cos 2 a, way^2 sin 2 a)`` with their direction a: a way and
its reverse look alike.
"""

import math

from mosca.data.arrays import Array
from mosca.detection.disc_fit.disc_image import FAST, Profile
from mosca.detection.disc_fit.ellipse import stretch_of
from mosca.detection.disc_fit.first_values import NO_STRETCH
from mosca.detection.disc_fit.gauss_newton import DiscFit, Model, Workspace
from mosca.numba_support.decorators import bare_step

LEAST_WAY_2 = 0.01
"""Square of the least way [px^2] of a smeared disc."""


@bare_step(fastmath=FAST)
def way_of(shape: tuple[float, float, float], radius: float) -> tuple[float, float]:
    """Return the way of a smeared disc with the moments of the ellipse that ``shape`` maps to this radius."""
    # moments radius^2 / 4 times the inverse square of shape, and way^2 / 12 along the way
    xx = shape[0] * shape[0] + shape[1] * shape[1]
    xy = shape[1] * (shape[0] + shape[2])
    yy = shape[1] * shape[1] + shape[2] * shape[2]
    return 3.0 * radius * radius * (yy - xx), -6.0 * radius * radius * xy


@bare_step(fastmath=FAST)
def smeared(profile: Profile, way: tuple[float, float]) -> Profile:
    """Return a profile with this way."""
    square = max(math.hypot(way[0], way[1]), LEAST_WAY_2)
    x = math.sqrt(max(0.5 * (square + way[0]), 0.0))
    y = math.copysign(math.sqrt(max(0.5 * (square - way[0]), 0.0)), way[1])
    return Profile(profile.limb, profile.skew, profile.tails, x, y)


@bare_step(fastmath=FAST)
def still_radius(shape: tuple[float, float, float], radius: float) -> float:
    """Return the radius of the smeared disc with the second moments of an ellipse, without its way."""
    way = way_of(shape, radius)
    mean = 0.125 * radius * radius * (shape[0] ** 2 + 2.0 * shape[1] ** 2 + shape[2] ** 2)
    return 2.0 * math.sqrt(max(mean - math.hypot(way[0], way[1]) / 24.0, 0.01 * mean))


@bare_step(fastmath=FAST)
def changed_way(
    way: tuple[float, float], n: int, pixels: Array, fit: DiscFit, model: Model, work: Workspace
) -> tuple[tuple[float, float], float]:
    """Return the next way after a fit with ``way``, and the squared length of that step in units of its error.

    It is computed from the stretch (p, q) of the residuals, which changes the moments M by ``-(p, q) trace M``.
    """
    change = stretch_of(n, pixels, fit, model, NO_STRETCH, work)
    times = 24.0 * (0.5 * fit.radius * fit.radius + math.hypot(way[0], way[1]) / 12.0)
    return (way[0] - times * change.p, way[1] - times * change.q), change.chi2
