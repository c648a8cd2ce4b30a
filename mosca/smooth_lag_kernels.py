"""Compiled fixed-lag smoothing: a Kalman filter that keeps correcting the positions of the last instants.

The state is augmented by earlier positions (Anderson and Moore 1979, section 7.3). Of the augmented covariance only
what is used is kept: each earlier position's own 3 x 3 and its 3 x 9 with the newest state. Given the same
measurements, this equals any other smoother of the same model.
"""

import numba
import numpy as np

kernel = numba.njit(nogil=True, cache=True, error_model="numpy")
step = numba.njit(nogil=True, error_model="numpy")


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
    for n in range(slots.shape[0]):
        s = slots[n]
        if fresh[n]:
            rung_cost[s] = start
            rung_mean[s] = 0.0
            rung_spread[s] = 0.0
            for r in range(ladder.shape[0]):
                for a in range(3):
                    rung_mean[s, r, a, 0] = xyz[n, a]
                    rung_spread[s, r, a, 0, 0] = covariance[n, a, a]
                    rung_spread[s, r, a, 1, 1], rung_spread[s, r, a, 2, 2] = speed2, ladder[r]
            variance = fixed if fixed >= 0.0 else ladder[np.argmin(start)]
            mean[s], spread[s] = 0.0, 0.0
            mean[s, :3] = xyz[n]
            spread[s, :3, :3] = covariance[n]
            for a in range(3):
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
                xyz[n], covariance[n], move[n], variance * noise[n], mean[s], spread[s], count[s],
                lag_xyz[s], lag_own[s], lag_cross[s],
            )  # fmt: skip
        k = count[s]
        lag_xyz[s, k] = mean[s, :3]
        lag_own[s, k] = spread[s, :3, :3]
        lag_cross[s, k] = spread[s, :3]
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
            xyz[out], own[out] = lag_xyz[s, k], lag_own[s, k]
            out += 1
            k += 1
        first[s] = k
        if k > 0:
            left = count[s] - k
            for j in range(left):
                lag_xyz[s, j], lag_own[s, j], lag_cross[s, j] = (
                    lag_xyz[s, j + k], lag_own[s, j + k], lag_cross[s, j + k],
                )  # fmt: skip
            count[s] = left
    return out


@step
def _correct(xyz, covariance, move, noise, x, p, count, lag_xyz, lag_own, lag_cross):  # type: ignore[no-untyped-def]
    """Carry a state and its earlier positions one step and correct them all with one measurement, in place."""
    _carry(x.reshape(1, 9), move)
    _carry(p, move)
    _carry(p.T, move)
    for a in range(3):
        for i in range(3):
            for j in range(3):
                p[3 * i + a, 3 * j + a] += noise[i, j]
    inverse = np.linalg.inv(p[:3, :3] + covariance)
    away = xyz - x[:3]
    top = p[:3].copy()
    for k in range(count):
        _carry(lag_cross[k], move)
        near = lag_cross[k, :, :3].copy()
        gain = _product(near, inverse)
        lag_xyz[k] += _times(gain, away)
        lag_own[k] -= _product(gain, near.T)
        lag_cross[k] -= _product(gain, top)
    gain = _product(top.T, inverse)
    x += _times(gain, away)
    p -= _product(gain, top)
    for i in range(9):
        for j in range(i):
            p[i, j] = p[j, i] = 0.5 * (p[i, j] + p[j, i])


@step
def _carry(rows, move):  # type: ignore[no-untyped-def]
    """Multiply each row of ``rows`` (n, 9) by the transition whose axes' part is ``move`` (3, 3), in place."""
    for row in range(rows.shape[0]):
        for a in range(3):
            v, w = rows[row, 3 + a], rows[row, 6 + a]
            rows[row, a] += move[0, 1] * v + move[0, 2] * w
            rows[row, 3 + a] = v + move[1, 2] * w
            rows[row, 6 + a] = move[2, 2] * w


@step
def _product(a, b):  # type: ignore[no-untyped-def]
    """Return a @ b; for matrices this small a loop is faster than a library's call."""
    out = np.zeros((a.shape[0], b.shape[1]))
    for i in range(a.shape[0]):
        for k in range(a.shape[1]):
            for j in range(b.shape[1]):
                out[i, j] += a[i, k] * b[k, j]
    return out


@step
def _times(a, x):  # type: ignore[no-untyped-def]
    """Return the vector a @ x."""
    out = np.zeros(a.shape[0])
    for i in range(a.shape[0]):
        for k in range(a.shape[1]):
            out[i] += a[i, k] * x[k]
    return out


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
    top = p[0].copy()
    for i in range(3):
        x[i] += top[i] * away / total
        for j in range(3):
            p[i, j] -= top[i] * top[j] / total
    return away * away / total + np.log(total)
