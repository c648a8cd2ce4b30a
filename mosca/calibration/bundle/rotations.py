"""Rotations of cameras and placements, and a-priori values of poses and points as observations; compiled."""

import numpy as np

from mosca.calibration.bundle.tables import EliminatedBlocks, Known, NormalEquations, ParameterValues
from mosca.data.arrays import Array
from mosca.numba_support.decorators import kernel, step


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


@step
def rotation_vector(r: Array) -> tuple[float, float, float]:
    """Rotation matrix (3, 3) -> rotation vector, its three components, for angles well below pi."""
    x, y, z = (r[2, 1] - r[1, 2]) / 2, (r[0, 2] - r[2, 0]) / 2, (r[1, 0] - r[0, 1]) / 2
    sine = np.sqrt(x * x + y * y + z * z)
    angle = np.arctan2(sine, (r[0, 0] + r[1, 1] + r[2, 2] - 1) / 2)
    longer = angle / sine if sine > 1e-9 else 1.0
    return x * longer, y * longer, z * longer


@kernel
def observed_pose(pose: Array, given: Array, weight: Array, normals: Array, slope: Array) -> float:
    """Add an observed pose to ``normals`` (6, 6), ``slope`` (6,); ``weight`` (6,) 1/sigma; return its cost.

    ``pose``, ``given`` (12,): rotation row by row, position. The rotation's residual is log(R0^T R), whose
    derivative by a further rotation is the inverse right Jacobian of SO(3) (Chirikjian 2011, eq. 10.86): I + [p]x
    / 2 + (1/a^2 - (1 + cos a) / (2 a sin a)) [p]x^2.
    """
    r = np.zeros((3, 3))
    for i in range(3):
        for k in range(3):
            for n in range(3):
                r[i, k] += given[3 * n + i] * pose[3 * n + k]
    x, y, z = rotation_vector(r)
    a2 = x * x + y * y + z * z
    a = np.sqrt(a2)
    c = 1 / 12.0 if a < 1e-4 else 1 / a2 - (1 + np.cos(a)) / (2 * a * np.sin(a))
    by, away = np.zeros((6, 6)), np.empty(6)
    # [p]x^2 = p p^T - a^2 I
    by[0, 0], by[0, 1], by[0, 2] = 1 + c * (x * x - a2), c * x * y - 0.5 * z, c * x * z + 0.5 * y
    by[1, 0], by[1, 1], by[1, 2] = c * x * y + 0.5 * z, 1 + c * (y * y - a2), c * y * z - 0.5 * x
    by[2, 0], by[2, 1], by[2, 2] = c * x * z - 0.5 * y, c * y * z + 0.5 * x, 1 + c * (z * z - a2)
    away[0], away[1], away[2] = x, y, z
    for i in range(3, 6):
        by[i, i], away[i] = 1.0, pose[i + 6] - given[i + 6]
    cost = 0.0
    for i in range(6):
        e = weight[i] * away[i]
        cost += e * e
        for k in range(6):
            slope[k] += weight[i] * by[i, k] * e
            for n in range(6):
                normals[k, n] += weight[i] ** 2 * by[i, k] * by[i, n]
    return cost


@kernel
def observed_blocks(
    state: ParameterValues, blocks: EliminatedBlocks, known: Known, normals: NormalEquations
) -> float:
    """Add the observed coordinates of eliminated points and the observed poses of placements; return their cost."""
    points, given, information = state.points, known.points, known.information
    dim, at_v, at_g, member = blocks.size, blocks.normals_at, blocks.slope_at, blocks.members
    pose_block, pose_weight = known.pose_block, known.pose_weight
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
    if pose_weight.size:
        for f in range(pose_block.size):
            b = pose_block[f]
            if b > 0:
                own = block_normals[at_v[b] : at_v[b] + 36].reshape(6, 6)
                slope = block_slope[at_g[b] : at_g[b] + 6]
                cost += observed_pose(state.placements[f], known.placements[f], pose_weight[f], own, slope)
    return cost
