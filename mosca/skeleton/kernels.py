"""A skeleton's kinematics, compiled.

Degrees of freedom come in threes: those of body b's rotation, about its own axes, are 3 b to 3 b + 2, and the root's
translation is 0 to 2, so that three degrees of freedom belong to each body, the world included. What moves a body is
moved by its parent too. So matrices of the pose have non-zero elements only where one body is above the other. Rows
are stored packed: element n belongs to the n-th degree of freedom above, counted from the root, which is the same one
in the rows of all bodies between. The factorisation without fill-in is that of the joint-space inertia (Featherstone
2008, section 6.5).
"""

import math
from typing import NamedTuple

import numpy as np

from mosca.data.arrays import Array
from mosca.numba_support.decorators import bare_step, kernel, step


class Tree(NamedTuple):
    """Bodies, parents first, and their markers.

    ``parent`` (nbody,), -1 for the world; ``offset`` (nbody, 3) [m] and ``turn`` (nbody, 4) wxyz of each body in its
    parent; ``body`` (m,) that carries each marker at ``local`` (m, 3) [m]; ``dofs`` (nbody, k) degrees of freedom
    that move a body, ascending, padded with -1; ``dof_count`` (nbody,) their number.
    """

    parent: Array
    offset: Array
    turn: Array
    body: Array
    local: Array
    dofs: Array
    dof_count: Array


class Placed(NamedTuple):
    """A posed skeleton in the world: ``rotation`` (nbody, 3, 3) world_from_body, ``origin`` (nbody, 3), ``marker``
    (m, 3), and ``shift`` (nbody, 3, 3): the velocity at the root's origin by each body's degrees of freedom.
    """

    rotation: Array
    origin: Array
    marker: Array
    shift: Array


@bare_step
def multiply(a, q, first, out):
    """Fill ``out`` (4,) with the product of the quaternions ``a`` (4,) and q[first : first + 4]."""
    w, x, y, z = q[first], q[first + 1], q[first + 2], q[first + 3]
    out[0], out[1], out[2], out[3] = (
        a[0] * w - a[1] * x - a[2] * y - a[3] * z,
        a[0] * x + a[1] * w + a[2] * z - a[3] * y,
        a[0] * y - a[1] * z + a[2] * w + a[3] * x,
        a[0] * z + a[1] * y - a[2] * x + a[3] * w,
    )


@bare_step
def normalise(q, first):
    """Scale the quaternion from element ``first`` of ``q`` on to length 1."""
    length = math.sqrt(q[first] ** 2 + q[first + 1] ** 2 + q[first + 2] ** 2 + q[first + 3] ** 2)
    for k in range(4):
        q[first + k] /= length


@step
def place_bodies(tree, q, placed):
    """Fill ``placed``, as ``place`` does."""
    rotation, origin, marker, shift = placed
    rotation[0], shift[0], origin[0] = 0.0, 0.0, 0.0
    for a in range(3):
        rotation[0, a, a] = shift[0, a, a] = 1.0
    world, relative = np.zeros((len(origin), 4)), np.empty(4)
    world[0, 0] = 1.0
    for b in range(1, len(origin)):
        parent = tree.parent[b]
        if b == 1:
            for a in range(4):
                world[b, a] = q[3 + a]
            for a in range(3):
                origin[b, a] = q[a]
        else:
            multiply(world[parent], tree.turn[b], 0, relative)
            multiply(relative, q, 4 * b - 1, world[b])
            _carry(rotation[parent], origin[parent], tree.offset[b], origin[b])
        normalise(world[b], 0)
        w, x, y, z = world[b, 0], world[b, 1], world[b, 2], world[b, 3]
        r = rotation[b]
        r[0, 0], r[0, 1], r[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
        r[1, 0], r[1, 1], r[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
        r[2, 0], r[2, 1], r[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
        dx, dy, dz = origin[1, 0] - origin[b, 0], origin[1, 1] - origin[b, 1], origin[1, 2] - origin[b, 2]
        for k in range(3):
            shift[b, 0, k] = r[1, k] * dz - r[2, k] * dy
            shift[b, 1, k] = r[2, k] * dx - r[0, k] * dz
            shift[b, 2, k] = r[0, k] * dy - r[1, k] * dx
    for j in range(len(marker)):
        _carry(rotation[tree.body[j]], origin[tree.body[j]], tree.local[j], marker[j])


@bare_step
def _carry(rotation, origin, local, out):
    for a in range(3):
        out[a] = origin[a] + rotation[a, 0] * local[0] + rotation[a, 1] * local[1] + rotation[a, 2] * local[2]


@kernel
def place(tree, q, placed):
    """Fill ``placed`` for the pose ``q`` (nq,): root's place [m] and quaternion, then a quaternion for each joint."""
    place_bodies(tree, q, placed)


@bare_step
def rotation_vector(q, first, vector, slope):
    """Fill a quaternion's rotation vector (3,) and its derivative (3, 3) by a turn about the body's axes.

    The derivative is the inverse of the right Jacobian of the rotation group (Sola et al. 2018, eq. 144).
    """
    sign = -1.0 if q[first] < 0 else 1.0
    x, y, z = sign * q[first + 1], sign * q[first + 2], sign * q[first + 3]
    sine = math.sqrt(x * x + y * y + z * z)
    angle = 2 * math.atan2(sine, abs(q[first]))
    factor = angle / sine if sine > 1e-9 else 2.0
    vector[0], vector[1], vector[2] = factor * x, factor * y, factor * z
    half = angle / 2
    square = (1 - half / math.tan(half)) / (angle * angle) if angle > 1e-4 else 1 / 12
    length2 = vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2
    for i in range(3):
        for j in range(3):
            slope[i, j] = square * vector[i] * vector[j]
    for i in range(3):
        slope[i, i] += 1 - square * length2
        j, k = (i + 1) % 3, (i + 2) % 3
        slope[k, j] += vector[i] / 2
        slope[j, k] -= vector[i] / 2


@kernel
def rotation_vectors(q, vectors, slopes):
    """Fill the rotation vectors (b, 3) [rad] of the joints in ``q`` (nq,) and their derivatives (b, 3, 3)."""
    for k in range(len(vectors)):
        rotation_vector(q, 7 + 4 * k, vectors[k], slopes[k])


@bare_step
def factor(tree, rows):
    """Factor packed rows (nv, k) in place into L' D L, L with a unit diagonal; return whether D is positive."""
    for d in range(len(rows) - 1, -1, -1):
        dofs, depth = tree.dofs[d // 3], tree.dof_count[d // 3] - 3 + d % 3
        if not rows[d, depth] > 0.0:
            return False
        for n in range(depth):
            share = rows[d, n] / rows[d, depth]
            above = rows[dofs[n]]
            for i in range(n + 1):
                above[i] -= share * rows[d, i]
        for n in range(depth):
            rows[d, n] /= rows[d, depth]
    return True


@kernel
def fill_slopes(tree, placed, bodies, points, slopes):
    """Fill the derivatives (n, 3, nv), given as 0, of ``points`` (n, 3) fixed to ``bodies`` (n,) by the pose."""
    for j in range(len(points)):
        point_slopes(tree, placed, bodies[j], points[j], slopes[j])


@kernel
def unpack(tree, rows, normal):
    """Fill a symmetric matrix (nv, nv), given as 0, from its packed rows."""
    for d in range(len(rows)):
        for n in range(tree.dof_count[d // 3] - 2 + d % 3):
            normal[d, tree.dofs[d // 3, n]] = normal[tree.dofs[d // 3, n], d] = rows[d, n]


@bare_step
def point_slopes(tree, placed, body, point, slopes):
    """Fill the derivatives (3, nv), given as 0, of a ``point`` (3,) fixed to a body by the pose."""
    x, y, z = point[0] - placed.origin[1, 0], point[1] - placed.origin[1, 1], point[2] - placed.origin[1, 2]
    for n in range(tree.dof_count[body] if body > 0 else 0):
        d = tree.dofs[body, n]
        b, k = d // 3, d % 3
        slopes[0, d], slopes[1, d], slopes[2, d] = placed.shift[b, 0, k], placed.shift[b, 1, k], placed.shift[b, 2, k]
        if b > 0:
            ax, ay, az = placed.rotation[b, 0, k], placed.rotation[b, 1, k], placed.rotation[b, 2, k]
            slopes[0, d] += ay * z - az * y
            slopes[1, d] += az * x - ax * z
            slopes[2, d] += ax * y - ay * x
