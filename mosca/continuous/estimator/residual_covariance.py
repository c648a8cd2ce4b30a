"""Errors missing from the splines' covariance: motion above the knot frequency, and time-correlated image errors.

Jitter: recorded motion has components above the exposure rate, which curves fit at exposures and miss between them.
Their variance is estimated from the residuals of a very smooth curve (the third derivative white) by REML. One value
is used at all times. At exposures, where the jitter is observed, it is too large; between them, where curves
interpolate the jitter of neighbouring exposures, it may be too small.

Time-correlated image errors (lens, calibration, a lamp's shape seen from one side) do not average out over exposures.
Their share is estimated from the autocovariance of a camera's residuals of one point at lags of some exposures. Their
effect on a point is that of an error of this size in one exposure of each camera.
"""

import numpy as np

from mosca.continuous.estimator.gauss_newton import Solved, frame_rows, of_group
from mosca.continuous.estimator.motion_prior import FARTHEST_M
from mosca.continuous.estimator.observation_equations import HUBER, ImagePoints
from mosca.continuous.estimator.single_point import JITTER_ORDER, smoothest_noise
from mosca.continuous.estimator.state import StateLayout, TrajectoryState
from mosca.data.arrays import Array

CHANCE = 3.0
"""Least excess of variances over the stated ones, in standard deviations, to count as significant."""
LATER = range(3, 9)
"""Lags of the autocovariance, in exposures: beyond the correlation that the fit itself causes."""
LEAST_SHOWN = 1 / 4
"""Least share of time-correlated errors that residuals show: where two cameras see every point."""
EXPOSURE_GROUP_S = 0.5
"""Length of time bins within which the set of cameras that see a point is assumed constant [s]."""


def unheld(image: ImagePoints, solved: Solved, places: StateLayout, alone: StateLayout, points: Array) -> Array:
    """Return covariances (pieces + 1, all points, 3, 3) [m^2] at the knots, to be added to those of the curves.

    ``points``: the estimated ones; ``alone``: the layout in which each point is a group of its own.
    """
    knots = solved.state.knots
    total = np.zeros((knots.pieces + 1, len(image.observations.points), 3, 3))
    share = np.maximum(time_correlated_variance(image, solved), of_lenses(image))
    seen = np.bincount(image.observations.camera, minlength=len(share))
    mean = float(np.average(share, weights=np.maximum(seen, 1)))
    total[:, points] += jitter(image, solved, alone, points, mean)[:, None, None] * np.eye(3)
    if mean > 0:
        total[:, points] += time_correlated_covariances(image, solved, places, share)[:, points]
    return total


def of_lenses(image: ImagePoints) -> Array:
    """Return the variance of each camera's lens model errors (c,), as the calibration states it, relative to the
    stated image variance, which contains it: the least time-correlated variance.

    Residuals show too little of errors that a curve takes up, or that change as a point moves on.
    """
    o = image.observations
    number = np.maximum(np.bincount(o.camera, minlength=len(o.cameras)), 1)
    stated = np.bincount(o.camera, np.trace(o.covariance_px2, axis1=1, axis2=2) / 2, len(o.cameras)) / number
    return np.asarray(np.minimum(image.lens_px**2 / np.maximum(stated, 1e-12), 1.0))


def jitter(image: ImagePoints, solved: Solved, alone: StateLayout, points: Array, share: float) -> Array:
    """Return the variance (points,) per axis [m^2] of motion above the exposures' rate.

    ``share``: share of time-correlated errors in the stated variances, which look like jitter when the cameras that
    see a point change. Where a prior of a higher order predicts left-out image points better, the motion's spectrum
    ends below that rate.
    """
    if solved.state.smooth.order > JITTER_ORDER:
        return np.zeros(len(points))
    noise, lever, number = smoothest_noise(image, solved.state, alone, points)
    excess = noise**2 - 1 - share
    return np.asarray(np.where(excess > CHANCE * np.sqrt(2 / number), excess / lever, 0.0))


def time_correlated_variance(image: ImagePoints, solved: Solved) -> float:
    """Return the variance of time-correlated image errors relative to the stated ones; 0 where chance explains it.

    Where C cameras see a point, its curve takes up 3 of 2 C parts of such errors; the residuals show the rest.
    """
    o = image.observations
    rest = np.clip(np.nan_to_num(solved.residual), -HUBER, HUBER)
    order = np.lexsort((o.exposure, o.camera, o.point))
    pair = (o.point * len(o.cameras) + o.camera)[order]
    seen_by = np.zeros(len(o.points))
    np.add.at(seen_by, np.unique(pair) // len(o.cameras), 1)
    shown = np.maximum(2 * seen_by - 3, 0) / np.maximum(2 * seen_by, 1)
    alike = own = 0.0
    number = 0
    for later in LATER:
        same = np.flatnonzero(pair[later:] == pair[:-later])
        same = same[image.carrier[order[same]] < 0]
        one, two = order[same], order[same + later]
        alike += float((rest[one] * rest[two]).sum())
        own += float(shown[o.point[one]].sum()) * 2
        number += 2 * len(same)
    if not number or not own:
        return 0.0
    size = float(np.mean(rest**2))
    # the same residuals are used at several lags
    chance = CHANCE * size * np.sqrt(len(LATER) / number)
    return alike / own if alike / number > chance else 0.0


def covariance_of_shared(image: ImagePoints, solved: Solved, places: StateLayout) -> Array:
    """Return the covariance (b, b) of the shared unknowns (clocks, poses of fixed cameras), larger where image errors
    do not average out.

    The joint effects on an unknown of all residuals of one point in one camera are summed as if these pairs were
    independent. This gives the covariance for errors that are correlated in any way within a pair (Liang and Zeger
    1986): of a lens, or of the image taken for the point. The given covariance is multiplied by the mean ratio of the
    variances, where chance does not explain it. The curves take up a part of such errors, as in
    ``time_correlated_variance``.
    """
    o, shared = image.observations, places.shared
    if not shared:
        return solved.covariance
    cameras = len(o.cameras)
    by_pair = np.zeros((len(o.points) * cameras, shared))
    for g, rows in enumerate(solved.rows):
        own = np.flatnonzero(of_group(image, places, g) & (solved.weight > 0))
        taken = [rows.applied(column, places.width(g)) for column in solved.carried[g].T]
        score = (rows.shared - np.stack(taken, axis=1)) * rows.rest[:, None]
        np.add.at(by_pair, o.point[own] * cameras + o.camera[own], score.reshape(len(own), 2, -1).sum(axis=1))
    seen = by_pair.any(axis=1).reshape(-1, cameras)
    seen_by = seen.sum(axis=1)
    shown = float(np.average(np.maximum(2 * seen_by - 3, 0) / np.maximum(2 * seen_by, 1), weights=seen_by))
    influence = by_pair @ solved.covariance
    # mean over all unknowns: the ratio of a single one is uncertain, as there are few pairs
    ratio = float(np.mean((influence**2).sum(axis=0) / np.diag(solved.covariance)))
    if ratio <= 1.0 + CHANCE * np.sqrt(2.0 / max(int(seen.sum()), 1)):
        return solved.covariance
    return np.asarray(solved.covariance * ratio / max(shown, LEAST_SHOWN))


def time_correlated_covariances(image: ImagePoints, solved: Solved, places: StateLayout, share: Array) -> Array:
    """Return the covariances (pieces + 1, all points, 3, 3) [m^2] of points at the knots by time-correlated errors.

    ``share`` (c,): share of these errors in each camera's stated variances. Their effect is that of errors in one
    exposure of each camera that sees a point at the time; where cameras move, also on their poses.
    """
    o, knots = image.observations, solved.state.knots
    bins = max(1, round((knots.end_s - knots.start_s) / EXPOSURE_GROUP_S))
    time = np.clip((image.times(solved.state) - knots.start_s) / (knots.end_s - knots.start_s), 0, 1)
    bin_of = np.minimum((time * bins).astype(int), bins - 1)
    result = np.zeros((bins, len(o.points), 3, 3))
    for g, rows in enumerate(solved.rows):
        own = np.flatnonzero(of_group(image, places, g) & (solved.weight > 0))
        columns, by = rows.columns[::2], rows.values.reshape(len(own), 2, -1)
        at = bin_of[own], o.point[own], o.camera[own]
        if places.moving:
            held = [_held(solved.state, places, g, (b + 0.5) / bins) for b in range(bins)]
            points = places.groups[g]
            result[:, points] = _with_poses(columns, by, at, share, held, len(points))
        else:
            one = _each_alone(by[:, :, :3], at, share, (bins, len(o.points), len(o.cameras)))
            result[:, places.groups[g]] = one[:, places.groups[g]]
    nearest = np.clip(
        ((knots.breaks_s - knots.start_s) / (knots.end_s - knots.start_s) * bins).astype(int), 0, bins - 1
    )
    return np.asarray(result[nearest])


def _each_alone(by: Array, at: tuple[Array, ...], share: Array, shape: tuple[int, int, int]) -> Array:
    """Return covariances (bins, points, 3, 3) of points for cameras with known poses.

    ``by`` (n, 2, 3): whitened derivatives; ``at``: bin, point and camera of each image point; ``shape``: their
    numbers.
    """
    information, count = np.zeros((*shape, 3, 3)), np.zeros(shape)
    np.add.at(information, at, np.swapaxes(by, 1, 2) @ by)
    np.add.at(count, at, 1)
    # where fewer than two cameras see a point: use its images at other times
    few = (count > 0).sum(axis=2) < 2
    ever = information.sum(axis=0) / np.maximum(count.sum(axis=0), 1)[..., None, None]
    mean = np.where(few[..., None, None, None], ever, information / np.maximum(count, 1)[..., None, None])
    enough = (count.sum(axis=0) > 0).sum(axis=1) >= 2
    result = np.zeros((*shape[:2], 3, 3))
    inverse = np.linalg.inv(mean.sum(axis=2)[:, enough] + np.eye(3) / FARTHEST_M**2)
    lasts = (mean * share[:, None, None]).sum(axis=2)[:, enough]
    result[:, enough] = inverse @ lasts @ inverse
    return result


def _with_poses(
    columns: Array, by: Array, at: tuple[Array, Array, Array], share: Array, held: list[Array], points: int
) -> Array:
    """Return covariances (bins, points, 3, 3) of points and moving cameras together.

    ``columns`` (n, k): columns of the group, of which the first 3 per point are those of ``points``; ``by``
    (n, 2, k): whitened derivatives of each image point; ``at``: its bin, point and camera; ``held``: for each bin the
    equations (m, width) that hold the frame.
    """
    bins, width = len(held), held[0].shape[1]
    bin_of, point, camera = at
    # one additional column receives the derivatives by held unknowns
    spread = np.zeros((len(by), 2, width + 1))
    np.put_along_axis(spread, np.repeat(np.where(columns < 0, width, columns)[:, None], 2, axis=1), by, axis=2)
    pair, of = np.unique(camera * (int(point.max(initial=0)) + 1) + point, return_inverse=True)
    of = of.reshape(-1)
    total, count = np.zeros((bins, len(pair), 2, width)), np.zeros((bins, len(pair)))
    np.add.at(total, (bin_of, of), spread[:, :, :width])
    np.add.at(count, (bin_of, of), 1)
    ever = total.sum(axis=0) / count.sum(axis=0)[:, None, None]
    owner, seer = np.zeros((2, len(pair)), dtype=np.int64)
    owner[of], seer[of] = point, camera
    loose = np.append(np.full(3 * points, FARTHEST_M**-2), np.zeros(width - 3 * points))
    result = np.zeros((bins, points, 3, 3))
    for b in range(bins):
        views = np.bincount(owner, count[b] > 0, int(point.max(initial=0)) + 1)[owner]
        mean = np.where((views < 2)[:, None, None], ever, total[b] / np.maximum(count[b], 1)[:, None, None])
        equations = mean.reshape(-1, width)
        whole = equations.T @ equations + held[b].T @ held[b] + np.diag(loose)
        lasts = equations * np.repeat(np.sqrt(share[seer]), 2)[:, None]
        change = np.linalg.solve(whole, lasts.T)[: 3 * points].reshape(points, 3, -1)
        result[b] = change @ np.swapaxes(change, 1, 2)
    return result


def _held(state: TrajectoryState, places: StateLayout, group: int, at: float) -> Array:
    """Return the equations (m, width) that hold the frame of moving cameras at the share ``at`` of the time."""
    rows = frame_rows(state, places, group)
    knots = state.knots.pieces + 1
    each = (len(rows.rest) - knots) // knots
    knot = min(int(at * knots), knots - 1)
    which = np.append(np.arange(knot * each, (knot + 1) * each), knots * each + knot)
    dense = np.zeros((len(which), places.width(group) + 1))
    np.put_along_axis(
        dense, np.where(rows.columns[which] < 0, places.width(group), rows.columns[which]), rows.values[which], axis=1
    )
    return dense[:, :-1]
