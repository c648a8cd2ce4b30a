"""Initial curves: each point separately, from its rays at their own instants; linear, without an initial guess."""

from dataclasses import dataclass, replace

import numpy as np

from mosca.continuous.estimator.banded_normals import Rows
from mosca.continuous.estimator.motion_prior import COARSER, CORNERED, DEGREE, ORDERS, Smoothness, one_point
from mosca.continuous.estimator.observation_equations import ImagePoints, LinearisedImages, robust_weights, weighted
from mosca.continuous.estimator.state import StateLayout, TrajectoryState
from mosca.continuous.model.bspline import Knots, fitted, knots_over
from mosca.continuous.model.observations import Curves
from mosca.data.arrays import Array

RAY_PASSES = 2
NEAREST_M = 0.05
"""Least depth [m] used for an image's weight: points are not nearer to a lens."""
JUDGES = 12
"""Most points from which order and knots are chosen."""
JITTER_ORDER = 3
"""Order of the smooth prior relative to which motion above the exposures' rate is estimated."""


@dataclass(frozen=True)
class Choice:
    """Properties of the prior that may be chosen. ``finest``: knots; ``free_knots``: whether wider ones are allowed.

    ``corners``: whether corner frequencies are allowed. They are not where clocks are assumed right: wrong clocks
    look like motion of high frequencies, which a corner admits; without a corner the residuals show them.
    """

    finest: Knots
    free_knots: bool
    corners: bool


def first_curves(
    image: ImagePoints,
    state: TrajectoryState,
    places: StateLayout,
    points: Array,
    start: Curves | None,
    noise_free: bool,
    choice: Choice,
) -> tuple[TrajectoryState, Array, float]:
    """Return the state with curves of ``points`` (indices), each one's log strength of smoothness, and the factor by
    which image errors are larger than stated (1 unless ``noise_free``).

    Rays are first weighted by a guessed depth (the distance of the point nearest to all axes), then by the estimated
    depth; then image errors themselves are used. Order, knot spacing and corner are those that predict best, as far
    as ``choice`` allows. ``start``: curves at which to linearise instead.
    """
    if start is not None:
        xyz = np.array(state.xyz)
        xyz[:, points] = _following(start, image.observations.points, points, state.knots)
        state = replace(state, xyz=np.nan_to_num(xyz))
    if start is None or not np.isfinite(xyz[:, points]).all():
        depth = np.full(len(image.observations), _middle_distance(state, image.times(state)))
        for k in range(RAY_PASSES):
            if k:
                depth = np.maximum(image.depths(state), NEAREST_M)
            seen = image.rays(state, depth)
            usable = np.isfinite(seen.residual).all(axis=1).astype(float)
            # maximum-likelihood noise gives a smooth curve, from which gross errors stand out
            state = _each_point(image, seen, state, usable, points, True)[0]
    seen = _of_whole_points(image, state, places)
    weight = robust_weights(seen.residual)
    state, seen = _likeliest(image, seen, state, weight, points, noise_free, choice)
    best, strength, noise, _ = _each_point(image, seen, state, weight, points, noise_free)
    return best, strength, max(1.0, float(np.median(noise)))


def _likeliest(
    image: ImagePoints, seen: LinearisedImages, state: TrajectoryState, weight: Array, points: Array,
    noise_free: bool, choice: Choice
) -> tuple[TrajectoryState, LinearisedImages]:  # fmt: skip
    """Return the state with the order, knots and corner that predict left-out image points of some points best, and
    the equations for these.

    Where knots are not free, the orders that their degree allows are compared.
    """
    some = points[np.unique(np.linspace(0, len(points) - 1, JUDGES).astype(int))]

    def tried(order: int, knots: Knots, corner: float = 0.0) -> tuple[float, TrajectoryState, LinearisedImages]:
        xyz = np.zeros((knots.count, *state.xyz.shape[1:]))
        new = replace(state, smooth=Smoothness(order, corner), knots=knots, xyz=xyz)
        rows = _on_knots(image, seen, new)
        return _each_point(image, rows, new, weight, some, noise_free)[3], new, rows

    best = np.inf, state, seen
    for order in ORDERS:
        # try all knots: rounding spoils predictions of high orders on close knots, so these must not end the search
        candidates = [tried(order, knots) for knots in _ladder(choice, order)]
        if not candidates:
            continue
        own = min(candidates, key=_score)
        if choice.corners and order >= CORNERED and np.isfinite(own[0]):
            # start from the highest corner of these knots: far below the motion's spectrum a corner has no effect
            corner, before = np.pi / own[1].knots.step_s, np.inf
            while (other := tried(order, own[1].knots, corner))[0] < before:
                own, before = min(own, other, key=_score), other[0]
                corner /= COARSER
        best = min(best, own, key=_score)
    return best[1], best[2]


def _score(candidate: tuple[float, TrajectoryState, LinearisedImages]) -> float:
    return candidate[0]


def _ladder(choice: Choice, order: int) -> list[Knots]:
    """Return the possible knots for a prior of ``order``, finest first, each ``COARSER`` times wider than before."""
    finest = choice.finest
    if not choice.free_knots:
        return [finest] if order <= finest.degree else []
    ladder, step_s = [], finest.step_s
    while (knots := knots_over(finest.start_s, finest.end_s, step_s, max(DEGREE, order))).pieces > order:
        ladder.append(knots)
        step_s *= COARSER
    return ladder


def _on_knots(image: ImagePoints, seen: LinearisedImages, state: TrajectoryState) -> LinearisedImages:
    """Return equations of whole points for the knots of ``state``."""
    first, weight = state.knots.weights(image.times(state))
    rows = seen.rows._replace(first=np.repeat(first, 2), weights=np.repeat(weight, 2, axis=0))
    return LinearisedImages(seen.residual, rows)


def smoothest_noise(
    image: ImagePoints, state: TrajectoryState, places: StateLayout, points: Array
) -> tuple[Array, Array, Array]:
    """Return for each of ``points``, with curves of order ``JITTER_ORDER``: the factor by which image errors are then
    larger than stated, the mean square of an image coordinate's derivative by position [1/m^2], and the number of
    image coordinates.
    """
    seen = _of_whole_points(image, state, places)
    smooth = replace(state, smooth=Smoothness(JITTER_ORDER))
    # jumps are rare and far larger than other residuals: found in a first pass, they get less weight in the second
    once = _each_point(image, seen, smooth, robust_weights(seen.residual), points, True)[0]
    noise = _each_point(image, seen, smooth, robust_weights(image.residuals(once)), points, True)[2]
    square = (seen.rows.values[:, :3] ** 2).sum(axis=1).reshape(-1, 2).sum(axis=1) / 2
    count = len(image.observations.points)
    own = np.bincount(image.observations.point, minlength=count)[points]
    lever = np.bincount(image.observations.point, square, count)[points] / own
    return noise, lever, 2.0 * own


def _each_point(
    image: ImagePoints, seen: LinearisedImages, state: TrajectoryState, weight: Array, points: Array, noise_free: bool
) -> tuple[TrajectoryState, Array, Array, float]:
    """Return the state with each point's maximum-likelihood curve, log strengths and noises, and the total cost."""
    xyz, strength, noise, total = np.array(state.xyz), np.zeros(len(points)), np.ones(len(points)), 0.0
    for n, p in enumerate(points):
        own = weighted(seen.rows, weight * (image.observations.point == p))
        number = len(own.rest)
        three = np.tile(np.arange(3), (number, 1))
        rows = Rows(own.first, own.weights, three, own.values[:, :3], np.zeros((number, 0)), own.rest)
        xyz[:, p], strength[n], noise[n], cost = one_point(rows, state.knots, state.smooth, noise_free)
        total += cost
    return replace(state, xyz=xyz), strength, noise, total


def _of_whole_points(image: ImagePoints, state: TrajectoryState, places: StateLayout) -> LinearisedImages:
    """Return equations at ``state`` in the coefficients of the points instead of in their increments."""
    seen = image.linearised(state, places)
    rows = seen.rows
    only = rows._replace(columns=rows.columns[:, :3], values=rows.values[:, :3], shared=np.zeros((len(rows.rest), 0)))
    rest = rows.rest + only.applied(state.xyz.ravel(), 3 * len(image.observations.points))
    return LinearisedImages(seen.residual, only._replace(rest=rest))


def _middle_distance(state: TrajectoryState, time_s: Array) -> float:
    """Return the mean distance [m] of cameras from the position that their axes pass nearest to."""
    rotation, centre = state.paths.at(np.linspace(time_s.min(), time_s.max(), 5))
    axis = rotation[..., 2].reshape(-1, 3)
    places = centre.reshape(-1, 3)
    across = np.eye(3) - axis[:, :, None] * axis[:, None, :]
    middle = np.linalg.lstsq(across.sum(axis=0), np.einsum("nij,nj->i", across, places), rcond=None)[0]
    return float(np.clip(np.linalg.norm(places - middle, axis=1).mean(), 0.3, 100.0))


def _following(curves: Curves, names: tuple[str, ...], points: Array, knots: Knots) -> Array:
    """Return coefficients (count, points, 3) near given curves; NaN where the curves have no such point."""
    time = np.linspace(knots.start_s, knots.end_s, 2 * knots.count + 1)
    at = curves.at(time)
    result = np.full((knots.count, len(points), 3), np.nan)
    for n, p in enumerate(points):
        if names[p] not in curves.points:
            continue
        given = at[:, curves.points.index(names[p])]
        good = np.isfinite(given).all(axis=1)
        if good.sum() >= 2:
            # in gaps and at the ends: interpolated between, or held at, the nearest known positions
            filled = np.column_stack([np.interp(time, time[good], given[good, k]) for k in range(3)])
            result[:, n] = fitted(knots, time, filled)
    return result
