"""Compiled refinement of the regions of a frame set, and what it teaches.

Called by ``mosca.refine``, which states the model, the noise and the source. One kernel call takes all regions of
a frame set, is free of the GIL and runs on one thread, so that the same images always give the same places.
"""

import math
from typing import Any

import numpy as np

from mosca.data.arrays import Array
from mosca.data.detections import MERGED, PARTIAL, SATURATED, UNREFINED
from mosca.detect_memory import image_at
from mosca.refine_fit import (
    ONE,
    P0,
    P1,
    P2,
    P3,
    P4,
    Model,
    f32,
    fit_disc,
    kernel,
    step,
)
from mosca.refine_window import (
    blank,
    box_of,
    corner_level,
    gather,
    gather_unmarked,
    half_side,
    region_sums,
    window_sums,
)

X, Y, XX, XY, YY, DIAMETER, PEAK, ELONGATION, FLAGS, BLUR, BLUR_INFO, MISFIT, ROUGH, PULL = range(14)
N_COLUMNS = 14

# What an image teaches: counts and sums, see mosca.refine.
N_TARGETS, BLUR_SUM, BLUR_WEIGHT, ROUGH_SUM, N_LIGHT = range(5)
N_TALLIES, N_TERMS = 5, 12
TOUCHING = 0.03
"""Error of a centroid that a neighbour's light draws, standard deviation as a share of the diameter (measured)."""
EACH = 8  # every so many targets the light's centroid is taken


@step
def tail_point(share: float) -> float:
    """Return t at which the normal distribution leaves ``share`` (up to a half) above it.

    Abramowitz and Stegun 26.2.22, right to 0.003.
    """
    q = math.sqrt(-2.0 * math.log(min(max(share, 1e-6), 0.5)))
    return max(q - (2.30753 + 0.27061 * q) / (1.0 + q * (0.99229 + 0.04481 * q)), 0.0)


@step
def below_edge(t: float) -> float:
    """Return the normal distribution's integral up to t >= 0, by the polynomial of the edge."""
    t = min(t, 3.0)
    u = t * t
    return float(0.5 + t * (P0 + u * (P1 + u * (P2 + u * (P3 + u * P4)))))


@step
def upright(sums_of_light: Any) -> tuple[float, float, float, float, float]:
    """Return centroid and central second moments (xx, xy, yy) from sums (1, x, y, xx, xy, yy) of light."""
    flux = max(float(sums_of_light[0]), 1e-6)
    x, y = sums_of_light[1] / flux, sums_of_light[2] / flux
    xx, xy, yy = sums_of_light[3] / flux, sums_of_light[4] / flux, sums_of_light[5] / flux
    return x, y, xx - x * x, xy - x * y, yy - y * y


@step
def stretch(xx: float, xy: float, yy: float, blur2: float, n: int) -> tuple[float, float, float]:
    """Return the symmetric matrix (xx, xy, yy) of determinant 1 that makes an elliptic target round.

    From its second moments less those of the blur. What pixels and noise do to a round target is left alone:
    the unit matrix.
    """
    size = max(0.5 * (xx + yy) - blur2, 0.5 * blur2)
    p, q = 0.5 * (xx - yy) / size, xy / size
    if p * p + q * q < (0.04 + 1.5 / n) ** 2:
        return 1.0, 0.0, 1.0
    e = min(math.sqrt(p * p + q * q), 0.85)
    k = e / math.sqrt(p * p + q * q)
    # moments are proportional to [[1 + p, q], [q, 1 - p]]: its inverse root, by Cayley and Hamilton
    a, b, c = 1.0 - k * p, -k * q, 1.0 + k * p
    root = math.sqrt(a * c - b * b)
    a, b, c = a / root, b / root, c / root
    t = math.sqrt(a + c + 2.0)
    return (a + 1.0) / t, b / t, (c + 1.0) / t


@step
def refine_region(
    image: Array,
    runs: Array,
    threshold: int,
    floor: int,
    blur: tuple[float, float],
    model: Model,
    xyv: tuple[Array, Array, Array, Array],
    sharper: Array,
    marks: Array,
    work: Array,
    learned: Array,
    usual_rough: float,
    teach: bool,
    out: Array,
    terms: Array,
    tally: Array,
    normal: Array,
    right_side: Array,
) -> None:
    """Fit one region and write its row of the table; add to the sums what it teaches."""
    box, n_px = box_of(runs)
    left, right, top, bottom = box
    size_x, size_y = right - left + 1, bottom - top + 1
    most = 0.5 * len(marks) - 2.0  # what the scratch arrays hold
    level = min(corner_level(image, box, floor), float(threshold))
    # the whole of a lonely round target is copied once; its box reaches past the edge by about 1.2 blurs
    column, row = (left + right + 1) // 2, (top + bottom + 1) // 2
    n = gather(image, (column, row), min(0.5 * max(size_x, size_y) + 1.6 * blur[0] + 0.5, most), xyv)
    bright, peak, light = window_sums(n, xyv, floor, level)
    crowded = bright != n_px
    if crowded:
        peak, light = region_sums(image, runs, (column, row), level)
    n_full = peak >= model.full_dn
    ax, ay, xx, xy, yy = upright(light)
    shape = stretch(xx, xy, yy, 0.5 * blur[0] * blur[0], n_px)
    # how long the region is: the difference of its principal moments over their sum
    pull_x, pull_y = (xx - yy) / (xx + yy), 2.0 * xy / (xx + yy)
    m0, m1, m2 = shape
    plain = m1 == 0.0 and m0 == m2

    # amplitude and radius from peak, area and threshold of the region
    amplitude = float(peak - level)
    area_radius = math.sqrt(n_px / math.pi)
    radius = area_radius
    for _ in range(2):
        radius = area_radius - blur[0] * tail_point((threshold + 0.5 - level) / amplitude)
        radius = max(radius, 0.4 * blur[0])
        amplitude = (peak - level) / below_edge(radius / blur[0])
    if n_full:
        amplitude *= 1.5
    x0, y0 = m0 * ax + m1 * ay, m1 * ax + m2 * ay
    if crowded or n_full or not plain:
        reach = min(radius + 3.0 * blur[0] + 0.5, most)
        side = 2 * min(half_side(shape, (x0, y0), reach), len(marks) // 2) + 1
        here = marks[:side, :side]
        first = blank(image, runs, (column, row), floor, model.full_dn, here)
        n = gather_unmarked(image, (column, row), shape, (x0, y0), reach, (here, first[0], first[1]), xyv)
    x0, y0, amplitude, level, radius, s, c, chi2, blur_variance, good = fit_disc(
        n,
        (xyv[0], xyv[1], xyv[2], sharper if plain else xyv[3]),
        (x0, y0, amplitude, level, radius),
        blur,
        model,
        not crowded and not n_full,
        work,
    )
    det = m0 * m2 - m1 * m1
    i0, i1, i2 = m2 / det, -m1 / det, m0 / det
    px, py = column + i0 * x0 + i1 * y0, row + i1 * x0 + i2 * y0
    # a fit that has left its region's light has found something else
    shift = math.hypot(px - column - ax, py - row - ay)
    good = good and shift < 0.3 + 0.15 * max(size_x, size_y)
    # with most of it left out for a neighbour's sake, the fit may know less than the centroid
    good = good and c[0] + c[2] < 2.0 * (2.0 * TOUCHING * radius) ** 2
    u0, u1, w0, w1 = (
        i0 * c[0] + i1 * c[1],
        i0 * c[1] + i1 * c[2],
        i1 * c[0] + i2 * c[1],
        i1 * c[1] + i2 * c[2],
    )
    out[XX], out[XY], out[YY] = u0 * i0 + u1 * i1, u0 * i1 + u1 * i2, w0 * i1 + w1 * i2
    half = math.sqrt(radius * radius + s * s)  # of the disc that has the flux of this blurred edge
    out[DIAMETER] = 2.0 * half
    out[PEAK] = peak
    out[ELONGATION] = max(size_x, size_y) / min(size_x, size_y)
    out[FLAGS] = (SATURATED if n_full else 0) + (0 if good else UNREFINED + (MERGED if crowded else 0))
    misfit = chi2 / max(n - 6, 1)
    # misfit beyond the noise, over the squared amplitude: of a good model about (2 %)^2
    rough = max(misfit - 1.0, 0.0) * (model.dark_dn2 + model.gain_dn * amplitude) / (amplitude * amplitude)
    out[MISFIT], out[ROUGH], out[PULL] = misfit, rough, math.hypot(pull_x, pull_y)
    odd = (
        good
        and not n_full
        and misfit > 1.3 + 5.0 * math.sqrt(2.0 / n)
        and rough > max(8.0 * usual_rough, 0.01)
    )
    if odd:
        # the model does not hold: the place is as uncertain as the misfit says
        out[FLAGS] += PARTIAL + (MERGED if out[PULL] > 0.2 else 0)
        out[XX], out[XY], out[YY] = misfit * out[XX], misfit * out[XY], misfit * out[YY]
    out[BLUR_INFO] = out[BLUR] = 0.0
    if good and plain and not crowded and not n_full:
        tally[N_TARGETS] += 1.0
        tally[ROUGH_SUM] += min(rough, 4.0 * usual_rough + 1e-4)
        if blur_variance < 1.0:
            # what the data alone say of the blur; no single target outweighs others by its brightness
            information = 1.0 / (blur_variance + 9e-4)
            posterior = 1.0 / (1.0 / blur_variance + 1.0 / (blur[1] * blur[1]))
            out[BLUR_INFO] = information
            out[BLUR] = (s / posterior - blur[0] / (blur[1] * blur[1])) * blur_variance
            tally[BLUR_SUM] += information * out[BLUR]
            tally[BLUR_WEIGHT] += information
        if teach and not odd:
            around = (x0, y0)
            teach_light(
                image, (column, row), around, min(half + 4.5 * s, most), floor, n_px, level, c, half, xyv, terms,
                tally, normal, right_side,
            )  # fmt: skip
    set_terms(image, px, py, half, terms)
    for k in range(9):  # the terms in R are shading
        px += learned[k, 0] * terms[k]
        py += learned[k, 1] * terms[k]
    out[X], out[Y] = px, py


@step
def set_terms(image: Array, x: float, y: float, radius: float, terms: Array) -> None:
    """Write (1, 1 / R, 1 / R^2, R) x (1, u, v) to ``terms``, u and v from the image's middle in half widths."""
    height, width = image.shape
    u, v = 2.0 * x / width - 1.0, (2.0 * y - height) / width
    size = 1.0
    for k in range(4):
        terms[3 * k], terms[3 * k + 1], terms[3 * k + 2] = size, size * u, size * v
        size = 0.25 * radius if k == 2 else size * 2.0 / radius


@step
def teach_light(
    image: Array,
    place: tuple[int, int],
    around: tuple[float, float],
    reach: float,
    floor: int,
    n_px: int,
    level: float,
    variance: tuple[float, float, float],
    radius: float,
    xyv: tuple[Array, Array, Array, Array],
    terms: Array,
    tally: Array,
    normal: Array,
    right_side: Array,
) -> None:
    """Add how far the centroid of a target's whole light lies from the fitted place, unless others shine there."""
    n = gather(image, place, reach, xyv)
    x, y, v, _ = xyv
    bright, limit = 0, f32(floor)
    for i in range(n):
        bright += v[i] > limit
    if bright != n_px:
        return
    # the background from the outer ring
    inner2 = f32((reach - 1.2) ** 2)
    ax, ay, base = f32(around[0]), f32(around[1]), f32(level)
    ring = n_ring = f32(0)
    for i in range(n):
        outside = (x[i] - ax) ** 2 + (y[i] - ay) ** 2 > inner2
        ring += (v[i] - base) * outside
        n_ring += ONE * outside
    if n_ring < 8.0:
        return
    base += ring / n_ring
    s = sx = sy = f32(0)
    for i in range(n):
        s += v[i] - base
        sx += (v[i] - base) * (x[i] - ax)
        sy += (v[i] - base) * (y[i] - ay)
    dx, dy = float(sx / s), float(sy / s)
    far2 = dx * dx + dy * dy
    if not far2 < 1.0:
        return
    # about the variance of the difference, with a floor; what lies far off counts little
    weight = 1.0 / ((variance[0] + variance[2] + 1e-4) * (1.0 + far2 / 0.04))
    set_terms(image, place[0] + around[0], place[1] + around[1], radius, terms)
    for i in range(N_TERMS):
        for j in range(N_TERMS):
            normal[i, j] += weight * terms[i] * terms[j]
        right_side[i, 0] += weight * terms[i] * dx
        right_side[i, 1] += weight * terms[i] * dy
    tally[N_LIGHT] += 1.0


@kernel
def refine_regions(
    addresses: Array,
    like: Array,
    size: tuple[int, int],
    runs: Array,
    regions: Array,
    lowest: Array,
    blurs: Array,
    learned: Array,
    rough: Array,
    model: Model,
) -> tuple[Array, Array, Array, Array, Array]:
    """Fit every region that does not touch its image's border.

    ``addresses``, ``like`` and ``size``: the images, as in ``mosca.detect_scan.scan_set``; ``runs``, ``regions`` and
    ``lowest`` are those of ``find_regions_in_set``; ``blurs`` (n images, 2): prior mean
    and standard deviation of the blur [px]; ``learned`` (n images, N_TERMS, 2): offsets by place and size;
    ``rough`` (n images,): usual misfit. Returns a table (n, N_COLUMNS), the region of each row (n), and what each
    image teaches: tallies (n images, N_TALLIES), normal matrices and right sides of the offsets.
    """
    height, width = size
    n_images = len(addresses)
    table = np.empty((len(regions), N_COLUMNS))
    region_of = np.empty(len(regions), np.int32)
    tally = np.zeros((n_images, N_TALLIES))
    normal, right_side = np.zeros((n_images, N_TERMS, N_TERMS)), np.zeros((n_images, N_TERMS, 2))
    terms = np.empty(N_TERMS)
    largest = 0
    for r in range(len(regions)):
        box, _ = box_of(runs[regions[r, 1] : regions[r, 2]])
        largest = max(largest, box[1] - box[0] + 1, box[3] - box[2] + 1)
    # the widest window: a region, and the blur that the fit may reach (see fit_disc)
    side = 2 * (largest + 30) + 1
    xyv = (
        np.empty(side * side, f32),
        np.empty(side * side, f32),
        np.empty(side * side, f32),
        np.empty(side * side, f32),
    )
    ones = np.ones(side * side, f32)
    marks, work = np.empty((side, side), np.uint8), np.empty((6, 7))
    n = first_of_image = 0
    for r in range(len(regions)):
        own = runs[regions[r, 1] : regions[r, 2]]
        box, _ = box_of(own)
        if box[0] == 0 or box[1] == width - 1 or box[2] == 0 or box[3] == height - 1:
            continue
        k = regions[r, 0]
        if n == 0 or regions[region_of[n - 1], 0] != k:
            first_of_image = n
        image = image_at(addresses[k], like, height, width)
        refine_region(
            image, own, regions[r, 3], lowest[k], (blurs[k, 0], blurs[k, 1]), model, xyv, ones, marks, work,
            learned[k], rough[k], (n - first_of_image) % EACH == 0, table[n], terms, tally[k], normal[k],
            right_side[k],
        )  # fmt: skip
        region_of[n] = r
        n += 1
    return table[:n], region_of[:n], tally, normal, right_side
