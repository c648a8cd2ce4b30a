"""Image points of balls that their own wand hides in part.

A bar that comes out of a ball towards the camera covers a part of the ball's image, and the centre found is shifted
away from the bar by up to a hundredth of the diameter. A bar that goes away from the camera lies behind the ball. The
error is the same in all frames with the wand at one tilt, so that it does not average out: it stretches the wand and
with it the scale. The bar of a wand is not known; its effect is estimated from the residuals (additional parameters,
Brown 1976): a shift along the bar, piecewise linear in the cosine between bar and line of sight, zero where the bar
points away. The hidden part grows with the image, blur and pixels do not. So one part of the shift is proportional to
the image's size, the other is the same number of pixels at all sizes. The remaining errors give variances by the same
cosine (Koch 1999, section 3.6).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from mosca.calibration.uncalibrated.image_points import PointViews
from mosca.calibration.uncalibrated.partial_adjustment import Network
from mosca.camera.projection import project_with_jacobians
from mosca.data.arrays import Array
from mosca.data.distributions import chi2

KNOTS = 5
"""Knots of the shift above a cosine of 0, and classes of variances there."""
LEAST_REDUNDANCY = 40
"""Least redundancy of a class with a variance of its own."""
SIGNIFICANT = 1e-3
"""Level of the test whether bars shift image points."""
ROUNDS, SETTLED = 40, 0.1
"""Largest number of adjustments; change of image points, in standard deviations, and of these, relative, that ends
them."""


@dataclass(frozen=True, eq=False)
class BarDirections:
    """Direction of the bar nearest to the line of sight at n image points.

    ``cosine`` (n,): 1 where it points from its ball at the camera; ``along`` (n, 2) [px/m]: the image of a metre
    across the line of sight in the bar's direction. NaN where ball or wand have no position.
    """

    cosine: Array
    along: Array


def without_hidden(start: Network, adjusted: Callable[[Network, PointViews], Network]) -> Network:
    """Return the network adjusted with the shifts by the wand's bars removed and the rest in the standard deviations.

    ``start``: with precision; ``adjusted``: adjusts a network again with other image points, with precision. A wand
    that hides nothing leaves the network as it is.
    """
    base, one = start.tracks, start
    bars = bar_directions(start)
    design = _designs(bars)
    shift = np.zeros(design.shape[2])
    for k in range(ROUNDS):
        more, gain = _shifts(one, design)
        if k == 0 and chi2.sf(gain / max(one.adjustment.sigma0**2, 1e-12), len(shift)) > SIGNIFICANT:
            return start
        shift = shift + more
        xy = base.xy_px - np.nan_to_num(design @ shift)
        factor = _variance_factors(one, one.tracks.xy_px - xy, base, bars.cosine)
        sigma = np.asarray(base.sigma_px) * np.sqrt(factor)
        moved = np.linalg.norm(xy - one.tracks.xy_px, axis=1) / sigma
        change = max(moved.max(initial=0.0), np.abs(sigma / one.tracks.sigma_px - 1).max(initial=0.0))
        one = adjusted(one, replace(base, xy_px=xy, sigma_px=sigma))
        if change <= SETTLED:
            break
    return one


def bar_directions(one: Network) -> BarDirections:
    """Return the directions of the wand's bars at each image point of a network."""
    tracks, points, rods = one.tracks, one.points, one.tracks.rods
    start = np.concatenate([rods.first, rods.second])
    bar = points[np.concatenate([rods.second, rods.first])] - points[start]
    known = np.flatnonzero(np.isfinite(bar).all(axis=1))
    order = known[np.argsort(start[known], kind="stable")]
    start, bar = start[order], bar[order] / np.linalg.norm(bar[order], axis=1, keepdims=True)
    first, last = (np.searchsorted(start, tracks.point, side=side) for side in ("left", "right"))
    n = len(tracks)
    cosine, along = np.full(n, -np.inf), np.full((n, 2), np.nan)
    for k, camera in one.cameras.items():
        mine = np.flatnonzero((tracks.camera == k) & (last > first))
        at = points[tracks.point[mine]]
        sight = camera.world_from_camera.translation - at
        sight /= np.linalg.norm(sight, axis=1, keepdims=True)
        slope = project_with_jacobians(camera, at).by_point
        # a ball has as many bars as the wand has other balls, in two directions at the most
        for which in range(int((last - first)[mine].max(initial=0))):
            there = np.flatnonzero((last - first)[mine] > which)
            direction = bar[first[mine[there]] + which]
            towards = np.einsum("ni,ni->n", direction, sight[there])
            nearer = towards > cosine[mine[there]]
            there, direction, towards = there[nearer], direction[nearer], towards[nearer]
            across = direction - towards[:, None] * sight[there]
            across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
            cosine[mine[there]] = towards
            along[mine[there]] = np.einsum("nij,nj->ni", slope[there], across)
    return BarDirections(np.where(np.isfinite(cosine), cosine, np.nan), along)


def _hats(cosine: Array) -> Array:
    """Return the weights (n, KNOTS) of the knots above zero in a piecewise linear function of the cosine."""
    place = np.clip(np.nan_to_num(cosine), 0.0, 1.0)[:, None] * (KNOTS)
    return np.asarray(np.maximum(0.0, 1.0 - np.abs(place - np.arange(1, KNOTS + 1))))


def _designs(bars: BarDirections) -> Array:
    """Return the shifts (n, 2, 2 KNOTS) [px] of image points by a unit at each knot.

    A unit is one pixel. In the first half this holds for images of median size, and the shift is proportional to the
    size; in the second half it holds for all sizes.
    """
    hats, along = _hats(bars.cosine)[:, None, :], bars.along[:, :, None]
    size = np.linalg.norm(along, axis=1, keepdims=True)
    usual = np.median(size[np.isfinite(size)]) if np.isfinite(size).any() else 1.0
    return np.asarray(np.concatenate([hats * along / usual, hats * along / np.maximum(size, 1e-9)], axis=2))


def _shifts(one: Network, design: Array) -> tuple[Array, float]:
    """Return the shift (2 KNOTS,) [px] estimated from the residuals, and its decrease of the sum of squares."""
    residual = one.residuals_px / one.tracks.sigma_px[:, None]
    good = one.adjustment.used & np.isfinite(design).all(axis=(1, 2)) & np.isfinite(residual).all(axis=1)
    a = (design / one.tracks.sigma_px[:, None, None])[good].reshape(-1, design.shape[2])
    r = residual[good].ravel()
    shift = np.linalg.lstsq(a, r)[0]
    return shift, float(r @ r - ((r - a @ shift) ** 2).sum())


def _variance_factors(one: Network, moved_px: Array, base: PointViews, cosine: Array) -> Array:
    """Return the factor (n,) on the variances of ``base`` that makes them as right as where bars point away.

    ``moved_px`` (n, 2): motion of the image points since the network was adjusted, subtracted from the residuals. The
    stated variance of a ball hidden by a bar reflects the misfit of a disc, which is no longer the error of the
    centre once that is moved. So each class gets one variance. Medians are used, since balls that nearly touch
    another's image are far off.
    """
    assert one.adjustment.precision is not None
    stated = np.asarray(base.sigma_px) ** 2
    # the redundancy is the share of an error left in the residuals: little where few others are as good
    left = one.adjustment.precision.redundancy_numbers.sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        squares = ((one.residuals_px - moved_px) ** 2).sum(axis=1) / left
    # class 0: bars that point away
    of = np.ceil(np.clip(np.nan_to_num(cosine), 0.0, 1.0) * KNOTS).astype(int)
    of[~(np.isfinite(cosine) & np.isfinite(squares))] = -1
    classes = [np.flatnonzero(of == k) for k in range(KNOTS + 1)]
    factor, away = np.ones(len(base)), classes[0]
    usual = np.median((squares / stated)[away]) if left[away].sum() >= LEAST_REDUNDANCY else 0.0
    if usual == 0:
        return factor
    for mine in classes[1:]:
        if left[mine].sum() >= LEAST_REDUNDANCY:
            factor[mine] = np.median(squares[mine]) / (usual * stated[mine])
    return factor
