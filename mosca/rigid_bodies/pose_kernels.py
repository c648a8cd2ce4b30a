"""Pose of a known constellation, compiled: least squares with the points' full covariances.

The first pose is Horn's closed form by unit quaternions (1987), with one weight a point. Gauss-Newton refines it in
(translation, rotation vector in world axes), R <- exp([r]) R. Small matrices are solved in place: a LAPACK call for a
6 x 6 or 4 x 4 matrix costs more than the loops, and NumPy's calls in compiled code allocate memory.
"""

import math

import numpy as np

from mosca.numba_support.decorators import kernel, step
from mosca.numba_support.linalg3 import inverse3, plus_identity3, store3, symmetric3

STEPS = 6
"""Gauss-Newton steps at most."""
SETTLED = 1e-11
"""Largest change of translation [m] or rotation [rad] at convergence."""
SINGULAR = 1e-10
"""A pivot of the normal matrix below this share of its diagonal element counts as zero."""
JACOBI_SWEEPS = 12
ANNIHILATED = 1e-30
"""Sum of squared elements off the diagonal at which Jacobi's rotations have converged."""


@kernel
def fit_pose(place, xyz, covariance, sigma2, rotation, translation, spread, chi2):
    """Fit x_world = R place + t to points; fills R (3, 3), t (3,), covariance (6, 6) and chi2 (k,) of each point.

    ``place`` (k, 3): markers in the body's frame; ``xyz`` (k, 3): points with ``covariance`` (k, 3, 3); ``sigma2``
    [m^2]: variance of a marker position per axis. Returns the sum of chi2, or -1 where the pose is undetermined.
    """
    k = place.shape[0]
    if k < 3:
        return -1.0
    weight = np.empty((k, 3, 3))
    for i in range(k):
        store3(inverse3(plus_identity3(symmetric3(covariance[i]), sigma2)), weight[i])
    _horn(place, xyz, weight, rotation, translation)
    normal, right, lever = np.empty((6, 6)), np.empty(6), np.empty((k, 3))
    total = 0.0
    for iteration in range(STEPS):
        total = _normals(place, xyz, weight, rotation, translation, normal, right, lever, chi2)
        if not _cholesky(normal):
            return -1.0
        if iteration == STEPS - 1:
            break
        _solve(normal, right)
        _rotate_by(rotation, right[3], right[4], right[5])
        moved = 0.0
        for c in range(6):
            if c < 3:
                translation[c] += right[c]
            moved = max(moved, abs(right[c]))
        if moved < SETTLED:
            break
    column = np.empty(6)
    for c in range(6):
        for d in range(6):
            column[d] = 1.0 if c == d else 0.0
        _solve(normal, column)
        for d in range(6):
            spread[d, c] = column[d]
    return total


@step
def _normals(place, xyz, weight, rotation, translation, normal, right, lever, chi2):
    """Fill J'WJ and J'Wr of all points at a pose; returns r'Wr."""
    normal[:], right[:] = 0.0, 0.0
    r, wr, jac, wj = np.empty(3), np.empty(3), np.zeros((3, 6)), np.empty((3, 6))
    total = 0.0
    for i in range(place.shape[0]):
        for a in range(3):
            lever[i, a] = rotation[a, 0] * place[i, 0] + rotation[a, 1] * place[i, 1] + rotation[a, 2] * place[i, 2]
            r[a] = xyz[i, a] - lever[i, a] - translation[a]
            jac[a, a] = 1.0
        # d(R p) = w x (R p)
        jac[0, 4], jac[0, 5] = lever[i, 2], -lever[i, 1]
        jac[1, 3], jac[1, 5] = -lever[i, 2], lever[i, 0]
        jac[2, 3], jac[2, 4] = lever[i, 1], -lever[i, 0]
        for a in range(3):
            w = weight[i, a]
            wr[a] = w[0] * r[0] + w[1] * r[1] + w[2] * r[2]
            for c in range(6):
                wj[a, c] = w[0] * jac[0, c] + w[1] * jac[1, c] + w[2] * jac[2, c]
        chi2[i] = r[0] * wr[0] + r[1] * wr[1] + r[2] * wr[2]
        total += chi2[i]
        for c in range(6):
            right[c] += jac[0, c] * wr[0] + jac[1, c] * wr[1] + jac[2, c] * wr[2]
            for d in range(c + 1):
                normal[c, d] += jac[0, c] * wj[0, d] + jac[1, c] * wj[1, d] + jac[2, c] * wj[2, d]
    return total


@step
def _horn(place, xyz, weight, rotation, translation):
    """Closed-form pose with one weight a point: the eigenvector of the largest eigenvalue (Horn 1987, eq. 4)."""
    k = place.shape[0]
    p, q = np.zeros(3), np.zeros(3)
    whole = 0.0
    for i in range(k):
        w = weight[i, 0, 0] + weight[i, 1, 1] + weight[i, 2, 2]
        whole += w
        for a in range(3):
            p[a] += w * place[i, a]
            q[a] += w * xyz[i, a]
    for a in range(3):
        p[a] /= whole
        q[a] /= whole
    s = np.zeros((3, 3))
    for i in range(k):
        w = (weight[i, 0, 0] + weight[i, 1, 1] + weight[i, 2, 2]) / whole
        for a in range(3):
            for b in range(3):
                s[a, b] += w * (place[i, a] - p[a]) * (xyz[i, b] - q[b])
    n = np.empty((4, 4))
    n[0, 0] = s[0, 0] + s[1, 1] + s[2, 2]
    n[0, 1] = n[1, 0] = s[1, 2] - s[2, 1]
    n[0, 2] = n[2, 0] = s[2, 0] - s[0, 2]
    n[0, 3] = n[3, 0] = s[0, 1] - s[1, 0]
    n[1, 1] = s[0, 0] - s[1, 1] - s[2, 2]
    n[2, 2] = -s[0, 0] + s[1, 1] - s[2, 2]
    n[3, 3] = -s[0, 0] - s[1, 1] + s[2, 2]
    n[1, 2] = n[2, 1] = s[0, 1] + s[1, 0]
    n[1, 3] = n[3, 1] = s[2, 0] + s[0, 2]
    n[2, 3] = n[3, 2] = s[1, 2] + s[2, 1]
    q4 = np.empty(4)
    _largest(n, q4)
    _matrix(q4[0], q4[1], q4[2], q4[3], rotation)
    for a in range(3):
        translation[a] = q[a] - rotation[a, 0] * p[0] - rotation[a, 1] * p[1] - rotation[a, 2] * p[2]


@step
def _largest(n, vector):
    """Fill the unit eigenvector (4,) of the largest eigenvalue of n (4, 4): cyclic Jacobi rotations, n is used up."""
    vectors = np.eye(4)
    for _sweep in range(JACOBI_SWEEPS):
        off = 0.0
        for p in range(3):
            for q in range(p + 1, 4):
                off += n[p, q] ** 2
                if n[p, q] == 0.0:
                    continue
                h = (n[q, q] - n[p, p]) / (2.0 * n[p, q])
                t = (1.0 if h >= 0.0 else -1.0) / (abs(h) + math.sqrt(h * h + 1.0))
                c = 1.0 / math.sqrt(t * t + 1.0)
                s = t * c
                for k in range(4):
                    n[k, p], n[k, q] = c * n[k, p] - s * n[k, q], s * n[k, p] + c * n[k, q]
                for k in range(4):
                    n[p, k], n[q, k] = c * n[p, k] - s * n[q, k], s * n[p, k] + c * n[q, k]
                    u, v = vectors[k, p], vectors[k, q]
                    vectors[k, p], vectors[k, q] = c * u - s * v, s * u + c * v
        if off < ANNIHILATED:
            break
    best = 0
    for k in range(1, 4):
        if n[k, k] > n[best, best]:
            best = k
    for k in range(4):
        vector[k] = vectors[k, best]


@step
def _matrix(w, x, y, z, rotation):
    rotation[0, 0], rotation[0, 1] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z)
    rotation[0, 2], rotation[1, 0] = 2 * (x * z + w * y), 2 * (x * y + w * z)
    rotation[1, 1], rotation[1, 2] = 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    rotation[2, 0], rotation[2, 1] = 2 * (x * z - w * y), 2 * (y * z + w * x)
    rotation[2, 2] = 1 - 2 * (x * x + y * y)


@step
def _rotate_by(rotation, u, v, w):
    """R <- exp([(u, v, w)]) R."""
    angle = math.sqrt(u * u + v * v + w * w)
    half = math.sin(angle / 2) / angle if angle > 1e-12 else 0.5
    change = np.empty((3, 3))
    _matrix(math.cos(angle / 2), half * u, half * v, half * w, change)
    for b in range(3):
        x, y, z = rotation[0, b], rotation[1, b], rotation[2, b]
        for a in range(3):
            rotation[a, b] = change[a, 0] * x + change[a, 1] * y + change[a, 2] * z


@step
def _cholesky(n):
    """Factor the lower triangle of n (6, 6) in place; False where it is numerically singular."""
    for j in range(6):
        own = n[j, j]
        s = own
        for k in range(j):
            s -= n[j, k] ** 2
        if not s > SINGULAR * own or not math.isfinite(s):
            return False
        n[j, j] = math.sqrt(s)
        for i in range(j + 1, 6):
            s = n[i, j]
            for k in range(j):
                s -= n[i, k] * n[j, k]
            n[i, j] = s / n[j, j]
    return True


@step
def _solve(factor, b):
    for i in range(6):
        for k in range(i):
            b[i] -= factor[i, k] * b[k]
        b[i] /= factor[i, i]
    for i in range(5, -1, -1):
        for k in range(i + 1, 6):
            b[i] -= factor[k, i] * b[k]
        b[i] /= factor[i, i]
