"""Compiled image of a blurred disc on pixels, and the normal equations of a fit to them.

The model and the source: ``mosca.detection.disc_fit.camera_statistics``.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from mosca.data.arrays import Array
from mosca.numba_support.decorators import bare_step, inlined_step

# Re-ordered sums let the compiler add eight pixels at once. NaN and infinity keep their meaning.
FAST = {"reassoc", "nsz", "arcp", "contract", "afn"}

f32 = np.float32

P0, P1, P2, P3, P4 = f32(0.3982078), f32(-0.06448306), f32(0.008401767), f32(-0.0006522268), f32(2.190772e-05)
Q0, Q1, Q2, Q3, Q4 = f32(0.3964177), f32(-0.1851492), f32(0.03625069), f32(-0.003324804), f32(0.00011544)
"""Polynomials of the edge on |t| <= 3, by least squares: erf(t / sqrt 2) / 2 = t P(t^2), right to 3e-4, and 1/2 at 3;
its derivative is the normal density Q(t^2), 0 at 3. A division would cost as much as ten of their terms."""
K1, K2 = f32(3), f32(6)  # of the Hermite polynomials t^3 - 3 t and t^4 - 6 t^2 + 3
ZERO, HALF, ONE, REACH = f32(0), f32(0.5), f32(1), f32(3)  # REACH: blurs from the edge where it ends
TINY = f32(1e-6)  # keeps distances from the centre above zero [px^2]

WHOLE_PIXELS, HALF_PIXELS, THIRD_PIXELS = 0.55, 0.4, 0.33
"""Blurs [px] from which pixels are taken whole, in 2 x 2 and in 3 x 3 parts; below, in 4 x 4. For simulated discs of
2 to 8 px and 10,000 photoelectrons, the model's error with whole pixels is 0.18 of the Cramer-Rao bound at 0.55 px,
0.64 at 0.8 of that and 0.01 to 0.09 at 1.25 of it; with 2 x 2 parts it is 0.025 at 0.4 px. For edges without any blur
the efficiency is 0.5 to 0.7 with 3 x 3 parts, 0.8 to 0.9 with 4 x 4 and with 5 x 5."""
WHOLE_PROFILED = 0.8
"""Blur from which pixels are taken whole for a disc with a profile: the error is a quarter of that at 0.55 px."""
LEAST_PART_2 = 1.0 / 192.0
"""Least squared blur of a part [px^2]: that of a perfect lens, (1 / 4 px)^2 / 12."""
SPACING = 1.5
"""Largest distance, in blurs, between the discs that make up a smeared one: the ripple of their sum is 3e-4 of it.
For images of 6 px of motion the error over the bound is 1.03 with 1.0, 1.04 with 1.5, 1.05 with 2, 1.10 with 3."""


class Profile(NamedTuple):
    """How a disc differs from an evenly bright one that stands still."""

    limb: float
    """Brightness is 1 + limb (r^2 / radius^2 - 1/2) at the distance r from the centre: below 0 for balls under light
    from their front, above for bright rims."""
    skew: float
    """The edge is the integral E(t) of a Gaussian plus ``skew`` and ``tails`` times its third and fourth derivatives
    (Edgeworth's series), for a rim that falls off more and more, and for rings of diffraction."""
    tails: float
    smear_x: float
    """Way of the disc in the image during the exposure, at constant speed [px]; pixels are not mapped where it is not
    0."""
    smear_y: float


EVEN = Profile(0.0, 0.0, 0.0, 0.0, 0.0)
"""An evenly bright disc that stands still."""


@bare_step(fastmath=FAST)
def even_as(profile: Profile) -> Profile:
    """Return the profile of an evenly bright disc with the same motion."""
    return Profile(0.0, 0.0, 0.0, profile.smear_x, profile.smear_y)


@bare_step(fastmath=FAST)
def is_profiled(profile: Profile) -> bool:
    """Return whether brightness or edge differ from those of an even disc."""
    return profile.limb != 0.0 or profile.skew != 0.0 or profile.tails != 0.0


@bare_step(fastmath=FAST)
def is_smeared(profile: Profile) -> bool:
    """Return whether the disc moved during the exposure."""
    return profile.smear_x != 0.0 or profile.smear_y != 0.0


@bare_step(fastmath=FAST)
def parts_of(blur: float) -> int:
    """Return into how many parts a pixel's side is divided, see ``disc_image``."""
    if blur >= WHOLE_PIXELS:
        return 1
    return 2 if blur >= HALF_PIXELS else 3 if blur >= THIRD_PIXELS else 4


@bare_step(fastmath=FAST)
def profiled_parts_of(blur: float) -> int:
    """Return the same for a disc with a profile: a pixel's square must not be taken for part of the profile."""
    return max(parts_of(blur), 2) if blur < WHOLE_PROFILED else 1


@bare_step(fastmath=FAST)
def part_blur(blur: float, m: int) -> float:
    """Return the blur [px] of lens and part of a pixel, where sides of pixels are divided by m."""
    return math.sqrt(max(blur * blur - (1.0 - 1.0 / (m * m)) / 12.0, LEAST_PART_2))


@inlined_step(fastmath=FAST)
def gaussian_edge(t: Any) -> Any:
    """Return the square of a position t within ``REACH`` blurs of an edge, and value and slope of the edge there."""
    u = t * t
    q = Q0 + u * (Q1 + u * (Q2 + u * (Q3 + u * Q4)))
    return u, HALF - t * (P0 + u * (P1 + u * (P2 + u * (P3 + u * P4)))), q


@inlined_step(fastmath=FAST)
def edge_at(x: Any, y: Any, sharper: Any, disc: tuple[Any, Any, Any, Any, Any, Any]) -> Any:
    """Return the value of a whole pixel of a blurred disc of brightness 1, and ``amplitude`` times its slopes.

    ``disc``: x0, y0, amplitude, background, radius, blur. Slopes: by x0, y0, radius and blur.
    """
    x0, y0, a, _, radius, blur = disc
    sharp = ONE / blur
    dx, dy = x - x0, y - y0
    r2 = dx * dx + dy * dy + TINY
    per_r = ONE / math.sqrt(r2)
    t = (r2 * per_r - radius) * sharp * sharper
    t = min(max(t, -REACH), REACH)
    _, e, q = gaussian_edge(t)
    g = a * sharp * sharper * q
    return e, g * per_r * dx, g * per_r * dy, g, g * t


@inlined_step(fastmath=FAST)
def profiled_edge_at(
    x: Any, y: Any, sharper: Any, disc: tuple[Any, Any, Any, Any, Any, Any], profile: tuple[Any, Any, Any]
) -> Any:
    """Return the same for a disc with another brightness or edge, see ``disc_image``.

    The slopes by radius and blur are exact at the edge only, which is enough to converge.
    """
    x0, y0, a, _, radius, blur = disc
    limb, skew, tails = profile
    sharp = sharper / blur
    dx, dy = x - x0, y - y0
    r2 = dx * dx + dy * dy + TINY
    per_r = ONE / math.sqrt(r2)
    r, per_radius, s = r2 * per_r, ONE / radius, ONE / sharp
    far = r - radius
    t = min(max(far * sharp, -REACH), REACH)
    u, gauss, q = gaussian_edge(t)
    e = gauss + (skew * (u - ONE) + tails * t * (u - K1)) * q
    f = q * sharp * (ONE + skew * t * (u - K1) + tails * (u * (u - K2) + K1))
    # a step times 1 + limb (r^2 / radius^2 - 1/2), under the blur
    c1 = f32(2) * limb * per_radius
    c2 = HALF * c1 * per_radius
    rim = ONE + HALF * limb
    value = e * (rim + far * (c1 + c2 * far) + c2 * s * s) - s * q * (c1 + c2 * far)
    inside, across = e * c1 * r * per_radius, c1 * per_radius * s * q
    g = a * (rim * f + across - inside * r * per_radius)
    slope = a * (rim * f + across - inside) * per_r
    return value, slope * dx, slope * dy, g, a * rim * f * t


def _add_edge_for(profiled: bool) -> Any:
    """Return ``add_edge`` for evenly bright discs or for others."""

    @bare_step(fastmath=FAST)
    def add_edge(
        n: int,
        pixels: Array,
        centre: tuple[Any, Any],
        radius: Any,
        blur: Any,
        profile: tuple[Any, Any, Any],
        share: tuple[Any, Any, Any],
        image: Array,
    ) -> None:
        """Add the values of a disc of brightness 1 at n points, under a Gaussian blur, to the rows of ``image``.

        ``share``: factors of what is in the rows, of the values, and a further one of the change with the blur.
        """
        x, y, sharper = pixels[0], pixels[1], pixels[2]
        e, by_x, by_y, by_radius, by_blur = image[0], image[1], image[2], image[3], image[4]
        kept, whole, change = share
        disc = (centre[0], centre[1], whole, ZERO, radius, blur)
        for i in range(n):
            if profiled:
                part, jx, jy, g, js = profiled_edge_at(x[i], y[i], sharper[i], disc, profile)
            else:
                part, jx, jy, g, js = edge_at(x[i], y[i], sharper[i], disc)
            e[i] = kept * e[i] + whole * part
            by_x[i] = kept * by_x[i] + jx
            by_y[i] = kept * by_y[i] + jy
            by_radius[i] = kept * by_radius[i] + g
            by_blur[i] = kept * by_blur[i] + change * js

    return add_edge


add_even_edge, add_profiled_edge = _add_edge_for(False), _add_edge_for(True)
del _add_edge_for  # Python has no use for it


@bare_step(fastmath=FAST)
def parts_along(
    profile: Profile, blur: float, m: int, shape: tuple[float, float, float]
) -> tuple[int, tuple[float, float], tuple[float, float]]:
    """Return number and extent of the parts in one direction, and extent of the ``m`` parts in the other.

    The directions are those of a pixel's sides. For a smeared disc they are along its way, with the pixel's extent
    there, and across it, with the pixel's alone. The parts have the variance of way and pixel together.
    """
    way = math.hypot(profile.smear_x, profile.smear_y)
    if way == 0.0:
        return m, (shape[0], shape[1]), (shape[1], shape[2])
    x, y, square = profile.smear_x / way, profile.smear_y / way, way * way + 1.0 - 1.0 / (m * m)
    n = max(math.ceil(math.sqrt(square) / (SPACING * part_blur(blur, m))), 2)
    longer = math.sqrt(square / (1.0 - 1.0 / (n * n)))
    return n, (longer * x, longer * y), (-y, x)


@bare_step(fastmath=FAST)
def disc_image(
    n: int,
    pixels: Array,
    disc: tuple[Any, Any, Any, Any],
    profile: Profile,
    shape: tuple[float, float, float],
    image: Array,
) -> None:
    """Write the values of a blurred disc of brightness 1 at n pixels, and their change with its parameters.

    A pixel averages over its area. Its sides are divided into m parts. The blur of such a part is approximated by a
    Gaussian with its variance, ``1 / (12 m^2)``. The error of m = 1 is that of the fourth cumulant, and falls with
    the fourth power of blur and m.

    Parameters
    ----------
    n, pixels
        The pixels (5, n or more): x, y, factor by which the edge is sharper there, 1 (0 for padding), grey value.
    disc
        x0, y0, radius and blur [px]; the blur is that of lens and pixel together.
    profile
        Light and motion of the disc.
    shape
        Symmetric matrix (xx, xy, yy) by which the offsets of pixels were mapped.
    image
        (5, n or more), of finite values: brightness, and its change with x0, y0, radius and blur.
    """
    x0, y0, radius, blur = disc
    used = (f32(profile.limb), f32(profile.skew), f32(profile.tails))
    profiled = is_profiled(profile)
    m = profiled_parts_of(blur) if profiled else parts_of(blur)
    n_along, along, across = parts_along(profile, blur, m, shape)
    part = f32(part_blur(blur, m))
    share, kept = ONE / f32(n_along * m), ZERO
    for j in range(m):
        for i in range(n_along):
            u, v = (i + 0.5) / n_along - 0.5, (j + 0.5) / m - 0.5
            at = (x0 - f32(along[0] * u + across[0] * v), y0 - f32(along[1] * u + across[1] * v))
            if profiled:
                add_profiled_edge(n, pixels, at, radius, part, used, (kept, share, blur / part), image)
            else:
                add_even_edge(n, pixels, at, radius, part, used, (kept, share, blur / part), image)
            kept = ONE


def _sums_for(divided: bool) -> Any:
    """Return ``sums`` for whole pixels, whose values it computes itself, or for divided ones, from ``disc_image``."""

    @bare_step(fastmath=FAST)
    def sums(
        n: int, pixels: Array, at: tuple[Any, Any, Any, Any, Any, Any], dark: Any, gain: Any, image: Array
    ) -> Any:
        """Return the normal equations of one Gauss-Newton step over n pixels.

        ``pixels`` and ``image`` as in ``disc_image``; ``at``: x0, y0, amplitude, background, radius, blur. For a
        window that is symmetric about the target the centre is uncorrelated with the other four unknowns, and is
        solved separately.
        """
        x, y, sharper, there, v = pixels[0], pixels[1], pixels[2], pixels[3], pixels[4]
        share, by_x, by_y, by_radius, by_blur = image[0], image[1], image[2], image[3], image[4]
        a, b = at[2], at[3]
        a_gain = a * gain
        hxx = hxy = hyy = cx = cy = chi2 = ZERO
        haa = hab = har = has = hbb = hbr = hbs = hrr = hrs = hss = ca = cb = cr = cs = ZERO
        for i in range(n):
            if divided:
                e, jx, jy, g, js = share[i], a * by_x[i], a * by_y[i], a * by_radius[i], a * by_blur[i]
            else:
                e, jx, jy, g, js = edge_at(x[i], y[i], sharper[i], at)
            w = there[i] / (dark + a_gain * e)
            d = v[i] - b - a * e
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

    return sums


sums_whole, sums_divided = _sums_for(False), _sums_for(True)
del _sums_for  # Python has no use for it


def _cross_sums_for(divided: bool) -> Any:
    """Return ``cross_sums`` for whole or divided pixels."""

    @bare_step(fastmath=FAST)
    def cross_sums(
        n: int, pixels: Array, at: tuple[Any, Any, Any, Any, Any, Any], dark: Any, gain: Any, image: Array
    ) -> Any:
        """Return what ``sums`` leaves out: the products of x, then y, with amplitude, background, radius and blur."""
        x, y, sharper, there = pixels[0], pixels[1], pixels[2], pixels[3]
        share, by_x, by_y, by_radius, by_blur = image[0], image[1], image[2], image[3], image[4]
        a = at[2]
        a_gain = a * gain
        xa = xb = xr = xs = ya = yb = yr = ys = ZERO
        for i in range(n):
            if divided:
                e, jx, jy, g, js = share[i], a * by_x[i], a * by_y[i], a * by_radius[i], a * by_blur[i]
            else:
                e, jx, jy, g, js = edge_at(x[i], y[i], sharper[i], at)
            w = there[i] / (dark + a_gain * e)
            wx, wy = w * jx, w * jy
            xa += wx * e
            xb += wx
            xr += wx * g
            xs += wx * js
            ya += wy * e
            yb += wy
            yr += wy * g
            ys += wy * js
        return xa, xb, xr, xs, ya, yb, yr, ys

    return cross_sums


cross_sums_whole, cross_sums_divided = _cross_sums_for(False), _cross_sums_for(True)
del _cross_sums_for
