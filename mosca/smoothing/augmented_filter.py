"""A Kalman filter that keeps correcting the positions of the last instants, compiled.

Its state is augmented by earlier positions (Anderson and Moore 1979, section 7.3). Only the parts of the augmented
covariance that are used are kept: each earlier position's own 3 x 3 block and its 3 x 9 block with the newest state.
"""

from typing import NamedTuple

import numpy as np

from mosca.data.arrays import Array
from mosca.numba_support.decorators import kernel, step
from mosca.smoothing.rts import add_process_noise, innovation_inverse, predict_covariance, predict_state, update_state
from mosca.tracking.state import Scratch


class Filters(NamedTuple):
    """Filters of s slots with up to w earlier positions each, and r variances of acceleration to choose from."""

    mean: Array
    """(s, 9) position, velocity, acceleration."""
    spread: Array
    """(s, 9, 9) its covariance."""
    kept: Array
    """(s,) earlier positions kept."""
    xyz: Array
    """(s, w, 3) earlier positions, oldest first."""
    own: Array
    """(s, w, 3, 3) their covariances."""
    cross: Array
    """(s, w, 3, 9) their covariances with the newest state."""
    axis_mean: Array
    """(s, r, 3, 3) states of filters for one axis each, which give the likelihood of each variance of
    acceleration."""
    axis_spread: Array
    """(s, r, 3, 3, 3) their covariances."""
    cost: Array
    """(s, r) -2 log-likelihood of each variance."""


def empty_filters(slots: int, width: int, variances: int) -> Filters:
    """Return empty filters of s ``slots`` with up to w = ``width`` earlier positions, for r ``variances``."""
    n, w, r = slots, width, variances
    return Filters(
        mean=np.zeros((n, 9)), spread=np.zeros((n, 9, 9)), kept=np.zeros(n, np.int64), xyz=np.zeros((n, w, 3)),
        own=np.zeros((n, w, 3, 3)), cross=np.zeros((n, w, 3, 9)), axis_mean=np.zeros((n, r, 3, 3)),
        axis_spread=np.zeros((n, r, 3, 3, 3)), cost=np.zeros((n, r)),
    )  # fmt: skip


class TrackMeasurements(NamedTuple):
    """n measurements in order of time, as the kernel reads them."""

    slots: Array
    """(n,)"""
    first: Array
    """(n,) whether it is a track's first."""
    xyz: Array
    """(n, 3)"""
    covariance: Array
    """(n, 3, 3)"""
    move: Array
    """(n, 3, 3) one axis' transition since the track's measurement before."""
    noise: Array
    """(n, 3, 3) its noise for variance of acceleration 1."""
    remembered: Array
    """(n,) share of the cost so far that still counts."""


class Prior(NamedTuple):
    """Prior of the motion."""

    speed2: float
    """Variance of a first velocity."""
    ladder: Array
    """(r,) variances of acceleration to choose from."""
    start: Array
    """(r,) prior cost of each."""
    fixed: float
    """The variance of acceleration; below 0: the likeliest of the ladder."""


@kernel
def update(measured, prior, filters):
    """Update the filters with n measurements, and keep each position among the earlier ones."""
    scratch, inverse, innovation = Scratch(np.empty((9, 3)), np.empty((3, 9))), np.empty((3, 3)), np.empty(3)
    for n in range(measured.slots.shape[0]):
        s = measured.slots[n]
        if measured.first[n]:
            _begin(measured, n, prior, filters, s)
        else:
            variance = _likeliest(measured, n, prior, filters, s)
            _update_one(measured, n, variance, filters, s, scratch, inverse, innovation)
        k = filters.kept[s]
        for a in range(3):
            filters.xyz[s, k, a] = filters.mean[s, a]
            for b in range(3):
                filters.own[s, k, a, b] = filters.spread[s, a, b]
            for i in range(9):
                filters.cross[s, k, a, i] = filters.spread[s, a, i]
        filters.kept[s] = k + 1


@kernel
def release(upto, frame, filters, released, xyz, own):
    """Take the earlier positions of frames up to ``upto`` out of all slots; return how many there were.

    ``frame`` (s, w) of each position. Fills ``xyz`` (m, 3) and ``own`` (m, 3, 3), slot by slot, and ``released`` (s,)
    with the number taken from each slot. The caller shifts its own columns.
    """
    out = 0
    for s in range(filters.kept.shape[0]):
        k = 0
        while k < filters.kept[s] and frame[s, k] <= upto:
            for a in range(3):
                xyz[out, a] = filters.xyz[s, k, a]
                for b in range(3):
                    own[out, a, b] = filters.own[s, k, a, b]
            out += 1
            k += 1
        released[s] = k
        if k > 0:
            left = filters.kept[s] - k
            for j in range(left):
                for a in range(3):
                    filters.xyz[s, j, a] = filters.xyz[s, j + k, a]
                    for b in range(3):
                        filters.own[s, j, a, b] = filters.own[s, j + k, a, b]
                    for i in range(9):
                        filters.cross[s, j, a, i] = filters.cross[s, j + k, a, i]
            filters.kept[s] = left
    return out


@step
def _begin(measured, n, prior, filters, s):
    """Begin the filters of slot ``s`` with its first measurement."""
    for r in range(prior.ladder.shape[0]):
        filters.cost[s, r] = prior.start[r]
        filters.axis_mean[s, r], filters.axis_spread[s, r] = 0.0, 0.0
        for a in range(3):
            filters.axis_mean[s, r, a, 0] = measured.xyz[n, a]
            filters.axis_spread[s, r, a, 0, 0] = measured.covariance[n, a, a]
            filters.axis_spread[s, r, a, 1, 1] = prior.speed2
            filters.axis_spread[s, r, a, 2, 2] = prior.ladder[r]
    variance = prior.fixed if prior.fixed >= 0.0 else prior.ladder[np.argmin(prior.start)]
    filters.mean[s], filters.spread[s] = 0.0, 0.0
    filters.mean[s, :3], filters.spread[s, :3, :3] = measured.xyz[n], measured.covariance[n]
    for a in range(3):
        filters.spread[s, 3 + a, 3 + a], filters.spread[s, 6 + a, 6 + a] = prior.speed2, variance
    filters.kept[s] = 0


@step
def _likeliest(measured, n, prior, filters, s):
    """Return the variance of acceleration for slot ``s``: the fixed one, or the likeliest with measurement ``n``."""
    if prior.fixed >= 0.0:
        return prior.fixed
    for r in range(prior.ladder.shape[0]):
        filters.cost[s, r] *= measured.remembered[n]
        for a in range(3):
            filters.cost[s, r] += _update_axis(
                filters.axis_mean[s, r, a], filters.axis_spread[s, r, a], measured.xyz[n, a],
                measured.covariance[n, a, a], measured.move[n], measured.noise[n], prior.ladder[r],
            )  # fmt: skip
    return prior.ladder[np.argmin(filters.cost[s])]


@step
def _update_one(measured, n, variance, filters, s, scratch, inverse, innovation):
    """Predict the state and the earlier positions of slot ``s`` and update them all with measurement ``n``.

    ``inverse`` (3, 3), ``innovation`` (3,): working memory.
    """
    x, p, move = filters.mean[s], filters.spread[s], measured.move[n]
    past_xyz, own, cross = filters.xyz[s], filters.own[s], filters.cross[s]
    top, gain = scratch.rows, scratch.gain
    predict_state(x, move)
    predict_covariance(p, move)
    add_process_noise(p, measured.noise[n], variance)
    for a in range(3):
        innovation[a] = measured.xyz[n, a] - x[a]
    innovation_inverse(p, measured.covariance[n], inverse)
    update_state(x, p, innovation, inverse, scratch)
    for k in range(filters.kept[s]):
        for a in range(3):
            predict_state(cross[k, a], move)
        for a in range(3):
            # an earlier position's row of the gain
            n0, n1, n2 = cross[k, a, 0], cross[k, a, 1], cross[k, a, 2]
            g0 = n0 * inverse[0, 0] + n1 * inverse[1, 0] + n2 * inverse[2, 0]
            g1 = n0 * inverse[0, 1] + n1 * inverse[1, 1] + n2 * inverse[2, 1]
            g2 = n0 * inverse[0, 2] + n1 * inverse[1, 2] + n2 * inverse[2, 2]
            past_xyz[k, a] += g0 * innovation[0] + g1 * innovation[1] + g2 * innovation[2]
            gain[a, 0], gain[a, 1], gain[a, 2] = g0, g1, g2
        for a in range(3):
            for b in range(3):
                own[k, a, b] -= (
                    gain[a, 0] * cross[k, b, 0] + gain[a, 1] * cross[k, b, 1] + gain[a, 2] * cross[k, b, 2]
                )
        for a in range(3):
            for i in range(9):
                cross[k, a, i] -= gain[a, 0] * top[0, i] + gain[a, 1] * top[1, i] + gain[a, 2] * top[2, i]


@step
def _update_axis(x, p, z, variance, f, q, strength):
    """Predict and update one axis' filter in place; returns -2 log-likelihood of the measurement."""
    x[0] += f[0, 1] * x[1] + f[0, 2] * x[2]
    x[1] += f[1, 2] * x[2]
    x[2] *= f[2, 2]
    for _ in range(2):
        for i in range(3):
            p[i, 0] += f[0, 1] * p[i, 1] + f[0, 2] * p[i, 2]
            p[i, 1] += f[1, 2] * p[i, 2]
            p[i, 2] *= f[2, 2]
        for i in range(3):
            for j in range(i):
                p[i, j], p[j, i] = p[j, i], p[i, j]
    for i in range(3):
        for j in range(3):
            p[i, j] += strength * q[i, j]
    total = p[0, 0] + variance
    away = z - x[0]
    t0, t1, t2 = p[0, 0], p[0, 1], p[0, 2]
    for i in range(3):
        own = t0 if i == 0 else (t1 if i == 1 else t2)
        x[i] += own * away / total
        p[i, 0] -= own * t0 / total
        p[i, 1] -= own * t1 / total
        p[i, 2] -= own * t2 / total
    return away * away / total + np.log(total)
