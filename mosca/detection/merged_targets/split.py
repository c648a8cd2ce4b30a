"""Two targets whose images have grown together: a joint fit of two discs, where their region's shape says two.

The model is that of ``mosca.detection.disc_fit.camera_statistics`` with two discs, the farther one hidden where the
nearer one lies,

    I = b + A1 e1 + A2 (e2 - e12),   e = Phi(t),   t = (R - r) / s,

for places, brightnesses and radii of both, the background and one blur: ten unknowns by damped Gauss-Newton steps
with the weights of EMVA 1288, either one in front, what fits better. e12 is what both cover, seen through the blur:
of two straight edges it is the bivariate normal integral Phi2(t1, t2; rho), rho the cosine of the angle between their
normals (edges that face each other: nothing before they meet), by quadrature (Drezner and Wesolowsky 1990). The
normal matrix gives the covariance.

Who is asked: regions that nearly touch; and regions alone whose fit by one disc failed or does not hold, or that are
long where few are. What is long is not yet two: a disc that moved while it was exposed (swept along a line) and an
ellipse are fitted to the same pixels, and two are taken where they explain these better than both by ``DECISIVE``
of chi-square, leave no more than ``MOST_ROUGH`` (squared, over the noise) of the brightness unexplained, and are
alike in size and brightness and farther apart than ``NEAREST`` diameters.
"""

import math
from typing import Any

import numpy as np

from mosca.data.arrays import Array
from mosca.data.detections import MERGED, PARTIAL, SATURATED, UNREFINED
from mosca.detection.disc_fit.fit_regions import (
    BLUR,
    BLUR_INFO,
    DIAMETER,
    ELONGATION,
    FLAGS,
    MISFIT,
    N_TERMS,
    PEAK,
    PULL,
    ROUGH,
    XX,
    XY,
    YY,
    X,
    Y,
    set_terms,
)
from mosca.detection.disc_fit.gauss_newton import FAST, Model
from mosca.detection.merged_targets.fit import ELLIPSE, PAIR, SWEPT, clearance, fit
from mosca.detection.merged_targets.pixels import gather_all, keep_near, start_of
from mosca.numba_support.decorators import bare_step, kernel, step
from mosca.numba_support.intrinsics import image_at

DECISIVE = 30.0
"""Chi-square by which two discs must explain the pixels better than one long target, two unknowns dearer."""
MOST_ROUGH = 3e-3
"""Misfit of two discs beyond the noise over their squared brightness; half-hidden and other shapes have more."""
NEAREST, FARTHEST = 0.45, 1.6
"""Separations in mean diameters: nearer ones cannot be told from one, farther ones do not touch."""
ALIKE = 1.7
"""Ratio of the radii, and its square of the brightnesses, up to which two discs are two targets."""
SMALLEST = 1.0
"""Least radius [px] of each: below it the shape of a region tells nothing."""
LONGER, LONG, FEW = 0.12, 0.3, 0.03
"""Least share of its second moments by which a region is longer than wide: one whose fit failed, and one whose fit
holds, which is asked where no more than ``FEW`` of all are so long."""
TOUCHING_PX = 2.7
"""Rim to rim, two regions nearer than this are fitted together: windows of their own would lose too much of their
light. At 2 px that costs a factor of 4 to 10 of what the pixels tell."""
MISMATCH_PX = 0.8
"""What the straight edge's blur, bent round, is wrong by for small discs, which beside another one moves the place:
standard deviation an axis over the fourth power of blur by radius (measured at diameters of 4 to 12 px)."""


@kernel(fastmath=FAST)
def fit_pairs(
    addresses: Array,
    like: Array,
    size: tuple[int, int],
    runs: Array,
    regions: Array,
    asked: Array,
    lowest: Array,
    blurs: Array,
    learned: Array,
    model: Model,
) -> tuple[Array, Array]:
    """Fit two discs to each of ``asked`` (k, 2): a region alone (its number, -1) or with a second one.

    The others as in ``mosca.detection.disc_fit.fit_regions.refine_regions``. Returns rows (k, 2, columns of its
    table) and which are two targets (k,).
    """
    height, width = size
    rows, two = np.zeros((len(asked), 2, PULL + 1)), np.zeros(len(asked), np.bool_)
    work, terms = np.empty((10, 11)), np.empty(N_TERMS)
    for q in range(len(asked)):
        first, second = asked[q, 0], asked[q, 1]
        k = regions[first, 0]
        image = image_at(addresses[k], like, height, width)
        own = runs[regions[first, 1] : regions[first, 2]]
        other = own[:0] if second < 0 else runs[regions[second, 1] : regions[second, 2]]
        pixels, n, level, peak = gather_all(image, own, other, lowest[k], model.full_dn)
        if n < 30:
            continue
        start = start_of(pixels, n, own, other, level, peak, blurs[k, 0])
        if start[4] < SMALLEST:
            continue
        n = keep_near(pixels, n, start)
        best, best_chi2, variance = start, math.inf, np.zeros((10, 10))
        for _front in range(2):
            trial = start.copy()
            chi2, inverse, good = fit(PAIR, trial, pixels, n, blurs[k, 0], blurs[k, 1], model, 0.0, work)
            if good and chi2 < best_chi2 - 1e-6:
                best, best_chi2, variance = trial, chi2, inverse
            if not good or clearance(trial) > 0.0:
                break  # none hides the other
            for a in range(4):
                start[2 * a], start[2 * a + 1] = trial[2 * a + 1], trial[2 * a]
            start[8], start[9] = trial[8], trial[9]
        if not plausible(best, best_chi2, n, model):
            continue
        if second < 0 and not better_than_one(
            best, best_chi2, pixels, n, blurs[k, 0], blurs[k, 1], model, work
        ):
            continue
        two[q] = True
        misfit = max(best_chi2 / (n - 10), 1.0)
        for a in range(2):
            out = rows[q, a]
            x, y = best[a], best[2 + a]
            half = math.sqrt(best[4 + a] ** 2 + best[9] ** 2)
            set_terms(image, x, y, half, terms)
            for t in range(9):
                x += learned[k, t, 0] * terms[t]
                y += learned[k, t, 1] * terms[t]
            out[X], out[Y], out[DIAMETER], out[PEAK], out[ELONGATION] = x, y, 2.0 * half, peak, 1.0
            model_px2 = (MISMATCH_PX * (best[9] / best[4 + a]) ** 4) ** 2
            out[XX], out[YY] = (
                misfit * variance[a, a] + model_px2,
                misfit * variance[2 + a, 2 + a] + model_px2,
            )
            out[XY] = misfit * variance[a, 2 + a]
            out[FLAGS] = SATURATED if peak >= model.full_dn else 0
            out[MISFIT] = best_chi2 / (n - 10)
            out[BLUR], out[BLUR_INFO], out[ROUGH] = 0.0, 0.0, 0.0
    return rows, two


@bare_step(fastmath=FAST)
def plausible(p: Array, chi2: float, n: int, model: Model) -> bool:
    """Tell whether two discs are alike, as far apart as two that touch, and explain the pixels."""
    if not math.isfinite(chi2):
        return False
    apart, across = math.hypot(p[0] - p[1], p[2] - p[3]), p[4] + p[5]
    small, large = min(p[4], p[5]), max(p[4], p[5])
    dim, bright = min(p[6], p[7]), max(p[6], p[7])
    if small < SMALLEST or large > ALIKE * small or not dim > 0.0 or bright > ALIKE * ALIKE * dim:
        return False
    if not NEAREST * across < apart < FARTHEST * across + 2.0 * p[9]:
        return False
    excess = chi2 / max(n - 10, 1) - 1.0
    rough = max(excess, 0.0) * (model.dark_dn2 + model.gain_dn * bright) / (bright * bright)
    return excess < 0.3 + 5.0 * math.sqrt(2.0 / n) or rough < MOST_ROUGH


@step(fastmath=FAST)
def better_than_one(
    p: Array, chi2: float, pixels: Array, n: int, blur: float, spread: float, model: Model, work: Array
) -> bool:
    """Tell whether two discs explain the pixels decisively better than one that is long, in both ways it can be."""
    dx, dy = 0.5 * (p[1] - p[0]), 0.5 * (p[3] - p[2])
    x, y, half = p[0] + dx, p[2] + dy, math.hypot(dx, dy)
    radius, bright = 0.5 * (p[4] + p[5]), 0.5 * (p[6] + p[7])
    misfit = max(chi2 / (n - 10), 1.0)
    one = np.empty(8)
    for kind in (ELLIPSE, SWEPT):
        one[0], one[1], one[4], one[5], one[6], one[7] = x, y, radius, bright, p[8], p[9]
        if kind == SWEPT:
            # as much light on as long a way: its ends are dimmer than its middle
            one[2], one[3], one[5] = 1.5 * dx, 1.5 * dy, 1.4 * bright
        else:
            longer = 1.0 + half / radius
            # the ellipse's matrix has the eigenvalues 1 -+ e along and across
            e = (longer - 1.0) / (longer + 1.0)
            one[2], one[3] = -e * (dx * dx - dy * dy) / (half * half), -e * 2.0 * dx * dy / (half * half)
            one[4] = radius * 2.0 * longer / (longer + 1.0)
        enough = chi2 + DECISIVE * misfit
        if fit(kind, one, pixels, n, blur, spread, model, enough, work)[0] < enough:
            return False
    return True


@kernel(fastmath=FAST)
def touching(table: Array, image_of: Array) -> Array:
    """Return the pairs (k, 2) of rows, in the order of their topmost rows, whose targets nearly touch."""
    found = np.empty((len(table) + 4, 2), np.int64)
    n = 0
    for i in range(len(table)):
        bottom = table[i, Y] + 0.5 * table[i, DIAMETER] + 2.0 * TOUCHING_PX
        for j in range(i + 1, len(table)):
            if image_of[j] != image_of[i] or table[j, Y] - 0.5 * table[j, DIAMETER] > bottom:
                break
            across = 0.5 * (table[i, DIAMETER] + table[j, DIAMETER])
            if math.hypot(table[i, X] - table[j, X], table[i, Y] - table[j, Y]) < across + TOUCHING_PX:
                if n == len(found):
                    return found
                found[n, 0], found[n, 1] = i, j
                n += 1
    return found[:n]


def asked_of(table: Array, flags: Array, image_of: Array) -> Array:
    """Return which rows of a table may be two targets: (k, 2) of one alone (row, -1) or of two that touch."""
    beside = touching(table, image_of)
    long = (table[:, PULL] > LONG) & (flags == 0)
    alone = (flags & (UNREFINED | MERGED) == UNREFINED) | (flags & PARTIAL > 0)
    alone &= table[:, PULL] > LONGER
    if np.count_nonzero(long) <= max(FEW * len(table), 1.0):
        alone |= long
    alone[beside.ravel()] = False
    single = np.flatnonzero(alone)
    return np.concatenate([beside, np.column_stack([single, np.full(len(single), -1)])]).astype(np.int64)


def split_pairs(
    table: Array,
    image_of: Array,
    region_of: Array,
    runs: Array,
    regions: Array,
    lowest: Array,
    given: tuple[Any, ...],
) -> tuple[Array, Array]:
    """Return the table of ``mosca.detection.disc_fit.fit_regions`` with two rows for each two targets, and the
    image of each row.

    ``image_of`` (n,), ``region_of`` (n,): image and region of each row; ``given``: addresses, like, size, blurs,
    learned and model as there. A row that is in two pairs goes with the first one that holds.
    """
    asked = asked_of(table, table[:, FLAGS].astype(np.uint8), image_of)
    if not len(asked):
        return table, image_of
    addresses, like, size, blurs, learned, model = given
    by_region = np.where(asked >= 0, region_of[asked], -1)
    rows, two = fit_pairs(addresses, like, size, runs, regions, by_region, lowest, blurs, learned, model)
    spent: set[int] = set()
    more, after = [], []
    for (one, other), fitted, is_two in zip(asked.tolist(), rows, two, strict=True):
        if not is_two or one in spent or other in spent:
            continue
        spent |= {one, other} - {-1}
        table[one] = fitted[0]
        if other >= 0:
            table[other] = fitted[1]
        else:
            more.append(fitted[1])
            after.append(one)
    if not more:
        return table, image_of
    at = np.array(after) + 1
    return np.insert(table, at, np.array(more), axis=0), np.insert(image_of, at, image_of[after])
