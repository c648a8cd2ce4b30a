"""Turns of cameras and placements, and what is known of poses and points beforehand; compiled."""

import numpy as np
from numba import njit


@njit(nogil=True, cache=True, error_model="numpy")
def turn_on(rotation, step):  # type: ignore[no-untyped-def]
    """Turn rotations (n, 9 or more; the first nine, row by row) about their own axes by vectors (n, 3): R
    exp([w]x).
    """
    e, r = np.empty((3, 3)), np.empty(9)
    for n in range(rotation.shape[0]):
        x, y, z = step[n, 0], step[n, 1], step[n, 2]
        a2 = x * x + y * y + z * z
        a = np.sqrt(a2)
        s, c = (1 - a2 / 6, 0.5 - a2 / 24) if a < 1e-4 else (np.sin(a) / a, (1 - np.cos(a)) / a2)
        e[0, 0], e[0, 1], e[0, 2] = 1 - c * (y * y + z * z), c * x * y - s * z, c * x * z + s * y
        e[1, 0], e[1, 1], e[1, 2] = c * x * y + s * z, 1 - c * (x * x + z * z), c * y * z - s * x
        e[2, 0], e[2, 1], e[2, 2] = c * x * z - s * y, c * y * z + s * x, 1 - c * (x * x + y * y)
        r[:] = rotation[n, :9]
        for i in range(3):
            for k in range(3):
                rotation[n, 3 * i + k] = r[3 * i] * e[0, k] + r[3 * i + 1] * e[1, k] + r[3 * i + 2] * e[2, k]


@njit(nogil=True, cache=True, error_model="numpy")
def log_turn(r):  # type: ignore[no-untyped-def]
    """Rotation matrix (3, 3) -> rotation vector (3,), for turns well below half a turn."""
    half = np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]]) / 2
    sine = np.sqrt(half[0] ** 2 + half[1] ** 2 + half[2] ** 2)
    angle = np.arctan2(sine, (r[0, 0] + r[1, 1] + r[2, 2] - 1) / 2)
    return half * (angle / sine if sine > 1e-9 else 1.0)


@njit(nogil=True, cache=True, error_model="numpy")
def weighted_pose(pose, given, weight, normals, slope):  # type: ignore[no-untyped-def]
    """Add an observed pose to ``normals`` (6, 6), ``slope`` (6,); ``weight`` (6,) 1/sigma; return its cost.

    ``pose``, ``given`` (12,): rotation row by row, position. The turn's residual is log(R0^T R), whose
    derivative by a further turn is the inverse right Jacobian of SO(3) (Chirikjian 2011, eq. 10.86): I + [p]x
    / 2 + (1/a^2 - (1 + cos a) / (2 a sin a)) [p]x^2.
    """
    p = log_turn(given[:9].copy().reshape(3, 3).T.copy() @ pose[:9].copy().reshape(3, 3))
    a2 = p[0] * p[0] + p[1] * p[1] + p[2] * p[2]
    a = np.sqrt(a2)
    c = 1 / 12.0 if a < 1e-4 else 1 / a2 - (1 + np.cos(a)) / (2 * a * np.sin(a))
    cross = np.array([[0.0, -p[2], p[1]], [p[2], 0.0, -p[0]], [-p[1], p[0], 0.0]])
    by = np.zeros((6, 6))
    by[:3, :3] = np.eye(3) + 0.5 * cross + c * (cross @ cross)
    by[3, 3] = by[4, 4] = by[5, 5] = 1.0
    cost = 0.0
    for i in range(6):
        e = weight[i] * (p[i] if i < 3 else pose[i + 6] - given[i + 6])
        cost += e * e
        for k in range(6):
            slope[k] += weight[i] * by[i, k] * e
            for n in range(6):
                normals[k, n] += weight[i] ** 2 * by[i, k] * by[i, n]
    return cost


@njit(nogil=True, cache=True, error_model="numpy")
def weighted_blocks(state, blocks, known, normals):  # type: ignore[no-untyped-def]
    """Add the observed coordinates of eliminated points and the observed poses of placements; return their
    cost.
    """
    _, points, placements = state
    dim, _, _, _, at_v, at_g, _, _, member = blocks
    given, information, pose_block, given_placements, pose_weight, _, _, _ = known
    _, _, _, _, block_normals, block_slope, _, _ = normals
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
                cost += weighted_pose(placements[f], given_placements[f], pose_weight[f], own, slope)
    return cost
