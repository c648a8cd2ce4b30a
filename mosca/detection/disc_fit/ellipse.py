"""Compiled: an elliptic target's shape and its ellipticity, from the residuals of the disc that was fitted to it.

Let (1 + T), T = [[p, q], [q, -p]], be a small stretch of the map in which the target is round. It changes a pixel's
value by ``-g r (p cos 2 phi + q sin 2 phi)``, g being the slope of its edge. Over a window all around the target this
change is uncorrelated with centre, radius, blur, amplitude and background, so p and q are solved for by themselves.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from mosca.data.arrays import Array
from mosca.detection.disc_fit.disc_image import FAST, ZERO, disc_image, f32, is_smeared
from mosca.detection.disc_fit.first_values import Light, Region, is_plain, least_difference
from mosca.detection.disc_fit.gauss_newton import DiscFit, Model, Workspace
from mosca.numba_support.decorators import bare_step

f64 = np.float64

MOST_CHANGE = 0.3
"""Largest stretch of one step."""


class Stretch(NamedTuple):
    """Stretch estimated from the residuals of a fitted disc."""

    p: float
    q: float
    chi2: float
    """Squared length of the step, in units of its error."""
    variance: float
    """Variance of p and of q, as a geometric mean; infinite where the pixels do not determine them."""


@bare_step(fastmath=FAST)
def stretch_sums(n: int, pixels: Array, fit: DiscFit, model: Model, image: Array) -> Any:
    """Return the normal equations (pp, pq, qq, p, q) of a stretch; ``image`` as from ``disc_image``."""
    x, y, there, v = pixels[0], pixels[1], pixels[3], pixels[4]
    share, by_x, by_y = image[0], image[1], image[2]
    x0, y0, a, b = f32(fit.x), f32(fit.y), f32(fit.amplitude), f32(fit.background)
    dark, a_gain = f32(model.dark_dn2), f32(model.gain_dn) * a
    pp = pq = qq = cp = cq = ZERO
    for i in range(n):
        dx, dy, jx, jy = x[i] - x0, y[i] - y0, a * by_x[i], a * by_y[i]
        jp, jq = jy * dy - jx * dx, -jx * dy - jy * dx
        w = there[i] / (dark + a_gain * share[i])
        d = w * (v[i] - b - a * share[i])
        pp += w * jp * jp
        pq += w * jp * jq
        qq += w * jq * jq
        cp += d * jp
        cq += d * jq
    return pp, pq, qq, cp, cq


@bare_step(fastmath=FAST)
def stretch_of(
    n: int, pixels: Array, fit: DiscFit, model: Model, shape: tuple[float, float, float], work: Workspace
) -> Stretch:
    """Return the stretch of a target whose pixels, mapped by ``shape``, were fitted by a disc."""
    image = work.image
    disc_image(n, pixels, (f32(fit.x), f32(fit.y), f32(fit.radius), f32(fit.blur)), fit.profile, shape, image)
    sums = stretch_sums(n, pixels, fit, model, image)
    pp, pq, qq, cp, cq = f64(sums[0]), f64(sums[1]), f64(sums[2]), f64(sums[3]), f64(sums[4])
    det = pp * qq - pq * pq
    if not det > 0.0:
        return Stretch(0.0, 0.0, 0.0, math.inf)
    p, q = (qq * cp - pq * cq) / det, (pp * cq - pq * cp) / det
    return Stretch(p, q, p * cp + q * cq, 1.0 / math.sqrt(det))


@bare_step(fastmath=FAST)
def stretched(shape: tuple[float, float, float], change: Stretch) -> tuple[float, float, float]:
    """Return the symmetric matrix (xx, xy, yy) of determinant 1 in which a target is round, after ``change``."""
    hold = min(1.0, MOST_CHANGE / max(math.hypot(change.p, change.q), 1e-9))
    p, q = hold * change.p, hold * change.q
    # (1 + T) S maps to the same circle as the root of its square, which is symmetric (Cayley and Hamilton)
    m0, m1, m2 = shape
    a, b = m0 + p * m0 + q * m1, m1 + p * m1 + q * m2
    c, d = m1 + q * m0 - p * m1, m2 + q * m1 - p * m2
    xx, xy, yy = a * a + c * c, a * b + c * d, b * b + d * d
    root = math.sqrt(xx * yy - xy * xy)
    t = math.sqrt(xx / root + yy / root + 2.0)
    return (xx / root + 1.0) / t, xy / root / t, (yy / root + 1.0) / t


@bare_step(fastmath=FAST)
def ellipticity(shape: tuple[float, float, float]) -> tuple[float, float]:
    """Return the ellipticity of a target that ``shape`` makes round, see ``mosca.data.detections.Detections``.

    The shape is the exponential of -[[a, b], [b, -a]] / 2 with the ellipticity (a, b).
    """
    a, b = 0.5 * (shape[2] - shape[0]), -shape[1]
    sine = math.sqrt(a * a + b * b)
    if not sine > 0.0:
        return 0.0, 0.0
    scale = 2.0 * math.log(sine + math.sqrt(1.0 + sine * sine)) / sine
    return scale * a, scale * b


@bare_step(fastmath=FAST)
def smeared_ellipticity(fit: DiscFit) -> tuple[float, float]:
    """Return the ellipticity of the ellipse that has the second moments of a smeared disc."""
    x, y = fit.profile.smear_x, fit.profile.smear_y
    square = x * x + y * y
    scale = 0.5 * math.log(1.0 + square / (3.0 * fit.radius * fit.radius)) / square
    return scale * (x * x - y * y), scale * 2.0 * x * y


@bare_step(fastmath=FAST)
def ellipticity_of(
    n: int,
    pixels: Array,
    region: Region,
    light: Light,
    fit: DiscFit,
    good: bool,
    misfit: float,
    model: Model,
    work: Workspace,
) -> tuple[float, float, float]:
    """Return the ellipticity (2) of a fitted target and its standard deviation, 0 where it is not known.

    ``pixels``: the n that were fitted, mapped by the light's shape; ``misfit``: their chi-square a degree of freedom.
    The ellipticity comes from the residuals where they lie all around an elliptic target, else from second moments.
    To first order it is their relative difference, which counts as 0 up to ``least_difference``. If it is evenly
    spread within a circle of this radius, half of the radius is its standard deviation. Overwrites ``work``.
    """
    if not good:
        return 0.0, 0.0, 0.0
    if is_smeared(fit.profile) or not (is_plain(light.shape) or light.crowded or light.saturated):
        change = stretch_of(n, pixels, fit, model, light.shape, work)
        if change.variance < math.inf:
            x, y = (
                smeared_ellipticity(fit) if is_smeared(fit.profile) else ellipticity(stretched(light.shape, change))
            )
            return x, y, 2.0 * math.sqrt(change.variance * max(misfit, 1.0))
    x, y = ellipticity(light.shape)
    return x, y, 0.5 * least_difference(fit.blur, region.n_px)
