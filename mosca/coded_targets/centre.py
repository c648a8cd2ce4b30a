"""Centres of the dots of coded targets: the centroid within a soft window that is centred on it.

A mask of whole pixels truncates the blurred edge unevenly and biases a centroid by 0.005 to 0.02 px. The window here
is smooth, elliptic as the dot, and centred on the centre c itself, so that its truncation is symmetric::

    sum_p w(p - c) (I(p) - b(p)) (p - c) = 0

with b the light of the plate. Where the window is flat this is the plain centroid; Newton's method finds c, with ``J
= sum (I - b) (w 1 + d grad w^T)``, d = p - c. Pixel noise goes through at first order: ``C = J^-1 (sum w^2 var(I) d
d^T) J^-T``, ``var(I) = dark + gain (I - b)`` (as in ``mosca.detection.detect``). The covariance is the random error,
to a third. What remains besides, measured on rendered targets at blurs of 0.4 to 0.9 px, is below 0.002 px rms where
the dot's shorter axis is 7 px or more, 0.004 px from 5 px on, and up to 0.009 px below.

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
from mosca.coded_targets.ring_sampling import shading
from mosca.data.arrays import Array, looked_at
from mosca.numba_support.decorators import kernel, step

FLAT_SHARE, FLAT_PX, FLATTEST_SHARE, WIDEST_FLAT = 1.45, 1.5, 0.5, 1.25
"""The window is flat up to ``FLAT_SHARE - FLAT_PX / s`` radii of the dot, s its shorter semi-axis [px]; limits."""
END_PX, END_SHARE = 4.0, 0.6
"""It ends this far beyond the dot [px], at most this share of the way to the ring."""
LEAST_SLOPE, LEAST_SLOPE_PX = 0.4, 2.5
"""Width of the window's slope, at least: in radii of the dot, or in px where that is less."""
BAND_SPREAD = 0.15
"""Spacing of the radii at which the ring's white is sampled, as a share of the ring's width."""
STEPS_MOST, CLOSE_PX, FARTHEST = 12, 3e-4, 0.5
"""Largest number of Newton steps, step length at convergence, and largest total shift in radii."""


def measure_dots(
    image: Array,
    dots: Readings,
    target: TargetAppearance,
    dark_dn2: float,
    gain_dn: float,
    turned_dn: float | None = None,
) -> tuple[Array, Array]:
    """Return centres (n, 2) [px] and covariances (n, 2, 2) [px^2] of ``dots``; NaN for one that has none.

    ``image`` (H, W) shows them white. ``turned_dn``: the grey value that was black, where the image was inverted:
    then photon noise grows with the plate's light. ``dark_dn2``, ``gain_dn``: variance of a pixel
    without light [DN^2], and what a grey value of light adds to it.
    """
    image = looked_at(image)
    xy, covariance = np.empty((len(dots), 2)), np.empty((len(dots), 2, 2))
    plate, dark, gain = dots.levels[:, PLATE_DN], np.full(len(dots), float(dark_dn2)), float(gain_dn)
    if turned_dn is not None:
        dark, gain = dark + gain * (turned_dn - plate), -gain
    centroids(image, dots.frames, plate_and_white(image, dots, target), target.ring_inner, dark, gain, xy, covariance)
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


@kernel
def centroids(
    image: Array, frames: Array, light: Array, ring_inner: float, dark: Array, gain: float, xy: Array, cov: Array
) -> None:
    """Write centres and covariances of the dots of ``frames`` (n, FRAME) to ``xy`` (n, 2) and ``cov`` (n, 2, 2).

    ``light`` (n, 5): see ``plate_and_white``.
    """
    for n in range(len(frames)):
        frame = frames[n]
        flat, end = window_of(frame, ring_inner)
        det = frame[AXX] * frame[AYY] - frame[AXY] ** 2
        ixx, ixy, iyy = frame[AYY] / det, -frame[AXY] / det, frame[AXX] / det  # pixels to radii
        half_x = end * math.hypot(frame[AXX], frame[AXY]) + 1.0
        half_y = end * math.hypot(frame[AXY], frame[AYY]) + 1.0
        x, y, length = frame[X], frame[Y], 1.0
        sxx = sxy = syy = jxx = jxy = jyx = jyy = 0.0
        for _ in range(STEPS_MOST):
            fx = fy = sxx = sxy = syy = jxx = jxy = jyx = jyy = 0.0
            left, right = max(int(x - half_x), 0), min(int(x + half_x) + 1, image.shape[1] - 1)
            for row in range(max(int(y - half_y), 0), min(int(y + half_y) + 1, image.shape[0] - 1) + 1):
                dy = row - y
                for column in range(left, right + 1):
                    dx = column - x
                    u, v = ixx * dx + ixy * dy, ixy * dx + iyy * dy
                    radius = math.sqrt(u * u + v * v)
                    if radius >= end:
                        continue
                    white = 1.0 + light[n, 3] * u + light[n, 4] * v
                    value = image[row, column] - light[n, 0] - light[n, 1] * u - light[n, 2] * v
                    variance = max(dark[n] + gain * value, 0.0) / (white * white)
                    value /= white
                    weight, slope = 1.0, 0.0
                    if radius > flat:
                        t = (radius - flat) / (end - flat)
                        weight = 1.0 - t * t * (3.0 - 2.0 * t)
                        slope = -6.0 * t * (1.0 - t) / (end - flat) / radius
                    gx, gy = slope * (u * ixx + v * ixy), slope * (u * ixy + v * iyy)
                    fx += weight * value * dx
                    fy += weight * value * dy
                    jxx += value * (weight + dx * gx)
                    jxy += value * dx * gy
                    jyx += value * dy * gx
                    jyy += value * (weight + dy * gy)
                    noise = weight * weight * variance
                    sxx += noise * dx * dx
                    sxy += noise * dx * dy
                    syy += noise * dy * dy
            j = jxx * jyy - jxy * jyx
            if not (j > 0.0 and jxx > 0.0):
                length = math.inf
                break
            move_x, move_y = (jyy * fx - jxy * fy) / j, (jxx * fy - jyx * fx) / j
            x += move_x
            y += move_y
            length = math.hypot(move_x, move_y)
            dx, dy = x - frame[X], y - frame[Y]
            away = math.hypot(ixx * dx + ixy * dy, ixy * dx + iyy * dy)
            if length < CLOSE_PX or away > FARTHEST:
                length = length if away <= FARTHEST else math.inf
                break
        if not length < 1e-2:
            xy[n], cov[n] = math.nan, math.nan
            continue
        j = jxx * jyy - jxy * jyx
        a, b, c, d = jyy / j, -jxy / j, -jyx / j, jxx / j
        xy[n, 0], xy[n, 1] = x, y
        cov[n, 0, 0] = a * a * sxx + 2.0 * a * b * sxy + b * b * syy
        cov[n, 1, 1] = c * c * sxx + 2.0 * c * d * sxy + d * d * syy
        cov[n, 0, 1] = cov[n, 1, 0] = a * c * sxx + (a * d + b * c) * sxy + b * d * syy
