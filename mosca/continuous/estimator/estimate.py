"""Curves of all points, cameras' poses and clocks, from all exposures at their own times, with covariances.

Steps: check the input -> estimate each point separately, with its smoothness -> estimate all points jointly, with the
covariance of their accelerations -> find and use constant distances -> hold and report unknowns that the data do not
determine.
"""

import time as stopwatch
from dataclasses import replace

import numpy as np

from mosca.continuous.estimator import clocks as clock_rules
from mosca.continuous.estimator.constant_distances import NO_PAIRS, Pairs, find_pairs, joined, learned
from mosca.continuous.estimator.gauss_newton import Solved, curves_of, draws, sigma0, step
from mosca.continuous.estimator.initial_state import (
    enough,
    first_covariances,
    first_knots,
    grouped,
    moving_start,
    seen_from_to,
)
from mosca.continuous.estimator.input_checks import check, check_places
from mosca.continuous.estimator.motion_prior import Smoothness, expected_accelerations, liveliness, shrunk
from mosca.continuous.estimator.observation_equations import ImagePoints
from mosca.continuous.estimator.residual_covariance import covariance_of_shared, unheld
from mosca.continuous.estimator.single_point import Choice, first_curves
from mosca.continuous.estimator.state import StateLayout, TrajectoryState, layout
from mosca.continuous.model.camera_paths import StillCameras
from mosca.continuous.model.estimated import Clock, ConstantDistance, ContinuousEstimate, ContinuousSettings
from mosca.continuous.model.observations import CameraPaths, Curves, TimedObservations
from mosca.data.arrays import Array
from mosca.data.rig import Rig

__all__ = ["Clock", "ConstantDistance", "ContinuousEstimate", "ContinuousSettings", "estimate"]
DRAWS = 12
"""Number of posterior samples of the curves per round; each has hundreds of accelerations."""
LARGEST_SIGMA0 = 1.5
"""A posteriori standard deviation of unit weight above which a finding states that errors are larger than stated."""
JOINED_AT = 1
"""First round in which the joint prior is good enough to test distances."""
SPOILT = 0.1
"""If more than this share of distances is dropped at once, the variances are estimated again."""
SETTLING = 2
"""Number of last rounds without a search for new distances, so that the variances of new ones can converge."""
ROUNDS_ALONE = 2
MOST_ROUNDS = 20
FEWEST_ROUNDS = 4
STILL = 1e-3
"""Smallest acceleration assumed for moving cameras: rad/s^2 or m/s^2 in a band of one hertz."""
AT_REST_M = 2e-4
"""Largest move of a curve in a round [m] below which the rounds may end."""
NEARLY_ONE = 1.1
"""Factor on the stated image errors below which they are about as large as stated: clocks and poses have converged
when, in addition, curves move less than AT_REST_M."""


def estimate(
    observations: TimedObservations,
    rig: Rig,
    settings: ContinuousSettings | None = None,
    start: Curves | None = None,
    paths: CameraPaths | None = None,
) -> ContinuousEstimate:
    """Return the curves of all points that no camera carries, cameras' paths and clocks, with covariances.

    ``rig``: lenses and poses; the poses are right ("known") or starting values. ``start``: starting curves;
    ``paths``: starting paths of "moving" cameras, by default the rig's poses. Gauge of unknown cameras: the first
    stays at its pose in the rig; the scale is the start's and is reported as unknown. InputError, in one line, for
    equal or unsorted time stamps, cameras without common time, or too short a recording.
    """
    began = stopwatch.perf_counter()
    settings = ContinuousSettings() if settings is None else settings
    check(observations, rig)
    if settings.cameras != "moving":
        check_places(observations.cameras, rig)
    findings: list[str] = []
    used = observations
    if settings.cameras == "known":
        used = observations.only(observations.carried_by[observations.point] < 0)
    image = ImagePoints(used, rig)
    points = enough(used, findings)
    spans = seen_from_to(used, used.time_s)
    still = StillCameras.of(rig, observations.cameras)
    knots = first_knots(used, settings)
    clock_free = clock_rules.free_unknowns(settings.clocks, len(observations.cameras))
    xyz = np.zeros((knots.count, len(observations.points), 3))
    state = TrajectoryState(
        knots, xyz, still, moving_start(settings, still, paths, knots), np.zeros(clock_free.shape)
    )
    alone = layout(tuple(np.array([p]) for p in points), len(still.cameras), "known", np.zeros_like(clock_free))
    held = np.zeros_like(clock_free)
    # given paths are near: overestimated noise would mask how little cameras move
    begun = settings.cameras == "moving" and paths is not None and settings.clocks == "known"
    known = settings.clocks == "known" and settings.cameras == "known"
    free_knots = settings.knot_s is None and settings.cameras != "moving"
    choice = Choice(knots, free_knots, free_knots and not known and settings.cameras == "known")
    state, strength, noise = first_curves(image, state, alone, points, start, not (known or begun), choice)
    of_cameras = np.zeros((0, 0))
    if not known:
        state, held, of_cameras = _settled(image, state, points, settings, strength, noise, clock_free)
        # variances estimated with wrong clocks and poses attribute their errors to motion: they are estimated again,
        # from rays, since image points far from the initial curves (jumps) have little weight and would never recover
        state = replace(state, smooth=Smoothness(), knots=knots, xyz=xyz)
        state, strength, _ = first_curves(image, state, alone, points, None, False, choice)
    groups = grouped(state, points, settings)
    places = layout(groups, len(still.cameras), settings.cameras, clock_free & ~held)
    covariances = first_covariances(points, strength, places)
    if places.moving:
        covariances[0][3 * len(points) :, 3 * len(points) :] = of_cameras
    seen = np.isin(np.arange(len(observations.points)), points)
    solved, covariances, pairs = _rounds(image, state, places, covariances, settings, seen, spans)
    rng = np.random.default_rng(0)
    size, of_camera = sigma0(image, solved, places, draws(solved, places, DRAWS, rng))
    findings += clock_rules.findings(observations.cameras, held)
    if settings.cameras != "known":
        findings.append(
            "scale: no length is given, so that it is the start's; give a known distance to make it metres"
        )
    if size > LARGEST_SIGMA0:
        findings.append(
            f"image errors are {size:.1f} times as large as stated: look at clocks, calibration and names"
        )
    spans = seen_from_to(used, image.times(solved.state))
    missing = unheld(image, solved, places, alone, points)
    solved = replace(solved, covariance=covariance_of_shared(image, solved, places))
    curves = curves_of(solved, places, covariances, observations, spans, missing, knots.step_s)
    names = observations.points
    found = tuple(
        ConstantDistance(names[i], names[j], float(d), float(s))
        for (i, j), d, s in zip(pairs.pair, pairs.distance, pairs.slack, strict=True)
    )
    times = clock_rules.results(observations.cameras, places, solved.state.clocks, solved.covariance, held)
    spent = stopwatch.perf_counter() - began
    return ContinuousEstimate(
        curves, solved.state.paths, tuple(times), found, tuple(findings), size, of_camera, spent
    )


def _settled(
    image: ImagePoints, state: TrajectoryState, points: Array, settings: ContinuousSettings, strength: Array,
    noise: float, clock_free: Array
) -> tuple[TrajectoryState, Array, Array]:  # fmt: skip
    """Return the state with converged clocks and poses, which clock unknowns are held as undetermined, and moving
    cameras' part of the prior's covariance.
    """
    rng = np.random.default_rng(0)
    places = layout(grouped(state, points, settings), len(state.still.cameras), settings.cameras, clock_free)
    covariances = first_covariances(points, strength, places)
    for k in range(MOST_ROUNDS):
        solved = step(image, state, places, covariances, NO_PAIRS, noise)
        state = solved.state
        if k >= FEWEST_ROUNDS and solved.moved < AT_REST_M and noise < NEARLY_ONE:
            break
        drawn = draws(solved, places, DRAWS, rng)
        if noise > 1:
            # errors of clocks and poses act as noise, which shrinks as these converge
            noise = max(1.0, noise * sigma0(image, solved, places, drawn)[0])
        covariances = _learned(state, places, drawn, covariances)
    held = clock_rules.undetermined_clocks(places, solved.covariance)
    return (
        replace(state, clocks=np.where(held, 0.0, state.clocks)),
        held,
        covariances[0][3 * len(places.groups[0]) :, 3 * len(places.groups[0]) :],
    )


def _learned(state: TrajectoryState, places: StateLayout, drawn: list[Array], before: list[Array]) -> list[Array]:
    """Return the prior's covariance of each group, estimated from its drawn curves.

    Expectation-maximisation converges slowly where data determine little, as for cameras that are stationary. So
    decreases of cameras' standard deviations take steps of twice the length, and stay above ``STILL``.
    """
    count, result = state.knots.count, []
    for points, curves, old in zip(places.groups, drawn, before, strict=True):
        new = shrunk(expected_accelerations(state.knots, curves, state.smooth, state.pace), count)
        if places.moving:
            free = np.arange(len(new)) >= 3 * len(points)
            ratio = np.sqrt(np.diag(new) / np.diag(old))
            smaller = np.where(free, np.minimum(ratio, 1.0), 1.0)
            smaller = np.where(free, np.maximum(smaller, STILL / np.sqrt(np.diag(new))), 1.0)
            new = new * smaller[:, None] * smaller
        result.append(new)
    return result


def _rounds(
    image: ImagePoints, state: TrajectoryState, places: StateLayout, covariances: list[Array],
    settings: ContinuousSettings, known: Array, spans: Array
) -> tuple[Solved, list[Array], Pairs]:  # fmt: skip
    """Alternate Gauss-Newton steps and variance estimation; constant distances are searched for once the prior is
    joint, and again with them in use.
    """
    rng = np.random.default_rng(0)
    pairs, before = NO_PAIRS, (covariances, state.pace)
    left: set[tuple[int, int]] = set()
    last = JOINED_AT + (settings.rounds if settings.limbs else 1)
    for k in range(MOST_ROUNDS):
        solved = step(image, state, places, covariances, pairs)
        state = solved.state
        if k == last:
            break
        drawn = draws(solved, places, DRAWS, rng)
        pace = liveliness(state.knots, drawn, covariances, state.smooth)
        state = replace(state, pace=pace / np.exp(np.log(pace).mean()))
        covariances = _learned(state, places, drawn, covariances)
        if k == JOINED_AT:
            before = covariances, state.pace
        if settings.limbs and k >= JOINED_AT:
            had = len(pairs)
            pairs, dropped = _pairs(pairs, state, places, drawn, known, spans, left if k < last - SETTLING else None)
            left |= dropped
            if len(dropped) > SPOILT * had:
                # false distances distorted the curves: variances estimated from these are wrong
                covariances, state = before[0], replace(state, pace=before[1])
                last = min(k + settings.rounds, MOST_ROUNDS - 1)
            elif not had and not len(pairs):
                # no slowly converging variances: curves alone converge soon
                last = min(last, JOINED_AT + ROUNDS_ALONE)
    return solved, covariances, pairs


def _pairs(
    pairs: Pairs, state: TrajectoryState, places: StateLayout, drawn: list[Array], known: Array, spans: Array,
    left: set[tuple[int, int]] | None
) -> tuple[Pairs, set[tuple[int, int]]]:  # fmt: skip
    """Return the constant distances estimated from the drawn curves, and those that were dropped as not informative.

    New ones are also searched for, except those in ``left``, which were dropped before; None: no search.
    """
    whole = np.zeros((DRAWS, *state.xyz.shape))
    group = np.full(len(known), -1)
    for g, (points, curves) in enumerate(zip(places.groups, drawn, strict=True)):
        group[points] = g
        whole[:, :, points] = curves[:, :, : 3 * len(points)].reshape(DRAWS, state.knots.count, -1, 3)
    kept, tells = learned(pairs, state.knots, whole)
    dropped = {(i, j) for i, j in kept.only(~tells).pair.tolist()}
    kept = kept.only(tells)
    if left is None:
        return kept, dropped
    new = find_pairs(state.knots, state.xyz, whole, known, spans)
    new = new.only(group[new.pair[:, 0]] == group[new.pair[:, 1]])
    had = {(i, j) for i, j in pairs.pair.tolist()} | left
    new = new.only(np.array([(i, j) not in had for i, j in new.pair.tolist()], dtype=bool))
    return joined([kept, new]), dropped
