"""Compiled fit of targets that are not round: as an ellipse, or as a disc that moved while it was exposed.

Second steps of ``mosca.detection.disc_fit.fit_regions``. Both shapes are estimated from the residuals of the fit with
the shape before.
"""

import math
from typing import NamedTuple

from mosca.data.arrays import Array
from mosca.detection.disc_fit.disc_image import FAST, parts_of
from mosca.detection.disc_fit.ellipse import stretch_of, stretched
from mosca.detection.disc_fit.first_values import NO_STRETCH, Light, Region, is_plain, reshaped, turned
from mosca.detection.disc_fit.gauss_newton import DiscFit, DiscPrior, Model, Workspace, fit_disc
from mosca.detection.disc_fit.hidden_background import take_behind
from mosca.detection.disc_fit.neighbours import gather_unmarked, half_side, mark_foreign
from mosca.detection.disc_fit.pixels import RoundWindows, level_pixels, pad
from mosca.detection.disc_fit.priors import with_profile
from mosca.detection.disc_fit.row import misfit_by_chance
from mosca.detection.disc_fit.smear import changed_way, smeared, still_radius, way_of
from mosca.numba_support.decorators import bare_step

SHAPE_STEPS, SMEAR_STEPS, SHAPE_CHI2 = 3, 6, 4.0
"""Most steps of an ellipse's shape and of a smeared disc's; a step whose chi-square (two degrees of freedom) is below
the third number is the last."""


class Buffers(NamedTuple):
    """Working memory of the fits of a frame set."""

    side: int
    """Edge of the widest window [px]."""
    pixels: Array
    """(5, side^2 + OVER) float32: pixels of a fit that no round window holds."""
    windows: RoundWindows
    marks: Array
    """(4, side^2) uint8."""
    marked: Array
    """(2,) int64: first run of the region that ``marks`` were made for, negative before, and their square's edge."""
    fit: Workspace
    terms: Array
    """(N_TERMS,): terms of the offset."""
    behind: Array
    """(4, side^2 + OVER) float32: see ``take_behind``."""


@bare_step(fastmath=FAST)
def reach_around(radius: float, blur: float, buffers: Buffers) -> float:
    """Return how far from its centre a target's pixels are fitted [px], limited by what the buffers hold."""
    return min(radius + 3.0 * blur + 0.5, 0.5 * buffers.side - 2.0)


@bare_step(fastmath=FAST)
def gather_mapped(
    image: Array,
    behind: Array,
    own: Array,
    region: Region,
    shape: tuple[float, float, float],
    around: tuple[float, float],
    reach: float,
    model: Model,
    buffers: Buffers,
) -> int:
    """Copy a region's pixels, without neighbours' and saturated ones, to ``buffers.pixels``; return how many.

    ``own``: its runs; ``behind``: what was subtracted from the image; the others as in ``gather_unmarked``.
    """
    middle = ((region.left + region.right + 1) // 2, (region.top + region.bottom + 1) // 2)
    side, known = 2 * min(half_side(shape, around, reach), buffers.side // 2) + 1, buffers.marked
    if known[0] != region.first_run or known[1] < side:
        known[0], known[1] = region.first_run, side
        limits = (region.floor, model.full_dn, model.dark_dn2)
        mark_foreign(image, behind, own, middle, limits, side, buffers.marks)
    marks = buffers.marks[0]
    n: int = gather_unmarked(image, middle, shape, around, reach, marks, int(known[1]), buffers.pixels)
    pad(n, buffers.pixels)
    m0, m1, m2 = shape
    det, (slope_x, slope_y) = m0 * m2 - m1 * m1, region.slope
    level_pixels(n, buffers.pixels, ((m2 * slope_x - m1 * slope_y) / det, (m0 * slope_y - m1 * slope_x) / det))
    if len(behind) > 0:
        take_behind(
            n, buffers.pixels, behind, middle, region.slope, shape, region.threshold, model.dark_dn2, buffers.behind
        )
    return n


@bare_step(fastmath=FAST)
def refit_smeared(
    image: Array,
    behind: Array,
    own: Array,
    region: Region,
    light: Light,
    fit: DiscFit,
    prior: DiscPrior,
    model: Model,
    buffers: Buffers,
) -> tuple[DiscFit, int, bool]:
    """Fit a region again as a disc that moved while it was exposed, starting from ``fit`` of an ellipse.

    Returns the fit, how many pixels ``buffers.pixels`` holds, and whether its way has converged.
    """
    way, radius, n = way_of(light.shape, fit.radius), still_radius(light.shape, fit.radius), 0
    x, y = turned(fit.x, fit.y, light.shape, NO_STRETCH)
    amplitude, background = fit.amplitude * (fit.radius / radius) ** 2, fit.background
    for _ in range(SMEAR_STEPS):
        tried = with_profile(prior, smeared(prior.profile, way))
        reach = reach_around(radius + 0.5 * math.sqrt(math.hypot(way[0], way[1])), prior.blur, buffers)
        n = gather_mapped(image, behind, own, region, NO_STRETCH, (x, y), reach, model, buffers)
        padded, start = (n + 7) // 8 * 8, (x, y, amplitude, background, radius)
        fit = fit_disc(padded, buffers.pixels, start, tried, model, not light.crowded, NO_STRETCH, buffers.fit)
        if not fit.converged:
            break
        x, y, amplitude, background, radius = fit.x, fit.y, fit.amplitude, fit.background, fit.radius
        way, chi2 = changed_way(way, padded, buffers.pixels, fit, model, buffers.fit)
        if chi2 < SHAPE_CHI2:
            return fit, n, True
    return fit, n, False


@bare_step(fastmath=FAST)
def refit_shaped(
    image: Array,
    behind: Array,
    own: Array,
    region: Region,
    light: Light,
    fit: DiscFit,
    prior: DiscPrior,
    model: Model,
    buffers: Buffers,
) -> tuple[DiscFit, Light, int]:
    """Fit a region again, with its shape from the residuals of ``fit``: an ellipse, or a smeared disc.

    Returns the fit, the light with the shape, and how many pixels ``buffers.pixels`` holds of that fit: 0 where the
    fit stays as it is. A round target that neither shape fits stays round.
    """
    first, first_light, plain, symmetric = fit, light, is_plain(light.shape), not light.crowded
    reach, good = reach_around(fit.radius, fit.blur, buffers), fit.converged
    n = gather_mapped(image, behind, own, region, light.shape, (fit.x, fit.y), reach, model, buffers)
    for _ in range(SHAPE_STEPS if plain or parts_of(fit.blur) > 1 else 0):
        change = stretch_of((n + 7) // 8 * 8, buffers.pixels, fit, model, light.shape, buffers.fit)
        if not good or change.chi2 < SHAPE_CHI2:
            break
        shape = stretched(light.shape, change)
        x0, y0 = turned(fit.x, fit.y, light.shape, shape)
        light = reshaped(light, shape)
        n = gather_mapped(image, behind, own, region, light.shape, (x0, y0), reach, model, buffers)
        start = (x0, y0, fit.amplitude, fit.background, fit.radius)
        fit = fit_disc((n + 7) // 8 * 8, buffers.pixels, start, prior, model, symmetric, light.shape, buffers.fit)
        good = fit.converged
    if good and not is_plain(light.shape) and fit.chi2 > n:
        moving, m, settled = refit_smeared(image, behind, own, region, light, fit, prior, model, buffers)
        if settled and moving.chi2 < min(fit.chi2 / n * m, (m - 6) * misfit_by_chance(m)):
            return moving, reshaped(light, NO_STRETCH), m
        if light.shape != first_light.shape:
            n = gather_mapped(image, behind, own, region, light.shape, (fit.x, fit.y), reach, model, buffers)
    if light.shape == first_light.shape or (plain and not (good and fit.chi2 < (n - 6) * misfit_by_chance(n))):
        return first, first_light, 0
    return fit, light, n
