"""How a camera's targets differ from evenly bright discs under a Gaussian blur, learned from their residuals.

Blur, limb, skew and tails (``mosca.detection.disc_fit.disc_image``) are estimated together, since a bright rim looks
like a sharp edge and a dark limb like a blurred one. The normal equations of amplitude, background, radius and these
four are reduced to the last four. Their unknowns are the values themselves, not steps from those of the fit, so that
targets fitted before a profile was known count alike.
"""

import math
from typing import Any

import numpy as np

from mosca.data.arrays import Array
from mosca.detection.disc_fit.disc_image import (
    FAST,
    HALF,
    K1,
    ONE,
    REACH,
    TINY,
    ZERO,
    Profile,
    disc_image,
    f32,
    gaussian_edge,
    part_blur,
    profiled_parts_of,
    sums_divided,
)
from mosca.detection.disc_fit.ellipse import stretch_sums
from mosca.detection.disc_fit.gauss_newton import DiscFit, Model, Workspace
from mosca.detection.disc_fit.light_offset import PROFILE_SUMS
from mosca.numba_support.decorators import bare_step

COUNT, NORMAL, RIGHT, USED, VALUES = 0, 1, 11, 15, 16
"""Columns of a camera's sums: number of targets; upper triangle (10) and right side (4) of the normal equations of
blur, limb, skew and tails; sums over the profiles that targets were fitted with: how many values were not 0, and
these values (3)."""
CHANGES = 5
"""First of three rows of a fit's image: its change with limb, skew and tails."""
SPREADS = (0.05, 0.2, 0.05, 0.05)
"""Standard deviations from target to target of blur (as a share of it), limb, skew and tails, so that no single
target outweighs others."""
PRIOR_SIGMAS = (1.0, 0.3, 0.3)
"""Standard deviations of limb, skew and tails before any target is seen. With a limb of -1 the rim has a third of the
middle's light."""
CHANCE = 12.0
"""Least chi-square of each of limb, skew and tails: false-positive rate below 1 / 2,000."""
MORE, SETTLED = 0.1, 0.9
"""Least chi-square of a further value, as a share of what the ones before it explain, and the share of targets that
must have been fitted with those before: equations hold to first order, and show second orders of a limb as skew and
tails."""
LEAST = (0.1, 0.07, 0.07)
"""Least values that are used. Leaving out smaller ones costs about 1 % of the centre's variance, as much as the
beginning of their use moves targets that stand still."""
MOST = np.array([[-1.5, 1.5], [-0.35, 0.35], [-0.15, 0.25]])
"""Limits, within which the image of a disc has hardly a negative value."""
LEAST_EDGE, LEAST_RADIUS = 2.0, 3.0
"""Radii, in blurs, from which the form of an edge and a limb are estimated: in a smaller disc the edge is
everywhere."""
REMEMBERED = 100.0
"""Targets after which older ones are weighted down."""
NOT_ROUND = 12.0
"""Chi-square of an ellipse, over that of all pixels, from which a target is not round but smeared by motion."""


@bare_step(fastmath=FAST)
def add_change(
    n: int, pixels: Array, at: tuple[Any, Any], radius: Any, blur: Any, share: Any, limb: Any, image: Array
) -> None:
    """Add to rows of ``image`` the change of a disc with limb, skew and tails at n points, as ``add_edge`` does."""
    x, y, sharper = pixels[0], pixels[1], pixels[2]
    by_limb, by_skew, by_tails = image[CHANGES], image[CHANGES + 1], image[CHANGES + 2]
    rim, c1 = ONE + HALF * limb, f32(2) / radius
    c2 = HALF * c1 / radius
    for i in range(n):
        dx, dy, s = x[i] - at[0], y[i] - at[1], blur / sharper[i]
        far = math.sqrt(dx * dx + dy * dy + TINY) - radius
        t = min(max(far / s, -REACH), REACH)
        u, e, q = gaussian_edge(t)
        by_limb[i] += share * (e * (HALF + far * (c1 + c2 * far) + c2 * s * s) - s * q * (c1 + c2 * far))
        by_skew[i] += share * rim * (u - ONE) * q
        by_tails[i] += share * rim * t * (u - K1) * q


@bare_step(fastmath=FAST)
def profile_image(n: int, pixels: Array, fit: DiscFit, shape: tuple[float, float, float], image: Array) -> None:
    """Write the change of a fitted disc of brightness 1 with limb, skew and tails, at n pixels."""
    m = profiled_parts_of(fit.blur)
    blur = f32(part_blur(fit.blur, m))
    for i in range(n):
        image[CHANGES, i] = image[CHANGES + 1, i] = image[CHANGES + 2, i] = ZERO
    for j in range(m):
        for i in range(m):
            u, v = (i + 0.5) / m - 0.5, (j + 0.5) / m - 0.5
            at = (f32(fit.x - shape[0] * u - shape[1] * v), f32(fit.y - shape[1] * u - shape[2] * v))
            add_change(n, pixels, at, f32(fit.radius), blur, ONE / f32(m * m), f32(fit.profile.limb), image)


@bare_step(fastmath=FAST)
def change_sums(n: int, pixels: Array, fit: DiscFit, model: Model, row: Array, image: Array) -> Any:
    """Return the products of the change ``row`` with those by amplitude, background, radius and blur.

    Also return its products with the changes by limb, skew and tails, and with the residuals.
    """
    there, v = pixels[3], pixels[4]
    share, by_radius, by_blur = image[0], image[3], image[4]
    by_limb, by_skew, by_tails = image[CHANGES], image[CHANGES + 1], image[CHANGES + 2]
    a, b, dark, gain = f32(fit.amplitude), f32(fit.background), f32(model.dark_dn2), f32(model.gain_dn)
    k0 = k1 = k2 = k3 = k4 = k5 = k6 = k7 = ZERO
    for i in range(n):
        w = there[i] * a * row[i] / (dark + gain * a * share[i])
        k0 += w * share[i]
        k1 += w
        k2 += w * a * by_radius[i]
        k3 += w * a * by_blur[i]
        k4 += w * a * by_limb[i]
        k5 += w * a * by_skew[i]
        k6 += w * a * by_tails[i]
        k7 += w * (v[i] - b - a * share[i])
    return k0, k1, k2, k3, k4, k5, k6, k7


@bare_step(fastmath=FAST)
def add_profile(
    n: int,
    pixels: Array,
    fit: DiscFit,
    model: Model,
    shape: tuple[float, float, float],
    misfit: float,
    work: Workspace,
    tally: Array,
) -> None:
    """Add the equations of blur, limb, skew and tails from n pixels of a target's fit to its camera's ``tally``.

    ``pixels``, ``shape``: as in ``disc_image``; ``misfit``: chi-square a degree of freedom. Overwrites ``work``.
    """
    image, e = work.image, work.equations
    if fit.radius < LEAST_EDGE * fit.blur:
        return
    # pixels are divided as for a disc with a profile, whether the fit's had one or not
    profile = Profile(fit.profile.limb, fit.profile.skew, fit.profile.tails + 1e-6, 0.0, 0.0)
    disc_image(n, pixels, (f32(fit.x), f32(fit.y), f32(fit.radius), f32(fit.blur)), profile, shape, image)
    pp, pq, qq, p, q = stretch_sums(n, pixels, fit, model, image)
    if qq * p * p - f32(2) * pq * p * q + pp * q * q > f32(NOT_ROUND * max(misfit, 1.0)) * (pp * qq - pq * pq):
        return
    profile_image(n, pixels, fit, shape, image)
    at = (f32(fit.x), f32(fit.y), f32(fit.amplitude), f32(fit.background), f32(fit.radius), f32(fit.blur))
    _, h, c, _ = sums_divided(n, pixels, at, f32(model.dark_dn2), f32(model.gain_dn), image)
    k = 0
    for i in range(4):
        for j in range(i, 4):
            e[j, i] = h[k]
            k += 1
        e[i, 7] = c[i]
    for i in range(3):
        k0, k1, k2, k3, k4, k5, k6, k7 = change_sums(n, pixels, fit, model, image[CHANGES + i], image)
        row = e[4 + i]
        row[0], row[1], row[2], row[3], row[4], row[5], row[6], row[7] = k0, k1, k2, k3, k4, k5, k6, k7
    # amplitude, background and radius are eliminated
    for k in range(3):
        if not e[k, k] > 1e-9:
            return
        for i in range(k + 1, 7):
            part = e[i, k] / e[k, k]
            e[i, 7] -= part * e[k, 7]
            for j in range(k + 1, i + 1):
                e[i, j] -= part * e[j, k]
    told = (True, fit.radius > LEAST_RADIUS * fit.blur, True, True)
    known = (fit.blur, fit.profile.limb, fit.profile.skew, fit.profile.tails)
    for i in range(4):
        e[3 + i, 7] *= told[i]
        for j in range(i + 1):
            e[3 + i, 3 + j] *= told[i] * told[j]
            e[3 + j, 3 + i] = e[3 + i, 3 + j]
    for i in range(4):
        for j in range(4):
            e[3 + i, 7] += e[3 + i, 3 + j] * known[j]
    spreads = (SPREADS[0] * fit.blur, SPREADS[1], SPREADS[2], SPREADS[3])
    for i in range(3):
        tally[PROFILE_SUMS + VALUES + i] += known[1 + i]
    tally[PROFILE_SUMS + USED] += (known[1] != 0.0) + (known[2] != 0.0) + (known[3] != 0.0)
    add_widened(max(misfit, 1.0), spreads, e, tally)


@bare_step(fastmath=FAST)
def add_widened(misfit: float, spreads: tuple[float, float, float, float], e: Array, tally: Array) -> None:
    """Add normal equations to a tally, with the spread of targets in their covariance.

    In ``H x = r``, H is rows and columns 3 to 6 of ``e`` and r its column 7; variances are ``misfit / H``. The spread
    T of each unknown in turn widens them: ``H - h h' / (h_kk + misfit / T)`` is ``(misfit / H + T)^-1`` times misfit.
    """
    for k in range(4):
        own = e[3 + k, 3 + k]
        if not own > 0.0:
            continue
        part = 1.0 / (own + misfit / (spreads[k] * spreads[k]))
        for i in range(4):
            if i != k:
                e[3 + i, 7] -= part * e[3 + i, 3 + k] * e[3 + k, 7]
                for j in range(4):
                    if j != k:
                        e[3 + i, 3 + j] -= part * e[3 + i, 3 + k] * e[3 + k, 3 + j]
        less = 1.0 - part * own
        e[3 + k, 7] *= less
        for i in range(4):
            e[3 + k, 3 + i] *= less
            if i != k:
                e[3 + i, 3 + k] *= less
    tally[PROFILE_SUMS + COUNT] += 1.0
    k = PROFILE_SUMS + NORMAL
    for i in range(4):
        for j in range(i, 4):
            tally[k] += e[3 + i, 3 + j] / misfit
            k += 1
    for i in range(4):
        tally[PROFILE_SUMS + RIGHT + i] += e[3 + i, 7] / misfit


def weights_of_older(kept: Array, added: Array) -> Array:
    """Return the weights (n,) of sums (n, VALUES + 3) of earlier targets when those of others are added.

    A target's equations hold for values near those of its fit, so those of fits with another profile count less.
    """
    weights = np.ones(len(kept))
    for k, (old, new) in enumerate(zip(kept.tolist(), added.tolist(), strict=True)):
        if old[COUNT] > 0 and new[COUNT] > 0:
            many, more = max(old[COUNT], 1.0), max(new[COUNT], 1.0)
            values = zip(old[VALUES:], new[VALUES:], SPREADS[1:], strict=True)
            away = [(before / many - now / more) / spread for before, now, spread in values]
            weights[k] = min(1.0, REMEMBERED / many) / (1.0 + sum(part * part for part in away))
    return weights


def solve_profiles(sums: Array, blurs: Array) -> tuple[Array, Array]:
    """Return profiles (n, 3) of cameras from their sums (n, VALUES + 3), and their blurs (n,) [px].

    ``blurs``: those of even discs, which are returned where nothing is significant.
    """
    out, blurs = np.zeros((len(sums), 3)), blurs.copy()
    for k in np.flatnonzero(sums[:, COUNT] > 0):
        found = _selected(sums[k].tolist())
        if len(found) > 1:
            blurs[k] = found.pop(0)
            for other, value in found.items():
                out[k, other - 1] = np.clip(value, *MOST[other - 1])
    return out, blurs


def _selected(sums: list[float]) -> dict[int, float]:
    """Return the values of blur (0) and of those of limb, skew and tails (1, 2, 3) that are significant beside it.

    Forward selection by Gauss-Jordan elimination: the rest of a row is the equation of a further unknown.
    """
    ridge, upper = (1e-9, *(1.0 / sigma**2 for sigma in PRIOR_SIGMAS)), iter(sums[NORMAL:RIGHT])
    h = [[0.0] * 4 + [right] for right in sums[RIGHT:USED]]
    for i in range(4):
        for j in range(i, 4):
            h[i][j] = h[j][i] = next(upper)
        h[i][i] += ridge[i]
    used, explained = [0], 0.0
    most = min(1 + int(sums[USED] / sums[COUNT] + 1.0 - SETTLED), 3)
    while True:
        pivot = h[used[-1]]
        for i in range(4):
            part = h[i][used[-1]] / pivot[used[-1]] if i != used[-1] else 0.0
            h[i] = [one - part * other for one, other in zip(h[i], pivot, strict=True)]
        tried = [
            (h[i][4] ** 2 / h[i][i], i)
            for i in range(1, 4)
            if i not in used and abs(h[i][4]) > LEAST[i - 1] * h[i][i]
        ]
        chi2, best = max(tried, default=(0.0, 0))
        if len(used) > most or chi2 < max(CHANCE, MORE * explained):
            return {i: h[i][4] / h[i][i] for i in used}
        used, explained = [*used, best], explained + chi2
