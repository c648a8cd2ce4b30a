"""Result of a bundle adjustment, computed from the normal equations at the solution."""

from dataclasses import dataclass

import numpy as np

from mosca.calibration.bundle.datum import placed_points
from mosca.calibration.bundle.inner_constraints import in_free_network, undetermined
from mosca.calibration.bundle.kernels import LENS
from mosca.calibration.bundle.layout import NormalsLayout
from mosca.calibration.bundle.levenberg_marquardt import Solution, adjusted_cameras
from mosca.calibration.bundle.precision import precise
from mosca.calibration.bundle.problem import Placements, Problem
from mosca.calibration.bundle.tables import Loss, ParameterValues, ReducedInverse
from mosca.data.arrays import Array, read_only
from mosca.data.rig import Camera, FisheyeLens, principal_distances_px


@dataclass(frozen=True, eq=False)
class Precision:
    """Precision of an adjustment. All covariances carry the a-posteriori sigma0."""

    covariance: Array
    """(u, u) of ``Adjustment.parameters``."""
    points: Array
    """(p, 3, 3) [m^2], including the uncertainty of the cameras; zero where held, NaN where not determined."""
    placements: Array
    """(f, 6, 6) of the rotation about the thing's own axes and the position; otherwise as ``points``."""
    redundancy_numbers: Array
    """(n, 2) of each image coordinate (Baarda 1968): 0 if not checked by the others, 1 if fully; NaN if left out."""
    standardised: Array
    """(n, 2) residual over its standard deviation (w-test)."""
    statistic: Array
    """(n,) v^T Q_vv^-1 v of both coordinates together, of unit variance: chi-square with 2 degrees of freedom. For
    image points left out, v is the difference from the others' prediction. NaN where it cannot be tested."""
    sigma_x_px: Array
    """(c,) a-posteriori standard deviation of an image coordinate, by camera."""
    sigma_y_px: Array
    sigma_x_m: Array
    """(c,) the same, converted to the object at each point's distance (the Mosca paper, section 2.2, Table 2)."""
    sigma_y_m: Array


@dataclass(frozen=True, eq=False)
class Adjustment:
    """A bundle adjustment's result."""

    cameras: tuple[Camera, ...]
    points: Array
    """(p, 3) [m]."""
    placements: Placements
    residuals_px: Array
    """(n, 2) observed minus projected, also of points left out; NaN where a camera does not image its point."""
    used: Array
    """(n,) bool."""
    rejected: Array
    """Indices of observations rejected as blunders; ``used`` is also False for undetermined and unseen ones."""
    parameters: tuple[str, ...]
    """Names of the u unknowns of cameras, lenses and kept points."""
    weak: tuple[str, ...]
    """Names of the unknowns that the data hardly determine."""
    held: tuple[str, ...]
    """Lens parameters among them that are held near their starting values."""
    sigma0: float
    """A-posteriori standard deviation of unit weight: 1 where the a-priori sigmas were right."""
    redundancy: int
    """Observations minus unknowns."""
    cost: float
    """Weighted sum of squares, or robust loss."""
    steps: int
    converged: bool
    precision: Precision | None
    """None unless requested."""

    @property
    def standard_deviations(self) -> dict[str, float]:
        """Standard deviation of each unknown of cameras, lenses and kept points, by name."""
        if self.precision is None:
            raise ValueError("the adjustment was made without precision; set settings.precision")
        return dict(zip(self.parameters, np.sqrt(np.diag(self.precision.covariance)).tolist(), strict=True))


def tested(layout: NormalsLayout, solution: Solution, loss: Loss) -> tuple[Array, Array]:
    """Return the cofactors of the blocks, flat, and the tests (n, 7) of the sorted image points (``precise``)."""
    see = layout.observations._replace(weight=solution.weight)
    inverse = ReducedInverse(np.pad(solution.cofactors, (0, 1)), layout.index, solution.inverse)
    cofactors, tests = np.empty_like(solution.inverse), np.empty((len(layout.order), 7))
    precise(
        solution.descent.state, see, layout.observations.weight, layout.columns, layout.blocks, loss,
        solution.descent.normals.mixed, inverse, cofactors, tests
    )  # fmt: skip
    return cofactors, tests


def precision_of(
    problem: Problem, layout: NormalsLayout, solution: Solution, cofactors: Array, tests: Array, variance: float
) -> Precision:
    """Return the precision of a solution, in the datum asked for; ``tests`` as ``tested`` returns them."""
    state = solution.descent.state
    reduced_cofactors, block_cofactors = solution.cofactors, _by_point(layout, cofactors)
    if problem.datum == "points":
        reduced_cofactors, block_cofactors = in_free_network(layout, solution, block_cofactors)
    loose = undetermined(layout, solution.inverse)
    points = np.zeros((len(problem.points), 3, 3))
    # held points are exact; points without observations have no covariance
    absent = ~problem.points.held
    absent[np.concatenate([layout.members, layout.kept])] = False
    points[absent] = np.nan
    block_cofactors[loose[: len(layout.members)]] = np.nan
    points[layout.members] = variance * block_cofactors
    if len(layout.kept):
        columns = layout.index[len(problem.cameras) :, :3]
        points[layout.kept] = variance * reduced_cofactors[columns[:, :, None], columns[:, None, :]]
    placements = np.full((len(problem.placements), 6, 6), np.nan)
    if len(layout.placed):
        poses = cofactors[-36 * len(layout.placed) :].reshape(-1, 6, 6).copy()
        poses[loose[len(layout.members) :]] = np.nan
        placements[layout.placed] = variance * poses
    order, used = layout.order, solution.weight > 0
    numbers, standardised, statistic = (np.full((len(order), *shape), np.nan) for shape in ((2,), (2,), ()))
    own = np.where(used[:, None], 1 - tests[:, [2, 4]], np.nan)
    numbers[order] = own
    sigma = np.sqrt(np.maximum(variance * own, 1e-300))
    whitened = -tests[:, :2] * (layout.observations.weight * np.sqrt(tests[:, 6]))[:, None]
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


def _by_point(layout: NormalsLayout, cofactors: Array) -> Array:
    """Return the cofactors (m, 3, 3) of the eliminated points, from those of their blocks, flat."""
    dim, at_v = layout.blocks.size, layout.blocks.normals_at
    _, block, offset = layout.blocks.members.T
    axis = np.arange(3)
    first = at_v[block] + offset * (dim[block] + 1)
    flat = first[:, None, None] + axis[:, None] * dim[block][:, None, None] + axis
    return np.asarray(cofactors[flat])


def _by_camera(
    problem: Problem, layout: NormalsLayout, state: ParameterValues, used: Array, tests: Array, numbers: Array
) -> tuple[Array, Array, Array, Array]:
    """Return sigma x, y [px] and sigma x, y [m] of each camera (c,)."""
    camera, table = layout.observations.camera, state.cameras
    away = placed_points(layout, state, slice(None)) - table[camera, 9:LENS]
    axis_depth = np.einsum("ni,ni->n", away, table[:, [2, 5, 8]][camera])
    depth = np.where(_is_fisheye(problem)[camera], np.linalg.norm(away, axis=1), axis_depth)
    focal = np.array([principal_distances_px(c.lens) for c in adjusted_cameras(problem, state)])
    good = used & np.isfinite(tests[:, 0])
    cameras = len(problem.cameras)

    def total(values: Array) -> Array:
        return np.asarray(np.bincount(camera[good], values[good], cameras))

    # mean redundancy number of a camera's coordinates
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
