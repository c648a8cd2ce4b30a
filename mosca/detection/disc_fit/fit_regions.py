"""Compiled refinement of the regions of a frame set, and what it teaches.

The model, the noise and the source: ``mosca.detection.disc_fit.camera_statistics``. Called by
``mosca.detection.frame_set_kernel`` for all regions of a frame set at once, on one thread, so that the same images
always give the same places.
"""

import math
from typing import Any

import numpy as np

from mosca.data.arrays import Array
from mosca.data.detections import MERGED, PARTIAL, SATURATED, UNREFINED
from mosca.detection.disc_fit.gauss_newton import (
    FAST,
    ONE,
    P0,
    P1,
    P2,
    P3,
    P4,
    Model,
    f32,
    fit_disc,
)
from mosca.detection.disc_fit.pixels import (
    OVER,
    Windows,
    gather,
    gather_round,
    gather_unmarked,
    half_side,
    lent,
    pad,
    reach_of,
)
from mosca.detection.disc_fit.pixels import V as PIXEL_V
from mosca.detection.disc_fit.pixels import X as PIXEL_X
from mosca.detection.disc_fit.pixels import Y as PIXEL_Y
from mosca.detection.disc_fit.refine_window import blank, box_of, corner_level, region_sums, window_sums
from mosca.numba_support.decorators import bare_step, step
from mosca.numba_support.intrinsics import image_at, prefetch

X, Y, XX, XY, YY, DIAMETER, PEAK, ELONGATION, FLAGS, BLUR, BLUR_INFO, MISFIT, ROUGH, PULL = range(14)
N_COLUMNS = 14

# What an image teaches: counts and sums, see mosca.detection.disc_fit.camera_statistics.
N_TARGETS, BLUR_SUM, BLUR_WEIGHT, ROUGH_SUM, N_LIGHT = range(5)
N_TALLIES, N_TERMS = 5, 12
TOUCHING = 0.03
"""Error of a centroid that a neighbour's light draws, standard deviation as a share of the diameter (measured)."""
EACH = 8  # every so many targets the light's centroid is taken


@bare_step(fastmath=FAST)
def tail_point(share: float) -> float:
    """Return t at which the normal distribution leaves ``share`` (up to a half) above it.

    Abramowitz and Stegun 26.2.22, right to 0.003.
    """
    q = math.sqrt(-2.0 * math.log(min(max(share, 1e-6), 0.5)))
    return max(q - (2.30753 + 0.27061 * q) / (1.0 + q * (0.99229 + 0.04481 * q)), 0.0)


@bare_step(fastmath=FAST)
def below_edge(t: float) -> float:
    """Return the normal distribution's integral up to t >= 0, by the polynomial of the edge."""
    t = min(t, 3.0)
    u = t * t
    return float(0.5 + t * (P0 + u * (P1 + u * (P2 + u * (P3 + u * P4)))))


@bare_step(fastmath=FAST)
def upright(sums_of_light: Any) -> tuple[float, float, float, float, float]:
    """Return centroid and central second moments (xx, xy, yy) from sums (1, x, y, xx, xy, yy) of light."""
    flux = max(float(sums_of_light[0]), 1e-6)
    x, y = sums_of_light[1] / flux, sums_of_light[2] / flux
    xx, xy, yy = sums_of_light[3] / flux, sums_of_light[4] / flux, sums_of_light[5] / flux
    return x, y, xx - x * x, xy - x * y, yy - y * y


@bare_step(fastmath=FAST)
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


@bare_step(fastmath=FAST)
def refine_region(
    image: Array,
    runs: Array,
    box: tuple[int, int, int, int],
    n_px: int,
    threshold: int,
    floor: int,
    blur: tuple[float, float],
    model: Model,
    scratch: Array,
    windows: Windows,
    widest: int,
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
    left, right, top, bottom = box
    size_x, size_y = right - left + 1, bottom - top + 1
    most = 0.5 * widest - 2.0  # what the scratch arrays hold
    level = min(corner_level(image, box, floor), float(threshold))
    # the whole of a lonely round target is copied once
    column, row = (left + right + 1) // 2, (top + bottom + 1) // 2
    n, pixels = gather_round(
        image,
        (column, row),
        max(size_x, size_y),
        min(reach_of(max(size_x, size_y), blur[0]), most),
        windows,
        scratch,
    )
    bright, peak, light = window_sums(n, pixels, floor, level)
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
        side = 2 * min(half_side(shape, (x0, y0), reach), widest // 2) + 1
        first = blank(image, runs, (column, row), floor, model.full_dn, side, marks)
        n = gather_unmarked(
            image, (column, row), shape, (x0, y0), reach, (marks[0], side, first[0], first[1]), scratch
        )
        pixels = scratch
        pad(n, pixels)
    x0, y0, amplitude, level, radius, s, c, chi2, blur_variance, good = fit_disc(
        (n + 7) // 8 * 8,
        pixels,
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
    shift = math.sqrt((px - column - ax) ** 2 + (py - row - ay) ** 2)
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
    out[MISFIT], out[ROUGH], out[PULL] = misfit, rough, math.sqrt(pull_x * pull_x + pull_y * pull_y)
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
                image, (column, row), around, min(half + 4.5 * s, most), floor, n_px, level, c, half, scratch, terms,
                tally, normal, right_side,
            )  # fmt: skip
    set_terms(image, px, py, half, terms)
    for k in range(9):  # the terms in R are shading
        px += learned[k, 0] * terms[k]
        py += learned[k, 1] * terms[k]
    out[X], out[Y] = px, py


@bare_step(fastmath=FAST)
def set_terms(image: Array, x: float, y: float, radius: float, terms: Array) -> None:
    """Write (1, 1 / R, 1 / R^2, R) x (1, u, v) to ``terms``, u and v from the image's middle in half widths."""
    height, width = image.shape
    u, v = 2.0 * x / width - 1.0, (2.0 * y - height) / width
    size = 1.0
    for k in range(4):
        terms[3 * k], terms[3 * k + 1], terms[3 * k + 2] = size, size * u, size * v
        size = 0.25 * radius if k == 2 else size * 2.0 / radius


@bare_step(fastmath=FAST)
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
    scratch: Array,
    terms: Array,
    tally: Array,
    normal: Array,
    right_side: Array,
) -> None:
    """Add how far the centroid of a target's whole light lies from the fitted place, unless others shine there."""
    n = gather(image, place, reach * reach, scratch)
    x, y, v = scratch[PIXEL_X], scratch[PIXEL_Y], scratch[PIXEL_V]
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


@step(fastmath=FAST)
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

    ``addresses``, ``like`` and ``size``: the images, as in ``mosca.detection.bright_runs.scan_set``; ``runs``,
    ``regions`` and ``lowest`` are those of ``find_regions_in_set``; ``blurs`` (n images, 2): prior mean
    and standard deviation of the blur [px]; ``learned`` (n images, N_TERMS, 2): offsets by place and size;
    ``rough`` (n images,): usual misfit. Returns a table (n, N_COLUMNS), the region of each row (n), and what each
    image teaches: tallies (n images, N_TALLIES), normal matrices and right sides of the offsets.
    """
    height, width = size
    n_images, n_regions = len(addresses), len(regions)
    table = np.empty((n_regions, N_COLUMNS))
    region_of = np.empty(n_regions, np.int32)
    tally = np.zeros((n_images, N_TALLIES))
    normal, right_side = np.zeros((n_images * N_TERMS, N_TERMS)), np.zeros((n_images * N_TERMS, 2))
    largest = 0
    # left, right, top, bottom, number of pixels; 1 in the last where it touches the image's border
    own_boxes = np.empty((n_regions + 1, 6), np.int64)
    for r in range(n_regions):
        (left, right, top, bottom), n_px = box_of(runs, regions[r, 1], regions[r, 2])
        largest = max(largest, right - left + 1, bottom - top + 1)
        own_boxes[r, 0], own_boxes[r, 1], own_boxes[r, 2], own_boxes[r, 3] = left, right, top, bottom
        own_boxes[r, 4] = n_px
        own_boxes[r, 5] = left == 0 or right == width - 1 or top == 0 or bottom == height - 1
    # the widest window: a region, and the blur that the fit may reach (see fit_disc)
    side = 2 * (largest + 30) + 1
    most_blur, room = 0.0, 1
    for k in range(n_images):
        most_blur = max(most_blur, blurs[k, 0])
    for k in range(1, largest + 1):
        room += 5 * (min(2 * int(reach_of(k, most_blur)) + 1, side) ** 2 + 7) + OVER
    own_pixels, own_windows = np.empty((5, side * side + OVER), f32), np.empty((1, room), f32)
    own_half, own_known = np.empty((largest + 1, side), np.int32), np.empty((largest + 1, 2), np.int64)
    own_marks, own_work, own_terms = (
        np.empty((4, side * side), np.uint8),
        np.empty((6, 7)),
        np.empty((1, N_TERMS)),
    )
    own_learned = learned.copy().reshape(n_images * N_TERMS, 2)
    scratch, windows = lent(own_pixels), Windows(lent(own_windows), lent(own_half), lent(own_known))
    marks, work, terms = lent(own_marks), lent(own_work), lent(own_terms)[0]
    rows, all_runs, boxes, offsets = lent(table), lent(runs), lent(own_boxes), lent(own_learned)
    tallies, normals, right_sides = lent(tally), lent(normal), lent(right_side)
    n = first_of_image = 0
    for r in range(n_regions):
        if boxes[r, 5]:
            continue
        k = int(regions[r, 0])
        if n == 0 or regions[region_of[n - 1], 0] != k:
            first_of_image = n
            windows.known[:, 0] = -1
            windows.known[0, 0] = 0
        image = image_at(addresses[k], like, height, width)
        if r + 1 < n_regions:
            # the next region's pixels come while this one is fitted
            ahead = max(boxes[r + 1, 2] - 3, 0) * width + max(boxes[r + 1, 0] - 3, 0)
            at = addresses[regions[r + 1, 0]] + np.uint64(ahead * like.itemsize)
            for _ in range(boxes[r + 1, 3] - boxes[r + 1, 2] + 7):
                prefetch(at)  # type: ignore[call-arg]
                at += np.uint64(width * like.itemsize)
        begin, end = N_TERMS * k, N_TERMS * (k + 1)
        refine_region(
            image, all_runs[regions[r, 1] : regions[r, 2]],
            (boxes[r, 0], boxes[r, 1], boxes[r, 2], boxes[r, 3]), boxes[r, 4], regions[r, 3], lowest[k],
            (blurs[k, 0], blurs[k, 1]), model, scratch, windows, side, marks, work, offsets[begin:end], rough[k],
            (n - first_of_image) % EACH == 0, rows[n], terms, tallies[k], normals[begin:end],
            right_sides[begin:end],
        )  # fmt: skip
        region_of[n] = r
        n += 1
    # the scratch arrays are only lent above: here they have been needed
    own_pixels[0, 0] = own_windows[0, 0] = own_terms[0, 0] = own_work[0, 0] = own_learned[0, 0] = 0.0
    own_half[0, 0] = own_known[0, 0] = own_marks[0, 0] = own_boxes[0, 0] = 0
    return (
        table[:n], region_of[:n], tally, normal.reshape(n_images, N_TERMS, N_TERMS),
        right_side.reshape(n_images, N_TERMS, 2),
    )  # fmt: skip
