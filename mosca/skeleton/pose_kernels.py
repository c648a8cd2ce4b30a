"""The pose that fits a skeleton's markers best, compiled: damped Gauss-Newton.

Sums over the bodies below are composite, as for the joint-space inertia (Featherstone 2008, section 6.2), with the
markers' information in place of masses. Rows of matrices are packed as in ``mosca.skeleton.kernels``.
"""

import math
from typing import NamedTuple

import numpy as np

from mosca.data.arrays import Array
from mosca.numba_support.decorators import bare_step, kernel, step
from mosca.numba_support.linalg3 import inverse3, plus_identity3, store3, symmetric3
from mosca.skeleton.kernels import factor, multiply, normalise, place_bodies, rotation_vector


class RotationPrior(NamedTuple):
    """Prior of the joints' rotation vectors: ``weight`` and ``mean`` (nbody, 3), 0 for world and root."""

    weight: Array
    mean: Array


class PoseEquations(NamedTuple):
    """``q`` (nq,), ``weight`` (m,), ``residual`` (m, 3), ``rows`` (nv, k) the normal matrix, packed, and ``gradient``
    (nv,).
    """

    q: Array
    weight: Array
    residual: Array
    rows: Array
    gradient: Array


@kernel
def information_of(xyz, covariance, sigma_m, information):
    """Fill the inverse (m, 3, 3) of each ``covariance`` (m, 3, 3) with ``sigma_m`` (m,); 0 where ``xyz`` is NaN."""
    for j in range(len(xyz)):
        if math.isfinite(xyz[j, 0]):
            store3(inverse3(plus_identity3(symmetric3(covariance[j]), sigma_m[j] ** 2)), information[j])
        else:
            information[j] = 0.0


@step
def _equations(tree, placed, prior, target, information, robust, filled):
    """Fill the equations at the pose of ``filled``; return their cost (Huber 1964)."""
    q, weight, residual, rows, gradient = filled
    place_bodies(tree, q, placed)
    nbody = len(tree.parent)
    below, pull = np.zeros((nbody, 6, 6)), np.zeros((nbody, 6))
    cost = 0.0
    for j in range(len(target)):
        weight[j] = 1.0
        residual[j] = 0.0
        if math.isfinite(target[j, 0]) and information[j, 0, 0] != 0.0:
            b = tree.body[j]
            cost += _weigh(placed, j, target, information[j], robust, weight, residual)
            if b > 0:
                _add_marker(placed, j, weight[j], information[j], residual[j], below[b], pull[b])
    rows[:] = 0.0
    vector, slope, moved = np.empty(3), np.empty((3, 3)), np.empty((3, 6))
    for b in range(nbody - 1, -1, -1):
        if b > 0:
            for i in range(6):
                pull[tree.parent[b], i] += pull[b, i]
                for a in range(6):
                    below[tree.parent[b], i, a] += below[b, i, a]
        last = tree.dof_count[b] - 3
        for k in range(3):
            for i in range(6):
                total = 0.0
                for a in range(3):
                    total += below[b, i, 3 + a] * placed.shift[b, a, k]
                    if b > 0:
                        total += below[b, i, a] * placed.rotation[b, a, k]
                moved[k, i] = total
            gradient[3 * b + k] = _along(placed, b, k, pull[b])
        for n in range(0, last + 3, 3):
            above = tree.dofs[b, n] // 3
            for k in range(3):
                for i in range(3):
                    rows[3 * b + k, n + i] = _along(placed, above, i, moved[k])
        if b > 1:
            rotation_vector(q, 4 * b - 1, vector, slope)
            for a in range(3):
                off = vector[a] - prior.mean[b, a]
                shaped = prior.weight[b, a] * off
                cost += shaped * off
                for k in range(3):
                    gradient[3 * b + k] -= slope[a, k] * shaped
                    for i in range(3):
                        rows[3 * b + k, last + i] += slope[a, k] * prior.weight[b, a] * slope[a, i]
    return cost


@bare_step
def _weigh(placed, j, target, information, robust, weight, residual):
    """Set a marker's residual and weight; return its cost."""
    square = 0.0
    for a in range(3):
        residual[j, a] = target[j, a] - placed.marker[j, a]
    for a in range(3):
        for b in range(3):
            square += residual[j, a] * information[a, b] * residual[j, b]
    distance = math.sqrt(max(square, 0.0))
    if distance > robust:
        weight[j] = robust / distance
        return robust * (2 * distance - robust)
    return square


@bare_step
def _add_marker(placed, j, weight, information, residual, below, pull):
    """Add a marker's information (6, 6) and pull (6,) about the root's origin: turn, then shift."""
    x, y, z = (
        placed.marker[j, 0] - placed.origin[1, 0],
        placed.marker[j, 1] - placed.origin[1, 1],
        placed.marker[j, 2] - placed.origin[1, 2],
    )
    for a in range(3):
        # column a of the weighted information, as a force at the marker
        fx, fy, fz = weight * information[0, a], weight * information[1, a], weight * information[2, a]
        mx, my, mz = y * fz - z * fy, z * fx - x * fz, x * fy - y * fx
        column = (mx, my, mz, fx, fy, fz)
        b, c = (a + 1) % 3, (a + 2) % 3
        arm_b = (x, y, z)[b]
        arm_c = (x, y, z)[c]
        for i in range(6):
            below[i, 3 + a] += column[i]
            below[i, b] += arm_c * column[i]
            below[i, c] -= arm_b * column[i]
            pull[i] += column[i] * residual[a]


@bare_step
def _along(placed, b, k, wrench):
    """Return the work of a ``wrench`` (6,) on degree of freedom k of body b."""
    total = 0.0
    for a in range(3):
        total += placed.shift[b, a, k] * wrench[3 + a]
        if b > 0:
            total += placed.rotation[b, a, k] * wrench[a]
    return total


@bare_step
def _solve(tree, rows, x):
    """Solve in place for ``x`` (nv,) with rows as ``factor`` leaves them."""
    for d in range(len(rows) - 1, -1, -1):
        dofs, depth = tree.dofs[d // 3], tree.dof_count[d // 3] - 3 + d % 3
        for n in range(depth):
            x[dofs[n]] -= rows[d, n] * x[d]
    for d in range(len(rows)):
        dofs, depth = tree.dofs[d // 3], tree.dof_count[d // 3] - 3 + d % 3
        x[d] /= rows[d, depth]
        for n in range(depth):
            x[d] -= rows[d, n] * x[dofs[n]]


@step
def _moved(q, step, out):
    """Fill the pose ``q`` moved by the tangent vector ``step`` (nv,), turns about the bodies' own axes."""
    for a in range(3):
        out[a] = q[a] + step[a]
    turn = np.empty(4)
    for b in range(1, len(step) // 3):
        x, y, z = step[3 * b], step[3 * b + 1], step[3 * b + 2]
        angle = math.sqrt(x * x + y * y + z * z)
        sine = math.sin(angle / 2) / angle if angle > 1e-12 else 0.5
        turn[0], turn[1], turn[2], turn[3] = math.cos(angle / 2), sine * x, sine * y, sine * z
        multiply(q[4 * b - 1 : 4 * b + 3], turn, 0, out[4 * b - 1 : 4 * b + 3])
        normalise(out, 4 * b - 1)


@step
def _empty(tree, q):
    m, nv = len(tree.body), 3 * len(tree.parent)
    return PoseEquations(np.copy(q), np.empty(m), np.empty((m, 3)), np.empty((nv, tree.dofs.shape[1])), np.empty(nv))


@step
def _step_of(tree, at, damping, tiny, largest_turn, rows, step):
    """Fill the damped step (nv,), shortened to ``largest_turn``; return whether there is one."""
    for d in range(len(step)):
        step[d] = at.gradient[d]
        depth = tree.dof_count[d // 3] - 3 + d % 3
        for n in range(depth + 1):
            rows[d, n] = at.rows[d, n]
        rows[d, depth] += damping * rows[d, depth] + tiny
    if not factor(tree, rows):
        return False
    _solve(tree, rows, step)
    turn = _largest(step, 3)
    if turn > largest_turn:
        for d in range(len(step)):
            step[d] *= largest_turn / turn
    return True


@bare_step
def _largest(values, first):
    largest = 0.0
    for k in range(first, len(values)):
        largest = max(largest, abs(values[k]))
    return largest


@kernel
def fit_pose(tree, placed, prior, q, target, information, robust, iterations, limits):
    """Improve a pose by damped Gauss-Newton; return the equations at the best, the cost and whether it converged.

    With ``iterations`` 0, return the equations at ``q``. ``target`` (m, 3), NaN where not measured; ``information``
    (m, 3, 3). ``limits``: the step below which a pose has converged, the largest turn, and the term added to the
    normal matrix' diagonal. The cost is NaN where the normal matrix is not positive definite. ``placed`` is left in
    the best pose.
    """
    settled_at, largest_turn, tiny = limits
    best, trial = _empty(tree, q), _empty(tree, q)
    rows, step = np.empty_like(best.rows), np.empty_like(best.gradient)
    damping, settled = 0.0, False
    cost = _equations(tree, placed, prior, target, information, robust, best)
    for _ in range(iterations):
        if not _step_of(tree, best, damping, tiny, largest_turn, rows, step):
            return best, np.nan, False
        _moved(best.q, step, trial.q)
        new = _equations(tree, placed, prior, target, information, robust, trial)
        settled = _largest(step, 0) < settled_at
        if new <= cost * (1 + 1e-9):
            best, trial, cost = trial, best, new
            damping = damping / 10 if damping > 1e-3 else 0.0
        else:
            damping = max(10 * damping, 1e-3)
        if settled:
            break
    place_bodies(tree, best.q, placed)
    return best, cost, settled
