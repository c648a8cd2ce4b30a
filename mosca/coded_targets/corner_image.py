"""The image of a chessboard's corner: values of the pixels around it, and how they change with the corner.

Two edges cross in c. A pixel at r = p - c has the distances ``d_i = n_i r - q_i (t_i r)^2`` from them, with the
normals n_i, the directions t_i, and q_i half the curvature that the lens gives an edge. The pattern, -1 in squares of
one colour and 1 in the others, is blurred by a Gaussian that has the variance v_i across edge i::

    S = 4 Phi2(d_1 / s_1, d_2 / s_2; rho) - 2 Phi(d_1 / s_1) - 2 Phi(d_2 / s_2) + 1,    rho = n_1 n_2

(Phi2: the bivariate normal integral; for edges that are not perpendicular the product of two blurred edges is no
blurred corner). The parallel edges one square away, and the edges of a ChArUco board's markers, are included as
products. A pixel averages over its square: it is divided into parts as in ``mosca.detection.disc_fit.disc_image``,
whose own blur is added to v_i. Light is ``(a + b S) (1 + g r)``.
"""

import math
from typing import NamedTuple

import numpy as np

from mosca.data.arrays import Array
from mosca.detection.disc_fit.disc_image import parts_of
from mosca.detection.merged_targets.fit import FLAT, common, edge
from mosca.numba_support.decorators import kernel, step

UNKNOWNS = 10
CX, CY, TURN_1, TURN_2, BLUR_1, BLUR_2, MEAN, CONTRAST, SLOPE_X, SLOPE_Y = range(UNKNOWNS)
"""Unknowns of a corner: place [px], directions of its edges [rad], variances across them [px^2], mean of black and
white and half their difference [DN], slopes of the light [share per ``REACH``]."""
LEAST_VARIANCE = 1e-4
"""Least variance of a blur [px^2]: a hundredth of a pixel."""


class PatternNoise(NamedTuple):
    """Variance of a pixel [DN^2]: ``level + slope S + edge (1 - S^2)``, at least ``least``, S = 1 where white."""

    level: float
    slope: float
    edge: float
    least: float


X, Y, DIRECTION_1, DIRECTION_2, APART_1, APART_2, BEND_1, BEND_2, REACH, MARKERS = range(10)
PLACE = MARKERS + 8
"""Number of columns of a corner's surroundings by its board's view: place, directions, distances of the parallel
edges [px], half curvatures [1/px], half the window's longer side [px]; distances of a marker from both edges in each
quarter (d_1 < 0, d_2 < 0), (< 0, > 0), (> 0, < 0), (> 0, > 0) [px]."""


@step
def variance_of(noise: PatternNoise, s: float) -> float:
    """Return the variance of a pixel of the pattern ``s``, 1 where white [DN^2]."""
    return max(noise.level + noise.slope * s + noise.edge * (1.0 - s * s), noise.least)


@step
def wave(d: float, apart: float, sigma: float) -> tuple[float, float, float, float, float, float]:
    """Return an edge (-1 to 1) at distance ``d``, its slope, its change with the variance; the same for parallels."""
    half, density = edge(d / sigma)
    e, slope, spread = 2.0 * half - 1.0, 2.0 * density / sigma, -d * density / sigma**3
    other, other_slope, other_spread = 0.0, 0.0, 0.0
    for side in (-1.0, 1.0):
        far = d - side * apart
        if abs(far) < FLAT * sigma:
            half, density = edge(far / sigma)
            other -= 2.0 * half - 1.0 + side
            other_slope -= 2.0 * density / sigma
            other_spread += far * density / sigma**3
    return e, slope, spread, other, other_slope, other_spread


@step
def beyond(d: float, gap: float, sigma: float) -> tuple[float, float, float]:
    """Return how much of a marker lies at a distance ``d`` from an edge, with its slope and change with variance."""
    half, density = edge((d - gap) / sigma)
    return half, density / sigma, -0.5 * (d - gap) * density / sigma**3


@step
def add_part(
    d: tuple[float, float], place: Array, blur: tuple[float, float, float], colour: float, out: Array
) -> None:
    """Add to ``out`` (6,) the pattern at the distances ``d`` from both edges, and its changes.

    These are the changes with both distances, both variances and rho. ``blur``: standard deviations and rho.
    ``colour``: the pattern's sign where squares hold markers, 0 where none do.
    """
    s1, s2, rho = blur
    e1, k1, v1, o1, l1, w1 = wave(d[0], place[APART_1], s1)
    e2, k2, v2, o2, l2, w2 = wave(d[1], place[APART_2], s2)
    f1, f2 = e1 + o1, e2 + o2
    s, by1, by2 = f1 * f2, (k1 + l1) * f2, f1 * (k2 + l2)
    byv1, byv2, by_rho = (v1 + w1) * f2, f1 * (v2 + w2), 0.0
    h, k = d[0] / s1, d[1] / s2
    if abs(h) < FLAT and abs(k) < FLAT:
        both, change1, change2 = common(h, k, 0.5 * (1.0 + e1), 0.5 * (1.0 + e2), rho)
        extra1, extra2 = (4.0 * change1) / s1 - k1 - k1 * e2, (4.0 * change2) / s2 - k2 - k2 * e1
        s += 4.0 * both - e1 - e2 - 1.0 - e1 * e2
        by1 += extra1
        by2 += extra2
        # the heat equation: d S / d v = half of d2 S / d d2, along h
        byv1 -= 0.5 * d[0] / s1**2 * extra1
        byv2 -= 0.5 * d[1] / s2**2 * extra2
        rest = max(1.0 - rho * rho, 1e-6)
        by_rho = 4.0 * math.exp(-0.5 * (h * h + k * k - 2.0 * rho * h * k) / rest) / (2.0 * math.pi * math.sqrt(rest))
    if colour != 0.0:
        for side in (-1.0, 1.0):
            quarter = MARKERS + 2 * ((2 if side > 0.0 else 0) + (1 if side * colour > 0.0 else 0))
            m1, n1, q1 = beyond(side * d[0], place[quarter], s1)
            m2, n2, q2 = beyond(side * colour * d[1], place[quarter + 1], s2)
            s -= 2.0 * colour * m1 * m2
            by1 -= 2.0 * colour * side * n1 * m2
            by2 -= 2.0 * side * m1 * n2
            byv1 -= 2.0 * colour * q1 * m2
            byv2 -= 2.0 * colour * m1 * q2
    out[0] += s
    out[1] += by1
    out[2] += by2
    out[3] += byv1
    out[4] += byv2
    out[5] += by_rho


@step
def is_within(place: Array, band: float, x: float, y: float) -> bool:
    """Return whether a pixel (x, y) from the place is nearer to this corner than to others, and shows no bits."""
    d1 = abs(math.cos(place[DIRECTION_1]) * y - math.sin(place[DIRECTION_1]) * x) / place[APART_1]
    d2 = abs(math.cos(place[DIRECTION_2]) * y - math.sin(place[DIRECTION_2]) * x) / place[APART_2]
    return bool(max(d1, d2) < 0.5 and min(d1, d2) < band)


@step
def pixel_light(p: Array, place: Array, colour: float, x: float, y: float, out: Array, slope: Array) -> float:
    """Return the light [DN] of a pixel (x, y) [px].

    Writes its change with the unknowns ``p`` to ``slope`` (UNKNOWNS,), and the pattern as ``add_part`` does.
    """
    c1, s1, c2, s2 = math.cos(p[TURN_1]), math.sin(p[TURN_1]), math.cos(p[TURN_2]), math.sin(p[TURN_2])
    rx, ry = x - p[CX], y - p[CY]
    parts = 1
    if (
        min(
            abs(c1 * ry - s1 * rx) - FLAT * math.sqrt(p[BLUR_1]), abs(c2 * ry - s2 * rx) - FLAT * math.sqrt(p[BLUR_2])
        )
        < 1.0
    ):  # within a pixel and the bend of the edges
        parts = parts_of(math.sqrt(min(p[BLUR_1], p[BLUR_2]) + 1.0 / 12.0))
    own = 1.0 / (12.0 * parts * parts)
    sigma = math.sqrt(p[BLUR_1] + own), math.sqrt(p[BLUR_2] + own), c1 * c2 + s1 * s2
    out[:] = 0.0
    at1 = at2 = 0.0
    for i in range(parts):
        for k in range(parts):
            rx, ry = x - p[CX] + (i + 0.5) / parts - 0.5, y - p[CY] + (k + 0.5) / parts - 0.5
            t1, t2 = c1 * rx + s1 * ry, c2 * rx + s2 * ry
            d = c1 * ry - s1 * rx - place[BEND_1] * t1 * t1, c2 * ry - s2 * rx - place[BEND_2] * t2 * t2
            before1, before2 = out[1], out[2]
            add_part(d, place, sigma, colour, out)
            at1 += (out[1] - before1) * t1
            at2 += (out[2] - before2) * t2
    share = 1.0 / (parts * parts)
    for i in range(6):
        out[i] *= share
    rx, ry = (x - place[X]) / place[REACH], (y - place[Y]) / place[REACH]
    lit = 1.0 + p[SLOPE_X] * rx + p[SLOPE_Y] * ry
    value = p[MEAN] + p[CONTRAST] * out[0]
    b = p[CONTRAST] * lit
    slope[CX] = b * (s1 * out[1] + s2 * out[2])
    slope[CY] = -b * (c1 * out[1] + c2 * out[2])
    turned = math.sin(p[TURN_1] - p[TURN_2]) * out[5]
    slope[TURN_1], slope[TURN_2] = -b * (at1 * share + turned), -b * (at2 * share - turned)
    slope[BLUR_1], slope[BLUR_2] = b * out[3], b * out[4]
    slope[MEAN], slope[CONTRAST] = lit, lit * out[0]
    slope[SLOPE_X], slope[SLOPE_Y] = value * rx, value * ry
    return float(value * lit)


@kernel
def corner_sums(
    image: Array,
    unknowns: Array,
    places: Array,
    markers: tuple[float, float],
    noise: PatternNoise,
    full_dn: float,
    fitted: Array,
) -> tuple[Array, Array, Array, Array, Array]:
    """Return normal equations (n, UNKNOWNS, UNKNOWNS) and right sides at ``unknowns`` (n, UNKNOWNS) of corners.

    Also return chi-square and numbers of pixels (n,), and equations (n, 3, 4) of the noise. ``places`` (n, PLACE);
    ``markers``: 1 where a board's white squares hold some, -1 where its black ones do, 0 for none; and the width of
    the bands beside the lines that are looked at, in squares. ``fitted`` (n, UNKNOWNS, UNKNOWNS): covariance of the
    fit, by which the variance of residuals is reduced; if empty, equations of the noise are 0.
    """
    n = len(unknowns)
    normal, right = np.zeros((n, UNKNOWNS, UNKNOWNS)), np.zeros((n, UNKNOWNS))
    chi2, pixels, seen = np.zeros(n), np.zeros(n), np.zeros((n, 3, 4))
    out, slope, basis = np.zeros(6), np.zeros(UNKNOWNS), np.ones(3)
    for j in range(n):
        p, place = unknowns[j], places[j]
        colour = markers[0] if p[CONTRAST] >= 0.0 else -markers[0]
        reach = place[REACH]
        left, right_end = max(math.ceil(place[X] - reach), 0), min(math.floor(place[X] + reach), image.shape[1] - 1)
        top, bottom = max(math.ceil(place[Y] - reach), 0), min(math.floor(place[Y] + reach), image.shape[0] - 1)
        for row in range(top, bottom + 1):
            for column in range(left, right_end + 1):
                if not is_within(place, markers[1], column - place[X], row - place[Y]):
                    continue
                light = pixel_light(p, place, colour, float(column), float(row), out, slope)
                if light >= full_dn <= image[row, column]:
                    continue  # saturated, as it should be
                off = image[row, column] - light
                white = math.copysign(out[0], p[CONTRAST] * out[0])
                weight = 1.0 / variance_of(noise, white)
                pixels[j] += 1.0
                chi2[j] += weight * off * off
                for a in range(UNKNOWNS):
                    right[j, a] += weight * slope[a] * off
                    for b in range(a + 1):
                        normal[j, a, b] += weight * slope[a] * slope[b]
                if len(fitted):
                    taken = 0.0
                    for a in range(UNKNOWNS):
                        for b in range(UNKNOWNS):
                            taken += slope[a] * fitted[j, a, b] * slope[b]
                    square = off * off / max(1.0 - weight * taken, 0.1)
                    basis[1], basis[2] = white, 1.0 - white * white
                    for a in range(3):
                        for b in range(3):
                            seen[j, a, b] += weight * weight * basis[a] * basis[b]
                        seen[j, a, 3] += weight * weight * basis[a] * square
        for a in range(UNKNOWNS):
            for b in range(a):
                normal[j, b, a] = normal[j, a, b]
    return normal, right, chi2, pixels, seen
