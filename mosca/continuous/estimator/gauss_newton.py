"""One Gauss-Newton step on all curves, poses and clocks jointly, and samples of the posterior."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError

from mosca.continuous.estimator import clocks
from mosca.continuous.estimator.banded_normals import Band, Factor, Rows, solve_bordered
from mosca.continuous.estimator.constant_distances import Pairs, limb_rows
from mosca.continuous.estimator.motion_prior import FARTHEST_M, expected_accelerations
from mosca.continuous.estimator.observation_equations import ImagePoints, LinearisedImages, robust_weights, weighted
from mosca.continuous.estimator.state import StateLayout, TrajectoryState, replaced, unknowns
from mosca.continuous.model.bspline import values
from mosca.continuous.model.estimated import SplineCurves
from mosca.continuous.model.observations import TimedObservations
from mosca.data.arrays import Array
from mosca.errors import InputError

HALVINGS = 6
HELD = 1e12
"""Precision of unknowns that are held: far above that from images."""
FRAME = (1e-4, 0.2)
"""A-priori standard deviation of moving cameras about their initial path, rad or m per knot: first, others."""
DRIFT_OF_FRAME = (1.0, 1.0)
"""Standard deviations [rad, m] with which the start loosely holds the frame where none is given (unknown cameras)."""


@dataclass(frozen=True, eq=False)
class Solved:
    """A state and its covariance.

    ``carried``: each group's T^-1 B; ``covariance`` of the shared unknowns; ``rows``: each group's weighted equations
    of image points; ``weight`` and ``residual`` of image points; ``moved``: largest change of a coefficient [m].
    """

    state: TrajectoryState
    factors: list[Factor]
    carried: list[Array]
    covariance: Array
    rows: list[Rows]
    weight: Array
    residual: Array
    moved: float


def step(
    image: ImagePoints,
    state: TrajectoryState,
    places: StateLayout,
    covariances: list[Array],
    pairs: Pairs,
    noise: float = 1.0,
) -> Solved:
    """Return the state after one step with the prior's ``covariances`` (Q of each group) and constant distances.

    ``noise``: factor on the stated image errors.
    """
    seen = image.linearised(state, places)
    weight = robust_weights(seen.residual / noise) / noise**2
    knots, base = state.knots, 3 * len(image.observations.points)
    corner, corner_right = _shared_prior(places, state)
    factors, rights, borders, parts = [], [], [], []
    for g in range(len(places.groups)):
        width = places.width(g)
        own = _of_group(seen, weight, places, g, image, base)
        limb = limb_rows(pairs, places.column(g, len(image.observations.points)), knots, state.xyz, places.shared)
        x = unknowns(state, places, g)
        band = Band(knots.count, knots.degree + 1, width, places.shared)
        for rows in (own, limb, frame_rows(state, places, g)):
            # equations for a step from x and for all of x are equivalent; the prior needs those for all of x
            band.add(rows._replace(rest=rows.rest + rows.applied(x, width)))
        corner += own.shared.T @ own.shared
        corner_right += own.shared.T @ (own.rest + own.applied(x, width))
        add_prior(band, state, places, g, covariances[g])
        rights.append(band.right)
        borders.append(band.border)
        try:
            factors.append(band.factor())
        except LinAlgError:
            # hold directions whose information is below the rounding error of the best-determined one
            band.hold(x)
            rights[-1] = band.right
            factors.append(band.factor())
        parts.append(own)
    found, shared, carried, covariance = solve_bordered(factors, rights, borders, corner, corner_right)
    new = replaced(state, places, found, shared)
    if not (np.isfinite(new.xyz).all() and np.isfinite(new.clocks).all()):
        raise InputError(
            "continuous: the images do not determine the points or the cameras (cameras at one place, or a start "
            "that is far off); give the cameras' poses, or images from places farther apart"
        )
    if places.moving or places.shared:
        new = _short_enough(image, state, new, found, shared, places, covariances, pairs, weight)
    moved = float(np.abs(new.xyz - state.xyz).max(initial=0.0))
    return Solved(new, factors, carried, covariance, parts, weight, seen.residual, moved)


def add_prior(band: Band, state: TrajectoryState, places: StateLayout, group: int, covariance: Array) -> None:
    """Add the smoothness prior of a group, and a weak prior that keeps undetermined unknowns finite."""
    knots, width, points = state.knots, places.width(group), 3 * len(places.groups[group])
    gram = state.smooth.gram(knots, None if state.pace is None else 1 / state.pace)
    band.add_prior(gram, np.linalg.inv(covariance))
    loose = np.full(width, FARTHEST_M**-2)
    if places.moving:
        sigma = np.array([DRIFT_OF_FRAME[0]] * 3 + [FARTHEST_M] * 3)
        loose[points:] = np.tile(sigma**-2, places.cameras)
    band.add_prior(knots.gram(0), np.diag(loose))


def draws(solved: Solved, places: StateLayout, number: int, rng: np.random.Generator) -> list[Array]:
    """Return for each group curves (number, count, width) drawn from the posterior."""
    shared = np.zeros((places.shared, number))
    if places.shared:
        # root by eigenvalues: for unknowns that are held, rounding may leave a variance just below zero. The root is
        # symmetric: signs of the axes depend on rounding, and would give other draws on another processor
        sizes, axes = np.linalg.eigh(solved.covariance)
        random = rng.normal(size=(places.shared, number))
        shared = axes @ (np.sqrt(np.maximum(sizes, 0.0))[:, None] * (axes.T @ random))
    drawn = []
    for g, (factor, carried) in enumerate(zip(solved.factors, solved.carried, strict=True)):
        error = factor.spread(np.asfortranarray(rng.normal(size=(factor.count * factor.width, number))))
        error = error - carried @ shared
        whole = unknowns(solved.state, places, g)[:, None] + error
        drawn.append(whole.T.reshape(number, factor.count, factor.width))
    return drawn


def sigma0(image: ImagePoints, solved: Solved, places: StateLayout, drawn: list[Array]) -> tuple[float, Array]:
    """Return the standard deviation of unit weight of all image points and of each camera (c,), relative to the
    standard deviations used in ``step``: the variance components of Helmert and Foerstner.

    The degrees of freedom of the fit are subtracted. They are trace(H^-1 J^T J), which is the mean square change of
    the images by drawn curves.
    """
    cameras = len(image.observations.cameras)
    square, number, fitted = np.zeros((3, cameras))
    for g, rows in enumerate(solved.rows):
        x = unknowns(solved.state, places, g)
        own = of_group(image, places, g) & (solved.weight > 0)
        camera = np.repeat(image.observations.camera[own], 2)
        for one in drawn[g]:
            change = rows.applied(one.ravel() - x, places.width(g))
            fitted += np.bincount(camera, change**2, cameras) / len(drawn[g])
        number += np.bincount(camera, minlength=cameras)
        square += np.bincount(camera, rows.rest**2, cameras)

    def size(square: Array, number: Array, fitted: Array) -> Array:
        return np.asarray(np.sqrt(square / np.maximum(number - fitted, np.maximum(0.05 * number, 1.0))))

    whole = float(size(square.sum(), number.sum(), fitted.sum()))
    return whole, np.where(number > 0, size(square, number, fitted), whole)


def curves_of(
    solved: Solved,
    places: StateLayout,
    covariances: list[Array],
    observations: TimedObservations,
    spans: Array,
    unheld: Array,
    finest_s: float,
) -> SplineCurves:
    """Return the curves of all free points with their covariances; points that were left out are known nowhere.

    ``covariances``: those of the prior. White noise Q of derivative m has the spectrum Q / w^(2 m); splines contain
    its part below pi / step, and the rest is Q step^(2 m - 1) / ((2 m - 1) pi^(2 m)). ``finest_s``: the step that
    exposures allow; a wider one was chosen because there is no motion between the two. ``spans`` (points, 2): first
    and last instant at which each point was seen [s]; ``unheld`` (pieces + 1, points, 3, 3): see ``SplineCurves``.
    """
    state, free = solved.state, observations.free
    knots, n = state.knots, len(observations.points)
    blocks = np.zeros((knots.degree + 1, knots.count, n, 3, 3))
    carried = np.zeros((knots.count, n, 3, places.shared))
    beyond = np.zeros((n, 3, 3))
    odd = 2 * state.smooth.order - 1
    rest = finest_s**odd / (odd * np.pi ** (odd + 1))
    estimated = np.zeros(n, dtype=bool)
    for g, (points, factor) in enumerate(zip(places.groups, solved.factors, strict=True)):
        blocks[:, :, points] = factor.inverse_blocks(len(points))
        of_group = solved.carried[g].reshape(knots.count, factor.width, places.shared)
        carried[:, points] = of_group[:, : 3 * len(points)].reshape(knots.count, len(points), 3, places.shared)
        estimated[points] = True
        at = np.arange(3 * len(points)).reshape(-1, 3)
        beyond[points] = covariances[g][at[:, :, None], at[:, None, :]] * rest
    spans = np.where(estimated[:, None], spans, (np.inf, -np.inf))
    return SplineCurves(
        tuple(observations.points[p] for p in free), knots, state.xyz[:, free], blocks[:, :, free],
        carried[:, free], solved.covariance, beyond[free], state.pace_at_knots, unheld[:, free],
        spans[free, 0], spans[free, 1]
    )  # fmt: skip


def of_group(image: ImagePoints, places: StateLayout, group: int) -> Array:
    """Return the mask of the image points whose equations belong to a group; carried points belong to the first."""
    inside = np.zeros(len(image.observations.points), dtype=bool)
    inside[places.groups[group]] = True
    return np.where(image.carrier >= 0, group == 0, inside[image.observations.point])


def _of_group(
    seen: LinearisedImages, weight: Array, places: StateLayout, group: int, image: ImagePoints, base: int
) -> Rows:
    """Return the weighted equations of a group's image points in the group's own columns."""
    points = len(image.observations.points)
    rows = weighted(seen.rows, weight * of_group(image, places, group))
    table = np.full(base + 6 * places.cameras + 1, -1)
    begin = places.column(group, points)
    for k in range(3):
        table[k:base:3] = np.where(begin >= 0, begin + k, -1)
    if places.moving:
        table[base:-1] = 3 * len(places.groups[group]) + np.arange(6 * places.cameras)
    return rows._replace(columns=table[rows.columns])


def _shared_prior(places: StateLayout, state: TrajectoryState) -> tuple[Array, Array]:
    precision, right = clocks.prior(places, state.clocks)
    if places.still_free:
        loose = np.repeat(np.array(DRIFT_OF_FRAME) ** -2.0, 3) * 1e-4
        precision[: 6 * places.cameras] += np.tile(loose, places.cameras)
        precision[:6] += HELD
    matrix = np.diag(precision)
    if places.still_free:
        # gauge: the first camera stays at its pose in the rig, and the second's distance to it is the scale
        apart = state.still.centres[1] - state.still.centres[0]
        matrix[9:12, 9:12] += HELD * np.outer(apart, apart) / (apart @ apart)
    return matrix, right


def frame_rows(state: TrajectoryState, places: StateLayout, group: int) -> Rows:
    """Return equations that fix the gauge (frame) of moving cameras: weak priors on each at its initial pose, strong
    ones on the first and on the second's distance to the first.

    Cameras only observe each other and the points, so a common similarity transformation at each instant is
    undetermined. ``FRAME`` is its standard deviation, far looser than that from images where these determine it.
    """
    knots, moving = state.knots, state.moving
    time, cameras = knots.breaks_s, places.cameras if moving is not None else 0
    first, weight = knots.weights(time)
    n = len(time) * cameras * 6
    if moving is None:
        return Rows(
            first[:0], weight[:0], np.zeros((0, 1), int), np.zeros((0, 1)), np.zeros((0, places.shared)), time[:0]
        )
    wanted = values(knots, moving.frame, time)
    sigma = np.where(np.arange(cameras)[:, None] == 0, FRAME[0], FRAME[1])
    rest = (wanted - values(knots, moving.coefficients, time)) / sigma
    begin = 3 * len(places.groups[group])
    columns = np.full((n, 3), -1)
    columns[:, 0] = begin + np.tile(np.arange(cameras * 6), len(time))
    by = np.zeros((n, 3))
    by[:, 0] = np.broadcast_to(1 / sigma, rest.shape).ravel()
    each = np.repeat(np.arange(len(time)), cameras * 6)
    base = wanted[:, 1, 3:] - wanted[:, 0, 3:]
    base /= np.maximum(np.linalg.norm(base, axis=1), 1e-9)[:, None] * FRAME[0]
    apart = (rest * sigma)[:, 1, 3:]
    return Rows(
        np.append(first[each], first), np.concatenate([weight[each], weight]),
        np.concatenate([columns, np.tile(begin + 9 + np.arange(3), (len(time), 1))]),
        np.concatenate([by, base]), np.zeros((n + len(time), places.shared)),
        np.append(rest.ravel(), (base * apart).sum(axis=1))
    )  # fmt: skip


def _short_enough(
    image: ImagePoints, old: TrajectoryState, new: TrajectoryState, found: list[Array], shared: Array,
    places: StateLayout, covariances: list[Array], pairs: Pairs, weight: Array
) -> TrajectoryState:  # fmt: skip
    """Return the new state, or a shortened step where the full one increased the cost."""
    best = cost(image, old, places, covariances, pairs, weight)
    start = [unknowns(old, places, g) for g in range(len(places.groups))]
    share = 1.0
    for _ in range(HALVINGS):
        if cost(image, new, places, covariances, pairs, weight) <= best:
            return new
        share /= 2
        between = [a + share * (b - a) for a, b in zip(start, found, strict=True)]
        new = replaced(old, places, between, share * shared)
    return old


def cost(
    image: ImagePoints,
    state: TrajectoryState,
    places: StateLayout,
    covariances: list[Array],
    pairs: Pairs,
    weight: Array,
) -> float:
    """Return the weighted sum of squares of image errors, of the prior and of constant distances."""
    residual = image.residuals(state)[weight > 0]
    if not np.isfinite(residual).all():
        return float("inf")
    total = float((weight[weight > 0, None] * residual**2).sum())
    knots = state.knots
    for g, covariance in enumerate(covariances):
        table = unknowns(state, places, g).reshape(1, knots.count, -1)
        second = expected_accelerations(knots, table, state.smooth, state.pace) * state.smooth.rank(knots)
        total += float((np.linalg.inv(covariance) * second).sum())
        if places.moving:
            total += float((frame_rows(state, places, g).rest ** 2).sum())
    if len(pairs):
        at = values(knots, state.xyz, knots.breaks_s)
        length = np.linalg.norm(at[:, pairs.pair[:, 0]] - at[:, pairs.pair[:, 1]], axis=2)
        total += float((((length - pairs.distance) / pairs.slack) ** 2).sum())
    offsets = np.where(places.clock >= 0, state.clocks / np.array(clocks.BEFORE), 0.0)
    return total + float((offsets**2).sum())
