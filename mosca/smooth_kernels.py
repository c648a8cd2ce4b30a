"""Compiled smoothing of one trajectory: Kalman filter forth, Bryson and Frazier's recursion back.

The modified Bryson-Frazier form of the Rauch-Tung-Striebel smoother (Bierman 1973) needs no inverse of a predicted
covariance, so that instants without a measurement are only steps without a correction.
"""

import numba
import numpy as np

kernel = numba.njit(nogil=True, cache=True, error_model="numpy")
step = numba.njit(nogil=True, error_model="numpy")


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
    x[:3] = xyz[0]
    p[:3, :3] = covariance[0]
    for a in range(3):
        p[3 + a, 3 + a], p[6 + a, 6 + a] = speed2, variance
    before_x, before_p = np.empty((t, 9)), np.empty((t, 9, 9))
    after_x, after_p = np.empty((t, 9)), np.empty((t, 9, 9))
    inverse, innovation = np.zeros((t, 3, 3)), np.zeros((t, 3))
    cost, nis, count = 0.0, 0.0, 0
    for k in range(t):
        if k > 0:
            f = _of_axes(move[k])
            x = f @ x
            p = f @ p @ f.T + variance * _of_axes(noise[k])
        before_x[k], before_p[k] = x, p
        if measured[k] and k > 0:
            s = p[:3, :3] + covariance[k]
            inverse[k] = np.linalg.inv(s)
            innovation[k] = xyz[k] - x[:3]
            gain = np.ascontiguousarray(p[:, :3]) @ inverse[k]
            x = x + gain @ innovation[k]
            p = p - gain @ np.ascontiguousarray(p[:3, :])
            p = 0.5 * (p + p.T)
            square = innovation[k] @ inverse[k] @ innovation[k]
            cost += square + np.log(np.linalg.det(s))
            nis += square
            count += 1
        after_x[k], after_p[k] = x, p
    place, spread = np.empty((t, 3)), np.empty((t, 3, 3))
    lead, weight = np.zeros(9), np.zeros((9, 9))
    for k in range(t - 1, -1, -1):
        # lead, weight: adjoint of what is measured later, at the corrected state
        p = after_p[k]
        top = np.ascontiguousarray(p[:3, :])
        place[k] = after_x[k, :3] - top @ lead
        spread[k] = p[:3, :3] - top @ weight @ top.T
        if k == 0:
            break
        if measured[k]:
            p = before_p[k]
            gain = np.ascontiguousarray(p[:, :3]) @ inverse[k]
            left = np.eye(9)
            left[:, :3] -= gain
            lead = left.T @ lead
            lead[:3] -= inverse[k] @ innovation[k]
            weight = left.T @ weight @ left
            weight[:3, :3] += inverse[k]
        f = _of_axes(move[k])
        lead, weight = f.T @ lead, f.T @ weight @ f
    return place, spread, cost, nis / max(count, 1)


@step
def _of_axes(one):  # type: ignore[no-untyped-def]
    """Spread one axis' 3 x 3 matrix over position, velocity and acceleration of three axes (9, 9)."""
    full = np.zeros((9, 9))
    for a in range(3):
        for b in range(3):
            for c in range(3):
                full[3 * a + c, 3 * b + c] = one[a, b]
    return full
