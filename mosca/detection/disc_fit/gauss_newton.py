"""Compiled fit of a blurred disc to pixels: normal equations, their solution, the steps.

The model, the noise and the source: ``mosca.detection.disc_fit.camera_statistics``. Compiled into the
kernel in ``mosca.detection.disc_fit.fit_regions``.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from mosca.data.arrays import Array
from mosca.numba_support.decorators import bare_step

# Re-ordered sums let the compiler add eight pixels at once. NaN and infinity keep their meaning.
FAST = {"reassoc", "nsz", "arcp", "contract", "afn"}

f32 = np.float32

# The edge, on |t| <= 3: erf(t / sqrt 2) / 2 = t P(t^2), right to 3e-4, and 1/2 at 3; its derivative the normal
# density Q(t^2), 0 at 3. Least squares; polynomials, since a division costs as much as ten of their terms.
P0, P1, P2, P3, P4 = f32(0.3982078), f32(-0.06448306), f32(0.008401767), f32(-0.0006522268), f32(2.190772e-05)
Q0, Q1, Q2, Q3, Q4 = f32(0.3964177), f32(-0.1851492), f32(0.03625069), f32(-0.003324804), f32(0.00011544)
ZERO, HALF, ONE, REACH = f32(0), f32(0.5), f32(1), f32(3)  # REACH: blurs from the edge where it ends
TINY = f32(1e-6)  # keeps distances from the centre above zero [px^2]


MOST_STEPS = 9
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
    """A fitted disc, [px] and [DN], offsets as those of its pixels."""

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
    """Of the blur, from the data alone [px^2]."""
    converged: bool


@bare_step(fastmath=FAST)
def sums(n: int, pixels: Array, at: tuple[Any, Any, Any, Any, Any, Any], dark: Any, gain: Any) -> Any:
    """Return the normal equations of one Gauss-Newton step over n pixels.

    ``pixels`` (5, n or more): x, y, factor by which the edge is sharper there than the blur of ``at``, 1 (0 for
    padding), and grey value. ``at``: x0, y0, amplitude, background, radius, blur. For a window that is symmetric
    about the target the centre is uncorrelated with the other four unknowns, and is solved separately.
    """
    x, y, sharper, there, v = pixels[0], pixels[1], pixels[2], pixels[3], pixels[4]
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
        w = there[i] / (dark + a_gain * e)
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


@bare_step(fastmath=FAST)
def cross_sums(n: int, pixels: Array, at: tuple[Any, Any, Any, Any, Any, Any], dark: Any, gain: Any) -> Any:
    """Return what ``sums`` leaves out: the products of x, then y, with amplitude, background, radius and blur."""
    x, y, sharper, there = pixels[0], pixels[1], pixels[2], pixels[3]
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
        w = there[i] / (dark + a_gain * e)
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


@bare_step(fastmath=FAST)
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


@bare_step(fastmath=FAST)
def solve_all(
    place: Any, h: Any, cross: Any, c: Any, prior: tuple[float, float], peak: tuple[float, float], work: Array
) -> tuple[Any, ...]:
    """Solve for all six unknowns at once, for a window that is not symmetric about the target.

    ``prior``: information on the blur, and prior mean less the present one; ``peak``: the same of the amplitude,
    nearly collinear with the radius where a side is missing. ``work`` (6, 7): working memory. Returns the
    corrections (x, y, amplitude, background, radius, blur), the centre's covariance (xx, xy, yy), the variance of the
    blur from the data alone, and whether there is a solution.
    """
    # in the order amplitude, background, radius, blur, x, y: the factor's last rows hold the centre's covariance
    k = 0
    for j in range(4):
        for i in range(j, 4):
            work[i, j] = h[k]
            k += 1
        work[4, j], work[5, j], work[j, 6] = cross[j], cross[4 + j], c[j]
    work[4, 4], work[5, 4], work[5, 5] = place[0], place[1], place[2]
    work[4, 6], work[5, 6] = place[3], place[4]
    work[3, 3] += prior[0]
    work[3, 6] += prior[0] * prior[1]
    work[0, 0] += peak[0]
    work[0, 6] += peak[0] * peak[1]
    nothing = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, math.inf, False)
    # Cholesky of the matrix scaled to a unit diagonal: row i of the factor, and the right side with it
    for i in range(6):
        work[i, 6] *= 1.0 / math.sqrt(max(work[i, i], 1e-12))
    for i in range(6):
        for j in range(i):
            work[i, j] /= math.sqrt(max(work[i, i], 1e-12) * max(work[j, j], 1e-12))
    s0, s1, s2 = work[0, 0], work[1, 1], work[2, 2]
    s3, s4, s5 = work[3, 3], work[4, 4], work[5, 5]
    for i in range(6):
        for j in range(i):
            rest = work[i, j]
            for q in range(j):
                rest -= work[i, q] * work[j, q]
            work[i, j] = rest / work[j, j]
            work[i, 6] -= work[i, j] * work[j, 6]
        rest = 1.0 + 1e-7
        for q in range(i):
            rest -= work[i, q] * work[i, q]
        if not rest > 1e-9:
            return nothing
        work[i, i] = math.sqrt(rest)
        work[i, 6] /= work[i, i]
    # of the inverse factor the last three columns
    u3, u4, u5 = 1.0 / work[3, 3], 1.0 / work[4, 4], 1.0 / work[5, 5]
    u43, u54 = -work[4, 3] * u3 * u4, -work[5, 4] * u4 * u5
    u53 = -(work[5, 3] * u3 + work[5, 4] * u43) * u5
    s4, s5 = 1.0 / math.sqrt(max(s4, 1e-12)), 1.0 / math.sqrt(max(s5, 1e-12))
    own = (u3 * u3 + u43 * u43 + u53 * u53) / max(s3, 1e-12)
    for i in range(5, -1, -1):
        for q in range(i + 1, 6):
            work[i, 6] -= work[q, i] * work[q, 6]
        work[i, 6] /= work[i, i]
    return (
        work[4, 6] * s4, work[5, 6] * s5, work[0, 6] / math.sqrt(max(s0, 1e-12)),
        work[1, 6] / math.sqrt(max(s1, 1e-12)), work[2, 6] / math.sqrt(max(s2, 1e-12)),
        work[3, 6] / math.sqrt(max(s3, 1e-12)), (u4 * u4 + u54 * u54) * s4 * s4, u54 * u5 * s4 * s5,
        u5 * u5 * s5 * s5, 1.0 / max(1.0 / own - prior[0], 1e-12), True,
    )  # fmt: skip


@bare_step(fastmath=FAST)
def fit_disc(
    n: int,
    pixels: Array,
    start: tuple[Any, ...],
    blur: tuple[float, float],
    model: Model,
    symmetric: bool,
    work: Array,
) -> DiscFit:
    """Fit a blurred disc to n pixels by Gauss-Newton steps until the centre moves by less than its error.

    Parameters
    ----------
    n, pixels
        The pixels as in ``sums``.
    start
        x0, y0, amplitude, background, radius.
    blur
        Prior mean and standard deviation.
    symmetric
        Whether the pixels lie all around the target, so that the centre can be solved separately.
    model, work
        Pixel noise and saturation; (6, 7) working memory.
    """
    x0, y0, a, b, radius = start
    mean, prior = blur[0], 1.0 / (blur[1] * blur[1])
    s = mean
    # a saturated target shows only that its peak is higher
    known = 1.0 if start[2] + b >= model.full_dn else 0.1
    peak_prior = 1.0 / (known * start[2]) ** 2
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
            dx, dy, da, db, dr, ds, cxx, cxy, cyy, blur_variance, found = solve_all(
                place, h, cross, c, (prior, mean - s), (peak_prior, start[2] - a), work
            )
            if not found:
                break
        # over its own error, squared
        moved = (cyy * dx * dx - 2.0 * cxy * dx * dy + cxx * dy * dy) / (cxx * cyy - cxy * cxy)
        gained = da * float(c[0]) + db * float(c[1]) + dr * float(c[2]) + ds * float(c[3])
        chi2 = chi2_here - dx * px - dy * py - gained
        far = max(abs(dx), abs(dy))
        most = 0.5 * radius + 0.3
        hold = min(1.0, most / far) if far > most else 1.0
        x0 += hold * dx
        y0 += hold * dy
        calm = abs(dr) < 0.25 * s and abs(da) < 0.25 * a
        near = max(abs(dr), abs(ds)) < NEAR * s and abs(da) < NEAR_LIGHT * a and moved < NEAR_2
        a = max(a + da, 0.4 * a)
        b += db
        radius = min(max(radius + dr, 0.6 * radius, 0.2 * s), 1.6 * radius + s)
        s = min(max(s + ds, 0.75 * s, 0.3), 1.3 * s, 6.0)
        if calm and (near or (turn > 0 and moved < SETTLED_2)):
            good = True
            break
    return DiscFit(x0, y0, a, b, radius, s, (cxx, cxy, cyy), chi2, blur_variance, good)
