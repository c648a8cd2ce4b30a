"""Curves of all points, cameras' poses and clocks from all exposures at their own times, with covariances.

The walk: refuse what cannot be used -> each point by itself, smooth as the data say -> all points together, whose
accelerations are learned together -> constant distances found and used -> what the data cannot tell is held and said.
"""

import time as stopwatch
from dataclasses import replace

import numpy as np

from mosca.continuous import clocks as clock_rules
from mosca.continuous.checks import check
from mosca.continuous.first import first_curves
from mosca.continuous.image_rows import ImagePoints
from mosca.continuous.limbs import NO_PAIRS, Pairs, find_pairs, joined, learned
from mosca.continuous.observations import CameraPaths, Curves, Observations
from mosca.continuous.result import (
    Clock,
    ConstantDistance,
    ContinuousSettings,
    Estimated,
)
from mosca.continuous.smoothness import expected_accelerations, shrunk
from mosca.continuous.solve import Solved, curves_of, draws, sigma0, step
from mosca.continuous.starts import (
    enough,
    first_covariance,
    first_knots,
    grouped,
    moving_start,
    seen_from_to,
    still_of,
)
from mosca.continuous.state import Layout, State, layout
from mosca.data.arrays import Array
from mosca.data.rig import Rig

__all__ = ["Clock", "ConstantDistance", "ContinuousSettings", "Estimated", "estimate"]
DRAWS = 12
"""Curves drawn from the posterior at each round; each has hundreds of accelerations to learn from."""
LARGEST_SIGMA0 = 1.5
MOST_ROUNDS = 20
AT_REST_M = 2e-4
NEARLY_ONE = 1.1
"""Clocks and poses are settled when curves move less than this, and image errors are about as large as stated."""


def estimate(
    observations: Observations,
    rig: Rig,
    settings: ContinuousSettings | None = None,
    start: Curves | None = None,
    paths: CameraPaths | None = None,
) -> Estimated:
    """Return the curves of all points that no camera carries, cameras' paths and clocks, with covariances.

    ``rig``: lenses and poses; the poses are right ("known") or a start. ``start``: curves to begin with, ``paths``:
    cameras' paths to begin with ("moving"), by default the rig's poses. Gauge of unknown cameras: the first stays
    where the rig has it; the scale is the start's and is said to be unknown. InputError in one line for equal or
    unsorted time stamps, cameras without common time, too short a recording.
    """
    began = stopwatch.perf_counter()
    settings = ContinuousSettings() if settings is None else settings
    check(observations, rig)
    told: list[str] = []
    used = observations
    if settings.cameras == "known":
        used = observations.only(observations.carried_by[observations.point] < 0)
    image = ImagePoints(used, rig)
    points = enough(used, told)
    spans = seen_from_to(used, used.time_s)
    still = still_of(rig, observations.cameras)
    knots = first_knots(used, settings)
    clock_free = clock_rules.free_unknowns(settings.clocks, len(observations.cameras))
    xyz = np.zeros((knots.count, len(observations.points), 3))
    state = State(knots, xyz, still, moving_start(settings, still, paths, knots), np.zeros(clock_free.shape))
    alone = layout(
        tuple(np.array([p]) for p in points), len(still.cameras), "known", np.zeros_like(clock_free)
    )
    unsure = settings.clocks != "known" or settings.cameras != "known"
    state, strength, noise = first_curves(image, state, alone, points, start, unsure)
    groups = grouped(state, points, settings)
    places = layout(groups, len(still.cameras), settings.cameras, clock_free)
    of_point = dict(zip(points.tolist(), strength, strict=True))
    covariances = [first_covariance(of_point, places, g) for g in range(len(groups))]
    known = np.isin(np.arange(len(observations.points)), points)
    solved, places, covariances, pairs, held = _rounds(
        image, state, places, covariances, settings, known, spans, clock_free, noise
    )
    rng = np.random.default_rng(0)
    size = sigma0(solved, places, draws(solved, places, DRAWS, rng))
    told += clock_rules.findings(observations.cameras, held)
    if settings.cameras != "known":
        told.append(
            "scale: no length is given, so that it is the start's; give a known distance to make it metres"
        )
    if size > LARGEST_SIGMA0:
        told.append(
            f"image errors are {size:.1f} times as large as stated: look at clocks, calibration and names"
        )
    curves = curves_of(
        solved, places, covariances, observations, seen_from_to(used, image.times(solved.state))
    )
    names = observations.points
    found = tuple(
        ConstantDistance(names[i], names[j], float(d), float(s))
        for (i, j), d, s in zip(pairs.pair, pairs.distance, pairs.slack, strict=True)
    )
    times = clock_rules.results(observations.cameras, places, solved.state.clocks, solved.covariance, held)
    return Estimated(
        curves, solved.state.paths, tuple(times), found, tuple(told), size, stopwatch.perf_counter() - began
    )


def _rounds(
    image: ImagePoints, state: State, places: Layout, covariances: list[Array], settings: ContinuousSettings,
    known: Array, spans: Array, clock_free: Array, noise: float,
) -> tuple[Solved, Layout, list[Array], Pairs, Array]:  # fmt: skip
    """Step and learn in turn; constant distances are sought once curves are joined, and once more with their help."""
    rng = np.random.default_rng(0)
    pairs, held = NO_PAIRS, np.zeros_like(clock_free)
    after = settings.rounds if settings.limbs else 1
    sure = settings.cameras == "known" and settings.clocks == "known"
    settled: int | None = None
    for k in range(MOST_ROUNDS):
        solved = step(image, state, places, covariances, pairs, noise)
        state = solved.state
        if settled is not None and k == settled + after:
            break
        drawn = draws(solved, places, DRAWS, rng)
        if settled is None and noise > 1:
            # what clocks and poses that are not right yet do looks like noise, and shrinks as they come right
            noise = max(1.0, noise * sigma0(solved, places, drawn))
        covariances = [
            shrunk(expected_accelerations(state.knots, d, state.order), state.knots.count) for d in drawn
        ]
        at_rest = k >= 1 if sure else k >= 4 and solved.moved < AT_REST_M and noise < NEARLY_ONE
        if settled is None and (at_rest or k == MOST_ROUNDS - 1 - after):
            settled, noise = k, 1.0
            if settings.clocks != "known":
                held = clock_rules.untold(places, solved.covariance)
                if held.any():
                    places = layout(places.groups, places.cameras, settings.cameras, clock_free & ~held)
                    state = replace(state, clocks=np.where(held, 0.0, state.clocks))
        if settled is not None and settings.limbs:
            pairs = _pairs(pairs, state, places, drawn, known, spans, look=k <= settled + 1)
    return solved, places, covariances, pairs, held


def _pairs(
    pairs: Pairs, state: State, places: Layout, drawn: list[Array], known: Array, spans: Array, look: bool
) -> Pairs:
    """Return the constant distances as the drawn curves have them; ``look``: with those that are found anew."""
    whole = np.zeros((DRAWS, *state.xyz.shape))
    group = np.full(len(known), -1)
    for g, (points, curves) in enumerate(zip(places.groups, drawn, strict=True)):
        group[points] = g
        whole[:, :, points] = curves[:, :, : 3 * len(points)].reshape(DRAWS, state.knots.count, -1, 3)
    kept, tells = learned(pairs, state.knots, whole)
    kept = kept.only(tells)
    if not look:
        return kept
    new = find_pairs(state.knots, state.xyz, whole, known, spans)
    new = new.only(group[new.pair[:, 0]] == group[new.pair[:, 1]])
    had = {tuple(p) for p in pairs.pair.tolist()}
    new = new.only(np.array([tuple(p) not in had for p in new.pair.tolist()], dtype=bool))
    return joined([kept, new])
