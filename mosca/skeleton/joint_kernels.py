"""Covariances of joints' centres and rotations from those of a pose and of its model's parameters, compiled.

A joint's change is A y + D c, with y the change of the pose and c that of the parameters. Least squares gives
y = -H^-1 M c, with H the normal matrix of the pose and M its block with the parameters; noise gives y the covariance
H^-1. Neither M nor A is ever formed. Instead, columns of a root of the covariance of c are passed up and down the
tree of bodies, WIDE at a time: as displacements of the markers, forces at them, sums of forces over the bodies below,
and turns and shifts of bodies (Featherstone 2008, chapter 5).
"""

from typing import NamedTuple

import numpy as np

from mosca.data.arrays import Array
from mosca.numba_support.decorators import bare_step, kernel, step
from mosca.skeleton.kernels import factor, point_slopes

WIDE = 64
"""Columns at a time: measured, 32 take 1.15 times as long and 128 no less."""


FAST = {"contract", "reassoc"}
"""Sums in any order, products added in one instruction."""


class JointTable(NamedTuple):
    """j joints. A joint's centre is the midpoint of the origins of the two bodies ``ends`` (j, 2), -1 for none; it
    joins the bodies ``near`` and ``far`` (j,) with the axes ``near_axes``, ``far_axes`` (j, 3, 3), 0 where not
    ``known`` (j,).
    """

    ends: Array
    near: Array
    far: Array
    near_axes: Array
    far_axes: Array
    known: Array


class Spread(NamedTuple):
    """Roots of covariances, k columns in blocks of WIDE: ``columns`` (blocks, p, WIDE) displacements of joints in
    their parents and of markers in their bodies [m]; ``near``, ``far`` (blocks, j, 3, WIDE) the turns of the axes of
    the joints' bodies by these displacements [rad]; ``near_own``, ``far_own`` (j, 3, l) turns of the axes alone.
    """

    columns: Array
    near: Array
    far: Array
    near_own: Array
    far_own: Array


@bare_step(fastmath=FAST)
def _add(matrix, first, x, sign, y):
    """Add sign times ``matrix`` (3, 3), from its column ``first`` on, times ``x`` (3, WIDE) to ``y`` (3, WIDE)."""
    for i in range(3):
        a, b, c = sign * matrix[i, first], sign * matrix[i, first + 1], sign * matrix[i, first + 2]
        for k in range(x.shape[1]):
            y[i, k] += a * x[0, k] + b * x[1, k] + c * x[2, k]


@bare_step(fastmath=FAST)
def _add_transposed(matrix, first, x, sign, y):
    """As ``_add`` with the transposed matrix."""
    for i in range(3):
        a, b, c = sign * matrix[0, first + i], sign * matrix[1, first + i], sign * matrix[2, first + i]
        for k in range(x.shape[1]):
            y[i, k] += a * x[0, k] + b * x[1, k] + c * x[2, k]


@bare_step(fastmath=FAST)
def _add_moved(placed, point, turn, shift, share, y):
    """Add ``share`` of a ``point``'s (3,) movement by its body's ``turn`` and ``shift`` at the root's origin."""
    wide = y.shape[1]
    arm_x, arm_y, arm_z = (
        share * (point[0] - placed.origin[1, 0]),
        share * (point[1] - placed.origin[1, 1]),
        share * (point[2] - placed.origin[1, 2]),
    )
    for k in range(wide):
        y[0, k] += share * shift[0, k] + turn[1, k] * arm_z - turn[2, k] * arm_y
        y[1, k] += share * shift[1, k] + turn[2, k] * arm_x - turn[0, k] * arm_z
        y[2, k] += share * shift[2, k] + turn[0, k] * arm_y - turn[1, k] * arm_x


@bare_step(fastmath=FAST)
def _add_square(x, covariance):
    """Add the products of the rows of ``x`` (3, WIDE) to ``covariance`` (3, 3)."""
    wide = x.shape[1]
    for i in range(3):
        for j in range(i + 1):
            total = 0.0
            for k in range(wide):
                total += x[i, k] * x[j, k]
            covariance[i, j] += total
            if i != j:
                covariance[j, i] += total


@bare_step(fastmath=FAST)
def _add_row(share, x, y):
    """Add ``share`` of ``x`` (WIDE,) to ``y`` (WIDE,)."""
    for k in range(x.shape[0]):
        y[k] += share * x[k]


@bare_step
def _solve(tree, rows, y):
    """Solve L' D L y = y in place for columns ``y`` (nbody, 3, WIDE); ``rows`` as ``factor`` leaves them."""
    for b in range(len(y) - 1, -1, -1):
        own, last = rows[3 * b : 3 * b + 3], tree.dof_count[b] - 3
        for i in range(2, 0, -1):
            for n in range(i):
                _add_row(-own[i, last + n], y[b, i], y[b, n])
        for n in range(0, last, 3):
            _add_transposed(own, n, y[b], -1.0, y[tree.dofs[b, n] // 3])
    for b in range(len(y)):
        own, last = rows[3 * b : 3 * b + 3], tree.dof_count[b] - 3
        for i in range(3):
            for k in range(y.shape[2]):
                y[b, i, k] /= own[i, last + i]
        for n in range(0, last, 3):
            _add(own, n, y[tree.dofs[b, n] // 3], -1.0, y[b])
        for i in range(1, 3):
            for n in range(i):
                _add_row(-own[i, last + n], y[b, n], y[b, i])


@step
def _pose_noise(tree, placed, table, rows, covariance):
    """Add the part from noise of the pose, A H^-1 A', to ``covariance`` (2, j, 3, 3)."""
    nv = len(rows)
    slopes, ends = np.empty((3, nv)), np.empty((3, nv))
    for j in range(len(table.near)):
        for what in range(2):
            for a in range(3):
                for d in range(nv):
                    slopes[a, d] = 0.0
            if what == 0 and table.ends[j, 0] >= 0:
                for end in table.ends[j]:
                    for a in range(3):
                        for d in range(nv):
                            ends[a, d] = 0.0
                    point_slopes(tree, placed, end, placed.origin[end], ends)
                    for a in range(3):
                        for d in range(nv):
                            slopes[a, d] += ends[a, d] / 2
            elif what == 1:
                _turn_slopes(tree, placed, table.far[j], table.far_axes[j], table.far[j], 1.0, slopes)
                _turn_slopes(tree, placed, table.near[j], table.far_axes[j], table.far[j], -1.0, slopes)
            for d in range(nv - 1, -1, -1):
                dofs, depth = tree.dofs[d // 3], tree.dof_count[d // 3] - 3 + d % 3
                for a in range(3):
                    value = slopes[a, d]
                    if value != 0.0:
                        for n in range(depth):
                            slopes[a, dofs[n]] -= rows[d, n] * value
                for a in range(3):
                    for b in range(3):
                        covariance[what, j, a, b] += slopes[a, d] * slopes[b, d] / rows[d, depth]


@bare_step
def _turn_slopes(tree, placed, body, axes, carrier, sign, slopes):
    """Add sign times a body's turn by the pose, in ``axes`` (3, 3) of the body ``carrier``, to ``slopes`` (3, nv)."""
    for n in range(3, tree.dof_count[body]):
        d = tree.dofs[body, n]
        for i in range(3):
            total = 0.0
            for a in range(3):
                world = 0.0
                for c in range(3):
                    world += placed.rotation[carrier, a, c] * axes[c, i]
                total += world * placed.rotation[d // 3, a, d % 3]
            slopes[i, d] += sign * total


@step
def _rotations(placed, table, far_from_world, far_from_near, rotation):
    """Fill far_from_world, far_from_near (j, 3, 3), and ``rotation``, near from far (j, 3, 3), NaN if unknown."""
    near = np.empty((3, 3))
    for j in range(len(table.near)):
        for a in range(3):
            for i in range(3):
                far_from_world[j, i, a], near[a, i] = 0.0, 0.0
                for c in range(3):
                    far_from_world[j, i, a] += placed.rotation[table.far[j], a, c] * table.far_axes[j, c, i]
                    near[a, i] += placed.rotation[table.near[j], a, c] * table.near_axes[j, c, i]
        for i in range(3):
            for k in range(3):
                far_from_near[j, i, k] = 0.0
                for a in range(3):
                    far_from_near[j, i, k] += far_from_world[j, i, a] * near[a, k]
                rotation[j, k, i] = far_from_near[j, i, k] if table.known[j] else np.nan


@step
def _own_axes(table, spread, far_from_near, covariance):
    """Add the part from the axes' own turns to the rotations' ``covariance`` (j, 3, 3)."""
    turn = np.empty(3)
    for j in range(len(table.near)):
        for k in range(spread.far_own.shape[2]):
            for i in range(3):
                turn[i] = spread.far_own[j, i, k]
                for a in range(3):
                    turn[i] -= far_from_near[j, i, a] * spread.near_own[j, a, k]
            for i in range(3):
                for a in range(3):
                    covariance[j, i, a] += turn[i] * turn[a]


@kernel
def read_joints(tree, placed, normal, weighted, tiny, table, spread, out):
    """Fill ``out``: centres (j, 3), rotations (j, 3, 3), covariances (2, j, 3, 3) of both.

    ``placed``: the pose, with its ``normal`` matrix H (nv, nv), to whose diagonal ``tiny`` is added; ``weighted``
    (m, 3, 3) information of the markers. Returns whether H is positive definite.
    """
    centre, rotation, covariance = out
    nbody, j = len(tree.parent), len(table.near)
    rows = np.zeros((len(normal), tree.dofs.shape[1]))
    for d in range(len(rows)):
        for n in range(tree.dof_count[d // 3] - 2 + d % 3):
            above = tree.dofs[d // 3, n]
            rows[d, n] = normal[d, above] + (tiny if above == d else 0.0)
    if not factor(tree, rows):
        return False
    far_from_world, far_from_near = np.empty((j, 3, 3)), np.empty((j, 3, 3))
    _rotations(placed, table, far_from_world, far_from_near, rotation)
    covariance[:] = 0.0
    _pose_noise(tree, placed, table, rows, covariance)
    _own_axes(table, spread, far_from_near, covariance[1])
    torque = np.empty((len(weighted), 3, 3))
    for i in range(len(weighted)):
        _torques(placed, i, weighted[i], torque[i])
    shape = (nbody, 3, WIDE)
    work = np.empty(shape), np.empty(shape), np.empty(shape), np.empty(shape)
    for block in range(len(spread.columns)):
        _turns_and_shifts(tree, placed, rows, weighted, torque, spread.columns[block], work)
        _add_joints(placed, table, far_from_world, far_from_near, spread, block, work, covariance)
    for k in range(j):
        a, b = table.ends[k, 0], table.ends[k, 1]
        for i in range(3):
            centre[k, i] = (placed.origin[a, i] + placed.origin[b, i]) / 2 if a >= 0 else np.nan
            for c in range(3):
                if a < 0:
                    covariance[0, k, i, c] = np.nan
                if not table.known[k]:
                    covariance[1, k, i, c] = np.nan
    return True


@bare_step
def _torques(placed, i, weighted, out):
    """Fill the torques (3, 3) about the root's origin of the force ``weighted`` (3, 3) at marker i."""
    x, y, z = (
        placed.marker[i, 0] - placed.origin[1, 0],
        placed.marker[i, 1] - placed.origin[1, 1],
        placed.marker[i, 2] - placed.origin[1, 2],
    )
    for a in range(3):
        out[0, a] = y * weighted[2, a] - z * weighted[1, a]
        out[1, a] = z * weighted[0, a] - x * weighted[2, a]
        out[2, a] = x * weighted[1, a] - y * weighted[0, a]


@step
def _turns_and_shifts(tree, placed, rows, weighted, torque, columns, work):
    """Fill ``work``, each (nbody, 3, WIDE): displacements of the bodies' origins by ``columns`` (p, WIDE) at a fixed
    pose, the pose's change, and the bodies' turns and shifts at the root's origin by this change.
    """
    wide = columns.shape[1]
    moved, change, turn, shift = work
    nbody = len(tree.parent)
    first = 3 * (nbody - 2)
    for b in range(nbody):
        for i in range(3):
            for k in range(wide):
                moved[b, i, k] = moved[tree.parent[b], i, k] if b > 1 else 0.0
                change[b, i, k] = turn[b, i, k] = shift[b, i, k] = 0.0
        if b > 1:
            _add(placed.rotation[tree.parent[b]], 0, columns[3 * b - 6 : 3 * b - 3], 1.0, moved[b])
    place = change[0]
    for m in range(len(weighted)):
        b, local = tree.body[m], columns[first + 3 * m : first + 3 * m + 3]
        if b > 0:
            for i in range(3):
                for k in range(wide):
                    place[i, k] = moved[b, i, k]
            _add(placed.rotation[b], 0, local, 1.0, place)
            _add(torque[m], 0, place, 1.0, turn[b])
            _add(weighted[m], 0, place, 1.0, shift[b])
    for b in range(nbody - 1, -1, -1):
        for i in range(3):
            for k in range(wide):
                change[b, i, k] = 0.0
                if b > 0:
                    turn[tree.parent[b], i, k] += turn[b, i, k]
                    shift[tree.parent[b], i, k] += shift[b, i, k]
        _add_transposed(placed.shift[b], 0, shift[b], -1.0, change[b])
        if b > 0:
            _add_transposed(placed.rotation[b], 0, turn[b], -1.0, change[b])
    _solve(tree, rows, change)
    for b in range(nbody):
        for i in range(3):
            for k in range(wide):
                turn[b, i, k] = turn[tree.parent[b], i, k] if b > 0 else 0.0
                shift[b, i, k] = shift[tree.parent[b], i, k] if b > 0 else 0.0
        _add(placed.shift[b], 0, change[b], 1.0, shift[b])
        if b > 0:
            _add(placed.rotation[b], 0, change[b], 1.0, turn[b])


@step
def _add_joints(placed, table, far_from_world, far_from_near, spread, block, work, covariance):
    """Add the part from a block of columns to the joints' ``covariance`` (2, j, 3, 3)."""
    moved, _, turn, shift = work
    found, difference = np.empty((3, WIDE)), np.empty((3, WIDE))
    wide = found.shape[1]
    for j in range(len(table.near)):
        near, far = table.near[j], table.far[j]
        if table.ends[j, 0] >= 0:
            for i in range(3):
                for k in range(wide):
                    found[i, k] = (moved[table.ends[j, 0], i, k] + moved[table.ends[j, 1], i, k]) / 2
            for end in table.ends[j]:
                _add_moved(placed, placed.origin[end], turn[end], shift[end], 0.5, found)
            _add_square(found, covariance[0, j])
        if table.known[j]:
            for i in range(3):
                for k in range(wide):
                    found[i, k] = spread.far[block, j, i, k]
                    difference[i, k] = turn[far, i, k] - turn[near, i, k]
            _add(far_from_world[j], 0, difference, 1.0, found)
            _add(far_from_near[j], 0, spread.near[block, j], -1.0, found)
            _add_square(found, covariance[1, j])
