"""Compiled fit of a disc before an uneven background that is known from the image itself alone.

A marker on a lit body, or beside its edge, stands before something that neither the planes between cells nor an image
without the marker show. It is estimated from the pixels that the disc leaves free, less the disc's own skirts. At
pixels that the disc covers in part it is the mean of the free ones, weighted by the inverse fourth power of the
distance. The disc is fitted before this background (``mosca.detection.disc_fit.hidden_background``), which changes
the skirts. Both are repeated until the disc stays where it is.
"""

from typing import Any

from mosca.data.arrays import Array
from mosca.detection.disc_fit.disc_image import FAST, ONE, ZERO, disc_image, even_as, f32, is_profiled
from mosca.detection.disc_fit.gauss_newton import DiscFit, DiscPrior, Model, Workspace
from mosca.detection.disc_fit.hidden_background import CLOSE_2, refit_before, uncover
from mosca.detection.disc_fit.row import FIRST_ROUGHNESS, misfit_by_chance
from mosca.numba_support.decorators import bare_step, step

FREE, HIDDEN = f32(0.12), f32(0.99)
"""Shares of a pixel that the disc covers: below the first it is one of the background, from the second on its
background does not matter. Eighty images of markers beside edges, which could not be fitted before an even
background, have an rms of 0.049 px with 0.05, 0.046 with 0.12, 0.053 with 0.25."""
SOFT_PX2 = f32(0.5)
"""Added to squared distances: a pixel's own value weighs nine times one beside it. The inverse third, fourth and
sixth power of the distance leave 0.051, 0.046 and 0.042 px in those images."""
TURNS = 3
"""Most fits in turn with the surroundings: three give as good results as six."""
HOPELESS = 4.0
"""A fit with more chi-square a pixel is not tried again: of 1,900 that chance explained in the end all but one had
less than 1.1 at first; of those of merged targets 95 % had more than 4.7."""
LEAST_TOLD = f32(0.25)
"""Share of a fit's chi-square that free pixels must have about their mean: otherwise it is the disc's own pixels that
misfit, as those of merged targets do. It gives up 88 % of the fits tried in vain in images of 200 balls, 17 % in
those of an actor and 0.6 % before a bright floor, and 0, 0 and 0.2 % of the fits that succeeded; 0.125 gives up 27, 6
and 0.3 %, 0.5 99, 55 and 2.3 % (and 0, 0.9 and 0.4 % of those that succeeded, with points missed before the
floor)."""
LEAST_FREE = 8
"""Least number of free pixels from which a background is estimated."""
FAR_PX = f32(1e6)
"""Where pixels that fill up a row lie: too far to have any weight."""
TEXTURE, VALUE, PRESENT, ERROR, TEXTURE_BEFORE, VALUE_BEFORE, ERROR_BEFORE, AROUND, LIGHT = range(9)
FREE_X, FREE_Y, FREE_VALUE, N_BEHIND = range(9, 13)
"""Rows of ``Buffers.behind``: the first four as ``take_behind`` writes them; three of them as they were before; how
far pixels are above the background [DN]; the disc's light for a brightness of 1; places and values of free pixels.
The last is the number of rows."""


@bare_step(fastmath=FAST)
def free_pixels(
    n: int, pixels: Array, shape: tuple[float, float, float], fit: DiscFit, work: Workspace, behind: Array
) -> tuple[Any, Any]:
    """Write how far free pixels are above the background [DN], without the disc's light; return their number.

    Also return the mean square of that about its mean [DN^2]. ``work.image[0]`` then holds the disc's coverage.
    """
    light, coverage, around = behind[LIGHT], work.image[0], behind[AROUND]
    disc = (f32(fit.x), f32(fit.y), f32(fit.radius), f32(fit.blur))
    disc_image(n, pixels, disc, fit.profile, shape, work.image)
    for i in range(n):
        light[i] = coverage[i]
    if is_profiled(fit.profile):
        disc_image(n, pixels, disc, even_as(fit.profile), shape, work.image)
    amplitude, level, mean, count = f32(fit.amplitude), f32(fit.background), ZERO, ZERO
    for i in range(n):
        mean += behind[TEXTURE_BEFORE, i]
        count += behind[PRESENT, i]
    mean /= max(count, ONE)
    total = square = count = ZERO
    for i in range(n):
        free = ONE - coverage[i]
        hidden = coverage[i] * (behind[TEXTURE_BEFORE, i] - mean)
        around[i] = (behind[VALUE_BEFORE, i] + hidden - level - amplitude * light[i]) / max(free, ONE - HIDDEN)
        known = behind[PRESENT, i] if coverage[i] < FREE else ZERO
        total += known * around[i]
        square += known * around[i] * around[i]
        count += known
    mean = total / max(count, ONE)
    return count, square / max(count, ONE) - mean * mean


@bare_step(fastmath=FAST)
def _gather_free(n: int, pixels: Array, coverage: Array, behind: Array) -> tuple[int, int]:
    """Copy the free ones of n pixels side by side; return their number, and that with padding that is far away."""
    m = 0
    for i in range(n):
        if coverage[i] < FREE and behind[PRESENT, i] > ZERO:
            behind[FREE_X, m], behind[FREE_Y, m] = pixels[0, i], pixels[1, i]
            behind[FREE_VALUE, m] = behind[AROUND, i]
            m += 1
    filled = m
    while filled % 8 > 0:
        behind[FREE_X, filled], behind[FREE_Y, filled], behind[FREE_VALUE, filled] = FAR_PX, FAR_PX, ZERO
        filled += 1
    return m, filled


@bare_step(fastmath=FAST)
def take_around(n: int, pixels: Array, dark_dn2: float, coverage: Array, behind: Array) -> None:
    """Add the background of free pixels to the texture behind n pixels, and subtract it from their grey values.

    Its error is the mean square difference between free pixels and their estimate from the others, less their noise.
    """
    around, present, texture, error = behind[AROUND], behind[PRESENT], behind[TEXTURE], behind[ERROR]
    wrong = ZERO
    m, filled = _gather_free(n, pixels, coverage, behind)
    x, y, free = behind[FREE_X], behind[FREE_Y], behind[FREE_VALUE]
    for i in range(n):
        texture[i] = ZERO
        if coverage[i] >= HIDDEN or present[i] == ZERO:
            continue
        total = weights = squares = ZERO
        for j in range(filled):
            dx, dy = pixels[0, i] - x[j], pixels[1, i] - y[j]
            near = ONE / (dx * dx + dy * dy + SOFT_PX2)
            weight = near * near
            total += weight * free[j]
            weights += weight
            squares += weight * weight
        texture[i] = total / weights
        if coverage[i] < FREE:
            # its estimate from the others
            own = ONE / (SOFT_PX2 * SOFT_PX2)
            total, weights, squares = total - own * around[i], weights - own, squares - own * own
            off = around[i] - total / weights
            wrong += off * off - f32(dark_dn2) * (ONE + squares / (weights * weights))
    variance = max(wrong / f32(m), ZERO) / f32(dark_dn2)
    for i in range(n):
        behind[VALUE, i] = behind[VALUE_BEFORE, i] - texture[i] * present[i]
        texture[i] += behind[TEXTURE_BEFORE, i]
        error[i] = behind[ERROR_BEFORE, i] + variance * present[i]


@bare_step(fastmath=FAST)
def keep_before(n: int, pixels: Array, subtracted: bool, behind: Array) -> None:
    """Write what ``take_around`` starts from; ``subtracted``: ``behind`` holds what ``take_behind`` wrote."""
    for i in range(n):
        if not subtracted:
            behind[TEXTURE, i], behind[VALUE, i], behind[ERROR, i] = ZERO, pixels[4, i], ZERO
            behind[PRESENT, i] = pixels[3, i]
        behind[TEXTURE_BEFORE, i], behind[VALUE_BEFORE, i] = behind[TEXTURE, i], behind[VALUE, i]
        behind[ERROR_BEFORE, i] = behind[ERROR, i]


@bare_step(fastmath=FAST)
def fit_around(
    n: int,
    pixels: Array,
    shape: tuple[float, float, float],
    fit: DiscFit,
    prior: DiscPrior,
    model: Model,
    buffers: Any,
) -> tuple[DiscFit, bool]:
    """Fit a disc and its surroundings in turn, from ``fit`` on; return the last fit, and whether chance explains it.

    The others as in ``refit_around``.
    """
    behind, work, told = buffers.behind, buffers.fit, ZERO
    for _ in range(TURNS):
        if free_pixels(n, pixels, shape, fit, work, behind)[0] < LEAST_FREE:
            return fit, False
        take_around(n, pixels, model.dark_dn2, work.image[0], behind)
        before = fit
        fit = refit_before(n, pixels, behind, shape, fit, prior, model, True, work)
        if not fit.converged or fit.chi2 > HOPELESS * n:
            return fit, False
        dx, dy = fit.x - before.x, fit.y - before.y
        if dx * dx + dy * dy < CLOSE_2 * (fit.covariance[0] + fit.covariance[2]):
            break
    free_pixels(n, pixels, shape, fit, work, behind)
    for i in range(n):
        told += behind[PRESENT, i] if work.image[0, i] >= FREE else ZERO
    inner = float(told) - 6.0
    good: bool = inner > 0.0 and fit.chi2 < inner * misfit_by_chance(inner + 6.0)
    return fit, good


@step(fastmath=FAST)
def refit_around(
    n: int,
    pixels: Array,
    subtracted: bool,
    shape: tuple[float, float, float],
    fits: tuple[DiscFit, DiscFit],
    prior: DiscPrior,
    model: Model,
    usual: float,
    buffers: Any,
) -> tuple[DiscFit, bool]:
    """Fit a disc to n pixels again before the background that the free ones among them show, if that is uneven.

    ``n``: with padding, all around the disc; ``subtracted``: whether something was subtracted from the image, which
    ``buffers.behind`` holds; ``fits``: the one so far, and the disc of the region's brightest pixels, from which the
    fit starts where the former did not converge; ``usual``: the camera's usual misfit, as ``ROUGH``, from skirts that
    its lens causes. Returns the fit, and whether it is a new one that chance explains; if not, the pixels are left as
    they were.
    """
    behind, work = buffers.behind, buffers.fit
    keep_before(n, pixels, subtracted, behind)
    seen = fits[0] if fits[0].converged else fits[1]
    count, square = free_pixels(n, pixels, shape, seen, work, behind)
    lens = min(usual, FIRST_ROUGHNESS) * seen.amplitude * seen.amplitude
    told = LEAST_TOLD * f32(seen.chi2) * f32(model.dark_dn2)
    if count >= LEAST_FREE and square > model.dark_dn2 * misfit_by_chance(count) + lens and count * square > told:
        fit, good = fit_around(n, pixels, shape, seen, prior, model, buffers)
        if good:
            return fit, True
    for i in range(n):
        behind[TEXTURE, i], behind[VALUE, i] = behind[TEXTURE_BEFORE, i], behind[VALUE_BEFORE, i]
        behind[ERROR, i] = behind[ERROR_BEFORE, i]
        if not subtracted:
            pixels[3, i], pixels[4, i] = behind[PRESENT, i], behind[VALUE, i]
    if subtracted:
        uncover(n, pixels, behind, shape, fits[0], prior.rim, work)
    return fits[0], False
