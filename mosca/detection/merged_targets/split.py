"""Two targets with merged images: a joint fit of two discs, where the shape of their region suggests two.

The model is that of ``mosca.detection.disc_fit.camera_statistics`` with two discs, the farther one hidden where the
nearer one lies,

    I = b + A1 e1 + A2 (e2 - e12),   e = Phi(t),   t = (R - r) / s,

for positions, brightnesses and radii of both, the background and one blur: ten unknowns by damped Gauss-Newton steps
with the weights of EMVA 1288, in the order of depth that fits better. e12 is the blurred area that both cover. For
two straight edges it is the bivariate normal integral Phi2(t1, t2; rho), with rho the cosine of the angle between
their normals (edges that face each other: nothing before they meet), by quadrature (Drezner and Wesolowsky 1990). The
normal matrix gives the covariance.

Candidates are regions that nearly touch, and single regions whose fit by one disc failed or was rejected, or that
are elongated where few others are. As alternative hypotheses a disc with motion blur (swept along a line) and an
ellipse are fitted to the same pixels. Two discs are accepted where their chi-square is lower than both by
``DECISIVE``, their misfit beyond the noise is at most ``MOST_ROUGH`` of the squared brightness, and they are alike
in size and brightness and farther apart than ``NEAREST`` diameters.
"""

import math
from typing import NamedTuple

import numpy as np

from mosca.data.arrays import Array
from mosca.data.detections import MERGED, PARTIAL, SATURATED, UNREFINED
from mosca.detection.centroid import DIAMETER, DIAMETER_SIGMA, ELONGATION, PEAK, XX, XY, YY, X, Y
from mosca.detection.disc_fit.disc_image import FAST
from mosca.detection.disc_fit.gauss_newton import Model
from mosca.detection.disc_fit.light_offset import N_TERMS, moved
from mosca.detection.disc_fit.priors import Priors
from mosca.detection.disc_fit.row import BLUR, BLUR_INFO, FLAGS, MISFIT, N_COLUMNS, PULL, ROUGH
from mosca.detection.frame_set_kernel import Measured
from mosca.detection.images import ImageSet, image_of
from mosca.detection.merged_targets.fit import ELLIPSE, PAIR, SWEPT, FitTask, clearance, fit
from mosca.detection.merged_targets.pixels import gather_all, keep_near, start_of
from mosca.detection.search import DARK, END_RUN, FIRST_RUN, FLOOR, GAIN, IMAGE, FoundRegions
from mosca.numba_support.decorators import bare_step, kernel, step

DECISIVE = 30.0
"""Least decrease of chi-square from one long target to two discs, which have two more unknowns."""
MOST_ROUGH = 3e-3
"""Misfit of two discs beyond the noise over their squared brightness; half-hidden and other shapes have more."""
NEAREST, FARTHEST = 0.45, 1.6
"""Separations in mean diameters: closer pairs cannot be resolved, farther ones do not touch."""
ALIKE = 1.7
"""Ratio of the radii, and its square of the brightnesses, up to which two discs are two targets."""
SMALLEST = 1.0
"""Least radius [px] of each: below it the shape of a region carries no information."""
LONGER, LONG, FEW = 0.12, 0.3, 0.03
"""Least differences of a region's principal second moments, as a share of their sum: of a region whose fit failed,
and of one whose fit was accepted, which is a candidate only where no more than ``FEW`` of all are so long."""
TOUCHING_PX = 2.7
"""Two regions with a gap below this are fitted together: separate windows would mask too many of their pixels (at
2 px, a factor of 4 to 10 of the information)."""
MISMATCH_PX = 0.8
"""Model error of the blurred edge for small discs, which next to another disc biases the position: standard
deviation per axis over the fourth power of blur by radius (measured at diameters of 4 to 12 px)."""


EXCESS, EXCESS_SIGMAS = 0.3, 5.0
"""Largest excess of chi-square per degree of freedom of two discs that are accepted: this and so many standard
deviations."""
FEWEST_PIXELS = 30
"""Fewer pixels than three for each unknown are not fitted."""


class FittedPair(NamedTuple):
    """Two discs fitted to the same pixels."""

    p: Array
    """(10,) unknowns, see ``mosca.detection.merged_targets.fit``."""
    inverse: Array
    """(10, 10) inverse of the normal matrix."""
    chi2: float
    n: int
    """Number of pixels."""
    peak: float
    """Largest grey value [DN]."""


@step(fastmath=FAST)
def fit_both_orders(start: Array, pixels: Array, n: int, peak: float, task: FitTask) -> FittedPair:
    """Fit two discs from ``start``, which is changed; where they cover each other, either one in front."""
    best, best_chi2, variance = start, math.inf, np.zeros((10, 10))
    for _front in range(2):
        trial = start.copy()
        chi2, inverse, good = fit(PAIR, trial, pixels, n, task, 0.0)
        if good and chi2 < best_chi2 - 1e-6:
            best, best_chi2, variance = trial, chi2, inverse
        if not good or clearance(trial) > 0.0:
            break  # none hides the other
        for a in range(4):
            start[2 * a], start[2 * a + 1] = trial[2 * a + 1], trial[2 * a]
        start[8], start[9] = trial[8], trial[9]
    return FittedPair(best, variance, best_chi2, n, peak)


@bare_step(fastmath=FAST)
def write_pair(image: Array, pair: FittedPair, offsets: Array, terms: Array, full_dn: float, rows: Array) -> None:
    """Write both discs of a pair to ``rows`` (2, columns), with their camera's offsets (N_TERMS, 2)."""
    p, variance = pair.p, pair.inverse
    misfit = max(pair.chi2 / (pair.n - 10), 1.0)
    for a in range(2):
        out = rows[a]
        half = math.sqrt(p[4 + a] ** 2 + p[9] ** 2)
        x, y = moved(image, p[a], p[2 + a], half, offsets, terms)
        out[X], out[Y], out[DIAMETER], out[PEAK], out[ELONGATION] = x, y, 2.0 * half, pair.peak, 1.0
        out[DIAMETER_SIGMA] = 2.0 * math.sqrt(misfit * variance[4 + a, 4 + a]) * p[4 + a] / half
        model_px2 = (MISMATCH_PX * (p[9] / p[4 + a]) ** 4) ** 2
        out[XX], out[YY] = (misfit * variance[a, a] + model_px2, misfit * variance[2 + a, 2 + a] + model_px2)
        out[XY] = misfit * variance[a, 2 + a]
        out[FLAGS] = SATURATED if pair.peak >= full_dn else 0
        out[MISFIT] = pair.chi2 / (pair.n - 10)
        out[BLUR], out[BLUR_INFO], out[ROUGH] = 0.0, 0.0, 0.0


@kernel(fastmath=FAST)
def fit_pairs(
    images: ImageSet, found: FoundRegions, candidates: Array, priors: Priors, full_dn: float
) -> tuple[Array, Array]:
    """Fit two discs to each of ``candidates`` (k, 2): a region alone (its number, -1) or with a second one.

    Returns rows (k, 2, columns of the table of ``mosca.detection.disc_fit.fit_regions``) and which are two targets
    (k,).
    """
    rows, two = np.zeros((len(candidates), 2, N_COLUMNS)), np.zeros(len(candidates), np.bool_)
    work, terms = np.empty((10, 11)), np.empty(N_TERMS)
    runs, regions = found.runs, found.regions
    for q in range(len(candidates)):
        first, second = candidates[q, 0], candidates[q, 1]
        k = regions[first, IMAGE]
        image, model = image_of(images, k), Model(found.noise[first, DARK], found.noise[first, GAIN], full_dn)
        own = runs[regions[first, FIRST_RUN] : regions[first, END_RUN]]
        other = own[:0] if second < 0 else runs[regions[second, FIRST_RUN] : regions[second, END_RUN]]
        pixels, n, level, peak = gather_all(image, own, other, regions[first, FLOOR], full_dn)
        if n < FEWEST_PIXELS:
            continue
        task = FitTask(priors.blurs[k, 0], priors.blurs[k, 1], model, work)
        start = start_of(pixels, n, own, other, level, peak, task.blur)
        if start[4] < SMALLEST:
            continue
        pair = fit_both_orders(start, pixels, keep_near(pixels, n, start), peak, task)
        if not plausible(pair.p, pair.chi2, pair.n, model):
            continue
        if second < 0 and not better_than_one(pair, pixels, task):
            continue
        two[q] = True
        write_pair(image, pair, priors.offsets[k], terms, model.full_dn, rows[q])
    return rows, two


@bare_step(fastmath=FAST)
def plausible(p: Array, chi2: float, n: int, model: Model) -> bool:
    """Return whether two discs are alike, as far apart as two that touch can be, and explain the pixels."""
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
    return excess < EXCESS + EXCESS_SIGMAS * math.sqrt(2.0 / n) or rough < MOST_ROUGH


@step(fastmath=FAST)
def better_than_one(pair: FittedPair, pixels: Array, task: FitTask) -> bool:
    """Return whether two discs explain the pixels decisively better than one that moved and than an ellipse."""
    p, chi2, n = pair.p, pair.chi2, pair.n
    dx, dy = 0.5 * (p[1] - p[0]), 0.5 * (p[3] - p[2])
    x, y, half = p[0] + dx, p[2] + dy, math.hypot(dx, dy)
    radius, bright = 0.5 * (p[4] + p[5]), 0.5 * (p[6] + p[7])
    misfit = max(chi2 / (n - 10), 1.0)
    one = np.empty(8)
    for kind in (ELLIPSE, SWEPT):
        one[0], one[1], one[4], one[5], one[6], one[7] = x, y, radius, bright, p[8], p[9]
        if kind == SWEPT:
            # as much light over the same length: the ends of a swept disc are dimmer than its middle
            one[2], one[3], one[5] = 1.5 * dx, 1.5 * dy, 1.4 * bright
        else:
            # a round target as wide as both discs are long
            one[2], one[3], one[4] = 0.0, 0.0, radius + half
        enough = chi2 + DECISIVE * misfit
        if fit(kind, one, pixels, n, task, enough)[0] < enough:
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


def candidates_of(table: Array, image_of: Array) -> Array:
    """Return which rows of a table may be two targets: (k, 2) of one alone (row, -1) or of two that touch."""
    flags = table[:, FLAGS].astype(np.uint8)
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
    measured: Measured, images: ImageSet, found: FoundRegions, priors: Priors, full_dn: float
) -> Measured:
    """Return the targets with the rows of each accepted pair replaced by those of its joint fit.

    A row that is in two pairs belongs to the first one accepted.
    """
    table, region_of, image_of = measured
    rows_of = candidates_of(table, image_of)
    if not len(rows_of):
        return measured
    by_region = np.where(rows_of >= 0, region_of[rows_of], -1)
    fits, two = fit_pairs(images, found, by_region, priors, full_dn)
    spent: set[int] = set()
    more, after = [], []
    for (one, other), fitted, is_two in zip(rows_of.tolist(), fits, two, strict=True):
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
        return measured
    at = np.array(after) + 1
    return Measured(
        np.insert(table, at, np.array(more), axis=0),
        np.insert(region_of, at, region_of[after]),
        np.insert(image_of, at, image_of[after]),
    )
