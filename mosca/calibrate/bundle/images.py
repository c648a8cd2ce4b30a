"""What moves whole images: a camera's body shakes, and all image points of an exposure are off alike.

Least squares takes image points for independent. A shake of 0.03 px of the body is small beside a centre's noise of
0.02 px when one point is looked at, and large beside what a hundred points of an image say together: the covariance
of the adjustment alone would promise too much. The shake's size is estimated from the images' mean residuals (a
variance component; Foerstner 1979), and what it adds is propagated through the normal equations: with g_i the change
of the reduced right-hand side for a shift of image i by 1 px, it is ``shake^2 Q (sum g_i g_i^T) Q``.
"""

import numpy as np
from numba import njit

from mosca.calibrate.bundle.adjustment import Adjustment
from mosca.calibrate.bundle.descent import Task, empty_normals, linearised, reduced, state_of
from mosca.calibrate.bundle.kernels import BY_OWN, BY_TURN, BY_WORLD, LEAST_SQUARES, OBSERVED, observe
from mosca.calibrate.bundle.layout import lay_out
from mosca.calibrate.bundle.lenses import FAST
from mosca.calibrate.bundle.precision import by_unknowns
from mosca.calibrate.bundle.priors import pulls
from mosca.calibrate.bundle.problem import Problem
from mosca.calibrate.bundle.reduction import times_inverse
from mosca.calibrate.bundle.start import intersected
from mosca.data.arrays import Array

FEWEST_POINTS = 4
"""Used points an image must have for its mean residual to say something of its shake."""


def steadied(problem: Problem, adjustment: Adjustment, exposure: Array, shake_px: float) -> Array:
    """Return the image points (n, 2) with the estimated shake of their images taken off.

    The mean residual of an image, less that of all images of its camera at the same stand (which belongs to the
    camera), shrunk by what its points' noise leaves uncertain.
    """
    see, used = problem.observations, np.asarray(adjustment.used)
    xy = np.array(see.xy_px)
    if shake_px == 0.0:
        return xy
    image, of, _ = _images(see.camera, exposure)
    count = np.bincount(of[used], minlength=len(image))
    many = np.maximum(count, 1)
    residual = np.where(used[:, None], adjustment.residuals_px, 0.0)
    mean = np.column_stack([np.bincount(of, residual[:, k], len(image)) for k in (0, 1)]) / many[:, None]
    inside = float(((residual - mean[of])[used] ** 2).mean())
    stand = np.zeros(len(image), dtype=np.int64)
    stand[of] = see.placement
    group, rank = np.unique(_group_of(image[:, 0], stand), return_inverse=True)
    images = np.bincount(rank.reshape(-1), minlength=len(group))
    common = np.column_stack([np.bincount(rank.reshape(-1), mean[:, k]) for k in (0, 1)]) / images[:, None]
    common[images < 2] = 0.0
    shrunk = shake_px**2 / (shake_px**2 + inside / many)
    return np.asarray(xy - ((mean - common[rank.reshape(-1)]) * shrunk[:, None])[of])


def body_shake(problem: Problem, adjustment: Adjustment, exposure: Array) -> float:
    """Return how far whole images move from exposure to exposure [px rms, an axis].

    ``exposure`` (n,): index of each observation's exposure. Images of one camera that show the target at one place
    tell it directly; where each exposure has a pose of its own, which takes up part of the shakes, the rest is
    enlarged by the share of redundancy. 0 where nothing shows it.
    """
    see = problem.observations
    placement = np.asarray(see.placement)
    used = np.asarray(adjustment.used)
    image, of, count = _images(see.camera[used], exposure[used])
    residual = adjustment.residuals_px[used]
    mean = np.column_stack([np.bincount(of, residual[:, k]) for k in (0, 1)]) / count[:, None]
    inside = residual - mean[of]
    many = count >= FEWEST_POINTS
    if not many.any():
        return 0.0
    noise = np.bincount(of, (inside**2).sum(axis=1))[many].sum() / (2 * (count[many] - 1).sum())
    stand = np.zeros(len(image), dtype=np.int64)
    stand[of] = placement[used]
    # of one camera at one stand, the images' common part belongs to camera and stand, not to the shake
    group = _group_of(image[:, 0], stand)
    squares = redundancy = 0.0
    for g in np.unique(group[many]):
        mine = np.flatnonzero((group == g) & many)
        if len(mine) > 1:
            here = mean[mine] - mean[mine].mean(axis=0)
            squares += float((here**2).sum()) - 2 * (len(mine) - 1) * float((noise / count[mine]).mean())
            redundancy += 2 * (len(mine) - 1)
    if redundancy == 0:
        cameras = np.bincount(stand[many & (stand >= 0)])
        share = max(1 - 6 / (2 * float(cameras[cameras > 0].mean())), 0.25) if (cameras > 0).any() else 1.0
        squares = float((mean[many] ** 2).sum() - 2 * (noise / count[many]).sum())
        redundancy = 2 * many.sum() * share
    return float(np.sqrt(max(squares / redundancy, 0.0)))


def shaken_covariance(problem: Problem, adjustment: Adjustment, exposure: Array, shake_px: float) -> Array:
    """Return the covariance (u, u) of ``adjustment.parameters`` with what shakes of whole images add to it.

    ``shake_px``: rms an axis (``body_shake``).
    """
    assert adjustment.precision is not None
    covariance = np.asarray(adjustment.precision.covariance)
    if shake_px == 0.0 or len(covariance) == 0:
        return covariance
    layout = lay_out(problem)
    points = intersected(
        adjustment.cameras, layout, np.where(np.isfinite(adjustment.points), adjustment.points, 0.0)
    )
    state = state_of(problem, adjustment.cameras, points, adjustment.placements)
    weight = np.where(adjustment.used[layout.order], layout.see[4], 0.0)
    task = Task(problem, layout, (), (LEAST_SQUARES, 1.0), 1.0, 1)
    normals = empty_normals(layout)
    linearised(task, state, weight, normals)
    pull, _ = pulls(problem, layout, (), state)
    inverse = np.empty_like(normals[4])
    reduced(layout, normals, pull, 0.0, inverse)
    image, of, _ = _images(problem.observations.camera, exposure)
    slopes = np.zeros((len(image), 2, len(layout.names) + 1))
    index = np.where(layout.index < 0, len(layout.names), layout.index)
    see = (*layout.see[:4], weight, *layout.see[5:])
    _slopes(state, see, layout.columns, layout.blocks, normals, inverse, index, of[layout.order], slopes)
    cofactors = covariance / max(adjustment.sigma0**2, 1e-300)
    moved = slopes[:, :, :-1].reshape(-1, len(layout.names)) @ cofactors
    return np.asarray(covariance + shake_px**2 * (moved.T @ moved))


def _images(camera: Array, exposure: Array) -> tuple[Array, Array, Array]:
    """Return the images (i, 2: camera, exposure), the image (n,) of each observation, and how many each has."""
    image, of, count = np.unique(
        np.column_stack([camera, exposure]), axis=0, return_inverse=True, return_counts=True
    )
    return image, of.reshape(-1), count


def _group_of(camera: Array, stand: Array) -> Array:
    return np.asarray(camera * (int(stand.max(initial=0)) + 2) + stand + 1)


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def _slopes(state, see, columns, blocks, normals, inverse, index, image, slopes):  # type: ignore[no-untyped-def]
    """Add to ``slopes`` (i, 2, u + 1) the reduced right-hand side of a shift of each image by 1 px along x and y.

    J_A^T w^2 - W V^-1 J_B^T w^2, summed over the image's points; the last column takes what is held.
    """
    cameras, points, placements = state
    camera_of, point_of, placement_of, _, weight, offset, _, kept, _ = see
    dim, first_observation, slot_first, slot_group, at_v, _, at_w, runs, _ = blocks
    mixed, width = normals[3], index.shape[1]
    out, j = np.empty((2, OBSERVED)), np.zeros((2, width))
    for r in range(-1, runs.size - 1):
        # block 0 holds the observations that touch no block
        b, count = (0, 1) if r < 0 else (runs[r], runs[r + 1] - runs[r])
        n, first = dim[b], slot_first[b]
        slots = 0 if r < 0 else slot_first[b + 1] - first
        rows, wide = count * n, slots * width
        carried = np.zeros((rows, wide))
        if slots > 0:
            own = mixed[at_w[first] : at_w[first] + rows * wide].reshape(rows, wide)
            times_inverse(inverse, at_v[b], n, count, own, carried)
        for one in range(count):
            for m in range(first_observation[b + one], first_observation[b + one + 1]):
                if weight[m] == 0.0:
                    continue
                camera, point, placement = camera_of[m], kept[m], placement_of[m]
                if not observe(cameras, camera, points, point_of[m], placements, placement, out):
                    continue
                by_unknowns(out, columns, camera, j)
                w = weight[m] * weight[m]
                size = 0 if n == 0 else (6 if placement >= 0 else 3)
                for axis in range(2):
                    to = slopes[image[m], axis]
                    for i in range(width):
                        to[index[camera, i]] += w * j[axis, i]
                    if point >= 0:
                        for i in range(3):
                            to[index[point, i]] += w * out[axis, BY_OWN + i]
                    for i in range(size):
                        by = (
                            BY_TURN + i
                            if size == 6 and i < 3
                            else (BY_WORLD + i - 3 if size == 6 else BY_WORLD + i)
                        )
                        d = w * out[axis, by]
                        row = carried[one * n + offset[m] + i]
                        for k in range(wide):
                            to[index[slot_group[first + k // width], k % width]] -= d * row[k]
