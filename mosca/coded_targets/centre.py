"""Centres of the dots of coded targets: the centroid within a soft window that is centred on it.

A mask of whole pixels truncates the blurred edge unevenly and biases a centroid by 0.005 to 0.02 px. The window here
is smooth, elliptic as the dot, and centred on the centre c itself, so that its truncation is symmetric::

    sum_p w(p - c) (I(p) - b(p)) / a(p) (p - c) = 0

with b the light of the plate and a what white adds to it. Where the window is flat this is the plain centroid of the
share e = (I - b) / a of each pixel that is white; Newton's method finds c, with ``J = sum e (w 1 + d grad w^T)``,
d = p - c. Well within the dot e is known to be 1: these pixels tell the level and slopes of a, so that the edge of a
shadow across the dot, or noise within it, hardly moves its centre. Noise of pixels at the edge and of a goes through
at first order: ``C = J^-1 (sum w^2 var(e) d d^T + M cov(a) M^T) J^-T``, M the slopes of the sum by the coefficients
of a, with the noise of ``mosca.coded_targets.pixel_noise``. The covariance is the random error, to a third. What
remains besides, measured on rendered targets at blurs of 0.4 to 0.9 px, is below 0.002 px rms where the dot's shorter
axis is 7 px or more, 0.004 px from 5 px on, and up to 0.009 px below; nonlinear shadows come on top.

A brightness gradient across a plate, from a near lamp or vignetting, biases a centroid too. It is estimated on plate
and ring where these are wide enough, and corrected; vignetting of 30 % in the image's corners leaves up to 0.006 px,
and 0.01 to 0.02 px for large dots tilted by 60 deg.
"""

import math

import numpy as np

from mosca.coded_targets.decode import Readings
from mosca.coded_targets.dots import (
    AXX,
    AXY,
    AYY,
    CONTRAST_DN,
    PLATE_DN,
    SLOPE_U,
    SLOPE_V,
    TargetAppearance,
    X,
    Y,
    light_at,
)
from mosca.coded_targets.pixel_noise import GreyValueNoise
from mosca.coded_targets.ring_sampling import shading
from mosca.data.arrays import Array, looked_at
from mosca.detection.local_background import ROUNDING_DN2
from mosca.numba_support.decorators import kernel, step

FLAT_SHARE, FLAT_PX, FLATTEST_SHARE, WIDEST_FLAT = 1.45, 1.5, 0.5, 1.25
"""The window is flat up to ``FLAT_SHARE - FLAT_PX / s`` radii of the dot, s its shorter semi-axis [px]; limits."""
END_PX, END_SHARE = 4.0, 0.6
"""It ends this far beyond the dot [px], at most this share of the way to the ring."""
LEAST_SLOPE, LEAST_SLOPE_PX = 0.4, 2.5
"""Width of the window's slope, at least: in radii of the dot, or in px where that is less."""
BAND_SPREAD = 0.15
"""Spacing of the radii at which the ring's white is sampled, as a share of the ring's width."""
EDGE_PX, INNER_PX = 1.2, 3.0
"""A dot's pixels show its white from the second distance from its edge on, and nothing but its edge up to the first.
In between both count, so that no pixel is in or out by chance."""
WHITE_UNKNOWNS, MIDDLE_SHARE, LEAST_UNEVEN = 3, 1.0, 1e-6
"""Level and two slopes; pixels for which the contrast counts, which is that of the dot's middle; least variance of
slopes, over a pixel's."""
ANY_SLOPE = 1.0
"""Standard deviation of slopes of which nothing is known: light that doubles within a radius."""
STEPS_MOST, CLOSE_PX, FARTHEST = 12, 3e-4, 0.5
"""Largest number of Newton steps, step length at convergence, and largest total shift in radii."""


def measure_dots(
    image: Array, dots: Readings, target: TargetAppearance, noise: GreyValueNoise, turned_dn: float | None = None
) -> tuple[Array, Array]:
    """Return centres (n, 2) [px] and covariances (n, 2, 2) [px^2] of ``dots``; NaN for one that has none.

    ``image`` (H, W) shows them white. ``turned_dn``: the grey value that was black, where the image was inverted:
    then the brightest pixels are those of the plate. ``noise``: of the image as it was taken.
    """
    image = looked_at(image)
    xy, covariance = np.empty((len(dots), 2)), np.empty((len(dots), 2, 2))
    plate, gain = dots.levels[:, PLATE_DN], noise.gain_dn
    if turned_dn is not None:
        plate, gain = turned_dn - plate, -gain
    dark = np.maximum(noise.variance_dn2 + noise.gain_dn * (plate - noise.level_dn), ROUNDING_DN2)
    light, contrasts = plate_and_white(image, dots, target), dots.levels[:, CONTRAST_DN]
    centroids(image, dots.frames, light, contrasts, target.ring_inner, dark, gain, xy, covariance)
    return xy, covariance


def plate_and_white(image: Array, dots: Readings, target: TargetAppearance) -> Array:
    """Return (n, 5) the plate's light [DN] with its slopes along u and v, and the slopes of white over its level.

    Slopes per radius of the dot. A brightness gradient of 0.1 % per pixel biases the plain centroid of a dot of
    radius R px by ``0.001 R^2 / 4`` px, a gradient of the plate's light by more.
    """
    middle, apart = (
        0.5 * (target.ring_inner + target.ring_outer),
        BAND_SPREAD * (target.ring_outer - target.ring_inner),
    )
    radii = np.array([target.gap, target.outside, middle - apart, middle, middle + apart])
    light, levels = light_at(image, dots.frames, target, radii)
    contrast = levels[:, [CONTRAST_DN]]
    seen = np.ascontiguousarray(levels[:, [SLOPE_U, SLOPE_V]] / contrast)
    slopes = shading(light, radii, seen, dots.frames, dots.rings, target)
    return np.column_stack([levels[:, PLATE_DN], slopes[:, :2] * contrast, slopes[:, 2:]])


@step
def window_of(frame: Array, ring_inner: float) -> tuple[float, float]:
    """Return up to which radius the window is flat and at which it ends, in radii of the dot."""
    middle, spread = 0.5 * (frame[2] + frame[4]), math.hypot(0.5 * (frame[2] - frame[4]), frame[3])
    shorter = middle - spread
    end = 1.0 + min(END_SHARE * (ring_inner - 1.0), END_PX / shorter)
    flat = min(max(FLAT_SHARE - FLAT_PX / shorter, FLATTEST_SHARE), WIDEST_FLAT)
    return min(flat, end - min(LEAST_SLOPE, LEAST_SLOPE_PX / shorter)), end


@step
def inner_share(frame: Array, u: float, v: float) -> float:
    """Return by how much a pixel at (u, v) [radii] counts as inside of a dot: 0 at its edge, 1 far from it."""
    det = frame[AXX] * frame[AYY] - frame[AXY] ** 2
    ixx, ixy, iyy = frame[AYY] / det, -frame[AXY] / det, frame[AXX] / det
    radius = math.hypot(u, v)
    # distance from the edge to first order: (1 - radius) over the gradient of the radius
    steep = max(math.hypot(u * ixx + v * ixy, u * ixy + v * iyy), 1e-9)
    t = ((1.0 - radius) * radius / steep - EDGE_PX) / (INNER_PX - EDGE_PX)
    t = min(max(t, 0.0), 1.0)
    return t * t * (3.0 - 2.0 * t)


@step
def light_of_dot(
    image: Array,
    frame: Array,
    at: tuple[float, float],
    light: Array,
    pixel: tuple[float, float],
    uneven: float,
    out: Array,
) -> tuple[float, float]:
    """Write the white of a dot ``at`` to ``out`` (3, 4): level and slopes along u and v (3,), and their covariance.

    In units of the contrast, relative to the white that ``light`` (5,) has of the ring. ``pixel``: contrast [DN] and
    a pixel's variance over its square; ``uneven``: variance of the slopes. Returns the two sums of their method of
    moments: with A p = b for slopes p, ``b b - var tr A`` has the expectation ``uneven tr A^2``.
    """
    contrast, variance = pixel
    det = frame[AXX] * frame[AYY] - frame[AXY] ** 2
    ixx, ixy, iyy = frame[AYY] / det, -frame[AXY] / det, frame[AXX] / det
    half_x, half_y = math.hypot(frame[AXX], frame[AXY]), math.hypot(frame[AXY], frame[AYY])
    n = su = sv = suu = suv = svv = y = yu = yv = yy = 0.0
    left, right = max(int(at[0] - half_x), 0), min(int(at[0] + half_x) + 1, image.shape[1] - 1)
    for row in range(max(int(at[1] - half_y), 0), min(int(at[1] + half_y) + 1, image.shape[0] - 1) + 1):
        for column in range(left, right + 1):
            dx, dy = column - at[0], row - at[1]
            u, v = ixx * dx + ixy * dy, ixy * dx + iyy * dy
            share = inner_share(frame, u, v)
            if share == 0.0:
                continue
            value = image[row, column] - light[0] - light[1] * u - light[2] * v
            value /= contrast * (1.0 + light[3] * u + light[4] * v)
            n += share
            su += share * u
            sv += share * v
            suu += share * u * u
            suv += share * u * v
            svv += share * v * v
            y += share * value
            yu += share * value * u
            yv += share * value * v
            yy += share * value * value
    n, y = n + MIDDLE_SHARE, y + MIDDLE_SHARE
    # the slopes' normal equations, the level eliminated: A p = b
    auu, auv, avv = suu - su * su / n, suv - su * sv / n, svv - sv * sv / n
    bu, bv = yu - su * y / n, yv - sv * y / n
    noise = variance
    for _ in range(2):
        held = variance / max(uneven, variance * LEAST_UNEVEN)
        d = (auu + held) * (avv + held) - auv * auv
        cuu, cuv, cvv = (avv + held) / d, -auv / d, (auu + held) / d
        out[1, 0], out[2, 0] = cuu * bu + cuv * bv, cuv * bu + cvv * bv
        # what the slopes do not explain, blur above all, keeps them from being believed; it is alike all around
        left = yy + MIDDLE_SHARE - y * y / n - out[1, 0] * bu - out[2, 0] * bv
        if not (n > WHITE_UNKNOWNS and left > variance * (n - WHITE_UNKNOWNS)):
            break
        variance = left / (n - WHITE_UNKNOWNS)
    out[0, 0] = (y - su * out[1, 0] - sv * out[2, 0]) / n
    out[1, 2], out[2, 3] = noise * cuu, noise * cvv
    out[1, 3] = out[2, 2] = noise * cuv
    out[0, 2] = out[1, 1] = -(su * out[1, 2] + sv * out[2, 2]) / n
    out[0, 3] = out[2, 1] = -(su * out[1, 3] + sv * out[2, 3]) / n
    out[0, 1] = noise / n - (su * out[0, 2] + sv * out[0, 3]) / n
    return (bu * bu + bv * bv - variance * (auu + avv)), auu * auu + 2.0 * auv * auv + avv * avv


@step
def to_covariance(
    sums: tuple[float, float, float],
    white: Array,
    slopes: Array,
    inverse: tuple[float, float, float, float],
    out: Array,
) -> None:
    """Write a centre's covariance (2, 2), from the noise of pixels at its edge and that of its white.

    ``sums`` (xx, xy, yy) of the first; ``slopes`` (2, 3) by level and slopes of ``white`` (3, 4).
    """
    sxx, sxy, syy = sums
    for i in range(3):
        for k in range(3):
            c = white[i, 1 + k] / (white[0, 0] * white[0, 0])
            sxx += slopes[0, i] * c * slopes[0, k]
            sxy += slopes[0, i] * c * slopes[1, k]
            syy += slopes[1, i] * c * slopes[1, k]
    a, b, c, d = inverse
    out[0, 0] = a * a * sxx + 2.0 * a * b * sxy + b * b * syy
    out[1, 1] = c * c * sxx + 2.0 * c * d * sxy + d * d * syy
    out[0, 1] = out[1, 0] = a * c * sxx + (a * d + b * c) * sxy + b * d * syy


@step
def edge_sums(
    image: Array,
    frame: Array,
    at: tuple[float, float],
    window: tuple[float, float],
    light: Array,
    pixel: tuple[float, float, float],
    white: Array,
    slopes: Array,
) -> tuple[tuple[float, float], tuple[float, float, float], tuple[float, float, float, float]]:
    """Return the sum that is zero at a dot's centre, its covariance (xx, xy, yy) by pixels, and J (xx, xy, yx, yy).

    ``window``: see ``window_of``; ``pixel``: contrast [DN], variance of a pixel of the plate [DN^2], gain [DN];
    ``white`` (3, 4) as ``light_of_dot`` writes it. Writes the sum's slopes by level and slopes of the white to
    ``slopes`` (2, 3).
    """
    det = frame[AXX] * frame[AYY] - frame[AXY] ** 2
    ixx, ixy, iyy = frame[AYY] / det, -frame[AXY] / det, frame[AXX] / det  # pixels to radii
    flat, end = window
    contrast, dark, gain = pixel
    half_x = end * math.hypot(frame[AXX], frame[AXY]) + 1.0
    half_y = end * math.hypot(frame[AXY], frame[AYY]) + 1.0
    x, y = at
    fx = fy = sxx = sxy = syy = jxx = jxy = jyx = jyy = 0.0
    slopes[:] = 0.0
    left, right = max(int(x - half_x), 0), min(int(x + half_x) + 1, image.shape[1] - 1)
    for row in range(max(int(y - half_y), 0), min(int(y + half_y) + 1, image.shape[0] - 1) + 1):
        dy = row - y
        for column in range(left, right + 1):
            dx = column - x
            u, v = ixx * dx + ixy * dy, ixy * dx + iyy * dy
            radius = math.sqrt(u * u + v * v)
            if radius >= end:
                continue
            weight, slope = 1.0, 0.0
            if radius > flat:
                t = (radius - flat) / (end - flat)
                weight = 1.0 - t * t * (3.0 - 2.0 * t)
                slope = -6.0 * t * (1.0 - t) / (end - flat) / radius
            value, inner = 1.0, inner_share(frame, u, v)
            if inner < 1.0:
                value = image[row, column] - light[0] - light[1] * u - light[2] * v
                short = 1.0 / max(radius, 1.0)
                level = white[0, 0] + short * (white[1, 0] * u + white[2, 0] * v)
                level *= contrast * (1.0 + light[3] * u + light[4] * v)
                own = weight * (1.0 - inner)
                noise = own * own * max(dark + gain * value, 0.0) / (level * level)
                value /= level
                sxx += noise * dx * dx
                sxy += noise * dx * dy
                syy += noise * dy * dy
                by_level = own * value
                for i, share in enumerate((1.0, u * short, v * short)):
                    slopes[0, i] += by_level * dx * share
                    slopes[1, i] += by_level * dy * share
                value = inner + (1.0 - inner) * value
            gx, gy = slope * (u * ixx + v * ixy), slope * (u * ixy + v * iyy)
            fx += weight * value * dx
            fy += weight * value * dy
            jxx += value * (weight + dx * gx)
            jxy += value * dx * gy
            jyx += value * dy * gx
            jyy += value * (weight + dy * gy)
    return (fx, fy), (sxx, sxy, syy), (jxx, jxy, jyx, jyy)


@kernel
def centroids(
    image: Array,
    frames: Array,
    light: Array,
    contrasts: Array,
    ring_inner: float,
    dark: Array,
    gain: float,
    xy: Array,
    cov: Array,
) -> None:
    """Write centres and covariances of the dots of ``frames`` (n, FRAME) to ``xy`` (n, 2) and ``cov`` (n, 2, 2).

    ``light`` (n, 5): see ``plate_and_white``; ``contrasts`` (n,) of dots and plates [DN].
    """
    white, slopes = np.empty((3, 4)), np.empty((2, 3))
    lit = np.maximum(dark + gain * contrasts, ROUNDING_DN2) / contrasts**2
    # how uneven light falls on dots, all of an image together: a first look with slopes as they come
    product = square = 0.0
    for n in range(len(frames)):
        pixel, at = (contrasts[n], lit[n]), (frames[n, X], frames[n, Y])
        one, other = light_of_dot(image, frames[n], at, light[n], pixel, ANY_SLOPE**2, white)
        product += one
        square += other
    uneven = max(product / square, 0.0) if square > 0.0 else 0.0
    for n in range(len(frames)):
        frame, window = frames[n], window_of(frames[n], ring_inner)
        det = frame[AXX] * frame[AYY] - frame[AXY] ** 2
        x, y, length, sums, j = frame[X], frame[Y], math.inf, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 1.0)
        for _ in range(STEPS_MOST):
            light_of_dot(image, frame, (x, y), light[n], (contrasts[n], lit[n]), uneven, white)
            pixel_noise = (contrasts[n], dark[n], gain)
            f, sums, (jxx, jxy, jyx, jyy) = edge_sums(
                image, frame, (x, y), window, light[n], pixel_noise, white, slopes
            )
            size = jxx * jyy - jxy * jyx
            if not (size > 0.0 and jxx > 0.0):
                length = math.inf
                break
            j = (jyy / size, -jxy / size, -jyx / size, jxx / size)
            move_x, move_y = j[0] * f[0] + j[1] * f[1], j[2] * f[0] + j[3] * f[1]
            x += move_x
            y += move_y
            length = math.hypot(move_x, move_y)
            dx, dy = x - frame[X], y - frame[Y]
            away = math.hypot(frame[AYY] * dx - frame[AXY] * dy, frame[AXX] * dy - frame[AXY] * dx) / det
            if length < CLOSE_PX or away > FARTHEST:
                length = length if away <= FARTHEST else math.inf
                break
        if not length < 1e-2:
            xy[n], cov[n] = math.nan, math.nan
            continue
        xy[n, 0], xy[n, 1] = x, y
        to_covariance(sums, white, slopes, j, cov[n])
