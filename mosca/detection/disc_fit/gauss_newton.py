"""Compiled fit of a blurred disc to pixels: the steps.

The model, the noise and the source: ``mosca.detection.disc_fit.camera_statistics``. Compiled into the
kernel in ``mosca.detection.disc_fit.fit_regions``.
"""

import math
from typing import Any, NamedTuple

from mosca.data.arrays import Array
from mosca.detection.disc_fit.disc_image import (
    EVEN,
    FAST,
    Profile,
    cross_sums_divided,
    cross_sums_whole,
    disc_image,
    f32,
    parts_of,
    sums_divided,
    sums_whole,
)  # fmt: skip
from mosca.detection.disc_fit.solve_step import factor_all, solve_all, solve_shape
from mosca.numba_support.decorators import bare_step

MOST_STEPS = 20
HELD_FROM = 8
"""Steps after which the blur of a disc with a profile no longer changes how pixels are divided: the fit could
alternate between two divisions and never settle."""
BACK = 0.3
"""A step that takes back more than this share of the last one is halved."""
CENTRE_RADII, CENTRE_PX = 0.5, 0.3
"""Longest step of the centre: this share of the radius and so many pixels."""
LIGHT_LEFT = 0.4
"""Least share of its amplitude that a step leaves a disc."""
SMALLER, LARGER, SMALLEST = 0.6, 1.6, 0.2
"""Least share of its radius that a step leaves a disc; largest share, to which a blur is added; least radius in
blurs."""
SHARPER, SOFTER = 0.75, 1.3
"""Share of its blur that a step leaves a disc, at least and at most."""
CLOSE_2 = 0.03
"""As ``SETTLED_2`` where pixels are divided: there the error that remains is of first order in the last step."""
LEAST_BLUR, MOST_BLUR = 0.29, 6.0
"""Limits of the blur of a fit [px]. A pixel alone, which averages over all of its area, has 1 / sqrt(12) = 0.29."""
HELD = 1e9
"""Information [px^-2] of a blur that is held."""
NEAR_START = 0.1
"""Standard deviation of the amplitude of a disc about its first value, as a share, where a side is missing."""
NEAR, NEAR_LIGHT, NEAR_2, SETTLED_2 = 0.1, 0.05, 4.0, 1.0
"""Convergence. The fit ends after one step where that moves the centre by at most ``sqrt(NEAR_2)`` standard
deviations, radius and blur by at most ``NEAR`` of the blur, and the amplitude by at most ``NEAR_LIGHT`` of itself;
with twice these limits the centre's errors grow by 2 %. Else it ends once a step moves the centre by less than
``sqrt(SETTLED_2)`` standard deviations; the remaining error is of second order in that step."""


class Model(NamedTuple):
    """What the fit takes as given, in grey values [DN] and pixels. Pixels from ``full_dn`` on are saturated."""

    dark_dn2: float
    gain_dn: float
    full_dn: float


class DiscFit(NamedTuple):
    """A fitted disc, in [px] and [DN]; offsets are those of its pixels."""

    x: float
    y: float
    amplitude: float
    background: float
    radius: float
    blur: float
    covariance: tuple[float, float, float]
    """(xx, xy, yy) of the centre [px^2]."""
    chi2: float
    blur_variance: float
    """Variance of the blur, from the data alone [px^2]."""
    radius_variance: float
    """Variance of the radius [px^2]."""
    own_amplitude: tuple[float, float]
    """Amplitude [DN] from the data alone, and its variance [DN^2]; infinite where it was not computed."""
    profile: Profile
    """The profile with which it was fitted."""
    converged: bool


class DiscPrior(NamedTuple):
    """Prior of a disc from others of its camera: means and standard deviations."""

    blur: float
    """[px]."""
    blur_sigma: float
    amplitude: float
    """[DN], of targets that are neither crowded nor saturated."""
    amplitude_sigma: float
    """Infinite where nothing is known."""
    rim: float
    """Radius within which a target hides its background, over that of its light."""
    profile: Profile


class Workspace(NamedTuple):
    """Working memory of a fit."""

    image: Array
    """(12, most pixels) float32: of ``disc_image``, and seven rows for ``mosca.detection.disc_fit.asymmetry`` and
    ``residual_noise``."""
    equations: Array
    """(7, 8), see ``factor_all``, ``mosca.detection.disc_fit.profile``."""


@bare_step(fastmath=FAST)
def first_fit(first: tuple[float, float, float, float, float], prior: DiscPrior) -> DiscFit:
    """Return the disc x, y, amplitude, background, radius from which a fit starts, with the blur of its prior."""
    x, y, amplitude, background, radius = first
    none, own = (0.0, 0.0, 0.0), (0.0, math.inf)
    return DiscFit(
        x, y, amplitude, background, radius, prior.blur, none, 0.0, math.inf, math.inf, own, prior.profile, False
    )  # fmt: skip


@bare_step(fastmath=FAST)
def amplitude_prior(start: float, saturated: bool, blur: float, prior: DiscPrior) -> tuple[float, float]:
    """Return mean [DN] and information [DN^-2] of the amplitude where all unknowns are solved for at once.

    ``start``: the first value, from the brightest pixel.
    """
    if saturated:
        return start, 1.0 / (start * start)  # a saturated pixel shows only that the peak is higher
    if parts_of(blur) == 1:
        return start, 1.0 / (NEAR_START * start) ** 2
    # where no pixel lies inside a small sharp target, its brightest pixel is no measure
    if prior.amplitude_sigma < prior.amplitude:
        return prior.amplitude, 1.0 / (prior.amplitude_sigma * prior.amplitude_sigma)
    return start, 1.0 / (start * start)


class DiscStep(NamedTuple):
    """One Gauss-Newton step."""

    x: float
    y: float
    amplitude: float
    background: float
    radius: float
    blur: float
    covariance: tuple[float, float, float]
    """(xx, xy, yy) of the centre [px^2]."""
    moved: float
    """Squared length of the centre's step over its error."""
    chi2: float
    """After the step, to first order."""
    blur_variance: float
    radius_variance: float
    own_amplitude: tuple[float, float]
    solved: bool


@bare_step(fastmath=FAST)
def step_of(
    n: int,
    pixels: Array,
    at: tuple[float, float, float, float, float, float],
    first: tuple[Any, ...],
    prior: DiscPrior,
    model: Model,
    symmetric: bool,
    shape: tuple[float, float, float],
    work: Workspace,
) -> DiscStep:
    """Return the next step from ``at`` (x0, y0, amplitude, background, radius, blur); the rest as in ``fit_disc``."""
    x0, y0, a, b, radius, s = at
    information, off = 1.0 / (prior.blur_sigma * prior.blur_sigma), prior.blur - s
    dark, gain = f32(model.dark_dn2), f32(model.gain_dn)
    at32 = (f32(x0), f32(y0), f32(a), f32(b), f32(radius), f32(s))
    whole = parts_of(s) == 1
    even = whole and prior.profile == EVEN
    if even:
        place, h, c, chi2 = sums_whole(n, pixels, at32, dark, gain, work.image)
    else:
        disc_image(n, pixels, (at32[0], at32[1], at32[4], at32[5]), prior.profile, shape, work.image)
        place, h, c, chi2 = sums_divided(n, pixels, at32, dark, gain, work.image)
    px, py = float(place[3]), float(place[4])
    own, own_variance = 0.0, math.inf
    if symmetric and whole:
        hxx, hxy, hyy = float(place[0]), float(place[1]), float(place[2])
        det = hxx * hyy - hxy * hxy
        cxx, cxy, cyy = hyy / det, -hxy / det, hxx / det
        da, db, dr, ds, blur_variance, radius_variance, sign = solve_shape(
            (
                float(h[0]), float(h[1]), float(h[2]), float(h[3]), float(h[4]),
                float(h[5]), float(h[6]), float(h[7]), float(h[8]), float(h[9]),
            ),
            (float(c[0]), float(c[1]), float(c[2]), float(c[3])), information, off,
        )  # fmt: skip
        solved = sign > 0.0 and det > 1e-9 * hxx * hyy
        dx, dy = cxx * px + cxy * py, cxy * px + cyy * py
    else:
        usual, known = amplitude_prior(first[2], first[2] + first[3] >= model.full_dn, s, prior)
        if even:
            cross = cross_sums_whole(n, pixels, at32, dark, gain, work.image)
        else:
            cross = cross_sums_divided(n, pixels, at32, dark, gain, work.image)
        solved = factor_all(place, h, cross, c, (information, off), (known, usual - a), work.equations)
        dx, dy, da, db, dr, ds, cxx, cxy, cyy, blur_variance, variance, radius_variance = solve_all(
            work.equations, information
        )
        if s + ds < LEAST_BLUR:
            # solve for the others as if the blur stayed at its limit
            solved &= factor_all(place, h, cross, c, (HELD, LEAST_BLUR - s), (known, usual - a), work.equations)
            dx, dy, da, db, dr, ds, cxx, cxy, cyy, _, variance, radius_variance = solve_all(work.equations, HELD)
        own_variance = 1.0 / max(1.0 / variance - known, 1e-12)
        own = ((a + da) / variance - usual * known) * own_variance
    moved = (cyy * dx * dx - 2.0 * cxy * dx * dy + cxx * dy * dy) / (cxx * cyy - cxy * cxy)
    gained = da * float(c[0]) + db * float(c[1]) + dr * float(c[2]) + ds * float(c[3])
    return DiscStep(
        dx, dy, da, db, dr, ds, (cxx, cxy, cyy), moved, chi2 - dx * px - dy * py - gained, blur_variance,
        radius_variance, (own, own_variance), solved,
    )  # fmt: skip


@bare_step(fastmath=FAST)
def is_settled(turn: int, step: DiscStep, taken: float, before: tuple[float, float], now: float) -> bool:
    """Return whether the fit ends after step number ``turn``, of which the share ``taken`` was taken.

    ``before``: amplitude and blur before that step; ``now``: blur after it.
    """
    amplitude, blur = before
    if parts_of(now) > 1:
        return turn > 0 and step.moved < CLOSE_2 and taken * abs(step.radius) < NEAR * now
    share = abs(step.amplitude) / amplitude
    calm = abs(step.radius) < 0.25 * blur and share < 0.25
    near = max(abs(step.radius), abs(step.blur)) < NEAR * blur and share < NEAR_LIGHT and step.moved < NEAR_2
    result: bool = calm and (near or (turn > 0 and step.moved < SETTLED_2))
    return result


@bare_step(fastmath=FAST)
def fit_disc(
    n: int,
    pixels: Array,
    first: tuple[Any, ...],
    prior: DiscPrior,
    model: Model,
    symmetric: bool,
    shape: tuple[float, float, float],
    work: Workspace,
) -> DiscFit:
    """Fit a blurred disc to n pixels by Gauss-Newton steps until the centre moves by less than its error.

    Parameters
    ----------
    n, pixels, shape
        The pixels as in ``disc_image``.
    first
        x0, y0, amplitude, background, radius to start from.
    prior
        What is known from other targets.
    model
        Pixel noise and saturation.
    symmetric
        Whether the pixels lie all around the target, so that the centre can be solved separately. Where pixels are
        divided it is not: coarse pixels correlate a centre with size and brightness.
    work
        Working memory.
    """
    x0, y0, a, b, radius = first
    s = prior.blur
    covariance, own, chi2 = (0.0, 0.0, 0.0), (0.0, math.inf), 0.0
    blur_variance = radius_variance = math.inf
    good = False
    last = (0.0, 0.0, 0.0)
    for turn in range(MOST_STEPS):
        step = step_of(n, pixels, (x0, y0, a, b, radius, s), first, prior, model, symmetric, shape, work)
        if not step.solved:
            break
        covariance, own, chi2 = step.covariance, step.own_amplitude, step.chi2
        blur_variance, radius_variance = step.blur_variance, step.radius_variance
        far, most = max(abs(step.x), abs(step.y)), CENTRE_RADII * radius + CENTRE_PX
        hold, share = min(1.0, most / far) if far > most else 1.0, 1.0
        if parts_of(s) > 1:
            # brightness, radius and place of a small target are correlated: whole steps overshoot to and fro
            back = step.x * last[0] + step.y * last[1] < -BACK * (last[0] * last[0] + last[1] * last[1])
            if back or step.amplitude * last[2] < -BACK * last[2] * last[2]:
                hold, share = 0.5 * hold, 0.5
            last = (hold * step.x, hold * step.y, share * step.amplitude)
        before = (a, s)
        x0 += hold * step.x
        y0 += hold * step.y
        a = max(a + share * step.amplitude, LIGHT_LEFT * a)
        b += share * step.background
        radius = min(max(radius + share * step.radius, SMALLER * radius, SMALLEST * s), LARGER * radius + s)
        next_s = min(max(s + share * step.blur, SHARPER * s, LEAST_BLUR), SOFTER * s, MOST_BLUR)
        if turn < HELD_FROM or prior.profile == EVEN or parts_of(next_s) == parts_of(s):
            s = next_s
        good = is_settled(turn, step, share, before, s)
        if good:
            break
    return DiscFit(
        x0, y0, a, b, radius, s, covariance, chi2, blur_variance, radius_variance, own, prior.profile, good
    )  # fmt: skip
