"""Compiled fit of a blurred disc to the pixels around an accepted region.

Called by ``mosca.refine``, which states the model, the noise and the source. One kernel call takes all regions of
a frame set, is free of the GIL and runs on one thread, so that the same images always give the same places.
"""

import math
from typing import Any, NamedTuple

import numba
import numpy as np

from mosca.data.arrays import Array
from mosca.detect_memory import image_at

# As in mosca.detect_kernels: a cached kernel and all its steps stand in one file. Re-ordered sums are wanted
# here: they let the compiler add eight pixels at once. NaN and infinity must stay what they are.
_FAST = {"nogil": True, "error_model": "numpy", "fastmath": {"reassoc", "nsz", "arcp", "contract", "afn"}}
kernel = numba.njit(cache=True, **_FAST)
step = numba.njit(no_cpython_wrapper=True, no_cfunc_wrapper=True, **_FAST)
_PIXELS = {**_FAST, "fastmath": True}  # where only grey values go in
pixel_step = numba.njit(no_cpython_wrapper=True, no_cfunc_wrapper=True, **_PIXELS)

X, Y, XX, XY, YY, DIAMETER, PEAK, ELONGATION, FLAGS, BLUR, BLUR_INFO, MISFIT, ROUGH, PULL = range(14)
N_COLUMNS = 14

# What an image teaches: counts and sums, see mosca.refine.
N_TARGETS, BLUR_SUM, BLUR_WEIGHT, ROUGH_SUM, N_LIGHT = range(5)
N_TALLIES, N_TERMS = 5, 12
EACH = 8  # every so many targets the light's centroid is taken

SATURATED, MERGED, PARTIAL, UNREFINED = 1, 2, 4, 8

f32 = np.float32

# The edge, on |t| <= 3: erf(t / sqrt 2) / 2 = t P(t^2), right to 3e-4, and 1/2 at 3; its derivative the normal
# density Q(t^2), 0 at 3. Least squares; polynomials, since a division costs as much as ten of their terms.
P0, P1, P2, P3, P4 = f32(0.3982078), f32(-0.06448306), f32(0.008401767), f32(-0.0006522268), f32(2.190772e-05)
Q0, Q1, Q2, Q3, Q4 = f32(0.3964177), f32(-0.1851492), f32(0.03625069), f32(-0.003324804), f32(0.00011544)
ZERO, HALF, ONE, REACH = f32(0), f32(0.5), f32(1), f32(3)
TINY = f32(1e-6)


class Model(NamedTuple):
    """What the fit takes as given, in grey values [DN] and pixels. Pixels from ``full_dn`` on are saturated."""

    dark_dn2: float
    gain_dn: float
    full_dn: float


@step
def sums(
    n: int, pixels: tuple[Array, Array, Array, Array], at: tuple[Any, Any, Any, Any, Any, Any], dark: Any, gain: Any
) -> Any:
    """Return the normal equations of one Gauss-Newton step over n pixels.

    ``pixels``: x, y, grey value, and how much sharper than ``at`` says the edge is there. ``at``: x0, y0,
    amplitude, background, radius, blur. The place and the other four unknowns are at right
    angles for a window that is symmetric about the target, and are solved apart.
    """
    x, y, v, sharper = pixels
    x0, y0, a, b, radius, blur = at
    sharp = ONE / blur
    a_sharp, a_gain = a * sharp, a * gain
    hxx = hxy = hyy = cx = cy = chi2 = ZERO
    haa = hab = har = has = hbb = hbr = hbs = hrr = hrs = hss = ca = cb = cr = cs = ZERO
    for i in range(n):
        dx, dy = x[i] - x0, y[i] - y0
        r2 = dx * dx + dy * dy + TINY
        per_r = ONE / math.sqrt(r2)
        t = (r2 * per_r - radius) * sharp * sharper[i]
        t = min(max(t, -REACH), REACH)
        u = t * t
        e = HALF - t * (P0 + u * (P1 + u * (P2 + u * (P3 + u * P4))))
        g = a_sharp * sharper[i] * (Q0 + u * (Q1 + u * (Q2 + u * (Q3 + u * Q4))))
        w = ONE / (dark + a_gain * e)
        d = v[i] - b - a * e
        jx, jy, js = g * per_r * dx, g * per_r * dy, g * t
        wd, wx, wy, we, wg = w * d, w * jx, w * jy, w * e, w * g
        hxx += wx * jx
        hxy += wx * jy
        hyy += wy * jy
        cx += wd * jx
        cy += wd * jy
        haa += we * e
        hab += we
        har += we * g
        has += we * js
        hbb += w
        hbr += wg
        hbs += w * js
        hrr += wg * g
        hrs += wg * js
        hss += w * js * js
        ca += wd * e
        cb += wd
        cr += wd * g
        cs += wd * js
        chi2 += wd * d
    return (hxx, hxy, hyy, cx, cy), (haa, hab, har, has, hbb, hbr, hbs, hrr, hrs, hss), (ca, cb, cr, cs), chi2


@step
def cross_sums(
    n: int, pixels: tuple[Array, Array, Array, Array], at: tuple[Any, Any, Any, Any, Any, Any], dark: Any, gain: Any
) -> Any:
    """Return what ``sums`` leaves out: the products of x, then y, with amplitude, background, radius and blur."""
    x, y, v, sharper = pixels
    x0, y0, a, _, radius, blur = at
    sharp = ONE / blur
    a_sharp, a_gain = a * sharp, a * gain
    xa = xb = xr = xs = ya = yb = yr = ys = ZERO
    for i in range(n):
        dx, dy = x[i] - x0, y[i] - y0
        r2 = dx * dx + dy * dy + TINY
        per_r = ONE / math.sqrt(r2)
        t = (r2 * per_r - radius) * sharp * sharper[i]
        t = min(max(t, -REACH), REACH)
        u = t * t
        e = HALF - t * (P0 + u * (P1 + u * (P2 + u * (P3 + u * P4))))
        g = a_sharp * sharper[i] * (Q0 + u * (Q1 + u * (Q2 + u * (Q3 + u * Q4))))
        w = ONE / (dark + a_gain * e)
        wx, wy = w * g * per_r * dx, w * g * per_r * dy
        xa += wx * e
        xb += wx
        xr += wx * g
        xs += wx * g * t
        ya += wy * e
        yb += wy
        yr += wy * g
        ys += wy * g * t
    return xa, xb, xr, xs, ya, yb, yr, ys


@step
def solve_all(
    place: Any, h: Any, cross: Any, c: Any, prior: float, pull: float, peak_prior: float, peak_pull: float
) -> tuple[Array, Array, float, bool]:
    """Solve for all six unknowns at once, for a window that is not symmetric about the target.

    The amplitude too has a prior here, from the peak: with a side missing it is hard to tell from the radius.
    Returns the corrections (x, y, amplitude, background, radius, blur), the covariance (6, 6), the variance that
    the data alone give the blur, and whether there is a solution.
    """
    m = np.empty((6, 6))
    m[0, 0], m[0, 1], m[1, 1] = place[0], place[1], place[2]
    k = 0
    for i in range(2):
        for j in range(2, 6):
            m[i, j] = cross[k]
            k += 1
    k = 0
    for i in range(2, 6):
        for j in range(i, 6):
            m[i, j] = h[k]
            k += 1
    scale = np.empty(6)
    m[5, 5] += prior
    m[2, 2] += peak_prior
    for i in range(6):
        scale[i] = 1.0 / math.sqrt(max(m[i, i], 1e-12))
    for i in range(6):
        for j in range(i, 6):
            m[i, j] *= scale[i] * scale[j]
            m[j, i] = m[i, j]
        m[i, i] += 1e-7
    right = np.array([place[3], place[4], c[0] + peak_prior * peak_pull, c[1], c[2], c[3] + prior * pull])
    right *= scale
    # Cholesky, then its inverse
    low = np.zeros((6, 6))
    for i in range(6):
        for j in range(i + 1):
            rest = m[i, j]
            for q in range(j):
                rest -= low[i, q] * low[j, q]
            if i == j:
                if not rest > 1e-9:
                    return right, m, math.inf, False
                low[i, i] = math.sqrt(rest)
            else:
                low[i, j] = rest / low[j, j]
    inverse = np.zeros((6, 6))
    for column in range(6):
        for i in range(column, 6):
            rest = 1.0 if i == column else 0.0
            for q in range(column, i):
                rest -= low[i, q] * inverse[q, column]
            inverse[i, column] = rest / low[i, i]
    covariance, step_taken = np.zeros((6, 6)), np.zeros(6)
    for i in range(6):
        for j in range(6):
            for q in range(max(i, j), 6):
                covariance[i, j] += inverse[q, i] * inverse[q, j]
            covariance[i, j] *= scale[i] * scale[j]
            step_taken[i] += covariance[i, j] * right[j] / scale[j]
    return step_taken, covariance, 1.0 / max(1.0 / covariance[5, 5] - prior, 1e-12), True


@step
def solve_shape(h: Any, c: Any, prior: float, pull: float) -> tuple[float, float, float, float, float, float]:
    """Solve for amplitude, background, radius and blur; the blur is held by a prior of this information.

    ``pull``: prior mean less the present blur. Returns the four corrections, the variance that the data alone
    give the blur, or infinity, and the determinant's sign (0 where the equations have no solution).
    """
    haa, hab, har, has, hbb, hbr, hbs, hrr, hrs, hss = h
    ca, cb, cr, cs = c
    # L D L' in the order amplitude, background, radius, blur; in float64
    d0 = haa + 1e-9
    l1, l2, l3 = hab / d0, har / d0, has / d0
    d1 = hbb - l1 * hab + 1e-12
    m2, m3 = (hbr - l1 * har) / d1, (hbs - l1 * has) / d1
    d2 = hrr - l2 * har - m2 * m2 * d1 + 1e-9
    n3 = (hrs - l2 * has - m2 * m3 * d1) / d2
    data = hss - l3 * has - m3 * m3 * d1 - n3 * n3 * d2
    if not (d0 > 0.0 and d1 > 0.0 and d2 > 0.0 and data + prior > 0.0):
        return 0.0, 0.0, 0.0, 0.0, math.inf, 0.0
    z1 = cb - l1 * ca
    z2 = cr - l2 * ca - m2 * z1
    z3 = cs - l3 * ca - m3 * z1 - n3 * z2
    s = (z3 + prior * pull) / (data + prior)
    r = z2 / d2 - n3 * s
    b = z1 / d1 - m2 * r - m3 * s
    a = ca / d0 - l1 * b - l2 * r - l3 * s
    return a, b, r, s, 1.0 / max(data, 1e-12), 1.0


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
    return 0.5 + t * (P0 + u * (P1 + u * (P2 + u * (P3 + u * P4))))


@step
def box_of(runs: Array) -> tuple[tuple[Any, Any, Any, Any], Any]:
    """Return a region's left, right, top and bottom pixel, and its number of pixels."""
    left, right, n = runs[0, 1], runs[0, 2], np.int64(0)
    for i in range(len(runs)):
        left = min(left, runs[i, 1])
        right = max(right, runs[i, 2])
        n += runs[i, 2] - runs[i, 1]
    return (np.int64(left), np.int64(right - 1), np.int64(runs[0, 0]), np.int64(runs[-1, 0])), n


@step
def region_sums(image: Array, runs: Array, place: tuple[int, int], level: float) -> tuple[Any, ...]:
    """Return peak and sums as ``window_sums`` for the pixels of a region, about the pixel ``place``."""
    base = f32(level)
    s = sx = sy = sxx = sxy = syy = peak = ZERO
    for i in range(len(runs)):
        py = f32(runs[i, 0] - place[1])
        for column in range(runs[i, 1], runs[i, 2]):
            value, px = f32(image[runs[i, 0], column]), f32(column - place[0])
            light = value - base
            s += light
            sx += light * px
            sy += light * py
            sxx += light * px * px
            sxy += light * px * py
            syy += light * py * py
            peak = max(peak, value)
    return peak, (s, sx, sy, sxx, sxy, syy)


@step
def corner_level(image: Array, box: tuple[Any, Any, Any, Any], floor: int) -> float:
    """Return the mean grey value of the dark pixels two px off the corners of a box, ``floor`` where none is."""
    left, right, top, bottom = box
    height, width = image.shape
    total, n = 0.0, 0
    for y in (max(top - 2, 0), min(bottom + 2, height - 1)):
        for x in (max(left - 2, 0), min(right + 2, width - 1)):
            if image[y, x] <= floor:
                total += image[y, x]
                n += 1
    return total / n if n > 0 else float(floor)


@step
def blank(
    image: Array, runs: Array, place: tuple[int, int], floor: int, full: float, out: Array
) -> tuple[int, int]:
    """Mark in ``out`` (side, side), centred on ``place``, what does not belong into the fit of a region.

    That are saturated pixels, and pixels above ``floor`` that are not the region's own with what lies around
    them: 2 px, as far as a blurred edge reaches below the floor; 1 px where it is the region's own. Returns the
    first column and row of ``out`` in the image.
    """
    side = out.shape[0]
    height, width = image.shape
    left, top = place[0] - side // 2, place[1] - side // 2
    out[:, :] = 0
    for i in range(len(runs)):
        j = runs[i, 0] - top
        if 0 <= j < side:
            for k in range(max(runs[i, 1] - left, 0), min(runs[i, 2] - left, side)):
                out[j, k] = OWN
    for j in range(max(-top, 0), min(height - top, side)):
        for k in range(max(-left, 0), min(width - left, side)):
            value = image[top + j, left + k]
            if value >= full:
                out[j, k] |= OUT
            if value > floor and not out[j, k] & OWN:
                for q in range(max(j - 2, 0), min(j + 3, side)):
                    for p in range(max(k - 2, 0), min(k + 3, side)):
                        if not out[q, p] & OWN or max(abs(q - j), abs(p - k)) < 2:
                            out[q, p] |= OUT
    return left, top


OWN, OUT = 1, 2


@step
def copy_eight(line: Array, k: Any, v: Array, at: Any) -> None:
    """Copy eight grey values; all are read before one is written, so that the compiler may do it at once."""
    one, two, three, four = np.uint64(1), np.uint64(2), np.uint64(3), np.uint64(4)
    five, six, seven = np.uint64(5), np.uint64(6), np.uint64(7)
    a, b, c, d = line[k], line[k + one], line[k + two], line[k + three]
    e, f, g, h = line[k + four], line[k + five], line[k + six], line[k + seven]
    v[at], v[at + one], v[at + two], v[at + three] = f32(a), f32(b), f32(c), f32(d)
    v[at + four], v[at + five], v[at + six], v[at + seven] = f32(e), f32(f), f32(g), f32(h)


@step
def gather(image: Array, place: tuple[int, int], reach: float, xyv: tuple[Array, Array, Array, Array]) -> int:
    """Copy the pixels within ``reach`` of the pixel ``place``, and their offsets from it; return how many."""
    x, y, v, _ = xyv
    height, width = image.shape
    column, row = place
    n = 0
    whole = np.int64(reach)
    reach2 = f32(reach * reach)
    for j in range(max(row - whole, 0), min(row + whole + 1, height)):
        fy = f32(j - row)
        half = np.int64(math.sqrt(max(reach2 - fy * fy, ZERO)))
        first, end = max(column - half, 0), min(column + half + 1, width)
        line = image[j]
        if first + (end - first + 7) // 8 * 8 <= width:
            # eight at a time; what is written beyond the end is overwritten by the next row
            for k in range(first, end, 8):
                copy_eight(line, np.uint64(k), v, np.uint64(n + k - first))
            for k in range(first, end, 8):
                at = np.uint64(n + k - first)
                fx = f32(k - column)
                for i in range(8):
                    x[at + np.uint64(i)] = fx + f32(i)
                    y[at + np.uint64(i)] = fy
        else:
            for k in range(first, end):
                x[n + k - first], y[n + k - first], v[n + k - first] = f32(k - column), fy, f32(line[k])
        n += end - first
    return n


@pixel_step
def window_sums(n: int, xyv: tuple[Array, Array, Array, Array], threshold: int, level: float) -> tuple[Any, ...]:
    """Return the number of pixels above a threshold, their peak, and the sums (1, x, y, xx, xy, yy) of v - level."""
    x, y, v, _ = xyv
    limit, base = f32(threshold), f32(level)
    count = peak = s = sx = sy = sxx = sxy = syy = ZERO
    for i in range(n):
        inside = ONE if v[i] > limit else ZERO
        light = inside * (v[i] - base)
        lx, ly = light * x[i], light * y[i]
        count += inside
        s += light
        sx += lx
        sy += ly
        sxx += lx * x[i]
        sxy += lx * y[i]
        syy += ly * y[i]
    for i in range(n):
        peak = max(peak, v[i])
    return np.int64(count), peak, (s, sx, sy, sxx, sxy, syy)


@step
def gather_unmarked(
    image: Array,
    place: tuple[int, int],
    shape: tuple[float, float, float],
    around: tuple[float, float],
    reach: float,
    marks: tuple[Array, int, int],
    xyv: tuple[Array, Array, Array, Array],
) -> int:
    """Copy the pixels that ``blank`` leaves and that lie within ``reach`` of a target; return how many.

    Pixel offsets from ``place`` are turned by the symmetric matrix ``shape`` (xx, xy, yy), in which the target is
    round, and ``around`` is its middle there. ``marks``: the ``out`` of ``blank``, its first column and row.
    """
    x, y, v, sharper = xyv
    height, width = image.shape
    out, left, top = marks
    n = 0
    first_row, end_row = rows_within(shape, around, reach)
    for j in range(max(place[1] + first_row, 0, top), min(place[1] + end_row, height, top + len(out))):
        first, end = span_within(shape, around, reach, j - place[1])
        for i in range(max(place[0] + first, 0, left), min(place[0] + end, width, left + len(out))):
            if not out[j - top, i - left] & OUT:
                dx, dy = i - place[0], j - place[1]
                px, py = shape[0] * dx + shape[1] * dy, shape[1] * dx + shape[2] * dy
                x[n], y[n], v[n] = f32(px), f32(py), f32(image[j, i])
                # turned with the target, the round blur becomes narrower to one side, wider to the other
                qx, qy = px - around[0], py - around[1]
                wide = math.hypot(shape[0] * qx + shape[1] * qy, shape[1] * qx + shape[2] * qy)
                sharper[n] = f32((math.hypot(qx, qy) + 1e-3) / (wide + 1e-3))
                n += 1
    return n


@step
def rows_within(
    shape: tuple[float, float, float], around: tuple[float, float], reach: float
) -> tuple[int, int]:
    """Return the first and the end row in which pixel offsets d have ``|M d - around| <= reach``."""
    m0, m1, m2 = shape
    det = m0 * m2 - m1 * m1
    middle, half = (m0 * around[1] - m1 * around[0]) / det, reach * math.sqrt(m0 * m0 + m1 * m1) / abs(det)
    return math.ceil(middle - half), math.floor(middle + half) + 1


@step
def span_within(
    shape: tuple[float, float, float], around: tuple[float, float], reach: float, row: int
) -> tuple[int, int]:
    """Return the first and the end column of a row in which ``|M d - around| <= reach``."""
    m0, m1, m2 = shape
    a = m0 * m0 + m1 * m1
    p, q = m1 * row - around[0], m2 * row - around[1]
    half_b = m0 * p + m1 * q
    d = half_b * half_b - a * (p * p + q * q - reach * reach)
    if d <= 0.0:
        return 0, 0
    half = math.sqrt(d)
    return math.ceil((-half_b - half) / a), math.floor((-half_b + half) / a) + 1


@step
def fit_disc(
    n: int,
    pixels: tuple[Array, Array, Array, Array],
    start: tuple[Any, ...],
    blur: tuple[float, float],
    model: Model,
    symmetric: bool,
) -> tuple[Any, ...]:
    """Fit a blurred disc by Gauss-Newton steps until the place moves by less than a third of its error.

    ``start``: x0, y0, amplitude, background, radius; ``blur``: its prior mean and standard deviation;
    ``symmetric``: whether the pixels lie all around the target, so that the place can be solved apart. Returns
    x0, y0, amplitude, background, radius, blur, the variances (xx, xy, yy) of the place, chi-square, the blur's
    variance from the data alone, and whether it converged.
    """
    x0, y0, a, b, radius = start
    mean, prior = blur[0], 1.0 / (blur[1] * blur[1])
    s = mean
    # a saturated target has no peak
    peak_prior = 0.0 if start[2] + b >= model.full_dn else 1.0 / (0.1 * start[2]) ** 2
    dark, gain = f32(model.dark_dn2), f32(model.gain_dn)
    cxx = cxy = cyy = chi2 = 0.0
    blur_variance = math.inf
    good = False
    for turn in range(MOST_STEPS):
        at = (f32(x0), f32(y0), f32(a), f32(b), f32(radius), f32(s))
        place, h, c, chi2_here = sums(n, pixels, at, dark, gain)
        px, py = float(place[3]), float(place[4])
        if symmetric:
            hxx, hxy, hyy = float(place[0]), float(place[1]), float(place[2])
            det = hxx * hyy - hxy * hxy
            if not det > 1e-9 * hxx * hyy:
                break
            cxx, cxy, cyy = hyy / det, -hxy / det, hxx / det
            da, db, dr, ds, blur_variance, solved = solve_shape(
                (
                    float(h[0]), float(h[1]), float(h[2]), float(h[3]), float(h[4]),
                    float(h[5]), float(h[6]), float(h[7]), float(h[8]), float(h[9]),
                ),
                (float(c[0]), float(c[1]), float(c[2]), float(c[3])), prior, mean - s,
            )  # fmt: skip
            if solved == 0.0:
                break
            dx, dy = cxx * px + cxy * py, cxy * px + cyy * py
        else:
            cross = cross_sums(n, pixels, at, dark, gain)
            change, covariance, blur_variance, found = solve_all(
                place, h, cross, c, prior, mean - s, peak_prior, start[2] - a
            )
            if not found:
                break
            cxx, cxy, cyy = covariance[0, 0], covariance[0, 1], covariance[1, 1]
            dx, dy, da, db, dr, ds = change[0], change[1], change[2], change[3], change[4], change[5]
        # over its own error, squared
        moved = (cyy * dx * dx - 2.0 * cxy * dx * dy + cxx * dy * dy) / (cxx * cyy - cxy * cxy)
        chi2 = chi2_here - dx * px - dy * py
        far = max(abs(dx), abs(dy))
        most = 0.5 * radius + 0.3
        hold = min(1.0, most / far) if far > most else 1.0
        x0 += hold * dx
        y0 += hold * dy
        calm = abs(dr) < 0.25 * s and abs(da) < 0.25 * a
        a = max(a + da, 0.4 * a)
        b += db
        radius = min(max(radius + dr, 0.6 * radius, 0.2 * s), 1.6 * radius + s)
        s = min(max(s + ds, 0.75 * s, 0.3), 1.3 * s, 6.0)
        if moved < 0.1 and calm and turn > 0:
            good = True
            break
    return x0, y0, a, b, radius, s, (cxx, cxy, cyy), chi2, blur_variance, good


MOST_STEPS = 9


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
    x0, y0 = m0 * ax + m1 * ay, m1 * ax + m2 * ay
    if crowded or n_full or not plain:
        first = blank(image, runs, (column, row), floor, model.full_dn, marks)
        reach = min(radius + 3.0 * blur[0] + 0.5, most)
        n = gather_unmarked(
            image, (column, row), shape, (x0, y0), reach, (marks, first[0], first[1]), xyv
        )
    x0, y0, amplitude, level, radius, s, c, chi2, blur_variance, good = fit_disc(
        n,
        (xyv[0], xyv[1], xyv[2], sharper if plain else xyv[3]),
        (x0, y0, amplitude, level, radius),
        blur,
        model,
        not crowded and not n_full,
    )
    det = m0 * m2 - m1 * m1
    i0, i1, i2 = m2 / det, -m1 / det, m0 / det
    px, py = column + i0 * x0 + i1 * y0, row + i1 * x0 + i2 * y0
    good = good and left - 1.0 <= px <= right + 1.0 and top - 1.0 <= py <= bottom + 1.0
    u0, u1, w0, w1 = i0 * c[0] + i1 * c[1], i0 * c[1] + i1 * c[2], i1 * c[0] + i2 * c[1], i1 * c[1] + i2 * c[2]
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
    odd = good and not n_full and misfit > 1.3 + 5.0 * math.sqrt(2.0 / n) and rough > max(8.0 * usual_rough, 0.004)
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
    ``rough`` (n images,): usual misfit. Returns a table (n, N_COLUMNS), the image of each row (n), and what each
    image teaches: tallies (n images, N_TALLIES), normal matrices and right sides of the offsets.
    """
    height, width = size
    n_images = len(addresses)
    table = np.empty((len(regions), N_COLUMNS))
    image_of = np.empty(len(regions), np.int32)
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
    marks = np.empty((side, side), np.uint8)
    n = first_of_image = 0
    for r in range(len(regions)):
        own = runs[regions[r, 1] : regions[r, 2]]
        box, _ = box_of(own)
        if box[0] == 0 or box[1] == width - 1 or box[2] == 0 or box[3] == height - 1:
            continue
        k = regions[r, 0]
        if n == 0 or image_of[n - 1] != k:
            first_of_image = n
        image = image_at(addresses[k], like, height, width)
        refine_region(
            image, own, regions[r, 3], lowest[k], (blurs[k, 0], blurs[k, 1]), model, xyv, ones, marks, learned[k],
            rough[k], (n - first_of_image) % EACH == 0, table[n], terms, tally[k], normal[k], right_side[k],
        )  # fmt: skip
        image_of[n] = k
        n += 1
    return table[:n], image_of[:n], tally, normal, right_side
