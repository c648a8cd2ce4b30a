"""Groups of rays as the matching kernels hold them: solve, judge by image sizes, add and drop rays."""

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from mosca.data.detections import MERGED, PARTIAL
from mosca.triangulate import solve_point

MOST_ODD = 0.7
"""Areas are compared up to this difference; beyond it an image says little more."""
ODD_SHIFT = 1.15
"""Shift of an image's centroid over (missing share of its area x radius). A disc with the share h hidden shifts by
0.85 h R to h R; small blurred images lose contrast with their area, so that only 3/4 of h is seen missing."""
SIZE_DEADBAND = 0.1
"""Differences of area below this are noise of the measured sizes."""
HALF_HIDDEN = 0.47
"""Missing share that more than half a disc leaves; two cameras do not make a point with such an image."""
PARTIAL_ODD = 0.2
"""Missing share of an image that detection takes for partly hidden, at least."""
TOO_LARGE = 1.3
"""Area over a target's from which an image is taken for two targets."""

XYZ, COVARIANCE, CHI2, GAIN, DIAMETER, VALUES = 0, 3, 12, 13, 14, 15
"""Places in a group's row of values: point, covariance (3, 3) row by row, sum of squared whitened errors, logarithm of
its likelihood against that of a chance meeting, diameter [m]."""


class Rays(NamedTuple):
    """Columns of ``mosca.triangulate.Bundle``; ``bonus`` (n,): log-likelihood that a ray adds to a group."""

    direction: Any
    white: Any
    spread: Any
    normal: Any
    sigma: Any
    radius: Any
    angle: Any
    flags: Any
    bonus: Any


class Views(NamedTuple):
    """The cameras: see ``mosca.triangulate.Bundle``."""

    origin: Any
    rotation: Any
    pairs: Any
    density: Any
    start: Any


class Rules(NamedTuple):
    """``mosca.match.MatchSettings`` as the kernels read them, the volume, and the targets' typical diameter [m]."""

    gate: float
    outlier: float
    minimum: int
    worst_variance: float
    judge: bool
    low: Any
    high: Any
    typical: float


class Scratch(NamedTuple):
    """The group in hand: ``members`` (c,) ray of each camera or -1, ``trust`` (c,); ``point`` (3,), ``cov`` (3, 3);
    ``share`` (c,) expected number of chance rays as near as each; the rest (c,): the members, packed.
    """

    members: Any
    trust: Any
    point: Any
    cov: Any
    share: Any
    chosen: Any
    owner: Any
    trusted: Any
    depth: Any


@njit(nogil=True, cache=True, error_model="numpy")
def scratch(cameras):  # type: ignore[no-untyped-def]
    """Return room for one group."""
    return Scratch(
        np.full(cameras, -1, dtype=np.int64), np.ones(cameras), np.empty(3), np.empty((3, 3)),
        np.ones(cameras), np.empty(cameras, dtype=np.int64), np.empty(cameras, dtype=np.int64), np.ones(cameras), np.ones(cameras),
    )  # fmt: skip


@njit(nogil=True, cache=True, error_model="numpy")
def solve(group, steps, rays, views):  # type: ignore[no-untyped-def]
    """Intersect the group's rays; the depths start from ``group.point``. See ``solve_point``."""
    n, x = 0, group.point
    for c in range(group.members.shape[0]):
        k = group.members[c]
        if k >= 0:
            d, o = rays.direction[k], views.origin[c]
            depth = d[0] * (x[0] - o[0]) + d[1] * (x[1] - o[1]) + d[2] * (x[2] - o[2])
            if not depth > 0.0:
                return -1.0
            group.chosen[n], group.owner[n], group.trusted[n], group.depth[n] = k, c, group.trust[c], depth
            n += 1
    return solve_point(
        n, group.chosen, group.owner, group.trusted, views.origin, rays.direction, rays.white, rays.normal,
        steps, group.depth, group.point, group.cov,
    )  # fmt: skip


@njit(nogil=True, cache=True, error_model="numpy")
def judge_sizes(group, rays, views, rules):  # type: ignore[no-untyped-def]
    """Set each member's trust from the size of its image; returns the target's diameter from its largest image."""
    largest = 0.0
    for c in range(group.members.shape[0]):
        if group.members[c] >= 0:
            largest = max(largest, image_size(group.members[c], c, group.point, rays, views))
    whole = rules.typical if rules.typical > 0.0 else largest
    for c in range(group.members.shape[0]):
        k = group.members[c]
        if k >= 0:
            size = image_size(k, c, group.point, rays, views)
            group.trust[c] = trust_of(k, size, whole, rays, rules.judge)
    return largest


@njit(nogil=True, cache=True, error_model="numpy")
def image_size(ray, camera, point, rays, views):  # type: ignore[no-untyped-def]
    """Return how large [m] a target at ``point`` is that fills the ray's image."""
    o = views.origin[camera]
    x, y, z = point[0] - o[0], point[1] - o[1], point[2] - o[2]
    return rays.angle[ray] * np.sqrt(x * x + y * y + z * z)


@njit(nogil=True, cache=True, error_model="numpy")
def trust_of(ray, size, whole, rays, judge):  # type: ignore[no-untyped-def]
    """Return the factor on a ray's whitened error when its image has ``size`` where ``whole`` would be right.

    Too small: partly hidden. Too large: merged with a neighbour, whose share of the light moves the centroid.
    What detection itself takes for partly hidden counts for less, whatever its size.
    """
    odd = 0.0
    if judge:
        share = (size / whole) ** 2
        odd = min(MOST_ODD, 1.0 - share if share < 1.0 else share - 1.0)
        if odd <= SIZE_DEADBAND:
            odd = 0.0
    if rays.flags[ray] & PARTIAL:
        odd = max(odd, PARTIAL_ODD)
    if odd == 0.0:
        return 1.0
    # the centroid's shift for the whole disc's radius, spread over both axes
    shift = ODD_SHIFT * odd * rays.radius[ray] * (whole / size if judge else 1.0)
    return 1.0 / np.sqrt(1.0 + 0.5 * (shift / rays.sigma[ray]) ** 2)


@njit(nogil=True, cache=True, error_model="numpy")
def wholeness(ray, trust, rays):  # type: ignore[no-untyped-def]
    """Return how whole an image is, by its trust: 1 of the right size, 0 half hidden."""
    if trust >= 1.0:
        return 1.0
    shift = rays.sigma[ray] * np.sqrt(2.0 * (1.0 / trust**2 - 1.0))  # undoes trust_of
    return max(0.0, 1.0 - shift / (ODD_SHIFT * rays.radius[ray]) / HALF_HIDDEN)


@njit(nogil=True, cache=True, error_model="numpy")
def too_large(ray, camera, point, rays, views, rules):  # type: ignore[no-untyped-def]
    """Whether an image shows two targets grown together."""
    if rays.flags[ray] & MERGED:
        return True
    if not rules.judge or rules.typical <= 0.0:
        return False
    return image_size(ray, camera, point, rays, views) ** 2 > TOO_LARGE * rules.typical**2


@njit(nogil=True, cache=True, error_model="numpy")
def half_hidden(group, diameter, rays, views, rules):  # type: ignore[no-untyped-def]
    """Whether a member's image is so small that more than half of the target must be hidden."""
    if not rules.judge:
        return False
    whole = rules.typical if rules.typical > 0.0 else diameter
    for c in range(group.members.shape[0]):
        k = group.members[c]
        if k >= 0 and 1.0 - (image_size(k, c, group.point, rays, views) / whole) ** 2 > HALF_HIDDEN:
            return True
    return False


@njit(nogil=True, cache=True, error_model="numpy")
def acceptable(group, count, error, diameter, rays, views, rules):  # type: ignore[no-untyped-def]
    """Whether a solved group is a target: errors, volume, certainty; a pair with both images at least half there."""
    x, v = group.point, group.cov
    if not 0.0 <= error <= limit(2 * count - 3, rules.gate if count == 2 else rules.outlier):
        return False
    for k in range(3):
        if not rules.low[k] <= x[k] <= rules.high[k]:
            return False
    if count == 2 and half_hidden(group, diameter, rays, views, rules):
        return False
    worst = rules.worst_variance
    return v[0, 0] + v[1, 1] + v[2, 2] <= worst or np.linalg.eigvalsh(v)[2] <= worst


@njit(nogil=True, cache=True, error_model="numpy")
def limit(freedom, sigma):  # type: ignore[no-untyped-def]
    """Chi-square bound of ``sigma`` standard deviations (exact for one, else Wilson and Hilferty's cube)."""
    if freedom == 1:
        return sigma * sigma
    q = 2.0 / (9.0 * freedom)
    return freedom * (1.0 - q + sigma * np.sqrt(q)) ** 3


@njit(nogil=True, cache=True, error_model="numpy")
def store(group, error, diameter, rays, values, members, trusts):  # type: ignore[no-untyped-def]
    """Write a group into its row: ``values`` (VALUES,), ``members`` (c,), ``trusts`` (c,).

    Gain: the likelihood of its images as one target against that of images by chance, but for the density of
    targets, which all groups share (Poore 1994, section 3): sum log(1 / (2 pi sigma^2 rho)) - chi2 / 2 +
    log det(2 pi P) / 2.
    """
    v = group.cov
    det = (
        v[0, 0] * (v[1, 1] * v[2, 2] - v[1, 2] ** 2)
        - v[0, 1] * (v[0, 1] * v[2, 2] - v[1, 2] * v[0, 2])
        + v[0, 2] * (v[0, 1] * v[1, 2] - v[1, 1] * v[0, 2])
    )
    gain = 0.5 * np.log(max(det, 1e-300) * (2.0 * np.pi) ** 3) - 0.5 * error
    for c in range(group.members.shape[0]):
        k = group.members[c]
        members[c], trusts[c] = k, group.trust[c]
        if k >= 0:
            gain += rays.bonus[k]
            if group.trust[c] < 1.0:
                gain += 2.0 * np.log(group.trust[c])
    values[XYZ:COVARIANCE] = group.point
    for p in range(3):
        for q in range(3):
            values[COVARIANCE + 3 * p + q] = v[p, q]
    values[CHI2], values[GAIN], values[DIAMETER] = error, gain, diameter
