"""Hypotheses "these images in different cameras show one target": solved, judged by image sizes, accepted, stored.

Compiled steps of ``mosca.correspondence.candidates`` and ``mosca.correspondence.selection``. Arrays travel in
NamedTuples, which Numba passes as their members.
"""

from typing import Any, NamedTuple

import numpy as np

from mosca.camera.ray_table import LONG
from mosca.correspondence.circle_fit import CIRCLE, LN_RADIUS, fit_circle
from mosca.data.detections import MERGED, PARTIAL, SATURATED, UNREFINED
from mosca.data.rays import ANGLE, AREA_RADIUS, BONUS, ELLIPTIC, FLAGS, RADIUS, SHARE_SIGMA, SIGMA
from mosca.numba_support.copying import copy_rows
from mosca.numba_support.decorators import inlined_step, step
from mosca.numba_support.linalg3 import Symmetric3, cofactors3, determinant3
from mosca.triangulation.triangulate import DEPTH, RANKS, TRUST, WHOLE, solve_rays

MOST_ODD, MOST_LARGE = 0.7, 0.9
"""Areas of small and of large images are compared up to this difference; beyond it there is no further evidence."""
ODD_SHIFT = 1.05
"""Shift of an image's centroid over (missing share of its area x radius). If a share h of a disc is hidden, its
centroid shifts by 0.85 h R to h R; in small blurred images a little less than h appears to be missing."""
FIRST_HIDDEN = 0.01
"""Share of the images that are hidden in part until ``mosca.correspondence.typical_size`` has learned it. Half or
twice of it gives the same."""
LEAST_AREA_SIGMA = 1e-6
"""Least relative standard deviation of an area: none that any image shows. Half or twice of it gives the same."""
LARGE_NOISE = 0.1
"""Differences of area, as shares, below which they are noise of images that are too large or whose brightest pixels
are saturated. The benchmark's actor, three seeds: with half 0.155 mm, with 0.1 and twice 0.156."""
HALF_HIDDEN = 0.7
"""Missing share from which more than half of a disc must be hidden, though sizes are noisy; two cameras do not make a
point with such an image. The benchmark's actor: completeness 0.9945 and 0.9957, rms 0.154 mm with 0.55 and 0.75."""
PARTIAL_ODD, LONG_ODD, UNFITTED_ODD = 0.2, 0.3, 0.7
"""Least missing share that is assumed for an image that detection takes for partly hidden; for one that is long where
the others are round (cut on one side; its size is little evidence); for one that is isolated and that no disc fits,
where discs fit the others (more than half of such targets is hidden, whatever their size)."""
AREAS, SIZES, SHAPES = 0.5, 1.0, 2.0
"""What images are judged by: their areas alone; also whether detection takes them for partly hidden; also whether
they are long and whether a disc fits them."""
PAIR = 2
"""Images that must fit a circle where flat targets are usual (``Rules.discs``)."""
LEAST_SEEN = 0.05
"""Least share of a disc's area that a camera sees: for a camera nearer to the disc's plane the image is a line."""
TOO_LARGE = 1.3
"""Ratio of an image's area to its target's from which the image is taken for two targets."""

XYZ, COVARIANCE, CHI2, GAIN, DIAMETER, VALUES = 0, 3, 12, 13, 14, 15
"""Columns of a hypothesis's values: point [m], covariance (3, 3) row by row [m^2], sum of squared whitened errors,
log-likelihood ratio against clutter, diameter [m]."""

# Not plain numbers: Numba would compile the functions that take them once for each value.
NONE, ONCE, TWICE = np.int64(0), np.int64(1), np.int64(2)


class Rules(NamedTuple):
    """``mosca.correspondence.match.MatchSettings`` as the kernels read them, and what is known of targets."""

    gate_sigma: float
    outlier_sigma: float
    support_sigma: float
    minimum_cameras: int
    worst_m2: float
    """Largest variance of a point in any direction."""
    judge: float
    """0, AREAS, SIZES or SHAPES."""
    discs: int
    """Images that must fit a circle for a target to be taken for a flat disc; 0: there are none."""
    typical_m: float
    """Diameter of the targets; 0 where it is unknown."""
    hidden: float
    """Share of the images that are hidden in part."""
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    """Corners of the volume [m]."""


RULES = np.dtype(
    [
        *((name, np.float64) for name in ("gate_sigma", "outlier_sigma", "support_sigma", "worst_m2", "judge")),
        ("discs", np.int64),
        *(
            (name, np.float64)
            for name in ("typical_m", "hidden", "low_x", "low_y", "low_z", "high_x", "high_y", "high_z")
        ),
        ("minimum_cameras", np.int64),
    ]
)
"""``Rules`` as a record."""


@step
def record_of(rules):
    """Return rules as an array (1,) of RULES."""
    table = np.empty(1, RULES)
    row = table[0]
    row.gate_sigma, row.outlier_sigma = rules.gate_sigma, rules.outlier_sigma
    row.support_sigma, row.minimum_cameras = rules.support_sigma, rules.minimum_cameras
    row.worst_m2, row.judge, row.typical_m = rules.worst_m2, rules.judge, rules.typical_m
    row.discs, row.hidden = rules.discs, rules.hidden
    row.low_x, row.low_y, row.low_z = rules.low
    row.high_x, row.high_y, row.high_z = rules.high
    return table


class MatchData(NamedTuple):
    """What hypotheses are made from: ``RayTable.rays``, ``RayTable.views`` and the rules."""

    rays: Any
    views: Any
    rules: Any
    """(1,) of RULES, passed by its address: passing the numbers themselves costs matching 13 %."""


class Hypothesis(NamedTuple):
    """The current hypothesis."""

    members: Any
    """(c,) ray of each camera, or -1."""
    ranks: Any
    """(c, RANKS) values of each ray (``mosca.triangulation.triangulate``)."""
    values: Any
    """(VALUES,)."""
    circle: Any
    """(CIRCLE,) of a flat target (``mosca.correspondence.circle_fit``)."""


class Hypotheses(NamedTuple):
    """Hypotheses that are kept, one a row."""

    values: Any
    """(n, VALUES)."""
    members: Any
    """(n, c)."""
    trusts: Any
    """(n, c) column TRUST of the ranks."""


@step
def new_hypothesis(cameras):
    """Return arrays for a hypothesis."""
    return Hypothesis(
        np.empty(cameras, dtype=np.int64), np.ones((cameras, RANKS)), np.zeros(VALUES), np.zeros(CIRCLE)
    )


@step
def no_hypotheses(capacity, cameras):
    """Return arrays for ``capacity`` hypotheses."""
    return Hypotheses(
        np.empty((capacity, VALUES)), np.empty((capacity, cameras), dtype=np.int64), np.empty((capacity, cameras))
    )


@step
def with_capacity(kept, count):
    """Return the first ``count`` hypotheses in arrays that hold one more at least."""
    if count < kept.values.shape[0]:
        return kept
    longer = no_hypotheses(2 * count, kept.members.shape[1])
    copy_rows(kept.values, longer.values)
    copy_rows(kept.members, longer.members)
    copy_rows(kept.trusts, longer.trusts)
    return longer


@inlined_step
def solve(hypothesis, steps, data):
    """Intersect the rays; the depths start from the point that the values hold. See ``solve_rays``."""
    members, ranks, values, _ = hypothesis
    rays, views, _ = data
    x, y, z = values[0], values[1], values[2]
    for c in range(members.shape[0]):
        k = members[c]
        if k >= 0:
            depth = rays[k, 0] * (x - views[c, 0]) + rays[k, 1] * (y - views[c, 1]) + rays[k, 2] * (z - views[c, 2])
            if not depth > 0.0:
                return -1.0
            ranks[c, DEPTH] = depth
    return solve_rays(members, ranks, rays, views, steps, values)


@inlined_step
def judge_sizes(hypothesis, data):
    """Set each member's trust from the size of its image; returns the target's diameter and whether it is flat.

    The diameter of a ball is that of its largest image.

    While no typical size is known, the second largest of four or more images is taken as unoccluded: the largest may
    be of two targets. Images of a flat target are expected to be as large as its circle appears to each camera.
    """
    members, ranks, values, circle = hypothesis
    rules = data.rules[0]
    if rules.discs > 0 and fit_circle(members, values, circle, data):
        diameter = 2.0 * np.exp(circle[LN_RADIUS])
        for c in range(members.shape[0]):
            k = members[c]
            if k >= 0:
                cosine = data.rays[k, 0] * circle[0] + data.rays[k, 1] * circle[1] + data.rays[k, 2] * circle[2]
                ranks[c, WHOLE] = diameter * np.sqrt(max(abs(cosine), LEAST_SEEN))
                size = image_size(k, c, values, data) * data.rays[k, AREA_RADIUS] / data.rays[k, RADIUS]
                ranks[c, TRUST] = np.sqrt(
                    trust2_of(k, size, ranks[c, WHOLE], data.rays, min(rules.judge, SIZES), rules)
                )
        return diameter, True
    largest, second, images = largest_image(members, values, data)
    if rules.typical_m > 0.0:
        whole = rules.typical_m
    else:
        whole = second if images >= 4 else largest
    for c in range(members.shape[0]):
        k = members[c]
        if k >= 0:
            size = image_size(k, c, values, data)
            ranks[c, TRUST] = np.sqrt(trust2_of(k, size, whole, data.rays, rules.judge, rules))
            ranks[c, WHOLE] = rules.typical_m if rules.typical_m > 0.0 else largest
    return largest, False


@inlined_step
def largest_image(members, point, data):
    """Return the largest and second largest size [m] of a hypothesis's images, and the number of images used.

    Images that detection takes for two targets and saturated ones, which look larger, are no evidence of the size,
    unless all are.
    """
    largest = second = anyhow = 0.0
    images = 0
    for c in range(members.shape[0]):
        k = members[c]
        if k >= 0:
            size = image_size(k, c, point, data)
            anyhow = max(anyhow, size)
            if not int(data.rays[k, FLAGS]) & (MERGED | SATURATED):
                images += 1
                second = max(second, min(size, largest))
                largest = max(largest, size)
    return (largest if largest > 0.0 else anyhow), second, images


@inlined_step
def image_size(ray, camera, point, data):
    """Return the size [m] of a target at ``point`` that fills the ray's image."""
    views = data.views
    x, y, z = point[0] - views[camera, 0], point[1] - views[camera, 1], point[2] - views[camera, 2]
    return data.rays[ray, ANGLE] * np.sqrt(x * x + y * y + z * z)


@inlined_step
def larger(i, size_i, j, size_j, rays):
    """Return the larger of two sizes; one that is no evidence (``largest_image``) does not count beside another."""
    one, other = int(rays[i, FLAGS]) & (MERGED | SATURATED), int(rays[j, FLAGS]) & (MERGED | SATURATED)
    if one and not other:
        return size_j
    if other and not one:
        return size_i
    return max(size_i, size_j)


def rather_hidden(missing: Any, sigma: Any, added: Any, hidden: Any) -> Any:
    """Return whether an image that misses a share of its area is to count as hidden in part.

    Whole images miss a share that is normally distributed with ``sigma``; ``hidden`` of all images miss any share,
    and err by ``added`` times the variance of a whole image if they count in full. A whole image that does not count
    in full loses once this variance.
    """
    sigma = np.maximum(sigma, LEAST_AREA_SIGMA)
    whole = np.exp(-0.5 * (missing / sigma) ** 2) / (np.sqrt(2.0 * np.pi) * sigma)
    return hidden * added > (1.0 - hidden) * whole


_rather_hidden = inlined_step(rather_hidden)


@inlined_step
def trust2_of(ray, size, whole, rays, judge, rules):
    """Return the factor on a ray's squared error if its image has ``size`` and ``whole`` is expected.

    A target whose image is too small is partly hidden. One whose image is too large is merged with a neighbour, whose
    share of the light moves the centroid. Whatever its size, an image also counts for less if detection takes it for
    partly hidden, if it is long, or if no disc fits it though nothing touches it. ``judge``: 0, AREAS, SIZES or
    SHAPES, in place of that of the ``rules``.
    """
    odd, flags = 0.0, int(rays[ray, FLAGS])
    # the centroid's shift for the whole disc's radius, over the error, for all of the area
    shift = ODD_SHIFT * rays[ray, RADIUS] / rays[ray, SIGMA] * (whole / size if judge > 0.0 else 1.0)
    if judge > 0.0:
        share = (size / whole) ** 2
        odd = min(MOST_ODD, 1.0 - share) if share < 1.0 else min(MOST_LARGE, share - 1.0)
        noise = LARGE_NOISE if share >= 1.0 or flags & SATURATED else 0.0
        # an image that errs by more is an outlier, whatever its size
        added = min(0.5 * (odd * shift) ** 2, rules.outlier_sigma**2)
        if odd <= noise or not _rather_hidden(odd, rays[ray, SHARE_SIGMA], added, rules.hidden):
            odd = 0.0
    if judge != AREAS and flags & PARTIAL:
        odd = max(odd, PARTIAL_ODD)
    if judge == SHAPES and flags & LONG:
        odd = max(odd, LONG_ODD)
    if judge == SHAPES and flags & (UNREFINED | MERGED) == UNREFINED:
        odd = max(odd, UNFITTED_ODD)
    # spread over both axes
    return 1.0 / (1.0 + 0.5 * (odd * shift) ** 2) if odd > 0.0 else 1.0


@inlined_step
def wholeness(ray, trust, rays):
    """Return how complete an image is, from its trust: 1 at the right size, 0 if half hidden."""
    if trust >= 1.0:
        return 1.0
    shift = rays[ray, SIGMA] * np.sqrt(2.0 * (1.0 / trust**2 - 1.0))  # undoes trust2_of
    return max(0.0, 1.0 - shift / (ODD_SHIFT * rays[ray, RADIUS]) / HALF_HIDDEN)


@inlined_step
def too_large(ray, camera, point, data):
    """Whether an image shows two merged targets.

    If no disc fits an image beside another, this is little evidence: where the targets' size is known, the area
    decides.
    """
    rules, flags = data.rules[0], int(data.rays[ray, FLAGS])
    known = rules.judge > 0.0 and rules.typical_m > 0.0
    if flags & MERGED and not (known and flags & UNREFINED):
        return True
    return known and image_size(ray, camera, point, data) ** 2 > TOO_LARGE * rules.typical_m**2


@inlined_step
def half_hidden(hypothesis, data):
    """Whether a member's image is so small that more than half of the target must be hidden.

    Where flat targets are usual, the size of an ellipse is its longer axis: the slant shortens the other one.
    """
    members, ranks, point, _ = hypothesis
    rules = data.rules[0]
    if not rules.judge > 0.0:
        return False
    for c in range(members.shape[0]):
        k = members[c]
        if k < 0:
            continue
        size = image_size(k, c, point, data)
        if rules.discs == PAIR and not int(data.rays[k, FLAGS]) & (MERGED | PARTIAL | UNREFINED):
            size *= np.exp(0.5 * np.hypot(data.rays[k, ELLIPTIC], data.rays[k, ELLIPTIC + 1]))
        if 1.0 - (size / ranks[c, WHOLE]) ** 2 > HALF_HIDDEN:
            return True
    return False


@inlined_step
def acceptable(hypothesis, count, error, data):
    """Whether a hypothesis keeps limits of error, volume and variance; a pair needs images at least half visible."""
    rules, solved = data.rules[0], hypothesis.values
    if not 0.0 <= error <= limit(2 * count - 3, rules.gate_sigma if count == 2 else rules.outlier_sigma):
        return False
    if not inside(solved, rules):
        return False
    if count == 2 and half_hidden(hypothesis, data):
        return False
    worst = rules.worst_m2
    if solved[3] + solved[7] + solved[11] <= worst:
        return True
    # no eigenvalue exceeds the worst if worst x identity minus the covariance has no negative one (Sylvester)
    d0, d1, d2 = worst - solved[3], worst - solved[7], worst - solved[11]
    e01, e02, e12 = solved[4], solved[5], solved[8]
    minor = d0 * d1 - e01 * e01
    det = d2 * minor + e02 * (2.0 * e01 * e12 - d1 * e02) - d0 * e12 * e12
    return d0 >= 0.0 and minor >= 0.0 and det >= 0.0


@inlined_step
def inside(point, rules):
    """Whether a point lies in the volume."""
    return (
        rules.low_x <= point[0] <= rules.high_x
        and rules.low_y <= point[1] <= rules.high_y
        and rules.low_z <= point[2] <= rules.high_z
    )


@inlined_step
def limit(freedom, sigma):
    """Return chi-square at ``sigma`` deviations (exact for 1 degree of freedom, else Wilson and Hilferty's cube)."""
    if freedom == 1:
        return sigma * sigma
    q = 2.0 / (9.0 * freedom)
    return freedom * (1.0 - q + sigma * np.sqrt(q)) ** 3


@inlined_step
def store(hypothesis, error, diameter, rays, at, kept):
    """Complete a hypothesis's values and keep it in row ``at``: values (n, VALUES), members (n, c), trusts (n, c).

    Gain: log-likelihood ratio sum log(1 / (2 pi sigma^2 rho)) - chi2 / 2 + log det(2 pi P) / 2 of its images as one
    target against chance images, without the density of targets, which all hypotheses share (Poore 1994, section 3).
    """
    members, ranks, solved, _ = hypothesis
    covariance = Symmetric3(solved[3], solved[4], solved[5], solved[7], solved[8], solved[11])
    det = determinant3(covariance, cofactors3(covariance))
    gain = 0.5 * np.log(max(det, 1e-300) * (2.0 * np.pi) ** 3) - 0.5 * error
    for c in range(members.shape[0]):
        k, trust = members[c], ranks[c, TRUST]
        kept.members[at, c], kept.trusts[at, c] = k, trust
        if k >= 0:
            gain += rays[k, BONUS]
            if trust < 1.0:
                gain += 2.0 * np.log(trust)
    solved[CHI2], solved[GAIN], solved[DIAMETER] = error, gain, diameter
    for k in range(VALUES):
        kept.values[at, k] = solved[k]
