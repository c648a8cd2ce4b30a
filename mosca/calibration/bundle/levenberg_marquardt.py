"""Levenberg-Marquardt on the reduced normal equations of a bundle adjustment.

Marquardt (1963): the diagonal is multiplied by 1 + damping; the damping falls after a step that gains what
was predicted and rises ever faster after one that does not (Nielsen 1999).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg.lapack import dposv

from mosca.calibration.bundle.initial_points import intersected
from mosca.calibration.bundle.kernels import LENS, imaged
from mosca.calibration.bundle.layout import NormalsLayout
from mosca.calibration.bundle.lenses import lens_of, lens_row, set_folds
from mosca.calibration.bundle.normals import linearise
from mosca.calibration.bundle.priors import Priors, pulls
from mosca.calibration.bundle.problem import Placements, Problem
from mosca.calibration.bundle.reduction import back_substitute, reduce_to_groups, scatter
from mosca.calibration.bundle.rotations import observed_blocks, rotate_by
from mosca.calibration.bundle.tables import Loss, NormalEquations, ParameterValues
from mosca.data.arrays import Array
from mosca.data.rig import Camera, Pose

# the least damping also keeps a free network regular: its common motions then do not move
FIRST_DAMPING, LEAST_DAMPING, WORST_DAMPING = 1e-6, 1e-10, 1e12
# damping beyond which a small predicted decrease only means a small step
STALLED = 1e2
# largest share by which a step's decrease may differ from the prediction where the problem counts as quadratic
AS_PROMISED = 0.1
# relative difference below which two sums of so many squares cannot be distinguished
ROUNDING = 1e-14
# residuals of rounding size, in standard deviations: an exact fit
EXACT = 1e-9

# residual, in typical ones and in standard deviations, from which a point is badly placed; share of its squared
# residuals that may remain when it is intersected again; residual of a point that is not imaged
FAR_SIGMAS, LEFT_SHARE, UNSEEN_SIGMAS = 8.0, 0.5, 1e9


@dataclass(frozen=True, eq=False)
class AdjustmentTask:
    """Inputs common to all steps of an adjustment.

    ``tolerance``: converged when the predicted step, or the last step taken, changes no unknown by more than this
    fraction of its standard deviation.
    """

    problem: Problem
    layout: NormalsLayout
    priors: Priors
    loss: Loss
    tolerance: float
    most_steps: int


@dataclass(frozen=True, eq=False)
class Descent:
    """End of a descent: state, normal equations there, cost, steps, unseen points, whether it converged."""

    state: ParameterValues
    normals: NormalEquations
    cost: float
    steps: int
    unseen: int
    converged: bool


@dataclass(frozen=True, eq=False)
class Solution:
    """A finished descent with the inverse of its normal equations, from which precision is computed.

    ``weight`` (n,) 1/sigma of the sorted image points, 0 where left out; ``cofactors`` (u, u) of the reduced system
    in any datum; ``inverse`` of the blocks; ``motions`` the number of common motions that are not fixed.
    """

    descent: Descent
    weight: Array
    cofactors: Array
    inverse: Array
    motions: int


def first_state(problem: Problem, layout: NormalsLayout) -> ParameterValues:
    """Return the starting values; points without any are intersected from their rays."""
    cameras = tuple(one.camera for one in problem.cameras)
    points = intersected(cameras, layout, np.array(problem.points.xyz))
    return state_of(problem, cameras, points, problem.placements)


def placed_again(
    task: AdjustmentTask, state: ParameterValues, residual: Array, weight: Array, least: float = 0.0
) -> ParameterValues | None:
    """Return the state with badly placed points intersected again, None where that improves no point.

    ``residual`` (n, 2) [px]: at ``state``; ``least``: least residual of a badly placed point, in standard deviations.
    A point is badly placed if a camera should image it and does not, or observes it far from its projection. From a
    poor start, one end of a wand may end on the wrong side of the other end, where the length is right as well.
    """
    layout = task.layout
    away = _distances(layout, residual, weight)
    if away.max(initial=0.0) < FAR_SIGMAS:
        return None
    limit = least or FAR_SIGMAS * max(float(np.median(away[weight > 0])), 1.0)
    lost = np.intersect1d(layout.observations.point[away >= limit], layout.members)
    if len(lost) == 0:
        return None
    points = state.points.copy()
    points[lost] = np.nan
    cameras = adjusted_cameras(task.problem, state)
    again = state._replace(points=intersected(cameras, layout, points, state.points))
    before, after = (
        np.bincount(layout.observations.point, one**2, len(points))
        for one in (away, _distances(layout, residuals(layout, again), weight))
    )
    worse = after > LEFT_SHARE * before
    again.points[worse] = state.points[worse]
    return again if (~worse[lost]).any() else None


def _distances(layout: NormalsLayout, residual: Array, weight: Array) -> Array:
    """Return the residuals (n,) of points of the world, in standard deviations; 0 for all others."""
    away = np.nan_to_num(np.hypot(residual[:, 0], residual[:, 1]) * weight, nan=UNSEEN_SIGMAS)
    return np.where((weight > 0) & (layout.observations.placement < 0), away, 0.0)


def residuals(layout: NormalsLayout, state: ParameterValues) -> Array:
    """Return projected minus observed (n, 2) [px] of the sorted image points, NaN where not imaged."""
    out = np.empty((len(layout.order), 2))
    imaged(state, layout.observations, out)
    return out


def adjusted_cameras(problem: Problem, state: ParameterValues) -> tuple[Camera, ...]:
    """Return the cameras of a state."""
    table = state.cameras
    return tuple(
        replace(
            one.camera,
            lens=lens_of(table[c, LENS:], one.camera.lens),
            world_from_camera=Pose(table[c, :9].reshape(3, 3), table[c, 9:LENS]),
        )
        for c, one in enumerate(problem.cameras)
    )


def state_of(problem: Problem, cameras: Sequence[Camera], points: Array, placements: Placements) -> ParameterValues:
    """Return a state of these cameras, points and placements."""
    table = [
        np.concatenate([pose.rotation.ravel(), pose.translation, lens_row(camera.lens, one.free)])
        for camera, one in zip(cameras, problem.cameras, strict=True)
        for pose in [camera.world_from_camera]
    ]
    poses = np.column_stack([placements.rotation.reshape(-1, 9), placements.translation])
    return ParameterValues(np.array(table), np.array(points), poses)


def reduced(
    layout: NormalsLayout, normals: NormalEquations, pull: tuple[Array, Array] | None, damping: float, inverse: Array
) -> tuple[Array, Array]:
    """Return the reduced normal matrix (u, u) and slope (u,); write the inverse blocks into ``inverse``."""
    unknowns, width = len(layout.names), layout.index.shape[1]
    pairs = np.empty((layout.pairs, width, width))
    group_slope = np.empty((len(layout.index), width))
    reduce_to_groups(layout.blocks, normals, damping, inverse, pairs, group_slope)
    matrix = np.empty((unknowns, unknowns))
    scatter(normals, pairs, layout.index, damping, matrix)
    there = layout.index >= 0
    slope = np.bincount(layout.index[there], group_slope[there], unknowns)
    if pull is not None:
        matrix += pull[0]
        matrix[np.diag_indices(unknowns)] += damping * np.diag(pull[0])
        slope += pull[1]
    return matrix, slope


def descend(task: AdjustmentTask, start: ParameterValues, weight: Array) -> Descent:
    """Descend from ``start`` to the least cost; ``weight`` (n,) 1/sigma of the sorted image points, 0 if left out."""
    layout = task.layout
    normals, inverse = empty_normals(layout), np.empty(int((layout.blocks.size**2).sum()))
    state = start
    cost, unseen, pull = linearised(task, state, weight, normals)
    if unseen:
        state = placed_again(task, state, normals.residuals_px, weight, UNSEEN_SIGMAS) or state
        cost, unseen, pull = linearised(task, state, weight, normals)
    used = int((weight > 0).sum())
    redundancy = max(2 * used - len(layout.names) - int(layout.blocks.size.sum()), 1)
    damping, growth, before = FIRST_DAMPING, 2.0, 0.0
    for step in range(task.most_steps):
        enough = max(task.tolerance**2 / redundancy, ROUNDING) * cost
        while True:
            steps, promised = _step(task, normals, pull, damping, inverse)
            if promised <= enough or cost <= EXACT**2 * used:
                return Descent(state, normals, cost, step, unseen, damping < STALLED)
            trial = None if steps is None else moved(layout, state, *steps)
            if trial is not None:
                trial_cost, trial_unseen, trial_pull = linearised(task, trial, weight, normals)
                if trial_cost < cost:
                    break
                linearised(task, state, weight, normals)
            damping, growth = damping * growth, growth * 2
            if damping > WORST_DAMPING:
                return Descent(state, normals, cost, step, unseen, False)
        gained = cost - trial_cost
        state, cost, unseen, pull = trial, trial_cost, trial_unseen, trial_pull
        ratio = gained / promised
        fall = 0.1 if ratio > 0.75 else max(1 / 3, 1 - (2 * ratio - 1) ** 3)
        damping, growth = max(damping * fall, LEAST_DAMPING), 2.0
        # gains of steps that match their prediction shrink at least linearly: the next gain is extrapolated
        # at the last rate
        next_one = promised**2 / before if before > 0 and abs(ratio - 1) < AS_PROMISED else np.inf
        if min(gained, next_one) <= enough:
            return Descent(state, normals, cost, step + 1, unseen, damping < STALLED)
        before = promised
    return Descent(state, normals, cost, task.most_steps, unseen, False)


def linearised(
    task: AdjustmentTask, state: ParameterValues, weight: Array, normals: NormalEquations
) -> tuple[float, int, tuple[Array, Array] | None]:
    """Write the normal equations at a state; return the cost, the number of unseen points and ``pulls``."""
    layout = task.layout
    see = layout.observations._replace(weight=weight)
    cost, unseen = linearise(state, see, layout.columns, layout.blocks, layout.known, task.loss, normals)
    if layout.known.information.size:
        cost += observed_blocks(state, layout.blocks, layout.known, normals)
    pull, more = pulls(task.problem, layout, task.priors, state)
    return float(cost) + more, int(unseen), pull


def _step(
    task: AdjustmentTask, normals: NormalEquations, pull: tuple[Array, Array] | None, damping: float, inverse: Array
) -> tuple[tuple[Array, Array] | None, float]:
    """Return a damped step of the groups and of the blocks (None where there is none) and the predicted decrease."""
    layout = task.layout
    matrix, slope = reduced(layout, normals, pull, damping, inverse)
    step = np.zeros(0)
    if len(slope):
        diagonal = np.diag(matrix)
        scale = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
        _, step, failed = dposv(matrix * scale[:, None] * scale, -scale * slope)
        if failed:
            return None, np.inf
        step = scale * step
    group_step = np.append(step, 0.0)[layout.index]
    block_step = np.empty(len(normals.block_slope))
    promised = back_substitute(layout.blocks, normals, damping, inverse, group_step, block_step)
    own = np.diagonal(normals.groups, axis1=1, axis2=2)
    promised += float(np.sum(group_step * (damping * own * group_step - normals.group_slope)))
    if pull is not None:
        promised += float(step @ (damping * np.diag(pull[0]) * step)) - float(step @ pull[1])
    return (group_step, block_step), promised


def moved(
    layout: NormalsLayout, state: ParameterValues, group_step: Array, block_step: Array
) -> ParameterValues | None:
    """Return ``state`` after steps of the groups (groups, K) and blocks; None for a scale of a lens not above 0."""
    cameras, points, placements = state
    cameras = cameras.copy()
    steps = group_step[: len(cameras)]
    rotate_by(cameras, np.ascontiguousarray(steps[:, :3]))
    cameras[:, 9:LENS] += steps[:, 3:6]
    if len(layout.lens_places):
        group, place, parameter = layout.lens_places.T
        cameras[group, LENS + parameter] += layout.lens_factors * group_step[group, place]
        if not set_folds(cameras[:, LENS:]):
            return None
    if len(layout.members) + len(layout.kept):
        points = points.copy()
        eliminated = 3 * len(layout.members)
        points[layout.members] = points.take(layout.members, axis=0) + block_step[:eliminated].reshape(-1, 3)
        points[layout.kept] += group_step[len(cameras) :, :3]
    if len(layout.placed):
        steps = block_step[3 * len(layout.members) :].reshape(-1, 6)
        moved = placements[layout.placed]
        rotate_by(moved, np.ascontiguousarray(steps[:, :3]))
        moved[:, 9:] += steps[:, 3:]
        placements = placements.copy()
        placements[layout.placed] = moved
    return ParameterValues(cameras, points, placements)


def empty_normals(layout: NormalsLayout) -> NormalEquations:
    """Return empty arrays for the normal equations."""
    groups, width = layout.index.shape
    dim, at_w = layout.blocks.size, layout.blocks.mixed_at
    return NormalEquations(
        np.empty((groups, width, width)),
        np.empty((layout.pairs, width, width)),
        np.empty((groups, width)),
        np.empty(at_w[-1]),
        np.empty(int((dim * dim).sum())),
        np.empty(int(dim.sum())),
        layout.pair_of,
        np.empty((len(layout.order), 2)),
    )
