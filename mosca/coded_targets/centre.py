"""Centres of the dots of coded targets: an ellipse fitted by least squares to the pixels of dot and plate.

The light of a pixel is ``P + (Q - P) s``. s is the share of it that the blurred ellipse covers; P, the light of the
plate, is a plane in the dot's coordinates, and so is Q, that of the dot. The brighter of the two has curvatures
besides, since the edge of a shadow may cross it. Each pixel is divided into ``PARTS`` x ``PARTS``, in which the edge
is straight. Saturated pixels show only that the light is above.

All light that is uneven shifts a centroid, in all cameras alike: by 0.1 px where a shadow's edge crosses a dot of 9
px. It hardly shifts an edge, since an even change of the light over the dot does not look like a shift of the dot,
unless the dot is blurred to its middle, or saturated there. Slopes have an a-priori variance. It is learned from all
dots of the image (Paule and Mandel 1982), and taken larger where in doubt: see ``WIDER``.

Weights are those of ``mosca.coded_targets.pixel_noise``. Residuals correct their scale: for all dots of an image
together by the median, for a dot that fits much worse by its own.
"""

import math

import numpy as np

from mosca.coded_targets.decode import Readings
from mosca.coded_targets.dots import AXX, AXY, AYY, CONTRAST_DN, PLATE_DN, TargetAppearance, X, Y
from mosca.coded_targets.pixel_noise import GreyValueNoise
from mosca.data.arrays import Array, looked_at
from mosca.data.distributions import chi2
from mosca.detection.local_background import ROUNDING_DN2
from mosca.numba_support.copying import copy_row, copy_rows
from mosca.numba_support.decorators import kernel, step

PLACE, SLOPES, LEVELS, BENDS, SHAPE, BLUR = 0, 2, 6, 8, 11, 14
"""Where unknowns begin: the centre [px]; slopes of plate and dot along u, v [DN per radius]; their levels [DN];
curvatures of the brighter one along uu, uv, vv; the frame's AXX, AXY, AYY [px]; blur besides that of pixels [px]."""
UNKNOWNS = 15
PARTS = 4
"""Parts of a pixel's side."""
LEAST_BLUR_PX = 0.25 / math.sqrt(12.0)
"""Blur of such a part."""
USUAL_BLUR_PX = 0.5
"""First guess of the blur, and its standard deviation, since small dots hardly determine their blur. With half or
twice as much errors are the same within 1 %."""
ANY_LIGHT = 1.0
"""Standard deviation of slopes and curvatures over the contrast: light that doubles within a radius."""
WIDER, DOUBT = 2.0, 0.01
"""The a-priori standard deviation of slopes over that of the image's slopes; for the latter the largest value is
taken that has the second number as its chance. Drawing slopes to zero causes an error that cameras share, and that no
covariance includes. Of the points of 12 rendered fields 87, 96 and 97 % are within 95 % at 1, 2 and 4; small dots in
even light have 3.0, 3.5, 4.1 mpx."""
HALVINGS = 40
"""Number of halvings of the interval in which a variance is searched for: to its last digit."""
END_PX, END_SHARE = 4.0, 0.6
"""The plate is looked at up to this distance from the dot [px], at most this share of the way to the ring."""
STEPS_MOST, CLOSE_PX, ENOUGH_PX, FARTHEST = 25, 3e-4, 1e-2, 0.5
"""Largest number of steps; step length at convergence, and at which an end is accepted; largest shift in radii."""
DAMPING, CALMER, WILDER = 1e-3, 0.2, 10.0
"""In the method of Levenberg and Marquardt: first damping, factors after a better and a worse step."""
REACH = 4.0
"""Distance from the edge, in blurs, where its blur ends."""
MISFIT = 1e-3
"""Chance with which a dot that fits is given its own scale of residuals."""


def measure_dots(
    image: Array,
    dots: Readings,
    target: TargetAppearance,
    noise: GreyValueNoise,
    full_dn: float,
    turned: bool = False,
) -> tuple[Array, Array, Array]:
    """Return centres (n, 2) [px], covariances (n, 2, 2) [px^2] and frames (n, FRAME) of ``dots``.

    A centre that was not found is NaN; its frame is the one from which it was searched for.

    ``image`` (H, W) shows the dots white; ``turned``: it is ``full_dn``, the grey value of saturated pixels, less the
    image as it was taken, and its brightest pixels are those of the plate. ``noise``: of the image as it was taken.
    """
    image, n = looked_at(image), len(dots)
    plate, contrast = dots.levels[:, PLATE_DN], dots.levels[:, CONTRAST_DN]
    taken, gain = (full_dn - plate, -noise.gain_dn) if turned else (plate, noise.gain_dn)
    dark = np.maximum(noise.variance_dn2 + noise.gain_dn * (taken - noise.level_dn), ROUNDING_DN2)
    found, normal, squares = np.empty((n, UNKNOWNS)), np.empty((n, UNKNOWNS, UNKNOWNS)), np.empty((n, 2))
    light = np.column_stack([plate, contrast, dark])
    fit_ellipses(image, dots.frames, light, gain, target.ring_inner, full_dn, turned, found, normal, squares)
    xy, covariance, frames = np.full((n, 2), np.nan), np.full((n, 2, 2), np.nan), dots.frames.copy()
    good = np.flatnonzero(np.isfinite(squares).all(axis=1))
    if not len(good):
        return xy, covariance, frames
    scale = np.sqrt(np.diagonal(normal[good], axis1=1, axis2=2))
    free = np.linalg.inv(normal[good] / scale[:, :, None] / scale[:, None, :])[:, :LEVELS, :LEVELS]
    free = free / scale[:, :LEVELS, None] / scale[:, None, :LEVELS] * _scales(*squares[good].T)[:, None, None]
    xy[good], covariance[good] = _with_likely_slopes(found[good, :LEVELS], free, contrast[good])
    frames[good, AXX], frames[good, AXY], frames[good, AYY] = found[good, SHAPE : SHAPE + 3].T
    return xy, covariance, frames


def _scales(squares: Array, pixels: Array) -> Array:
    """Return the ratio (n,) of the variance of each dot's pixels to the variance that was assumed.

    It is computed from their weighted ``squares`` (n,) and the number of ``pixels`` (n,).
    """
    redundancy = np.maximum(pixels - UNKNOWNS, 1)
    own = squares / redundancy
    together = float(np.median(own))
    return np.where(own > together * chi2.isf(MISFIT, redundancy) / redundancy, own, together)


def _with_likely_slopes(found: Array, covariance: Array, contrast: Array) -> tuple[Array, Array]:
    """Return centres (n, 2) and covariances (n, 2, 2), given how uneven light falls on the dots of the image.

    ``found`` (n, LEVELS) and ``covariance``: of centres and slopes, fitted without a prior on the slopes.
    """
    expected = np.zeros((len(found), LEVELS - SLOPES))
    for side in (slice(SLOPES, SLOPES + 2), slice(SLOPES + 2, LEVELS)):
        relative = covariance[:, side, side] / contrast[:, None, None] ** 2
        variance = WIDER**2 * _variance_between(found[:, side] / contrast[:, None], relative)
        expected[:, side.start - SLOPES : side.stop - SLOPES] = variance * contrast[:, None] ** 2
    total = covariance[:, SLOPES:, SLOPES:] + expected[:, :, None] * np.eye(LEVELS - SLOPES)
    pull = np.swapaxes(np.linalg.solve(total, covariance[:, SLOPES:, :SLOPES]), 1, 2)
    xy = found[:, :SLOPES] - np.einsum("nij,nj->ni", pull, found[:, SLOPES:])
    return xy, covariance[:, :SLOPES, :SLOPES] - pull @ covariance[:, SLOPES:, :SLOPES]


def _variance_between(values: Array, covariance: Array) -> float:
    """Return the variance of pairs of mean 0 whose measured ``values`` (n, 2) have errors of ``covariance``.

    It is the largest with which values as small as these have a chance of ``DOUBT``.
    """
    own, axes = np.linalg.eigh(covariance)
    squares = np.einsum("nji,nj->ni", axes, values) ** 2
    low, high = 0.0, ANY_LIGHT**2
    least = chi2.isf(1.0 - DOUBT, squares.size) / squares.size
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if np.mean(squares / (own + middle)) > least else (low, middle)
    return high


@step
def covered_share(dx: float, dy: float, inverse: tuple[float, float, float], blur: float, slopes: Array) -> float:
    """Return the share of a pixel that a blurred ellipse covers, (dx, dy) [px] away from its centre.

    ``inverse`` (xx, xy, yy) maps pixels to radii. Writes the change with x, y, AXX, AXY, AYY and blur to ``slopes``.
    """
    ixx, ixy, iyy = inverse
    slopes[:] = 0.0
    u, v = ixx * dx + ixy * dy, ixy * dx + iyy * dy
    radius = math.hypot(u, v)
    steep = math.hypot(u * ixx + v * ixy, u * ixy + v * iyy)
    room = REACH * blur + 0.75  # a pixel's corner is 0.71 px from its middle
    if radius * steep == 0.0 or (1.0 - radius) * radius > room * steep:
        return 1.0
    if (1.0 - radius) * radius < -room * steep:
        return 0.0
    share, each = 0.0, 1.0 / (PARTS * PARTS)
    for i in range(PARTS):
        for k in range(PARTS):
            ex, ey = dx + (i + 0.5) / PARTS - 0.5, dy + (k + 0.5) / PARTS - 0.5
            u, v = ixx * ex + ixy * ey, ixy * ex + iyy * ey
            radius = max(math.hypot(u, v), 1e-9)
            nx, ny = u * ixx + v * ixy, u * ixy + v * iyy
            steep = max(math.hypot(nx, ny), 1e-9)
            # distance from the edge to first order: (1 - radius) over the gradient of the radius
            t = (1.0 - radius) * radius / steep / blur
            if t > REACH:
                share += each
            if abs(t) > REACH:
                continue
            share += each * 0.5 * math.erfc(-t / math.sqrt(2.0))
            density = each * math.exp(-0.5 * t * t) / math.sqrt(2.0 * math.pi) / blur
            nx, ny, u, v = density * nx / steep, density * ny / steep, u / radius, v / radius
            slopes[0] += nx
            slopes[1] += ny
            slopes[2] += nx * u
            slopes[3] += nx * v + ny * u
            slopes[4] += ny * v
            slopes[5] -= density * t
    return share


@step
def observe_pixel(
    place: tuple[float, float],
    at: tuple[float, float],
    turned: bool,
    inverse: tuple[float, float, float],
    p: Array,
    edge: Array,
    slopes: Array,
) -> float:
    """Return the light of the pixel at ``place`` with unknowns ``p``; write its change with them to ``slopes``.

    ``at``: its coordinates in the first frame, in which slopes and curvatures are taken; ``edge`` (6,): work.
    """
    u, v = at
    share = covered_share(place[0] - p[PLACE], place[1] - p[PLACE + 1], inverse, p[BLUR], edge)
    bright = 1.0 - share if turned else share
    plate = p[LEVELS] + p[SLOPES] * u + p[SLOPES + 1] * v
    dot = p[LEVELS + 1] + p[SLOPES + 2] * u + p[SLOPES + 3] * v
    bend = p[BENDS] * u * u + p[BENDS + 1] * u * v + p[BENDS + 2] * v * v
    apart = dot - plate + (-bend if turned else bend)
    slopes[LEVELS], slopes[LEVELS + 1] = 1.0 - share, share
    slopes[SLOPES], slopes[SLOPES + 1] = (1.0 - share) * u, (1.0 - share) * v
    slopes[SLOPES + 2], slopes[SLOPES + 3] = share * u, share * v
    slopes[BENDS], slopes[BENDS + 1], slopes[BENDS + 2] = bright * u * u, bright * u * v, bright * v * v
    slopes[PLACE], slopes[PLACE + 1] = apart * edge[0], apart * edge[1]
    for i in range(4):
        slopes[SHAPE + i] = apart * edge[2 + i]
    light: float = plate + (dot - plate) * share + bend * bright
    return light


@step
def add_pixels(
    image: Array,
    frame: Array,
    light: Array,
    gain: float,
    ring_inner: float,
    full_dn: float,
    turned: bool,
    p: Array,
    normal: Array,
    pull: Array,
) -> tuple[float, float]:
    """Add the normal equations of a dot's pixels to ``normal`` and ``pull``; return weighted squares and pixels.

    ``light``: plate and contrast [DN], variance of a pixel of the plate [DN^2].
    """
    plate, contrast, dark = light
    det = frame[AXX] * frame[AYY] - frame[AXY] ** 2
    fxx, fxy, fyy = frame[AYY] / det, -frame[AXY] / det, frame[AXX] / det
    det = p[SHAPE] * p[SHAPE + 2] - p[SHAPE + 1] ** 2
    inverse = (p[SHAPE + 2] / det, -p[SHAPE + 1] / det, p[SHAPE] / det)
    end, spread = 1.0 + END_SHARE * (ring_inner - 1.0), math.sqrt(2.0 * (p[BLUR] ** 2 + 1.0 / 12.0))
    half_x, half_y = end * math.hypot(frame[AXX], frame[AXY]), end * math.hypot(frame[AXY], frame[AYY])
    left, right = max(int(frame[X] - half_x), 0), min(int(frame[X] + half_x) + 1, image.shape[1] - 1)
    squares, pixels = 0.0, 0.0
    edge, slopes = np.empty(6), np.empty(UNKNOWNS)
    for row in range(max(int(frame[Y] - half_y), 0), min(int(frame[Y] + half_y) + 1, image.shape[0] - 1) + 1):
        for column in range(left, right + 1):
            dx, dy = column - frame[X], row - frame[Y]
            u, v = fxx * dx + fxy * dy, fxy * dx + fyy * dy
            radius = math.hypot(u, v)
            steep = max(math.hypot(u * fxx + v * fxy, u * fxy + v * fyy), 1e-9)
            if radius >= end or (radius - 1.0) * radius > END_PX * steep:
                continue
            value = float(image[row, column])
            model = observe_pixel((float(column), float(row)), (u, v), turned, inverse, p, edge, slopes)
            if (value >= full_dn and model > value) or (value <= 0.0 and model < 0.0):
                continue
            # light that may come from the ring counts as noise
            near = 0.25 * contrast * math.erfc((ring_inner - radius) * radius / steep / spread)
            weight = 1.0 / (max(dark + gain * (model - plate), ROUNDING_DN2) + near * near)
            weighted = weight * (value - model)
            for i in range(UNKNOWNS):
                if slopes[i] == 0.0:  # most are, away from the edge
                    continue
                pull[i] += weighted * slopes[i]
                for k in range(i + 1):
                    normal[i, k] += weight * slopes[i] * slopes[k]
            squares += weighted * (value - model)
            pixels += 1.0
    return squares, pixels


@step
def solved(normal: Array, damping: float, b: Array) -> bool:
    """Solve the damped normal equations, lower triangle, for ``b``; False where they are singular."""
    factor = normal.copy()
    for j in range(UNKNOWNS):
        own = normal[j, j] * (1.0 + damping)
        for k in range(j):
            own -= factor[j, k] ** 2
        if not own > 1e-12 * normal[j, j]:
            return False
        factor[j, j] = math.sqrt(own)
        for i in range(j + 1, UNKNOWNS):
            for k in range(j):
                factor[i, j] -= factor[i, k] * factor[j, k]
            factor[i, j] /= factor[j, j]
    for i in range(UNKNOWNS):
        for k in range(i):
            b[i] -= factor[i, k] * b[k]
        b[i] /= factor[i, i]
    for i in range(UNKNOWNS - 1, -1, -1):
        for k in range(i + 1, UNKNOWNS):
            b[i] -= factor[k, i] * b[k]
        b[i] /= factor[i, i]
    return True


@step
def first_guess(frame: Array, plate_dn: float, contrast_dn: float) -> tuple[Array, Array]:
    """Return unknowns to start from, and their a-priori weights, both (UNKNOWNS,)."""
    start, prior = np.zeros(UNKNOWNS), np.zeros(UNKNOWNS)
    start[PLACE], start[PLACE + 1] = frame[X], frame[Y]
    start[SHAPE], start[SHAPE + 1], start[SHAPE + 2] = frame[AXX], frame[AXY], frame[AYY]
    start[LEVELS], start[LEVELS + 1], start[BLUR] = plate_dn, plate_dn + contrast_dn, USUAL_BLUR_PX
    prior[SLOPES:LEVELS] = prior[BENDS:SHAPE] = 1.0 / (ANY_LIGHT * contrast_dn) ** 2
    prior[BLUR] = 1.0 / USUAL_BLUR_PX**2
    return start, prior


@kernel
def fit_ellipses(
    image: Array,
    frames: Array,
    light: Array,
    gain: float,
    ring_inner: float,
    full_dn: float,
    turned: bool,
    found: Array,
    normals: Array,
    squares: Array,
) -> None:
    """Fit the ellipses of dots ``frames`` (n, FRAME) by Levenberg's and Marquardt's method.

    ``light`` (n, 3): see ``add_pixels``. Writes unknowns to ``found`` (n, UNKNOWNS), normal equations to ``normals``
    (n, UNKNOWNS, UNKNOWNS), weighted squares and number of pixels to ``squares`` (n, 2), NaN without a solution.
    """
    normal, pull, kept_pull = np.empty((UNKNOWNS, UNKNOWNS)), np.empty(UNKNOWNS), np.zeros(UNKNOWNS)
    for n in range(len(frames)):
        frame, best, damping, move = frames[n], math.inf, DAMPING, math.inf
        start, prior = first_guess(frame, light[n, 0], light[n, 1])
        p, squares[n] = start.copy(), math.nan
        for _ in range(STEPS_MOST):
            normal[:] = 0.0
            copy_row(prior * (start - p), pull)
            own, pixels = add_pixels(image, frame, light[n], gain, ring_inner, full_dn, turned, p, normal, pull)
            cost = own + np.sum(prior * (start - p) ** 2)
            if cost < best:
                best, damping = cost, damping * CALMER
                for i in range(UNKNOWNS):
                    normal[i, i] += prior[i]
                    for k in range(i):
                        normal[k, i] = normal[i, k]
                copy_row(p, found[n])
                copy_rows(normal, normals[n])
                copy_row(pull, kept_pull)
                squares[n, 0], squares[n, 1] = own, pixels
            else:
                damping = max(damping * WILDER, DAMPING)
            if move < CLOSE_PX:
                break
            copy_row(kept_pull, pull)
            if not (best < math.inf and solved(normals[n], damping, pull)):
                move = math.inf
                break
            copy_row(found[n] + pull, p)
            p[BLUR] = max(p[BLUR], LEAST_BLUR_PX)
            move = math.hypot(pull[PLACE], pull[PLACE + 1])
            if not p[SHAPE] * p[SHAPE + 2] > p[SHAPE + 1] ** 2:
                move = math.inf
                break
        det = frame[AXX] * frame[AYY] - frame[AXY] ** 2
        dx, dy = found[n, PLACE] - frame[X], found[n, PLACE + 1] - frame[Y]
        away = math.hypot(frame[AYY] * dx - frame[AXY] * dy, frame[AXX] * dy - frame[AXY] * dx) / det
        if not (move < ENOUGH_PX and away <= FARTHEST):
            squares[n] = math.nan
