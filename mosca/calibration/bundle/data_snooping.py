"""Blunders among the image points of a bundle adjustment: data snooping after Baarda (1968).

As in ``mosca.calibration.single_camera.outliers`` the standard deviation is estimated without the point under test. A
blunder has little effect beyond its own block (a point, or a placed thing). So the worst image point of each block is
rejected in one step. The adjustment is repeated until none is improbable; then those that fit are readmitted.
"""

from collections.abc import Callable

import numpy as np

from mosca.calibration.bundle.layout import NormalsLayout
from mosca.calibration.bundle.levenberg_marquardt import Solution
from mosca.data.arrays import Array
from mosca.data.distributions import f as f_distribution

LEAST_REDUNDANCY = 3
ROUNDS, PASSES = 40, 4

Solve = Callable[[Solution, Array], Solution]
"""Function of a solution and new weights (n,); returns the solution with these weights."""
Test = Callable[[Solution], tuple[Array, float, int]]
"""Function of a solution; returns statistics v^T Q_vv^-1 v (n,) in a-priori units, sum of squares, redundancy."""


def without_undetermined(layout: NormalsLayout, weight: Array) -> Array:
    """Return the weights (n,), 0 for image points of points and placements that too few of these determine."""
    dim, member = layout.blocks.size, layout.blocks.members
    block, used = layout.block_of, weight > 0
    enough = 2 * np.bincount(block[used], minlength=len(dim)) + np.diff(layout.known.first_distance)
    information = layout.known.information
    if information.size:
        weighted = (information[member[:, 0]] != 0).any(axis=(1, 2))
        enough += 3 * np.bincount(member[weighted, 1], minlength=len(dim))
    weight = np.where((enough >= dim)[block], weight, 0.0)
    # a point that a distance joins to others also needs two rays of its own
    point = layout.observations.point
    rays = np.bincount(point[weight > 0], minlength=int(point.max(initial=0)) + 1)
    joined = np.isin(point, member[dim[member[:, 1]] > 3, 0]) & (layout.observations.placement < 0)
    if information.size:
        joined &= ~(information[point] != 0).any(axis=(1, 2))
    return np.where(joined & (rays[point] < 2), 0.0, weight)


def snoop(
    layout: NormalsLayout, solution: Solution, significance: float, solve: Solve, test: Test
) -> tuple[Solution, Array]:
    """Return the solution without blunders and which sorted image points (n,) were rejected.

    ``significance``: chance that any image point is rejected where there are no blunders.
    """
    level = significance / len(layout.order)
    rejected = np.zeros(len(layout.order), dtype=bool)
    for _ in range(PASSES):
        solution, rejected = _without_worst(layout, solution, rejected, level, solve, test)
        statistic, cost, redundancy = test(solution)
        back = rejected & (f_distribution.sf(statistic / 2 / (cost / redundancy), 2, redundancy) >= level)
        if not back.any():
            break
        rejected = rejected & ~back
        solution = solve(solution, _weights(layout, rejected))
    return solution, rejected


def _without_worst(
    layout: NormalsLayout, solution: Solution, rejected: Array, level: float, solve: Solve, test: Test
) -> tuple[Solution, Array]:
    block = layout.block_of
    # observations that touch no block influence each other through their camera
    near = np.where(block > 0, block + layout.observations.camera.max() + 1, layout.observations.camera)
    for _ in range(ROUNDS):
        statistic, cost, redundancy = test(solution)
        if redundancy - 2 < LEAST_REDUNDANCY:
            break
        statistic = np.where(solution.weight > 0, np.nan_to_num(statistic), 0.0)
        # variance from the other image points, so that a blunder does not mask itself
        variance = np.maximum(cost - statistic, 1e-300) / (redundancy - 2)
        improbable = np.flatnonzero(f_distribution.sf(statistic / 2 / variance, 2, redundancy - 2) < level)
        if len(improbable) == 0:
            break
        improbable = improbable[np.argsort(-statistic[improbable], kind="stable")]
        worst = improbable[np.unique(near[improbable], return_index=True)[1]]
        rejected = rejected.copy()
        rejected[worst] = True
        solution = solve(solution, _weights(layout, rejected))
    return solution, rejected


def _weights(layout: NormalsLayout, rejected: Array) -> Array:
    return without_undetermined(layout, np.where(rejected, 0.0, layout.observations.weight))
