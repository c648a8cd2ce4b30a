"""What a bundle adjustment returns, and how it is worked out from the normal equations at the solution."""

from dataclasses import dataclass, replace

import numpy as np

from mosca.calibrate.bundle_datum import generators, placed_points, point_motions
from mosca.calibrate.bundle_descent import Descent, State
from mosca.calibrate.bundle_kernels import LENS
from mosca.calibrate.bundle_layout import Layout
from mosca.calibrate.bundle_lenses import lens_of
from mosca.calibrate.bundle_precision import carry_down, carry_up, precise
from mosca.calibrate.bundle_problem import Placements, Problem
from mosca.data.arrays import Array, read_only
from mosca.data.rig import Camera, FisheyeLens, Lens, MoscaLens, Pose


@dataclass(frozen=True, eq=False)
class Precision:
    """How good an adjustment is. All covariances carry the a-posteriori sigma0.

    ``covariance`` (u, u) of ``Adjustment.parameters``; ``points`` (p, 3, 3) [m^2] and ``placements`` (f, 6, 6) (turn about
    the thing's own axes, position) with the cameras' part, zero where held, NaN where not determined;
    ``redundancy_numbers`` (n, 2) of each image coordinate (Baarda 1968: 0 says nothing about itself, 1 all; NaN where
    left out) and ``standardised`` (n, 2) its residual over that residual's standard deviation (w-test);
    ``statistic`` (n,) the same of both coordinates together: v^T Q_vv^-1 v, of unit variance, chi-square with 2 degrees
    of freedom, also of points left out (from the others' prediction), NaN where it cannot be tested.
    ``sigma_x_px`` ... by camera (c,): a-posteriori standard deviation of an image coordinate and of the same on the
    object at each point's own distance (the Mosca paper's figure of a calibration, section 2.2, Table 2).
    """

    covariance: Array
    points: Array
    placements: Array
    redundancy_numbers: Array
    standardised: Array
    statistic: Array
    sigma_x_px: Array
    sigma_y_px: Array
    sigma_x_m: Array
    sigma_y_m: Array


@dataclass(frozen=True, eq=False)
class Adjustment:
    """A bundle adjustment's result.

    ``cameras``, ``points`` (p, 3) [m] and ``placements`` adjusted; ``residuals_px`` (n, 2) observed minus projected, of
    points left out too, NaN where a camera does not image its point; ``used`` (n,) bool; ``rejected`` indices of the
    observations rejected as blunders (``used`` lacks also those of points that the rest does not determine, and unseen
    ones); ``parameters`` names of the u unknowns of cameras, lenses and kept points; ``weak`` those that the data hardly
    determine, the lens parameters among them ``held`` near their starting values; ``sigma0`` a-posteriori standard deviation of
    unit weight (1 where the sigmas a priori were right; in px where they were 1 px); ``redundancy`` observations
    minus unknowns; ``cost`` weighted sum of squares, or robust loss; ``precision`` None unless asked for.
    """

    cameras: tuple[Camera, ...]
    points: Array
    placements: Placements
    residuals_px: Array
    used: Array
    rejected: Array
    parameters: tuple[str, ...]
    weak: tuple[str, ...]
    held: tuple[str, ...]
    sigma0: float
    redundancy: int
    cost: float
    steps: int
    converged: bool
    precision: Precision | None

    @property
    def standard_deviations(self) -> dict[str, float]:
        """Standard deviation of each unknown of cameras, lenses and kept points, by name."""
        if self.precision is None:
            raise ValueError("the adjustment was made without precision; set settings.precision")
        return dict(zip(self.parameters, np.sqrt(np.diag(self.precision.covariance)).tolist(), strict=True))

    @property
    def correlation(self) -> Array:
        """Correlations (u, u) of the unknowns of cameras, lenses and kept points."""
        if self.precision is None:
            raise ValueError("the adjustment was made without precision; set settings.precision")
        sigma = np.sqrt(np.diag(self.precision.covariance))
        return np.asarray(self.precision.covariance / np.outer(sigma, sigma))


@dataclass(frozen=True, eq=False)
class Solution:
    """A descent that ended, with the inverse of its normal equations: what precision is worked out from.

    ``weight`` (n,) 1/sigma of the sorted image points, 0 where left out; ``cofactors`` (u, u) of the reduced system in
    any datum; ``inverse`` of the blocks; ``motions`` the number of common motions that nothing fixes.
    """

    descent: Descent
    weight: Array
    cofactors: Array
    inverse: Array
    motions: int


def tested(layout: Layout, solution: Solution, robust: tuple[int, float]) -> tuple[Array, Array]:
    """Return the cofactors of the blocks, flat, and the tests (n, 7) of the sorted image points (``precise``)."""
    normals = solution.descent.normals
    see = (*layout.see[:4], solution.weight, *layout.see[5:])
    cofactors, tests = np.empty_like(solution.inverse), np.empty((len(layout.order), 7))
    precise(
        solution.descent.state, see, layout.see[4], layout.columns, layout.blocks, robust, normals, solution.inverse,
 np.pad(solution.cofactors, (0, 1)), layout.index, cofactors, tests,
    )  # fmt: skip
    return cofactors, tests


def adjusted_cameras(problem: Problem, layout: Layout, state: State) -> tuple[Camera, ...]:
    """Return the cameras with their adjusted lenses and poses."""
    table = state[0]
    return tuple(
        replace(
            one.camera,
            lens=lens_of(table[owner, LENS:], problem.cameras[owner].camera.lens),
            world_from_camera=Pose(table[c, :9].reshape(3, 3), table[c, 9:LENS]),
        )
        for c, (one, owner) in enumerate(zip(problem.cameras, layout.columns[0], strict=True))
    )


def precision_of(
    problem: Problem,
    layout: Layout,
    solution: Solution,
    cofactors: Array,
    tests: Array,
    variance: float,
) -> Precision:
    """Return the precision of a solution, in the datum asked for; ``tests`` as ``tested`` returns them."""
    state = solution.descent.state
    reduced_cofactors, block_cofactors = solution.cofactors, _by_point(layout, cofactors)
    if problem.datum == "points":
        reduced_cofactors, block_cofactors = _free_network(problem, layout, solution, block_cofactors)
    undetermined = _undetermined(layout, solution.inverse)
    points = np.zeros((len(problem.points), 3, 3))
    # points that no observation touches keep what is known of them
    absent = ~problem.points.held
    absent[np.concatenate([layout.members, layout.kept])] = False
    points[absent] = np.nan
    block_cofactors[undetermined[: len(layout.members)]] = np.nan
    points[layout.members] = variance * block_cofactors
    if len(layout.kept):
        columns = layout.index[len(problem.cameras) :, :3]
        points[layout.kept] = variance * reduced_cofactors[columns[:, :, None], columns[:, None, :]]
    placements = np.full((len(problem.placements), 6, 6), np.nan)
    if len(layout.placed):
        poses = cofactors[-36 * len(layout.placed) :].reshape(-1, 6, 6).copy()
        poses[undetermined[len(layout.members) :]] = np.nan
        placements[layout.placed] = variance * poses
    order, used = layout.order, solution.weight > 0
    numbers, standardised, statistic = (np.full((len(order), *shape), np.nan) for shape in ((2,), (2,), ()))
    own = np.where(used[:, None], 1 - tests[:, [2, 4]], np.nan)
    numbers[order] = own
    sigma = np.sqrt(np.maximum(variance * own, 1e-300))
    whitened = -tests[:, :2] * (layout.see[4] * np.sqrt(tests[:, 6]))[:, None]
    standardised[order] = np.where(own > 1e-6, whitened / sigma, np.nan)
    statistic[order] = tests[:, 5] / max(variance, 1e-300)
    sigmas = _by_camera(problem, layout, state, used, tests, own)
    return Precision(
        read_only(variance * reduced_cofactors, (None, None), "covariance"),
        read_only(points, (None, 3, 3), "points"),
        read_only(placements, (None, 6, 6), "placements"),
        read_only(numbers, (None, 2), "redundancy_numbers"),
        read_only(standardised, (None, 2), "standardised"),
        read_only(statistic, (None,), "statistic"),
        *(read_only(one, (None,), "sigma") for one in sigmas),
    )


def _by_point(layout: Layout, cofactors: Array) -> Array:
    """Return the cofactors (m, 3, 3) of the eliminated points, from those of their blocks, flat."""
    dim, at_v = layout.blocks[0], layout.blocks[4]
    _, block, offset = layout.blocks[-1].T
    axis = np.arange(3)
    first = at_v[block] + offset * (dim[block] + 1)
    flat = first[:, None, None] + axis[:, None] * dim[block][:, None, None] + axis
    return np.asarray(cofactors[flat])


def _undetermined(layout: Layout, inverse: Array) -> Array:
    """Return which eliminated points and then placements (m + f,) have a direction that nothing determines."""
    dim, at_v = layout.blocks[0], layout.blocks[4]
    count = int(dim.sum())
    block = np.repeat(np.arange(len(dim)), dim)
    inside = np.arange(count) - np.repeat(np.cumsum(dim) - dim, dim)
    loose = inverse[at_v[block] + inside * (dim[block] + 1)] <= 0
    points = 3 * len(layout.members)
    return np.concatenate(
        [loose[:points].reshape(-1, 3).any(axis=1), loose[points:].reshape(-1, 6).any(axis=1)]
    )


def datum_mask(problem: Problem, layout: Layout, inverse: Array) -> Array:
    """Return which eliminated points (m,) carry the datum of a free network: chosen, and determined."""
    mask = ~_undetermined(layout, inverse)[: len(layout.members)]
    return mask if problem.datum_points is None else mask & problem.datum_points[layout.members]


def _free_network(
    problem: Problem, layout: Layout, solution: Solution, by_point: Array
) -> tuple[Array, Array]:
    """Carry cofactors into the datum of the points (S-transformation, Baarda 1973): x' = x - G (G_d^T G_d)^-1 G_d^T x_d.

    Points depend on the reduced unknowns by x_p = e - V^-1 W^T x_c, with e of cofactors V^-1.
    """
    state, normals, inverse = solution.descent.state, solution.descent.normals, solution.inverse
    moves = generators(layout, state)[:, : solution.motions]
    point_moves = point_motions(state[1][layout.members])[:, :, : solution.motions]
    mask = datum_mask(problem, layout, inverse)
    chosen = np.where(mask[:, None, None], point_moves, 0.0)
    normal = np.einsum("mij,mik->jk", chosen, chosen)
    functional = np.zeros((int(layout.blocks[0].sum()), solution.motions))
    functional[: 3 * len(mask)] = np.linalg.solve(normal, chosen.reshape(-1, solution.motions).T).T
    up, own_part, own = carry_up(layout.blocks, normals, inverse, layout.index, len(layout.names), functional)
    q_up = solution.cofactors @ up
    common = own + up.T @ q_up
    camera_common = -q_up
    # the points' own part has the cofactors V^-1 with the datum's functional
    down = carry_down(layout.blocks, normals, inverse, layout.index, np.pad(q_up, ((0, 1), (0, 0))))
    point_common = (own_part + down)[: 3 * len(mask)].reshape(-1, 3, solution.motions)
    reduced_cofactors = (
        solution.cofactors - moves @ camera_common.T - camera_common @ moves.T + moves @ common @ moves.T
    )
    across = point_moves @ np.swapaxes(point_common, 1, 2)
    spread = point_moves @ common @ np.swapaxes(point_moves, 1, 2)
    return reduced_cofactors, by_point - across - np.swapaxes(across, 1, 2) + spread


def _by_camera(
    problem: Problem, layout: Layout, state: State, used: Array, tests: Array, numbers: Array
) -> tuple[Array, Array, Array, Array]:
    """Return sigma x, y [px] and sigma x, y [m] of each camera (c,)."""
    camera, table = layout.see[0], state[0]
    away = placed_points(layout, state, slice(None)) - table[camera, 9:LENS]
    axis_depth = np.einsum("ni,ni->n", away, table[:, [2, 5, 8]][camera])
    depth = np.where(_is_fisheye(problem)[camera], np.linalg.norm(away, axis=1), axis_depth)
    focal = np.array([_principal_distances_px(c.lens) for c in adjusted_cameras(problem, layout, state)])
    good = used & np.isfinite(tests[:, 0])
    cameras = len(problem.cameras)

    def total(values: Array) -> Array:
        return np.asarray(np.bincount(camera[good], values[good], cameras))

    # the share of redundancy that a camera's coordinates have on the average
    with np.errstate(invalid="ignore", divide="ignore"):
        redundancy = total(numbers.sum(axis=1)) / 2
        found = []
        for scale in (np.ones((len(camera), 2)), depth[:, None] / focal[camera]):
            for axis in (0, 1):
                squares = total((tests[:, axis] * scale[:, axis]) ** 2)
                found.append(np.sqrt(squares / redundancy))
    return found[0], found[1], found[2], found[3]


def _is_fisheye(problem: Problem) -> Array:
    return np.array([isinstance(one.camera.lens, FisheyeLens) for one in problem.cameras])


def _principal_distances_px(lens: Lens) -> tuple[float, float]:
    if isinstance(lens, MoscaLens):
        return lens.c_mm / lens.mx_mm_per_px, lens.c_mm / lens.my_mm_per_px
    return lens.fx_px, lens.fy_px
