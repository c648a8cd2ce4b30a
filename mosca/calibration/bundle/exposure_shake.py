"""Shake of whole images: a camera's body moves, and all image points of an exposure share an error.

Least squares assumes independent image points. A shake of 0.03 px of the body is of the order of a centre's noise
(0.02 px) for one point, and large against the precision of a hundred points together: the adjustment would give an
image too much weight, and its covariance would be too small. So each image has a shake (x, y) of its own, random with
one variance for all: a mixed model (Henderson 1975; Searle, Casella and McCulloch 1992, ch. 7). A body that shakes
rotates: for a given motion of the image's middle, the rim moves up to twice as far in a wide lens. If a uniform shift
were modelled, the remaining stretch would be taken for perspective of a moved target.

Let v be the residuals of the least-squares adjustment, W the weights, Z the shifts' columns, N the normal equations
and A the design. For a shake s and a noise sigma0 of unit weight, ``u = Z^T W v`` has the expectation 0 and

    Cov(u) = sigma0^2 B + s^2 B^2,   B = Z^T W Z - Z^T W A N^-1 A^T W Z.

``body_shake`` solves the expectations of v^T W v and of the images' squared mean residuals for s. ``steadied``
subtracts the best predictions (B + sigma0^2 / s^2)^-1 u from the image points. Their adjustment then equals
generalised least squares, in which the shake limits an image's weight; ``shaken_covariance`` returns its covariance.
B is never formed: it is the sum of a sparse matrix and one with the rank of the cameras' unknowns.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, csc_array, csr_array, diags_array
from scipy.sparse.linalg import SuperLU, splu

from mosca.calibration.bundle.adjustment import Adjustment
from mosca.calibration.bundle.initial_points import intersected
from mosca.calibration.bundle.kernels import BY_OWN, BY_ROTATION, BY_WORLD, LEAST_SQUARES, OBSERVED, observe
from mosca.calibration.bundle.layout import NormalsLayout, layout_of
from mosca.calibration.bundle.lenses import FAST
from mosca.calibration.bundle.levenberg_marquardt import AdjustmentTask, empty_normals, linearised, reduced, state_of
from mosca.calibration.bundle.precision import by_unknowns, carry_down
from mosca.calibration.bundle.priors import pulls
from mosca.calibration.bundle.problem import Problem
from mosca.calibration.bundle.tables import LensColumns, Loss, ParameterValues, SortedObservations
from mosca.camera.projection import project_with_jacobians
from mosca.data.arrays import Array
from mosca.data.rig import principal_distances_px
from mosca.numba_support.decorators import kernel

FEWEST_POINTS = 4
"""Fewest used points of an image whose mean residual is used to estimate the shake."""
LEAST_SHARE = 1e-3
"""Least mean share of an image's shift that remains in its residuals; below it the shakes cannot be estimated."""
LEAST_NOISE = 1e-6
"""Least variance of the noise, as a share of the variance of unit weight before the shakes are subtracted."""
LEAST_WEIGHT = 1e-30
"""Guards a division by zero."""
COLUMNS = 512


def body_shake(problem: Problem, adjustment: Adjustment, exposure: Array) -> float:
    """Return the shake of whole images from exposure to exposure [px rms, an axis]; 0 where it cannot be estimated.

    ``adjustment``: by least squares, with precision, blunders rejected; ``exposure`` (n,): index of each
    observation's exposure.
    """
    if len(adjustment.parameters) == 0:
        return 0.0
    shifts = shifts_of(problem, adjustment, exposure)
    counted = np.repeat(shifts.count >= FEWEST_POINTS, 2) / np.maximum(shifts.d, LEAST_WEIGHT) ** 2
    own = shifts.g @ shifts.cofactors
    sparse = shifts.beside_cameras()
    diagonal = sparse.diagonal() - np.einsum("iu,iu->i", own, shifts.g)
    squared = float(counted @ np.asarray(sparse.power(2).sum(axis=1)).ravel())
    squared -= 2 * float(np.sum((sparse @ shifts.g) * own * counted[:, None]))
    squared += float(np.sum((own.T @ (own * counted[:, None])) * (shifts.g.T @ shifts.g)))
    if squared < LEAST_SHARE**2 * (counted > 0).sum():
        return 0.0
    trace, by_noise = float(diagonal.sum()), float(counted @ diagonal)
    means, cost, redundancy = float(counted @ shifts.u**2), shifts.cost, max(adjustment.redundancy, 1)
    determinant = squared * redundancy - by_noise * trace
    return float(np.sqrt(max((means * redundancy - by_noise * cost) / determinant, 0.0)))


def steadied(problem: Problem, adjustment: Adjustment, exposure: Array, shake_px: float) -> Array:
    """Return the image points (n, 2) [px] minus the predicted shakes of their images.

    ``adjustment`` as for ``body_shake``; ``shake_px``: result of ``body_shake``.
    """
    xy = np.array(problem.observations.xy_px)
    if shake_px == 0.0 or len(adjustment.parameters) == 0:
        return xy
    shifts = shifts_of(problem, adjustment, exposure)
    own = np.einsum("iu,uv,iv->", shifts.g, shifts.cofactors, shifts.g, optimize=True)
    trace = float(shifts.beside_cameras().diagonal().sum() - own)
    redundancy = max(adjustment.redundancy, 1)
    noise = max(shifts.cost - shake_px**2 * trace, LEAST_NOISE * shifts.cost) / redundancy
    solve = _Solver.of(shifts, noise / shake_px**2)
    return np.asarray(xy - np.einsum("nij,nj->ni", shifts.z, solve(shifts.u).reshape(-1, 2)[shifts.image_of]))


def shaken_covariance(problem: Problem, adjustment: Adjustment, exposure: Array, shake_px: float) -> Array:
    """Return the covariance (u, u) of ``adjustment.parameters``, with the shakes of whole images included.

    ``adjustment``: with precision, of ``steadied`` image points; ``shake_px``: rms an axis.
    """
    assert adjustment.precision is not None
    covariance = np.asarray(adjustment.precision.covariance)
    if shake_px == 0.0 or len(covariance) == 0:
        return covariance
    shifts = shifts_of(problem, adjustment, exposure)
    solver = _Solver.of(shifts, adjustment.sigma0**2 / shake_px**2)
    # the subtracted predictions also contain noise, as if they were this number of further unknowns
    taken = 2 * len(shifts.count) - solver.ratio * solver.trace()
    redundancy = max(adjustment.redundancy, 1)
    noise = adjustment.sigma0**2 * redundancy / max(redundancy - taken, 1.0)
    solver = _Solver.of(shifts, noise / shake_px**2)
    scale = shifts.scale
    found = noise * np.linalg.inv(solver.normal) * scale[:, None] * scale
    return np.asarray((found + found.T) / 2)


@dataclass(frozen=True, eq=False)
class ExposureShifts:
    """The shakes of i images (2 each) beside the unknowns of an adjustment.

    ``image_of`` (n,): image of each observation; ``z`` (n, 2, 2): its derivative by its image's shakes, which are
    mixed so that Z^T W Z is diagonal; ``count`` (i,): used points; ``d`` (2i,): weights Z^T W Z; ``u`` (2i,).
    ``g`` (2i, u): mixed part with the unknowns of the reduced system, whose ``cofactors`` (u, u) are scaled to a unit
    diagonal by ``scale`` (u,). ``s`` (2i, q): mixed part with the unknowns of the blocks, whose normal matrix is
    ``v`` with the inverse ``v_inverse``. ``cost``: v^T W v, a-priori observations included.
    """

    image_of: Array
    z: Array
    count: Array
    d: Array
    u: Array
    g: Array
    cofactors: Array
    scale: Array
    s: csr_array
    v: csc_array
    v_inverse: csc_array
    cost: float

    def beside_cameras(self) -> csr_array:
        """Return Z^T W Z (2i, 2i) with the blocks eliminated and the cameras held."""
        return csr_array(diags_array(self.d) - self.s @ self.v_inverse @ self.s.T)


@dataclass(frozen=True, eq=False)
class _Solver:
    """Solver of (B + ratio) x = z: blocks first, then the unknowns of the reduced system.

    ``normal``: normal matrix of these unknowns beside the shifts (scaled as the cofactors); ``x_g`` (2i, u): solution
    of the sparse part for ``g``.
    """

    shifts: ExposureShifts
    ratio: float
    e: Array
    blocks: SuperLU | None
    x_g: Array
    normal: Array

    @classmethod
    def of(cls, shifts: ExposureShifts, ratio: float) -> "_Solver":
        e = 1 / (shifts.d + ratio)
        inner = csc_array(shifts.v - shifts.s.T @ diags_array(e) @ shifts.s)
        blocks = splu(inner) if inner.shape[0] else None
        x_g = _sparse_part(shifts, e, blocks, shifts.g)
        normal = np.linalg.inv(shifts.cofactors) - shifts.g.T @ x_g
        return cls(shifts, ratio, e, blocks, x_g, normal)

    def __call__(self, z: Array) -> Array:
        x = _sparse_part(self.shifts, self.e, self.blocks, z[:, None])[:, 0]
        return np.asarray(x + self.x_g @ np.linalg.solve(self.normal, self.shifts.g.T @ x))

    def trace(self) -> float:
        """Return the trace of (B + ratio)^-1."""
        total = float(self.e.sum() + np.trace(np.linalg.solve(self.normal, self.x_g.T @ self.x_g)))
        if self.blocks is None:
            return total
        inner = csc_array(self.shifts.s.T @ diags_array(self.e**2) @ self.shifts.s)
        for first in range(0, inner.shape[1], COLUMNS):
            some = inner[:, first : first + COLUMNS].toarray()
            solved = self.blocks.solve(some)
            total += float(np.trace(solved[first : first + some.shape[1]]))
        return total


def _sparse_part(shifts: ExposureShifts, e: Array, blocks: SuperLU | None, z: Array) -> Array:
    """Return (D + ratio - S V^-1 S^T)^-1 z for z (2i, k), by Woodbury's identity."""
    x = e[:, None] * z
    if blocks is None:
        return x
    return np.asarray(x + e[:, None] * (shifts.s @ blocks.solve(shifts.s.T @ x)))


def shifts_of(problem: Problem, adjustment: Adjustment, exposure: Array, even: bool = False) -> ExposureShifts:
    """Return the shakes of the images beside the adjustment's unknowns.

    ``even``: as shifts that are the same at all points of an image, not as rotations of its camera.
    """
    assert adjustment.precision is not None
    layout = layout_of(problem)
    points = intersected(adjustment.cameras, layout, np.where(np.isfinite(adjustment.points), adjustment.points, 0.0))
    state = state_of(problem, adjustment.cameras, points, adjustment.placements)
    used = np.asarray(adjustment.used)
    weight = np.where(used[layout.order], layout.observations.weight, 0.0)
    task = AdjustmentTask(problem, layout, (), Loss(LEAST_SQUARES, 1.0), 1.0, 1)
    normals = empty_normals(layout)
    linearised(task, state, weight, normals)
    pull, _ = pulls(problem, layout, (), state)
    inverse = np.empty_like(normals.blocks)
    reduced(layout, normals, pull, 0.0, inverse)
    image, of = np.unique(np.column_stack([problem.observations.camera, exposure]), axis=0, return_inverse=True)
    of = of.reshape(-1)
    squares = np.where(used, 1 / np.asarray(problem.observations.sigma_px) ** 2, 0.0)
    if even:
        z, d = np.tile(np.eye(2), (len(of), 1, 1)), np.repeat(np.bincount(of, squares, len(image)), 2)
    else:
        z, d = _by_shakes(problem, adjustment, of, squares)
    slopes = np.zeros((len(image), 2, len(layout.names) + 1))
    by_block = np.zeros((len(layout.order), 2, 6))
    index = np.where(layout.index < 0, len(layout.names), layout.index)
    see = layout.observations._replace(weight=weight)
    _sums(state, see, layout.columns, index, of[layout.order], z[layout.order], slopes, by_block)
    v, v_inverse, open_ = _block_matrices(layout, normals.blocks, inverse)
    s = _with_blocks(layout, of[layout.order], by_block, len(image), open_)
    each = np.eye(len(layout.names) + 1, len(layout.names))
    g = slopes[:, :, :-1].reshape(2 * len(image), -1)
    g = g - s @ carry_down(layout.blocks, normals.mixed, inverse, index, each)
    residual = np.where(used[:, None], adjustment.residuals_px, 0.0)
    pulled = squares[:, None] * np.einsum("nij,ni->nj", z, residual)
    u = np.column_stack([np.bincount(of, pulled[:, k], len(image)) for k in (0, 1)])
    cofactors = np.asarray(adjustment.precision.covariance) / max(adjustment.sigma0**2, 1e-300)
    scale = np.sqrt(np.diag(cofactors))
    return ExposureShifts(
        of,
        z,
        np.bincount(of[used], minlength=len(image)),
        d,
        u.ravel(),
        g * scale,
        cofactors / scale[:, None] / scale,
        scale,
        s,
        v,
        v_inverse,
        float(adjustment.sigma0**2 * max(adjustment.redundancy, 1)),
    )


def _by_shakes(problem: Problem, adjustment: Adjustment, image_of: Array, squares: Array) -> tuple[Array, Array]:
    """Return the derivatives of observations by their images' shakes (n, 2, 2), and the diagonal of Z^T W Z (2i,).

    A shake is a rotation of the camera about its own x and y axes, in the pixels by which the image's middle moves.
    The two shakes of an image are mixed by a rotation that makes Z^T W Z diagonal and does not change their variance.
    """
    see = problem.observations
    at = np.asarray(adjustment.points)[see.point]
    placed = np.flatnonzero(np.asarray(see.placement) >= 0)
    if len(placed):
        which = np.asarray(see.placement)[placed]
        rotation, translation = (adjustment.placements.rotation[which], adjustment.placements.translation[which])
        at[placed] = np.einsum("nij,nj->ni", rotation, at[placed]) + translation
    z = np.tile(np.eye(2), (len(at), 1, 1))
    for k, camera in enumerate(adjustment.cameras):
        mine = np.flatnonzero(see.camera == k)
        turned = project_with_jacobians(camera, at[mine]).by_pose[:, :, 1::-1]
        turned = turned / np.array(principal_distances_px(camera.lens)) * np.array([-1.0, 1.0])
        fine = np.isfinite(turned).all(axis=(1, 2))
        z[mine[fine]] = turned[fine]
    normal = squares[:, None, None] * np.einsum("nki,nkj->nij", z, z)
    images = int(image_of.max(initial=-1)) + 1
    sums = [np.bincount(image_of, normal[:, i, j], images) for i in (0, 1) for j in (0, 1)]
    d, mix = np.linalg.eigh(np.stack(sums, axis=1).reshape(-1, 2, 2))
    return z @ mix[image_of], d.ravel()


def _block_matrices(layout: NormalsLayout, flat: Array, inverse: Array) -> tuple[csc_array, csc_array, Array]:
    """Return the blocks' normal matrix and its inverse (q, q), and which unknowns (q,) are undetermined."""
    dim, first_value, first = layout.blocks.size, layout.blocks.normals_at, layout.blocks.slope_at
    block = np.repeat(np.arange(len(dim)), dim * dim)
    row, column = np.divmod(np.arange(len(block)) - first_value[block], dim[block])
    at, shape = (first[block] + row, first[block] + column), (int(dim.sum()),) * 2
    v_inverse = csc_array(coo_array((inverse, at), shape=shape))
    open_ = v_inverse.diagonal() <= 0
    # undetermined unknowns are held, as in the inverse
    kept = np.where(open_[at[0]] | open_[at[1]], (at[0] == at[1]).astype(float), flat)
    return csc_array(coo_array((kept, at), shape=shape)), v_inverse, open_


def _with_blocks(layout: NormalsLayout, image: Array, by_block: Array, images: int, open_: Array) -> csr_array:
    """Return Z^T W A of the blocks (2 images, q), from the contribution of each sorted observation (n, 2, 6)."""
    dim, first = layout.blocks.size, layout.blocks.slope_at
    block = layout.block_of
    column = np.broadcast_to(
        (first[block] + layout.observations.offset)[:, None, None] + np.arange(6), by_block.shape
    )
    row = np.broadcast_to((2 * image)[:, None, None] + np.arange(2)[:, None], by_block.shape)
    there = by_block != 0
    found = csr_array(coo_array((by_block[there], (row[there], column[there])), shape=(2 * images, int(dim.sum()))))
    return csr_array(found @ diags_array(np.where(open_, 0.0, 1.0))) if len(open_) else found


@kernel(fastmath=FAST)
def _sums(
    state: ParameterValues, see: SortedObservations, columns: LensColumns, index: Array, image: Array, z: Array,
    slopes: Array, by_block: Array
) -> None:  # fmt: skip
    """Sum z^T w^2 J of the observations over their images.

    The part of the reduced system's unknowns is added to ``slopes`` (i, 2, u + 1), whose last column collects held
    unknowns. The part of the block's unknowns is written to ``by_block`` (n, 2, 6).
    """
    weight, slot = see.weight, see.slot
    width = index.shape[1]
    out, j = np.empty((2, OBSERVED)), np.zeros((2, width))
    for m in range(weight.size):
        if weight[m] == 0.0:
            continue
        camera, point, placement = see.camera[m], see.kept_group[m], see.placement[m]
        if not observe(state, see, m, out):
            continue
        by_unknowns(out, columns, camera, j)
        for shake in range(2):
            x, y = weight[m] ** 2 * z[m, 0, shake], weight[m] ** 2 * z[m, 1, shake]
            to = slopes[image[m], shake]
            for i in range(width):
                to[index[camera, i]] += x * j[0, i] + y * j[1, i]
            if point >= 0:
                for i in range(3):
                    to[index[point, i]] += x * out[0, BY_OWN + i] + y * out[1, BY_OWN + i]
            # observations that touch no block have no slot
            if slot[m] < 0:
                continue
            for i in range(3):
                by_world = x * out[0, BY_WORLD + i] + y * out[1, BY_WORLD + i]
                if placement >= 0:
                    by_block[m, shake, i] = x * out[0, BY_ROTATION + i] + y * out[1, BY_ROTATION + i]
                    by_block[m, shake, 3 + i] = by_world
                else:
                    by_block[m, shake, i] = by_world
