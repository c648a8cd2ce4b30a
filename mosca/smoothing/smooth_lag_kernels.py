"""Compiled fixed-lag smoothing: a Kalman filter that keeps correcting the positions of the last instants.

The state is augmented by earlier positions (Anderson and Moore 1979, section 7.3). Of the augmented covariance only
what is used is kept: each earlier position's own 3 x 3 and its 3 x 9 with the newest state. Given the same
measurements, this equals any other smoother of the same model.
"""

import numpy as np

from mosca.numba_support.decorators import kernel, step
from mosca.smoothing.smooth_kernels import carry, carry_both, correct, invert3


@kernel
def take(  # type: ignore[no-untyped-def]
    slots, fresh, xyz, covariance, move, noise, speed2, ladder, fixed, start, remembered,
    mean, spread, count, lag_xyz, lag_own, lag_cross, rung_mean, rung_spread, rung_cost,
):  # fmt: skip
    """Give n measurements, in order, to the tracks in ``slots`` (n,); ``fresh`` (n,): a track's first.

    ``move``, ``noise`` (n, 3, 3): one axis' step since the track's last, noise for variance 1; ``speed2``: variance
    of a first velocity; ``ladder`` (r,): variances of acceleration to choose from, ``start`` (r,) what each costs
    before anything is known; ``fixed``: this one is used, below 0: the likeliest; ``remembered`` (n,): what share of
    the cost so far still counts. Changed, by slot: ``mean`` (s, 9), ``spread`` (s, 9, 9), ``count`` (s,) of earlier
    positions kept, their ``lag_xyz`` (s, w, 3), ``lag_own`` (s, w, 3, 3) and ``lag_cross`` (s, w, 3, 9);
    ``rung_...`` (s, r, ...) of the filters, an axis each, that tell how likely each variance is.
    """
    top, gain, inverse, away = np.empty((3, 9)), np.empty((9, 3)), np.empty((3, 3)), np.empty(3)
    for n in range(slots.shape[0]):
        s = slots[n]
        if fresh[n]:
            for r in range(ladder.shape[0]):
                rung_cost[s, r] = start[r]
                for a in range(3):
                    for i in range(3):
                        rung_mean[s, r, a, i] = 0.0
                        for j in range(3):
                            rung_spread[s, r, a, i, j] = 0.0
                    rung_mean[s, r, a, 0] = xyz[n, a]
                    rung_spread[s, r, a, 0, 0] = covariance[n, a, a]
                    rung_spread[s, r, a, 1, 1], rung_spread[s, r, a, 2, 2] = speed2, ladder[r]
            variance = fixed if fixed >= 0.0 else ladder[np.argmin(start)]
            for i in range(9):
                mean[s, i] = 0.0
                for j in range(9):
                    spread[s, i, j] = 0.0
            for a in range(3):
                mean[s, a] = xyz[n, a]
                for b in range(3):
                    spread[s, a, b] = covariance[n, a, b]
                spread[s, 3 + a, 3 + a], spread[s, 6 + a, 6 + a] = speed2, variance
            count[s] = 0
        else:
            if fixed < 0.0:
                for r in range(ladder.shape[0]):
                    rung_cost[s, r] *= remembered[n]
                    for a in range(3):
                        rung_cost[s, r] += _one_axis(
                            rung_mean[s, r, a], rung_spread[s, r, a], xyz[n, a], covariance[n, a, a],
                            move[n], noise[n], ladder[r],
                        )  # fmt: skip
            variance = fixed if fixed >= 0.0 else ladder[np.argmin(rung_cost[s])]
            _correct(
                xyz[n], covariance[n], move[n], noise[n], variance, mean[s], spread[s], count[s],
                lag_xyz[s], lag_own[s], lag_cross[s], top, gain, inverse, away,
            )  # fmt: skip
        k = count[s]
        for a in range(3):
            lag_xyz[s, k, a] = mean[s, a]
            for b in range(3):
                lag_own[s, k, a, b] = spread[s, a, b]
            for i in range(9):
                lag_cross[s, k, a, i] = spread[s, a, i]
        count[s] = k + 1


@kernel
def leave(upto, frame, first, count, lag_xyz, lag_own, lag_cross, xyz, own):  # type: ignore[no-untyped-def]
    """Take the earlier positions of frames up to ``upto`` out of all slots; return how many left.

    ``frame`` (s, w) of each position. What leaves is written to ``xyz`` (m, 3) and ``own`` (m, 3, 3), slot by slot,
    and how many of each slot to ``first`` (s,): the caller shifts its own columns.
    """
    out = 0
    for s in range(count.shape[0]):
        k = 0
        while k < count[s] and frame[s, k] <= upto:
            for a in range(3):
                xyz[out, a] = lag_xyz[s, k, a]
                for b in range(3):
                    own[out, a, b] = lag_own[s, k, a, b]
            out += 1
            k += 1
        first[s] = k
        if k > 0:
            left = count[s] - k
            for j in range(left):
                for a in range(3):
                    lag_xyz[s, j, a] = lag_xyz[s, j + k, a]
                    for b in range(3):
                        lag_own[s, j, a, b] = lag_own[s, j + k, a, b]
                    for i in range(9):
                        lag_cross[s, j, a, i] = lag_cross[s, j + k, a, i]
            count[s] = left
    return out


@step
def _correct(  # type: ignore[no-untyped-def]
    xyz, covariance, move, noise, variance, x, p, count, lag_xyz, lag_own, lag_cross, top, gain, inverse, away
):  # fmt: skip
    """Carry a state and its earlier positions one step and correct them all with one measurement, in place.

    ``top`` (3, 9), ``gain`` (9, 3), ``inverse`` (3, 3), ``away`` (3,): room to work.
    """
    carry(x, move)
    carry_both(p, move)
    for i in range(3):
        for j in range(3):
            for a in range(3):
                p[3 * i + a, 3 * j + a] += variance * noise[i, j]
    for a in range(3):
        away[a] = xyz[a] - x[a]
        for b in range(3):
            inverse[a, b] = p[a, b] + covariance[a, b]
    invert3(inverse)
    correct(x, p, away, inverse, top, gain)
    for k in range(count):
        for a in range(3):
            carry(lag_cross[k, a], move)
        for a in range(3):
            # an earlier position's row of the gain
            n0, n1, n2 = lag_cross[k, a, 0], lag_cross[k, a, 1], lag_cross[k, a, 2]
            g0 = n0 * inverse[0, 0] + n1 * inverse[1, 0] + n2 * inverse[2, 0]
            g1 = n0 * inverse[0, 1] + n1 * inverse[1, 1] + n2 * inverse[2, 1]
            g2 = n0 * inverse[0, 2] + n1 * inverse[1, 2] + n2 * inverse[2, 2]
            lag_xyz[k, a] += g0 * away[0] + g1 * away[1] + g2 * away[2]
            gain[a, 0], gain[a, 1], gain[a, 2] = g0, g1, g2
        for a in range(3):
            for b in range(3):
                lag_own[k, a, b] -= (
                    gain[a, 0] * lag_cross[k, b, 0]
                    + gain[a, 1] * lag_cross[k, b, 1]
                    + gain[a, 2] * lag_cross[k, b, 2]
                )
        for a in range(3):
            for i in range(9):
                lag_cross[k, a, i] -= gain[a, 0] * top[0, i] + gain[a, 1] * top[1, i] + gain[a, 2] * top[2, i]


@step
def _one_axis(x, p, z, variance, f, q, strength):  # type: ignore[no-untyped-def]
    """Carry one axis' filter a step, correct it in place and return what the measurement costs: -2 log-likelihood."""
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
