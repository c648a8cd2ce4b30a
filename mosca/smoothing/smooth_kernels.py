"""Compiled smoothing of one trajectory: Kalman filter forth, Bryson and Frazier's recursion back.

The modified Bryson-Frazier form of the Rauch-Tung-Striebel smoother (Bierman 1973) needs no inverse of a predicted
covariance, so that instants without a measurement are only steps without a correction. Matrices this small are
multiplied in loops: a library's call costs more, and is slow to compile.
"""

import numpy as np

from mosca.numba_support.decorators import kernel, step


@kernel
def smooth_one(xyz, covariance, measured, move, noise, speed2, variance):  # type: ignore[no-untyped-def]
    """Smooth one trajectory of t instants.

    ``xyz`` (t, 3), ``covariance`` (t, 3, 3) count where ``measured`` (t,); the first instant must be. ``move``,
    ``noise`` (t, 3, 3): one axis' transition and noise from the instant before, for ``variance`` of acceleration 1;
    the first is not used. ``speed2``: variance of the first velocity. Returns positions (t, 3), covariances
    (t, 3, 3), -2 log-likelihood and mean normalised innovation squared.
    """
    t = xyz.shape[0]
    x, p = np.zeros(9), np.zeros((9, 9))
    for a in range(3):
        x[a] = xyz[0, a]
        for b in range(3):
            p[a, b] = covariance[0, a, b]
        p[3 + a, 3 + a], p[6 + a, 6 + a] = speed2, variance
    before_p = np.empty((t, 9, 9))
    after_x, after_p = np.empty((t, 9)), np.empty((t, 9, 9))
    inverse, innovation = np.zeros((t, 3, 3)), np.zeros((t, 3))
    cost, nis, count = 0.0, 0.0, 0
    s, f, top, gain = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 9)), np.empty((9, 3))
    for k in range(t):
        if k > 0:
            for i in range(3):
                for j in range(3):
                    f[i, j] = move[k, i, j]
            carry(x, f)
            carry_both(p, f)
            for i in range(3):
                for j in range(3):
                    for a in range(3):
                        p[3 * i + a, 3 * j + a] += variance * noise[k, i, j]
        _copy(p, before_p, k)
        if measured[k] and k > 0:
            for a in range(3):
                innovation[k, a] = xyz[k, a] - x[a]
                for b in range(3):
                    s[a, b] = p[a, b] + covariance[k, a, b]
            determinant = invert3(s)
            square = 0.0
            for a in range(3):
                for b in range(3):
                    inverse[k, a, b] = s[a, b]
                    square += innovation[k, a] * s[a, b] * innovation[k, b]
            correct(x, p, innovation[k], s, top, gain)
            cost += square + np.log(determinant)
            nis += square
            count += 1
        for i in range(9):
            after_x[k, i] = x[i]
        _copy(p, after_p, k)
    place, spread = np.empty((t, 3)), np.empty((t, 3, 3))
    lead, weight, left, work = np.zeros(9), np.zeros((9, 9)), np.empty((9, 9)), np.empty((9, 9))
    for k in range(t - 1, -1, -1):
        # lead, weight: adjoint of what is measured later, at the corrected state
        for a in range(3):
            place[k, a] = after_x[k, a]
            for i in range(9):
                place[k, a] -= after_p[k, a, i] * lead[i]
                work[a, i] = 0.0
                for j in range(9):
                    work[a, i] += after_p[k, a, j] * weight[j, i]
            for b in range(3):
                spread[k, a, b] = after_p[k, a, b]
                for i in range(9):
                    spread[k, a, b] -= work[a, i] * after_p[k, b, i]
        if k == 0:
            break
        if measured[k]:
            for i in range(9):
                for j in range(9):
                    left[i, j] = 1.0 if i == j else 0.0
                for b in range(3):
                    for a in range(3):
                        left[i, b] -= before_p[k, i, a] * inverse[k, a, b]
            _adjoint(left, lead, weight, work)
            for a in range(3):
                for b in range(3):
                    lead[a] -= inverse[k, a, b] * innovation[k, b]
                    weight[a, b] += inverse[k, a, b]
        for i in range(3):
            for j in range(3):
                f[i, j] = move[k, j, i]
        carry(lead, f)
        carry_both(weight, f)
    return place, spread, cost, nis / max(count, 1)


@step
def _copy(p, kept, k):  # type: ignore[no-untyped-def]
    for i in range(9):
        for j in range(9):
            kept[k, i, j] = p[i, j]


@step
def _adjoint(left, lead, weight, work):  # type: ignore[no-untyped-def]
    """Carry ``lead`` (9,) and ``weight`` (9, 9) back over a correction: left' lead and left' weight left."""
    for i in range(9):
        for j in range(9):
            work[i, j] = 0.0
            for k in range(9):
                work[i, j] += weight[i, k] * left[k, j]
    for i in range(9):
        for j in range(9):
            weight[i, j] = 0.0
            for k in range(9):
                weight[i, j] += left[k, i] * work[k, j]
    for i in range(9):
        work[0, i] = 0.0
        for k in range(9):
            work[0, i] += left[k, i] * lead[k]
    for i in range(9):
        lead[i] = work[0, i]


@step
def carry(x, f):  # type: ignore[no-untyped-def]
    """Multiply position, velocity and acceleration of three axes (9,) by one axis' matrix ``f`` (3, 3), in place."""
    for a in range(3):
        u, v, w = x[a], x[3 + a], x[6 + a]
        for i in range(3):
            x[3 * i + a] = f[i, 0] * u + f[i, 1] * v + f[i, 2] * w


@step
def carry_both(p, f):  # type: ignore[no-untyped-def]
    """Carry the covariance (9, 9) of such a state, which is symmetric, in place."""
    for _ in range(2):
        for i in range(9):
            for a in range(3):
                u, v, w = p[i, a], p[i, 3 + a], p[i, 6 + a]
                for k in range(3):
                    p[i, 3 * k + a] = f[k, 0] * u + f[k, 1] * v + f[k, 2] * w
        for i in range(9):
            for j in range(i):
                p[i, j], p[j, i] = p[j, i], p[i, j]


@step
def correct(x, p, away, inverse, top, gain):  # type: ignore[no-untyped-def]
    """Correct a state (9,) and its covariance (9, 9) in place by a position ``away`` (3,) from its own.

    ``inverse`` (3, 3) of the innovation's covariance. ``top`` (3, 9), ``gain`` (9, 3): filled with the covariance's
    first rows as they were and the gain.
    """
    for i in range(9):
        for b in range(3):
            top[b, i] = p[b, i]
    for i in range(9):
        for b in range(3):
            gain[i, b] = top[0, i] * inverse[0, b] + top[1, i] * inverse[1, b] + top[2, i] * inverse[2, b]
        x[i] += gain[i, 0] * away[0] + gain[i, 1] * away[1] + gain[i, 2] * away[2]
    for i in range(9):
        for j in range(i + 1):
            less = gain[i, 0] * top[0, j] + gain[i, 1] * top[1, j] + gain[i, 2] * top[2, j]
            same = gain[j, 0] * top[0, i] + gain[j, 1] * top[1, i] + gain[j, 2] * top[2, i]
            p[i, j] = p[j, i] = 0.5 * (p[i, j] - less + p[j, i] - same)


@step
def invert3(s):  # type: ignore[no-untyped-def]
    """Invert a symmetric matrix (3, 3) in place; returns its determinant."""
    a, b, c, d, e, f = s[0, 0], s[0, 1], s[0, 2], s[1, 1], s[1, 2], s[2, 2]
    i, j, k = d * f - e * e, c * e - b * f, b * e - c * d
    det = a * i + b * j + c * k
    s[0, 0], s[1, 1], s[2, 2] = i / det, (a * f - c * c) / det, (a * d - b * b) / det
    s[0, 1] = s[1, 0] = j / det
    s[0, 2] = s[2, 0] = k / det
    s[1, 2] = s[2, 1] = (b * c - a * e) / det
    return det
