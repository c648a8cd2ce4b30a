"""Bundle adjustment: the solver for wands, test fields, boards and body-worn cameras.

A ``Problem`` states unknowns and observations; ``solve`` returns the ``Adjustment``:

    cameras = tuple(CameraUnknowns(camera, free=("f_px", "k1")) for camera in rig.cameras)
    observations = Observations(camera, point, xy_px)
    lengths = Distances(first, second, length_m, sigma_m)
    problem = Problem(cameras, observations, ObjectPoints.free(2 * frames), distances=lengths, datum="points")
    adjustment = solve(problem)

Least squares, or robust by reweighting, over cameras, lenses, points and poses at once (Brown 1958; Triggs et
al. 1999). Time and memory are linear in the observations. The cameras, lenses and points seen on placed
things stay in one dense reduced system; up to a thousand or two of these are sensible.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.linalg.lapack import dposv

from mosca.calibration.bundle.adjustment import Adjustment, Precision, precision_of, tested
from mosca.calibration.bundle.data_snooping import snoop, without_undetermined
from mosca.calibration.bundle.datum import check_datum, generators, null_generators, weak_directions
from mosca.calibration.bundle.initial_points import intersected
from mosca.calibration.bundle.inner_constraints import diagonals, onto_given
from mosca.calibration.bundle.kernels import CAUCHY, HUBER, LEAST_SQUARES, LENS, UNSEEN, weigh
from mosca.calibration.bundle.layout import NormalsLayout, layout_of
from mosca.calibration.bundle.levenberg_marquardt import (
    AdjustmentTask,
    Descent,
    Solution,
    adjusted_cameras,
    descend,
    empty_normals,
    first_state,
    linearised,
    placed_again,
    reduced,
    residuals,
    state_of,
)  # fmt: skip
from mosca.calibration.bundle.priors import Priors, count, pulls
from mosca.calibration.bundle.problem import (
    FOCAL,
    CameraUnknowns,
    Distances,
    ObjectPoints,
    Observations,
    Placements,
    Problem,
)  # fmt: skip
from mosca.calibration.bundle.tables import Loss, ParameterValues
from mosca.data.arrays import Array, read_only
from mosca.errors import CalibrationError

__all__ = [
    "FOCAL", "Adjustment", "BundleSettings", "CameraUnknowns", "Distances", "ObjectPoints",
    "Observations", "Placements", "Precision", "Problem", "solve"
]  # fmt: skip
LOSSES = {"least squares": LEAST_SQUARES, "huber": HUBER, "cauchy": CAUCHY}
HOLDING_ROUNDS, PLACING_ROUNDS = 16, 5
# unknowns of the reduced system up to which its eigenvectors are examined
MOST_EIGENVECTORS = 1500


@dataclass(frozen=True)
class BundleSettings:
    """Settings of a bundle adjustment."""

    loss: Literal["least squares", "huber", "cauchy"] = "least squares"
    """Robust losses give less weight to residuals beyond ``loss_scale``."""
    loss_scale: float = 2.5
    """Scale of a robust loss, in a-priori standard deviations of both coordinates together."""
    tolerance: float = 1e-2
    """Share of its standard deviation by which an unknown may still move at the end."""
    most_steps: int = 100
    blunder_significance: float | None = None
    """Chance that an image point is rejected in an adjustment without blunders; None rejects none."""
    hold_weak: bool = True
    """Hold lens parameters that the data do not determine near their starting values."""
    precision: bool = True
    """Compute covariances, redundancy numbers and tests."""


def solve(problem: Problem, settings: BundleSettings | None = None, start: Adjustment | None = None) -> Adjustment:
    """Adjust ``problem``, starting from its given values or from an earlier adjustment ``start`` of the same
    structure.

    CalibrationError where the datum or an unknown is not determined.
    """
    settings = settings or BundleSettings()
    layout = layout_of(problem)
    state = first_state(problem, layout) if start is None else _state_of(problem, layout, start)
    loss = Loss(LOSSES[settings.loss], settings.loss_scale**2)
    task = AdjustmentTask(problem, layout, (), loss, settings.tolerance, settings.most_steps)
    weight = without_undetermined(layout, layout.observations.weight)
    task, solution, weak, steps = _solved(task, state, weight, settings.hold_weak)
    held = tuple(layout.names[one.column] for one in task.priors)
    rejected = np.zeros(len(layout.order), dtype=bool)
    if settings.blunder_significance is not None:
        solution, rejected = _snooped(task, solution, settings.blunder_significance)
    if problem.datum == "points":
        in_datum = onto_given(layout, solution, state)
        solution = replace(solution, descent=replace(solution.descent, state=in_datum))
    variance, redundancy = _variance(task, solution)
    precision = None
    if settings.precision:
        if problem.datum == "points":
            solution = _solution_at(task, solution)
        cofactors, tests = tested(layout, solution, loss)
        precision = precision_of(problem, layout, solution, cofactors, tests, variance)
    descent = solution.descent
    # the common motion onto the datum changes no residual
    own = descent.normals.residuals_px if (solution.weight > 0).all() else residuals(layout, descent.state)
    used, out, residual = np.empty(len(own), dtype=bool), np.empty(len(own), dtype=bool), np.empty_like(own)
    used[layout.order] = (solution.weight > 0) & np.isfinite(own[:, 0])
    out[layout.order], residual[layout.order] = rejected, -own
    _, points, placed = descent.state
    return Adjustment(
        adjusted_cameras(problem, descent.state),
        read_only(points, (None, 3), "points"),
        Placements(placed[:, :9].reshape(-1, 3, 3), placed[:, 9:]),
        read_only(residual, (None, 2), "residuals_px"),
        read_only(used, (None,), "used", np.bool_),
        read_only(np.flatnonzero(out), (None,), "rejected", np.int64),
        layout.names,
        weak,
        held,
        float(np.sqrt(variance)),
        redundancy,
        descent.cost,
        steps,
        descent.converged,
        precision,
    )


def _solved(
    task: AdjustmentTask, state: ParameterValues, weight: Array, hold_weak: bool
) -> tuple[AdjustmentTask, Solution, tuple[str, ...], int]:
    """Minimise; lens parameters found to be weakly determined get a prior in the task returned.

    Also returns the names of weak unknowns and the number of steps.
    """
    weak: tuple[str, ...] = ()
    first, steps = state, 0
    for _ in range(HOLDING_ROUNDS):
        descent = descend(task, state, weight)
        steps += descent.steps
        for _ in range(PLACING_ROUNDS):
            again = placed_again(task, descent.state, descent.normals.residuals_px, weight)
            if again is None:
                break
            other = descend(task, again, weight)
            steps += other.steps
            if other.cost >= descent.cost:
                break
            descent = other
        matrix, inverse, motions = _normal_matrix(task, descent)
        more: Priors = ()
        if 0 < len(matrix) <= MOST_EIGENVECTORS:
            variance = _variance(task, Solution(descent, weight, matrix, inverse, motions))[0]
            found, more = weak_directions(task.problem, task.layout, descent.state, matrix, variance, task.priors)
            weak += tuple(name for name in found if name not in weak)
        if not (more and hold_weak):
            break
        # priors are at the starting values, however far the parameters have moved since
        more = tuple(replace(one, value=float(first.cameras[one.camera, LENS + one.parameter])) for one in more)
        task, state = replace(task, priors=task.priors + more), descent.state
    return task, Solution(descent, weight, _inverse(task.layout, matrix), inverse, motions), weak, steps


def _solution_at(task: AdjustmentTask, solution: Solution) -> Solution:
    """Return the solution with the normal equations computed again at its state, which was moved."""
    normals = empty_normals(task.layout)
    linearised(task, solution.descent.state, solution.weight, normals)
    return _inverted(task, replace(solution.descent, normals=normals), solution.weight)


def _inverted(task: AdjustmentTask, descent: Descent, weight: Array) -> Solution:
    matrix, inverse, motions = _normal_matrix(task, descent)
    return Solution(descent, weight, _inverse(task.layout, matrix), inverse, motions)


def _normal_matrix(task: AdjustmentTask, descent: Descent) -> tuple[Array, Array, int]:
    """Return the reduced normal matrix with the datum fixed, the inverse blocks, and the number of free motions."""
    pull, _ = pulls(task.problem, task.layout, task.priors, descent.state)
    inverse = np.empty_like(descent.normals.blocks)
    matrix, _ = reduced(task.layout, descent.normals, pull, 0.0, inverse)
    if len(matrix) == 0:
        return matrix, inverse, 0
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    motions = generators(task.layout, descent.state) * scale[:, None]
    loose = null_generators(matrix / scale[:, None] / scale, motions)
    check_datum(task.problem, loose.shape[1])
    if task.problem.datum == "points":
        fixing = loose * scale[:, None]
        matrix = matrix + fixing @ fixing.T
    return matrix, inverse, loose.shape[1]


def _inverse(layout: NormalsLayout, matrix: Array) -> Array:
    if len(matrix) == 0:
        return matrix
    scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    _, inverse, failed = dposv(matrix * scale[:, None] * scale, np.eye(len(matrix)))
    if failed:
        raise CalibrationError(
            f"the observations do not determine all unknowns (first {layout.names[failed - 1]}); hold some or "
            "observe more points"
        )
    inverse *= scale[:, None] * scale
    return np.asarray((inverse + inverse.T) / 2)


def _variance(task: AdjustmentTask, solution: Solution) -> tuple[float, int]:
    """Return the variance of unit weight and the redundancy."""
    layout, descent = task.layout, solution.descent
    active = int((solution.weight > 0).sum()) - descent.unseen
    determined = int((diagonals(layout, solution.inverse) > 0).sum())
    redundancy = 2 * active + count(task.problem, layout, task.priors) - len(layout.names) - determined
    redundancy += solution.motions if task.problem.datum == "points" else 0
    # a point that is not seen has a cost, but is no observation
    unseen = descent.unseen * weigh(2 * UNSEEN**2, task.loss)[0]
    return max(descent.cost - unseen, 0.0) / max(redundancy, 1), redundancy


def _snooped(task: AdjustmentTask, solution: Solution, significance: float) -> tuple[Solution, Array]:
    """Return the solution without blunders, and which sorted image points (n,) were rejected."""

    def solve_again(before: Solution, weight: Array) -> Solution:
        return _inverted(task, descend(task, before.descent.state, weight), weight)

    def test(one: Solution) -> tuple[Array, float, int]:
        variance, redundancy = _variance(task, one)
        return tested(task.layout, one, task.loss)[1][:, 5], variance * redundancy, redundancy

    return snoop(task.layout, solution, significance, solve_again, test)


def _state_of(problem: Problem, layout: NormalsLayout, start: Adjustment) -> ParameterValues:
    """Return the state of an earlier adjustment of the same structure."""
    points = np.where(np.isfinite(start.points), start.points, problem.points.xyz)
    return state_of(problem, start.cameras, intersected(start.cameras, layout, points), start.placements)
