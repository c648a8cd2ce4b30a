"""Bundle adjustment: the one solver for wands, test fields, boards, self-calibration and body-worn cameras.

A ``Problem`` says what is unknown and what was observed, ``solve`` returns the ``Adjustment``:

    cameras = tuple(CameraUnknowns(camera, free=("f_px", "k1")) for camera in rig.cameras)
    observations = Observations(camera, point, xy_px)
    lengths = Distances(first, second, length_m, sigma_m)
    problem = Problem(cameras, observations, ObjectPoints.free(2 * frames), distances=lengths, datum="points")
    adjustment = solve(problem)

Least squares, or robust by reweighting, over cameras, lenses, points and poses at once (Brown 1958; Triggs et al.
1999). Time and memory are linear in the observations; the cameras, lenses and points seen on placed things
stay in one dense reduced system, so that up to a thousand or two of these are sensible.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from mosca.calibrate.bundle_adjustment import (
    Adjustment,
    Precision,
    Solution,
    adjusted_cameras,
    datum_mask,
    precision_of,
    tested,
)
from mosca.calibrate.bundle_blunders import snoop, without_lonely
from mosca.calibrate.bundle_datum import check_datum, generators, null_generators, weak_directions
from mosca.calibrate.bundle_descent import (
    Descent,
    State,
    descend,
    first_state,
    placed_again,
    reduced,
    residuals,
    state_of,
)
from mosca.calibrate.bundle_kernels import CAUCHY, HUBER, LEAST_SQUARES, LENS, UNSEEN, weigh
from mosca.calibrate.bundle_layout import Layout, lay_out
from mosca.calibrate.bundle_priors import Priors, count, lens_priors, pulls
from mosca.calibrate.bundle_problem import (
    FOCAL,
    FREE,
    HELD,
    CameraUnknowns,
    Distances,
    ObjectPoints,
    Observations,
    Placements,
    Problem,
)
from mosca.calibrate.bundle_start import intersected
from mosca.data.arrays import Array, read_only
from mosca.errors import CalibrationError

__all__ = [
    "FOCAL", "FREE", "HELD", "Adjustment", "BundleSettings", "CameraUnknowns", "Distances", "ObjectPoints",
    "Observations", "Placements", "Precision", "Problem", "solve",
]  # fmt: skip
LOSSES = {"least squares": LEAST_SQUARES, "huber": HUBER, "cauchy": CAUCHY}
HOLDING_ROUNDS = 16
# unknowns of the reduced system up to which its eigenvectors are looked at
MOST_LOOKED_INTO = 1500


@dataclass(frozen=True)
class BundleSettings:
    """How a bundle is adjusted.

    ``loss``: robust losses count residuals beyond ``loss_scale`` (in a-priori standard deviations, of both coordinates
    together) for less. ``tolerance``: share of its standard deviation by which an unknown may still move at
    the end. ``blunder_significance``: chance that an image point is rejected in an adjustment without blunders; None
    rejects none. ``hold_weak``: hold lens parameters that the data leave open near their starting values.
    ``precision``: work out covariances, redundancy numbers and tests.
    """

    loss: Literal["least squares", "huber", "cauchy"] = "least squares"
    loss_scale: float = 2.5
    tolerance: float = 1e-2
    most_steps: int = 100
    blunder_significance: float | None = None
    hold_weak: bool = True
    precision: bool = True


def solve(
    problem: Problem, settings: BundleSettings | None = None, start: Adjustment | None = None
) -> Adjustment:
    """Adjust ``problem``, from its given values or from those of an earlier adjustment ``start`` of the same structure.

    CalibrationError where the datum or an unknown is not determined.
    """
    settings = settings or BundleSettings()
    layout = lay_out(problem)
    state = first_state(problem, layout) if start is None else _state_of(problem, layout, start)
    priors = lens_priors(problem, layout)
    robust = (LOSSES[settings.loss], settings.loss_scale**2)
    weight = without_lonely(layout, layout.see[4])
    solution, priors, weak, held, steps = _solved(problem, layout, state, weight, priors, robust, settings)
    rejected = np.zeros(len(layout.order), dtype=bool)
    if settings.blunder_significance is not None:
        significance = settings.blunder_significance
        solution, rejected = _snooped(problem, layout, solution, priors, robust, settings, significance)
    if problem.datum == "points":
        solution = replace(
            solution, descent=replace(solution.descent, state=_onto_given(problem, layout, solution, state))
        )
    descent = solution.descent
    own = residuals(layout, descent.state)
    sigma0_squared, redundancy = _variance(problem, layout, solution, priors, robust)
    precision = None
    if settings.precision:
        if problem.datum == "points":
            solution = _solution_at(problem, layout, solution, priors, robust)
        cofactors, tests = tested(layout, solution, robust)
        precision = precision_of(problem, layout, solution, cofactors, tests, sigma0_squared)
    used, out, residual = np.empty(len(own), dtype=bool), np.empty(len(own), dtype=bool), np.empty_like(own)
    used[layout.order] = (solution.weight > 0) & np.isfinite(own[:, 0])
    out[layout.order], residual[layout.order] = rejected, -own
    _, points, placed = descent.state
    return Adjustment(
        adjusted_cameras(problem, layout, descent.state),
        read_only(points, (None, 3), "points"),
        Placements(placed[:, :9].reshape(-1, 3, 3), placed[:, 9:]),
        read_only(residual, (None, 2), "residuals_px"),
        read_only(used, (None,), "used", np.bool_),
        read_only(np.flatnonzero(out), (None,), "rejected", np.int64),
        layout.names,
        weak,
        held,
        float(np.sqrt(sigma0_squared)),
        redundancy,
        descent.cost,
        steps,
        descent.converged,
        precision,
    )


def _solved(
    problem: Problem,
    layout: Layout,
    state: State,
    weight: Array,
    priors: Priors,
    robust: tuple[int, float],
    settings: BundleSettings,
) -> tuple[Solution, Priors, tuple[str, ...], tuple[str, ...], int]:
    """Descend, holding lens parameters that turn out to be weak; also the priors, weak and held names, and steps."""
    weak: tuple[str, ...] = ()
    held: tuple[str, ...] = ()
    first, steps = state, 0
    for _ in range(HOLDING_ROUNDS):
        descent = descend(
            problem, layout, state, weight, priors, robust, settings.tolerance, settings.most_steps
        )
        steps += descent.steps
        if descent.unseen:
            cameras = adjusted_cameras(problem, layout, descent.state)
            again = placed_again(cameras, layout, descent.state, weight)
            descent = descend(
                problem, layout, again, weight, priors, robust, settings.tolerance, settings.most_steps
            )
            steps += descent.steps
        matrix, inverse, motions = _normal_matrix(problem, layout, descent, priors)
        more: Priors = ()
        if 0 < len(matrix) <= MOST_LOOKED_INTO:
            trial = Solution(descent, weight, matrix, inverse, motions)
            variance = _variance(problem, layout, trial, priors, robust)[0]
            found, more = weak_directions(problem, layout, descent.state, matrix, variance, priors)
            weak += tuple(name for name in found if name not in weak)
        if not (more and settings.hold_weak):
            break
        # near their starting values, wherever they have crept
        more = tuple(replace(one, value=float(first[0][one.camera, LENS + one.parameter])) for one in more)
        priors += more
        held += tuple(layout.names[one.column] for one in more)
        state = descent.state
    return Solution(descent, weight, _inverse(layout, matrix), inverse, motions), priors, weak, held, steps


def _solution_at(
    problem: Problem, layout: Layout, solution: Solution, priors: Priors, robust: tuple[int, float]
) -> Solution:
    """Return the solution with the normal equations of its state, which may have been moved since."""
    there = descend(problem, layout, solution.descent.state, solution.weight, priors, robust, 1.0, 0)
    matrix, inverse, motions = _normal_matrix(problem, layout, there, priors)
    descent = replace(solution.descent, normals=there.normals)
    return Solution(descent, solution.weight, _inverse(layout, matrix), inverse, motions)


def _normal_matrix(
    problem: Problem, layout: Layout, descent: Descent, priors: Priors
) -> tuple[Array, Array, int]:
    """Return the reduced normal matrix with the datum fixed, the inverse blocks, and how many motions were loose."""
    pull, _ = pulls(problem, layout, priors, descent.state)
    matrix, _, inverse = reduced(layout, descent.normals, pull, 0.0)
    if len(matrix) == 0:
        return matrix, inverse, 0
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    motions = generators(layout, descent.state) * scale[:, None]
    loose = null_generators(matrix / scale[:, None] / scale, motions)
    check_datum(problem, loose.shape[1])
    if problem.datum == "points":
        fixing = loose * scale[:, None]
        matrix = matrix + fixing @ fixing.T
    return matrix, inverse, loose.shape[1]


def _inverse(layout: Layout, matrix: Array) -> Array:
    if len(matrix) == 0:
        return matrix
    scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    try:
        factor = cho_factor(matrix * scale[:, None] * scale, check_finite=False)
    except LinAlgError:
        worst = ", ".join(layout.names[k] for k in np.argsort(np.diag(matrix))[:3])
        raise CalibrationError(
            f"the observations do not determine all unknowns (perhaps {worst}); hold some or observe more points"
        ) from None
    inverse = cho_solve(factor, np.eye(len(matrix)), check_finite=False) * scale[:, None] * scale
    return np.asarray((inverse + inverse.T) / 2)


def _variance(
    problem: Problem, layout: Layout, solution: Solution, priors: Priors, robust: tuple[int, float]
) -> tuple[float, int]:
    """Return the variance of unit weight and the redundancy."""
    active = int((solution.weight > 0).sum()) - solution.descent.unseen
    dim, at_v = layout.blocks[0], layout.blocks[4]
    block = np.repeat(np.arange(len(dim)), dim)
    inside = np.arange(int(dim.sum())) - np.repeat(np.cumsum(dim) - dim, dim)
    determined = int((solution.inverse[at_v[block] + inside * (dim[block] + 1)] > 0).sum())
    observed = 2 * active + count(problem, layout, priors)
    redundancy = (
        observed - len(layout.names) - determined + (solution.motions if problem.datum == "points" else 0)
    )
    # a point that is not seen has a cost, but is no observation
    unseen = solution.descent.unseen * weigh(2 * UNSEEN**2, *robust)[0]
    cost = max(solution.descent.cost - unseen, 0.0)
    return cost / max(redundancy, 1), redundancy


def _snooped(
    problem: Problem,
    layout: Layout,
    solution: Solution,
    priors: Priors,
    robust: tuple[int, float],
    settings: BundleSettings,
    significance: float,
) -> tuple[Solution, Array]:
    """Return the solution without blunders, and which sorted image points (n,) were rejected."""

    def solve_again(before: Solution, weight: Array) -> Solution:
        start = before.descent.state
        descent = descend(
            problem, layout, start, weight, priors, robust, settings.tolerance, settings.most_steps
        )
        matrix, inverse, motions = _normal_matrix(problem, layout, descent, priors)
        return Solution(descent, weight, _inverse(layout, matrix), inverse, motions)

    def test(one: Solution) -> tuple[Array, float, int]:
        variance, redundancy = _variance(problem, layout, one, priors, robust)
        return tested(layout, one, robust)[1][:, 5], variance * redundancy, redundancy

    return snoop(layout, solution, significance, solve_again, test)


def _onto_given(problem: Problem, layout: Layout, solution: Solution, given: State) -> State:
    """Return the network moved so that its datum points neither shift, turn nor stretch against their given values.

    Minimises the sum of the squared distances (Horn 1987, by singular values: Umeyama 1991).
    """
    table, points, placements = solution.descent.state
    chosen = layout.members[datum_mask(problem, layout, solution.inverse)]
    if len(chosen) < 3:
        raise CalibrationError(
            f"datum 'points': {len(chosen)} determined points carry it; three at least are wanted"
        )
    target, source = given[1][chosen], points[chosen]
    middle, own = target.mean(axis=0), source.mean(axis=0)
    left, sizes, right = np.linalg.svd((target - middle).T @ (source - own))
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    turn = (left * signs) @ right
    stretch = float(sizes @ signs / np.sum((source - own) ** 2)) if solution.motions == 7 else 1.0
    shift = middle - stretch * turn @ own

    def carried(x: Array) -> Array:
        return np.asarray(stretch * x @ turn.T + shift)

    table, points, placements = table.copy(), points.copy(), placements.copy()
    own_points = np.concatenate([layout.members, layout.kept])
    of_world = own_points[~np.isin(own_points, layout.see[1][layout.see[2] >= 0])]
    points[of_world] = carried(points[of_world])
    for poses in (table, placements):
        poses[:, :9] = (turn @ poses[:, :9].reshape(-1, 3, 3)).reshape(-1, 9)
        poses[:, 9:12] = carried(poses[:, 9:12])
    return table, points, placements


def _state_of(problem: Problem, layout: Layout, start: Adjustment) -> State:
    """Return the state of an earlier adjustment of the same structure."""
    points = np.where(np.isfinite(start.points), start.points, problem.points.xyz)
    return state_of(problem, start.cameras, intersected(start.cameras, layout, points), start.placements)
