"""Compiled fit of discs to the regions of a frame set, and sums for the camera's blur and bias.

The model, the noise and the source: ``mosca.detection.disc_fit.camera_statistics``. Called by
``mosca.detection.frame_set_kernel`` for all regions of a frame set at once, on one thread, so that the same images
always give the same centres.
"""

from typing import Any

import numpy as np

from mosca.data.arrays import Array
from mosca.detection.centroid import X, Y
from mosca.detection.disc_fit.disc_image import FAST, f32, is_profiled, is_smeared, parts_of
from mosca.detection.disc_fit.ellipse import ellipticity_of
from mosca.detection.disc_fit.first_values import NO_STRETCH, Light, Region, first_disc, is_plain, light_of, reshaped
from mosca.detection.disc_fit.gauss_newton import DiscFit, DiscPrior, Model, Workspace, first_fit, fit_disc
from mosca.detection.disc_fit.hidden_background import compare_rims, is_known, refit_before, take_behind
from mosca.detection.disc_fit.light_offset import (
    N_TARGETS,
    N_TERMS,
    ROUGH_SUM,
    SMEARED_SUM,
    TRIED_SUM,
    StatisticsSums,
    add_light,
    moved,
    no_sums_compiled,
)
from mosca.detection.disc_fit.neighbours import sure_pixels
from mosca.detection.disc_fit.pixels import (
    OVER,
    RoundWindows,
    corner_background,
    fill_window,
    gather_at_border,
    is_inside,
    level_pixels,
    made_window,
    reach_of,
    region_sums,
    window_sums,
)
from mosca.detection.disc_fit.priors import Priors, add_learned, disc_prior, even_prior, with_profile
from mosca.detection.disc_fit.profile import add_profile
from mosca.detection.disc_fit.refit_shape import Buffers, gather_mapped, reach_around, refit_shaped
from mosca.detection.disc_fit.residual_noise import add_residuals
from mosca.detection.disc_fit.row import (
    BLUR,
    BLUR_INFO,
    ELLIPTIC_SIGMA,
    ELLIPTIC_X,
    ELLIPTIC_Y,
    MISFIT,
    N_COLUMNS,
    ROUGH,
    centre_of,
    is_good,
    misfit_by_chance,
    widen,
    write_diameter,
    write_row,
)
from mosca.detection.disc_fit.surroundings import N_BEHIND, refit_around
from mosca.detection.images import ImageSet, behind_of, image_of
from mosca.detection.search import (
    DARK,
    END_RUN,
    FIRST_RUN,
    FLOOR,
    GAIN,
    IMAGE,
    SLOPE_X,
    SLOPE_Y,
    THRESHOLD,
    FoundRegions,
    box_of,
)  # fmt: skip
from mosca.numba_support.decorators import bare_step, step
from mosca.numba_support.intrinsics import array_at

ROUGH_FACTOR, ROUGH_FLOOR = 4.0, 1e-4
"""In the camera's usual misfit a single target counts with at most so many times that misfit, plus (1 %)^2."""
MANY_SMEARED = 0.25
"""Share of targets smeared by motion among a camera's round targets that no disc fits, above which all of the latter
are fitted with other shapes. Below it a few in each image are: where nothing moves they are hidden in part, and the
fits take time. Half or twice of it gives the same places."""
EACH, MOST_PROFILES = 8, 4
"""Every so many-th target adds to the sums of centroid and noise. Of these targets at most the second number in an
image add to the sums of the profile and are tried with other shapes."""
MORE_PX = 30
"""Margin of the widest window around the largest region, on each side; limits the blur of a fit."""


@bare_step(fastmath=FAST)
def write_even(
    n: int, pixels: Array, fit: DiscFit, prior: DiscPrior, model: Model, light: Light, work: Workspace, out: Array
) -> DiscFit:
    """Write the diameter of an even disc to a row of the table, and return its fit: ``fit`` where it is one."""
    even = fit
    if fit.converged and is_profiled(fit.profile) and not light.crowded and not light.saturated:
        start = (fit.x, fit.y, fit.amplitude, fit.background, fit.radius)
        other = fit_disc(n, pixels, start, prior, model, True, light.shape, work)
        even = other if other.converged else fit
    write_diameter(even, model, out)
    return even


@bare_step(fastmath=FAST)
def is_crowded(
    bright: int, n: int, pixels: Array, behind: Array, middle: tuple[int, int], region: Region, model: Model
) -> bool:
    """Return whether some of n pixels, ``bright`` of which are above the floor, show light of a neighbour."""
    if bright == region.n_px or len(behind) == 0:
        return bright != region.n_px
    crowded: bool = sure_pixels(n, pixels, behind, middle, region.floor, model.dark_dn2) > region.n_px
    return crowded


@bare_step(fastmath=FAST)
def uncovered_sums(
    n: int,
    pixels: Array,
    behind: Array,
    middle: tuple[int, int],
    region: Region,
    background: float,
    priors: Priors,
    model: Model,
    buffers: Buffers,
) -> tuple[Any, Any]:
    """Return peak and sums of a region's light as ``window_sums``, without the negative of the hidden background.

    Adds what was subtracted to the pixels, as ``take_behind`` does.
    """
    dark, shadow = model.dark_dn2, buffers.behind
    take_behind(n, pixels, behind, middle, region.slope, NO_STRETCH, region.threshold, dark, shadow)
    blur = priors.blurs[region.image, 2]
    _, peak, sums = window_sums(n, pixels, region.floor, background)
    light = reshaped(light_of(region, background, peak, sums, False, blur, model.full_dn), NO_STRETCH)
    amplitude, radius = first_disc(region, light, blur)
    prior, start = disc_prior(region.image, priors, float(sums[0])), (light.x, light.y, amplitude, background, radius)
    padded = (n + 7) // 8 * 8
    fit = fit_disc(padded, pixels, start, prior, model, True, NO_STRETCH, buffers.fit)
    if fit.converged:
        refit_before(padded, pixels, buffers.behind, NO_STRETCH, fit, prior, model, True, buffers.fit)
        _, peak, sums = window_sums(n, pixels, region.floor, background)
    return peak, sums


@bare_step(fastmath=FAST)
def may_have_shape(n: int, fit: DiscFit, light: Light, tries: bool) -> bool:
    """Return whether a target may have another shape than its fit to n pixels.

    ``tries``: whether round blurred targets are tried too. Under a sharp edge second moments are no measure of a
    shape, and small regions were taken for round.
    """
    sharp = parts_of(fit.blur) > 1 and not light.crowded
    if light.saturated:
        return False
    if is_plain(light.shape):
        return (sharp or tries) and fit.chi2 > (n - 6) * misfit_by_chance(n)
    return sharp or fit.chi2 > n


@bare_step(fastmath=FAST)
def refit_uneven(
    n: int,
    pixels: Array,
    behind: Array,
    light: Light,
    fits: tuple[DiscFit, DiscFit],
    prior: DiscPrior,
    model: Model,
    usual: float,
    buffers: Buffers,
) -> tuple[DiscFit, bool]:
    """Fit a disc to n pixels again before the subtracted background, and if that fails before its surroundings.

    Returns the fit, and whether its background is estimated from its surroundings. ``behind``: what was subtracted
    from the image; ``fits``, ``usual``: as in ``refit_around``.
    """
    fit, padded, symmetric = fits[0], (n + 7) // 8 * 8, not light.crowded and not light.saturated
    if len(behind) > 0:
        fit = refit_before(padded, pixels, buffers.behind, light.shape, fit, prior, model, symmetric, buffers.fit)
        if is_known(padded, buffers.behind, model.dark_dn2):
            return fit, False
    # the remaining light of a neighbour is no background
    if not symmetric or (fit.converged and fit.chi2 <= (n - 6) * misfit_by_chance(n)):
        return fit, False
    fit, uneven = refit_around(
        padded, pixels, len(behind) > 0, light.shape, (fit, fits[1]), prior, model, usual, buffers
    )
    return fit, uneven


@bare_step(fastmath=FAST)
def gather_whole(
    image: Array, middle: tuple[int, int], size: int, reach: float, region: Region, buffers: Buffers
) -> tuple[int, Array]:
    """Copy all pixels up to ``reach`` from a region's middle; return how many, and the pixels.

    For an isolated target they are copied only once.
    """
    pixels = buffers.pixels
    if is_inside(image, middle, reach):
        address, columns = made_window(size, reach, buffers.windows)
        pixels = array_at(address, pixels, (5, columns))
        n = fill_window(image, middle, size, reach, buffers.windows, pixels)
    else:
        n = gather_at_border(image, middle, reach, pixels)
    level_pixels(n, pixels, region.slope)
    return n, pixels


@bare_step(fastmath=FAST)
def refine_region(
    image: Array,
    behind: Array,
    runs: Array,
    region: Region,
    priors: Priors,
    model: Model,
    buffers: Buffers,
    sums: StatisticsSums,
    takes: tuple[bool, bool, bool],
    out: Array,
) -> None:
    """Fit one region, write its row of the table ``out`` and add to the sums.

    ``behind``: what was subtracted from the image; ``takes``: whether to add to the sums of light and noise, whether
    to add to those of the profile, whether to try other shapes.
    """
    k, blur, own = region.image, priors.blurs[region.image, 2], runs[region.first_run : region.end_run]
    (takes_light, takes_profile, tries), most = takes, 0.5 * buffers.side - 2.0  # what the buffers hold
    size = max(region.right - region.left + 1, region.bottom - region.top + 1)
    middle = ((region.left + region.right + 1) // 2, (region.top + region.bottom + 1) // 2)
    reach = min(reach_of(size, blur), most)
    n, pixels = gather_whole(image, middle, size, reach, region, buffers)
    whole = is_inside(image, middle, reach) and len(behind) == 0
    box = (region.left, region.right, region.top, region.bottom)
    background = min(corner_background(image, box, region.floor), float(region.threshold))
    bright, peak, light_sums = window_sums(n, pixels, region.floor, background)
    crowded = is_crowded(bright, n, pixels, behind, middle, region, model)
    if crowded:
        peak, light_sums = region_sums(image, own, middle, background)
    elif len(behind) > 0:
        peak, light_sums = uncovered_sums(n, pixels, behind, middle, region, background, priors, model, buffers)
    prior = disc_prior(k, priors, float(light_sums[0]))
    light = light_of(region, background, peak, light_sums, crowded, blur, model.full_dn)
    (m0, m1, m2), plain, (amplitude, radius) = light.shape, is_plain(light.shape), first_disc(region, light, blur)
    x0, y0 = m0 * light.x + m1 * light.y, m1 * light.x + m2 * light.y
    symmetric = not light.crowded and not light.saturated
    mapped = not symmetric or not plain
    if mapped:
        reach = reach_around(radius, blur, buffers)
        n = gather_mapped(image, behind, own, region, light.shape, (x0, y0), reach, model, buffers)
        pixels = buffers.pixels
    start, padded = (x0, y0, amplitude, light.background, radius), (n + 7) // 8 * 8
    fit = fit_disc(padded, pixels, start, prior, model, symmetric, light.shape, buffers.fit)
    if may_have_shape(n, fit, light, tries or priors.smeared[k] > MANY_SMEARED):
        fit, light, m = refit_shaped(image, behind, own, region, light, fit, prior, model, buffers)
        sums.tallies[k, TRIED_SUM] += plain
        sums.tallies[k, SMEARED_SUM] += plain and is_smeared(fit.profile)
        plain &= is_plain(light.shape) and not is_smeared(fit.profile)
        if m == 0 and (mapped or not whole):  # other pixels were copied over those of the fit
            around = (x0, y0) if mapped else (0.0, 0.0)
            m = gather_mapped(image, behind, own, region, light.shape, around, reach, model, buffers)
        if m > 0:
            pixels, n, padded = buffers.pixels, m, (m + 7) // 8 * 8
        prior = with_profile(prior, fit.profile)
    fits = fit, first_fit((x0, y0, amplitude, light.background, radius), prior)
    fit, uneven = refit_uneven(n, pixels, behind, light, fits, prior, model, priors.roughness[k], buffers)
    if len(behind) > 0 and not uneven and symmetric and takes_light and fit.converged:
        compare_rims(padded, pixels, buffers.behind, light.shape, fit, prior, model, buffers.fit, sums.tallies[k])
    even = write_even(padded, pixels, fit, even_prior(k, priors, prior, fit), model, light, buffers.fit, out)
    centre = centre_of(middle, light, fit)
    tally, usual, good = sums.tallies[k], priors.roughness[k], is_good(region, light, fit, centre)
    odd, excess = write_row(region, light, fit, centre, (good, n, usual), model, out)
    widen(excess, symmetric and not odd, n, pixels, fit, model, light.shape, buffers.fit, out)
    teaches = good and symmetric and not uneven
    if teaches:
        tally[N_TARGETS] += 1.0
        tally[ROUGH_SUM] += min(out[ROUGH], ROUGH_FACTOR * usual + ROUGH_FLOOR)
        if takes_profile and plain:
            add_profile(padded, pixels, fit, model, light.shape, out[MISFIT], buffers.fit, tally)
        if takes_light and not odd:
            add_residuals(padded, pixels, fit, prior, model, light.shape, buffers.fit, tally)
    # ellipses are learned from only where edges are sharp: others may be smeared by motion
    if teaches and (plain or ((parts_of(fit.blur) > 1 or is_smeared(fit.profile)) and not odd)):
        out[BLUR], out[BLUR_INFO] = add_learned(even, amplitude, float(light_sums[0]), prior, tally)
        if takes_light and (plain or is_smeared(fit.profile)) and not odd:
            add_light(image, region, most, fit, centre.radius, buffers.pixels, buffers.terms, sums)
    shape = ellipticity_of(padded, pixels, region, light, fit, good, out[MISFIT], model, buffers.fit)
    out[ELLIPTIC_X], out[ELLIPTIC_Y], out[ELLIPTIC_SIGMA] = shape
    out[X], out[Y] = moved(image, centre.x, centre.y, centre.radius, priors.offsets[k], buffers.terms)


@step(fastmath=FAST)
def boxes_of(found: FoundRegions, height: int, width: int) -> tuple[Array, int]:
    """Return left, right, top, bottom, number of pixels and whether it touches the border (n, 6) of each region.

    Also return the longest edge of a box [px].
    """
    boxes, largest = np.empty((len(found.regions), 6), np.int64), 0
    for r in range(len(boxes)):
        first, end = found.regions[r, FIRST_RUN], found.regions[r, END_RUN]
        (left, right, top, bottom), n_px = box_of(found.runs, first, end)
        largest = max(largest, right - left + 1, bottom - top + 1)
        boxes[r, 0], boxes[r, 1], boxes[r, 2], boxes[r, 3], boxes[r, 4] = left, right, top, bottom, n_px
        boxes[r, 5] = left == 0 or right == width - 1 or top == 0 or bottom == height - 1
    return boxes, largest


@step(fastmath=FAST)
def buffers_for(largest: int, blurs: Array) -> Buffers:
    """Return working memory for regions of boxes up to ``largest`` [px]."""
    side = 2 * (largest + MORE_PX) + 1
    most_blur, room = 0.0, 1
    for k in range(len(blurs)):
        most_blur = max(most_blur, blurs[k, 0], blurs[k, 2])
    for k in range(1, largest + 1):
        room += 5 * (min(2 * int(reach_of(k, most_blur)) + 1, side) ** 2 + 7) + OVER
    windows = RoundWindows(
        np.empty(room, f32), np.empty((largest + 1, side), np.int32), np.empty((largest + 1, 2), np.int64)
    )
    return Buffers(
        side, np.empty((5, side * side + OVER), f32), windows, np.empty((4, side * side), np.uint8), np.full(2, -1),
        Workspace(np.zeros((12, side * side + OVER), f32), np.empty((7, 8))), np.empty(N_TERMS),
        np.empty((N_BEHIND, side * side + OVER), f32),
    )  # fmt: skip


@step(fastmath=FAST)
def refine_regions(
    images: ImageSet, found: FoundRegions, priors: Priors, full_dn: float
) -> tuple[Array, Array, StatisticsSums]:
    """Fit every region that does not touch its image's border.

    Returns a table (n, N_COLUMNS), the region of each row (n), and what each image adds to its camera's statistics.
    """
    n_images, n_regions = len(images.addresses), len(found.regions)
    table = np.empty((n_regions, N_COLUMNS))
    region_of = np.empty(n_regions, np.int32)
    sums = no_sums_compiled(n_images)
    boxes, largest = boxes_of(found, images.height, images.width)
    buffers = buffers_for(largest, priors.blurs)
    known, regions = buffers.windows.known, found.regions
    counts = np.zeros(n_images, np.int64)
    for r in range(n_regions):
        counts[int(regions[r, IMAGE])] += 1
    n = first_of_image = 0
    for r in range(n_regions):
        if boxes[r, 5]:
            continue
        k = int(regions[r, IMAGE])
        if n == 0 or regions[region_of[n - 1], IMAGE] != k:
            first_of_image = n
            known[:, 0] = -1
            known[0, 0] = 0
        region = Region(
            k, boxes[r, 0], boxes[r, 1], boxes[r, 2], boxes[r, 3], boxes[r, 4], regions[r, FIRST_RUN],
            regions[r, END_RUN], regions[r, THRESHOLD], regions[r, FLOOR],
            (found.noise[r, SLOPE_X], found.noise[r, SLOPE_Y]),
        )  # fmt: skip
        model = Model(found.noise[r, DARK], found.noise[r, GAIN], full_dn)
        number, behind = n - first_of_image, behind_of(images, k)
        seldom = number % max(counts[k] // MOST_PROFILES, EACH) == 0
        takes = (number % EACH == 0, len(behind) == 0 and seldom, seldom)  # the rest of a texture is no profile
        refine_region(
            image_of(images, k), behind, found.runs, region, priors, model, buffers, sums,
            takes, table[n],
        )  # fmt: skip
        region_of[n] = r
        n += 1
    return table[:n], region_of[:n], sums
