"""Compiled fits of two blurred discs, of one that moved and of an ellipse to the same pixels.

``mosca.detection.merged_targets.split`` states the models and compiles this in.
"""

import math
from typing import NamedTuple

import numpy as np

from mosca.data.arrays import Array
from mosca.detection.disc_fit.disc_image import FAST
from mosca.detection.disc_fit.gauss_newton import Model
from mosca.numba_support.decorators import bare_step, step

TURNS = 25
SMALL = 0.01
"""Least predicted decrease of chi-square of a step: steps below a tenth of the error are not taken."""
FLAT = 4.0
"""Distance from an edge, in blurs, beyond which the image is taken for flat."""
A1, A2, A3, A4, A5 = 0.319381530, -0.356563782, 1.781477937, -1.821255978, 1.330274429
"""Abramowitz and Stegun 1964, 26.2.17."""
FIRST_DAMPING, FIRST_OF_ONE = 1e-3, 0.3
"""Marquardt's damping of the first step: of a pair, and of one long target. The latter starts from the values of two
discs, and a full first step overshoots."""
CALMER, WILDER = 0.1, 8.0
"""Factors on the damping after a step that is better, and one that is worse."""
SHARPER, SOFTER, LEAST_BLUR, MOST_BLUR = 0.6, 1.6, 0.25, 6.0
"""Share of its blur that a step leaves, at least and at most, and its limits [px]."""
SMALLER, LARGER, LARGER_PX, LEAST_RADIUS = 0.6, 1.5, 0.5, 0.2
"""Share of its radius that a step leaves, at least and at most, so many pixels added to the latter; its least value
[px]."""
PAIR, SWEPT, ELLIPSE = range(3)
UNKNOWNS = (10, 8, 8)
MOST_NODES = 16
"""Largest number of instants of a swept disc; spaced a blur apart, they approximate continuous motion."""
FORESEEN = 4.0
"""A fit that need only show whether it gets below a chi-square ends where the decrease still needed is more than this
many times that predicted for its next step."""


class FitTask(NamedTuple):
    """What the fits to the pixels of one image have in common."""

    blur: float
    """Prior mean [px],"""
    spread: float
    """and standard deviation [px]."""
    model: Model
    work: Array
    """(10, 11): working memory."""


@bare_step(fastmath=FAST)
def edge(t: float) -> tuple[float, float]:
    """Return the normal distribution's integral and density at t (Abramowitz and Stegun 1964, 26.2.17: to 1e-7)."""
    if abs(t) > FLAT:
        return (1.0 if t > 0.0 else 0.0), 0.0
    density = 0.3989422804014327 * math.exp(-0.5 * t * t)
    k = 1.0 / (1.0 + 0.2316419 * abs(t))
    tail = density * k * (A1 + k * (A2 + k * (A3 + k * (A4 + k * A5))))
    return (1.0 - tail if t > 0.0 else tail), density


_AT, _SHARE = np.polynomial.legendre.leggauss(6)
SEEN = 3.2
"""Distance from an edge, in blurs, beyond which it is neglected: 0.07 % of the brightness."""


@bare_step(fastmath=FAST)
def common(t1: float, t2: float, e1: float, e2: float, rho: float) -> tuple[float, float, float]:
    """Return the bivariate normal integral up to t1 and t2 of correlation rho, and its change with t1 and t2."""
    root = math.sqrt(max(1.0 - rho * rho, 1e-6))
    d1 = 0.3989422804014327 * math.exp(-0.5 * t1 * t1) * edge((t2 - rho * t1) / root)[0]
    d2 = 0.3989422804014327 * math.exp(-0.5 * t2 * t2) * edge((t1 - rho * t2) / root)[0]
    if t1 > SEEN:
        return e2, d1, d2
    if t2 > SEEN:
        return e1, d1, d2
    half = 0.5 * math.asin(min(max(rho, -0.99999), 0.99999))
    total = 0.0
    for k in range(6):
        sine = math.sin(half * (_AT[k] + 1.0))
        total += _SHARE[k] * math.exp(-0.5 * (t1 * t1 + t2 * t2 - 2.0 * t1 * t2 * sine) / (1.0 - sine * sine))
    return e1 * e2 + half * total / (2.0 * math.pi), d1, d2


@bare_step(fastmath=FAST)
def clearance(p: Array) -> float:
    """Return the gap between two discs less their blur [px]: above 0 neither can hide the other."""
    return float(math.hypot(p[0] - p[1], p[2] - p[3]) - p[4] - p[5] - p[9])


@bare_step(fastmath=FAST)
def light_of(kind: int, p: Array, x: float, y: float, slope: Array) -> float:
    """Return the grey value of a pixel and write its change with the unknowns ``p``.

    PAIR: x1, x2, y1, y2, R1, R2, A1, A2, b, s, the first in front. SWEPT: x, y, half of the way (x, y), R, A, b, s.
    ELLIPSE: x, y, stretch (xx less yy, xy), R, A, b, s.
    """
    if kind == PAIR:
        s = p[9]
        ax, ay, bx, by = x - p[0], y - p[2], x - p[1], y - p[3]
        r1, r2 = math.sqrt(ax * ax + ay * ay + 1e-9), math.sqrt(bx * bx + by * by + 1e-9)
        t1, t2 = (p[4] - r1) / s, (p[5] - r2) / s
        e1, g1 = edge(t1)
        e2, g2 = edge(t2)
        both, d1, d2 = 0.0, 0.0, 0.0
        if t1 > -SEEN and t2 > -SEEN and clearance(p) < 0.0:
            both, d1, d2 = common(t1, t2, e1, e2, (ax * bx + ay * by) / (r1 * r2))
        h1, h2 = (p[6] * g1 - p[7] * d1) / s, p[7] * (g2 - d2) / s
        slope[0], slope[2], slope[4] = h1 * ax / r1, h1 * ay / r1, h1
        slope[1], slope[3], slope[5] = h2 * bx / r2, h2 * by / r2, h2
        slope[6], slope[7], slope[8] = e1, e2 - both, 1.0
        slope[9] = -h1 * t1 - h2 * t2
        result: float = p[8] + p[6] * e1 + p[7] * (e2 - both)
        return result
    s = p[7]
    for a in range(8):
        slope[a] = 0.0
    slope[6] = 1.0
    if kind == SWEPT:
        nodes = min(3 + int(2.0 * math.hypot(p[2], p[3]) / s), MOST_NODES)
        share = p[5] / (nodes * s)
        total = 0.0
        for k in range(nodes):
            way = (2 * k + 1.0) / nodes - 1.0
            dx, dy = x - p[0] - way * p[2], y - p[1] - way * p[3]
            r = math.sqrt(dx * dx + dy * dy + 1e-9)
            t = (p[4] - r) / s
            e, g = edge(t)
            total += e / nodes
            g *= share
            slope[0] += g * dx / r
            slope[1] += g * dy / r
            slope[2] += g * way * dx / r
            slope[3] += g * way * dy / r
            slope[4] += g
            slope[7] -= g * t
        slope[5] = total
        result = p[6] + p[5] * total
        return result
    # r = |S d|, across the edge it grows by q / r for each pixel, q = |S S d|
    a, c, dx, dy = p[2], p[3], x - p[0], y - p[1]
    u, v = (1.0 + a) * dx + c * dy, c * dx + (1.0 - a) * dy
    wx, wy = (1.0 + a) * u + c * v, c * u + (1.0 - a) * v
    hx, hy = (1.0 + a) * wx + c * wy, c * wx + (1.0 - a) * wy
    r, q = math.sqrt(u * u + v * v + 1e-9), math.sqrt(wx * wx + wy * wy + 1e-9)
    steep = q / r
    t = (p[4] - r) / (steep * s)
    e, g = edge(t)
    g *= p[5] / (steep * s)
    turn = t * s / r
    r_a, r_c = (u * dx - v * dy) / r, (u * dy + v * dx) / r
    q_a = 2.0 * ((1.0 + a) * wx * dx - (1.0 - a) * wy * dy) / q
    q_c = 2.0 * (wx * (c * dx + dy) + wy * (dx + c * dy)) / q
    q_x, q_y = ((1.0 + a) * hx + c * hy) / q, (c * hx + (1.0 - a) * hy) / q
    slope[0] = g * (wx / r + turn * (q_x - steep * wx / r))
    slope[1] = g * (wy / r + turn * (q_y - steep * wy / r))
    slope[2] = -g * (r_a + turn * (q_a - steep * r_a))
    slope[3] = -g * (r_c + turn * (q_c - steep * r_c))
    slope[4], slope[5], slope[7] = g, e, -g * t * steep
    result = p[6] + p[5] * e
    return result


@step(fastmath=FAST)
def fit(kind: int, p: Array, pixels: Array, n: int, task: FitTask, enough: float) -> tuple[float, Array, bool]:
    """Fit the unknowns ``p`` in place; return chi-square, the inverse normal matrix, whether it has converged.

    ``enough``: the fit ends once it is known whether this chi-square is reached. The noise of one long target is
    computed from the measured grey values: weights from a model that does not fit would be biased by the misfit.
    """
    blur, spread, model, work = task.blur, task.spread, task.model, task.work
    m = UNKNOWNS[kind]
    slope, change, off = np.empty(m), np.empty((m, n)), np.empty(n)
    normal, right, inverse = np.empty((m, m)), np.empty(m), np.zeros((m, m))
    fresh, pulled = np.empty((m, m)), np.empty(m)
    trial, damping, at_rest = p.copy(), FIRST_DAMPING if kind == PAIR else FIRST_OF_ONE, False
    last = math.inf
    for _turn in range(TURNS):
        for i in range(n):
            value = light_of(kind, trial, pixels[i, 0], pixels[i, 1], slope)
            light = (value if kind == PAIR else pixels[i, 2]) - trial[m - 2]
            root = math.sqrt(1.0 / (model.dark_dn2 + model.gain_dn * max(light, 0.0)))
            off[i] = root * (pixels[i, 2] - value)
            for a in range(m):
                change[a, i] = root * slope[a]
        # sums along contiguous rows: the compiler adds several pixels at once
        chi2 = dot(off, off)
        for a in range(m):
            pulled[a] = dot(change[a], off)
            for b in range(a + 1):
                fresh[a, b] = dot(change[a], change[b])
        fresh[m - 1, m - 1] += 1.0 / (spread * spread)
        pulled[m - 1] += (blur - trial[m - 1]) / (spread * spread)
        chi2 += ((blur - trial[m - 1]) / spread) ** 2
        if chi2 <= last * (1.0 + 1e-9):
            p[:], normal[:], right[:], last = trial, fresh, pulled, chi2
            damping = max(CALMER * damping, 1e-6)
        else:
            damping *= WILDER
            if damping > 1e6:
                break
        move = solved(normal, right, damping, work)
        gain = 0.0
        for a in range(m):
            trial[a] = p[a] + move[a]
            gain += move[a] * right[a]
        if gain < SMALL and damping < 1.0:
            at_rest = True
            break
        if last < enough or (damping < 1.0 and last - FORESEEN * gain > enough > 0.0):
            break
        trial[m - 1] = min(max(trial[m - 1], SHARPER * p[m - 1], LEAST_BLUR), SOFTER * p[m - 1], MOST_BLUR)
        for a in range(4, 6 if kind == PAIR else 5):
            trial[a] = min(max(trial[a], SMALLER * p[a], LEAST_RADIUS), LARGER * p[a] + LARGER_PX)
    for a in range(m):
        right[:] = 0.0
        right[a] = 1.0
        inverse[:, a] = solved(normal, right, 0.0, work)[:m]
    return last, inverse, at_rest


@bare_step(fastmath=FAST)
def dot(one: Array, other: Array) -> float:
    """Return the sum of the products of two rows."""
    total = 0.0
    for i in range(len(one)):
        total += one[i] * other[i]
    return total


@step(fastmath=FAST)
def solved(normal: Array, right: Array, damping: float, work: Array) -> Array:
    """Return the solution of (N + damping diag N) x = right, by Cholesky; the lower triangle of N is read."""
    m = len(right)
    x = np.zeros(10)
    for i in range(m):
        for j in range(i + 1):
            rest = normal[i, j] * (1.0 + damping if i == j else 1.0) + (1e-12 if i == j else 0.0)
            for k in range(j):
                rest -= work[i, k] * work[j, k]
            if i == j:
                work[i, i] = math.sqrt(max(rest, 1e-12))
            else:
                work[i, j] = rest / work[j, j]
        x[i] = right[i]
        for k in range(i):
            x[i] -= work[i, k] * x[k]
        x[i] /= work[i, i]
    for i in range(m - 1, -1, -1):
        for k in range(i + 1, m):
            x[i] -= work[k, i] * x[k]
        x[i] /= work[i, i]
    return x
