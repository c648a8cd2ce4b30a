"""Normal equations of a pose, compiled: a marker is moved by the joints above it alone."""

import math
from typing import NamedTuple

import numpy as np

from mosca.data.arrays import Array
from mosca.numba_support.decorators import kernel


class Moving(NamedTuple):
    """What moves the markers: ``body`` (m,) that carries each, ``dofs`` (nbody, k) degrees of freedom that move a
    body, ascending, -1 at the end; ``axes``, ``along`` (nv, 3) of each about ``centre`` (3,), as MuJoCo's cdof.
    """

    body: Array
    dofs: Array
    axes: Array
    along: Array
    centre: Array


class PoseEquations(NamedTuple):
    """``slopes`` (m, 3, nv), ``weight`` (m,), ``residual`` (m, 3), ``normal`` (nv, nv) and ``gradient`` (nv,)."""

    slopes: Array
    weight: Array
    residual: Array
    normal: Array
    gradient: Array


@kernel
def fill_equations(places, target, information, robust, moving, filled):
    """Fill the equations of a pose by its markers; return their cost (Huber 1964).

    ``places`` (m, 3) of the model's markers and ``target`` (m, 3), NaN where not measured; ``information`` (m, 3, 3).
    """
    slopes, weight, residual, normal, gradient = filled
    body, axes, along, centre = moving.body, moving.axes, moving.along, moving.centre
    m, nv = len(places), len(gradient)
    slopes[:] = 0.0
    normal[:] = 0.0
    gradient[:] = 0.0
    shaped = np.empty((3, nv))
    cost = 0.0
    for j in range(m):
        dofs = moving.dofs[body[j]]
        x, y, z = places[j, 0] - centre[0], places[j, 1] - centre[1], places[j, 2] - centre[2]
        for d in dofs:
            if d < 0:
                break
            slopes[j, 0, d] = along[d, 0] + axes[d, 1] * z - axes[d, 2] * y
            slopes[j, 1, d] = along[d, 1] + axes[d, 2] * x - axes[d, 0] * z
            slopes[j, 2, d] = along[d, 2] + axes[d, 0] * y - axes[d, 1] * x
        weight[j] = 1.0
        residual[j] = 0.0
        if not math.isfinite(target[j, 0]) or information[j, 0, 0] == 0.0:
            continue
        square = 0.0
        for a in range(3):
            residual[j, a] = target[j, a] - places[j, a]
        for a in range(3):
            for b in range(3):
                square += residual[j, a] * information[j, a, b] * residual[j, b]
        distance = math.sqrt(max(square, 0.0))
        if distance > robust:
            weight[j] = robust / distance
            cost += robust * (2 * distance - robust)
        else:
            cost += square
        for d in dofs:
            if d < 0:
                break
            for a in range(3):
                total = 0.0
                for b in range(3):
                    total += information[j, a, b] * slopes[j, b, d]
                shaped[a, d] = weight[j] * total
                gradient[d] += shaped[a, d] * residual[j, a]
        for d in dofs:
            if d < 0:
                break
            for e in dofs:
                if e < 0 or e > d:
                    break
                total = 0.0
                for a in range(3):
                    total += slopes[j, a, d] * shaped[a, e]
                normal[d, e] += total
    for d in range(nv):
        for e in range(d):
            normal[e, d] = normal[d, e]
    return cost
