"""Rotations of cameras and placements, and a-priori values of points as observations; compiled."""

import numpy as np

from mosca.calibration.bundle.tables import EliminatedBlocks, Known, NormalEquations, ParameterValues
from mosca.data.arrays import Array
from mosca.numba_support.decorators import kernel


@kernel
def rotate_by(rotation: Array, step: Array) -> None:
    """Rotate (n, 9 or more; the first nine, row by row) in place about their own axes by vectors (n, 3)."""
    e, r = np.empty((3, 3)), np.empty(9)
    for n in range(rotation.shape[0]):
        x, y, z = step[n, 0], step[n, 1], step[n, 2]
        a2 = x * x + y * y + z * z
        a = np.sqrt(a2)
        s, c = (1 - a2 / 6, 0.5 - a2 / 24) if a < 1e-4 else (np.sin(a) / a, (1 - np.cos(a)) / a2)
        e[0, 0], e[0, 1], e[0, 2] = 1 - c * (y * y + z * z), c * x * y - s * z, c * x * z + s * y
        e[1, 0], e[1, 1], e[1, 2] = c * x * y + s * z, 1 - c * (x * x + z * z), c * y * z - s * x
        e[2, 0], e[2, 1], e[2, 2] = c * x * z - s * y, c * y * z + s * x, 1 - c * (x * x + y * y)
        for i in range(9):
            r[i] = rotation[n, i]
        for i in range(3):
            for k in range(3):
                rotation[n, 3 * i + k] = r[3 * i] * e[0, k] + r[3 * i + 1] * e[1, k] + r[3 * i + 2] * e[2, k]


@kernel
def observed_blocks(
    state: ParameterValues, blocks: EliminatedBlocks, known: Known, normals: NormalEquations
) -> float:
    """Add the observed coordinates of eliminated points; return their cost."""
    points, given, information = state.points, known.points, known.information
    dim, at_v, at_g, member = blocks.size, blocks.normals_at, blocks.slope_at, blocks.members
    block_normals, block_slope = normals.blocks, normals.block_slope
    cost = 0.0
    if information.size:
        for k in range(member.shape[0]):
            point, b, at = member[k, 0], member[k, 1], member[k, 2]
            for i in range(3):
                pull = 0.0
                for c in range(3):
                    if information[point, i, c] != 0.0:
                        pull += information[point, i, c] * (points[point, c] - given[point, c])
                        block_normals[at_v[b] + (at + i) * dim[b] + at + c] += information[point, i, c]
                if pull != 0.0:
                    block_slope[at_g[b] + at + i] += pull
                    cost += pull * (points[point, i] - given[point, i])
    return cost
