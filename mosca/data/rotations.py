"""Conversion between rotation matrices and the forms that files use: quaternions wxyz and rotation vectors."""

from collections.abc import Sequence

import numpy as np

from mosca.data.arrays import Array


def rotation_from_quaternion(wxyz: Sequence[float] | Array) -> Array:
    """Return the rotation matrix (3, 3) of a unit quaternion (w, x, y, z) (Kuipers 1999, eq. 7.7)."""
    w, x, y, z = np.asarray(wxyz, dtype=np.float64) / np.linalg.norm(wxyz)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_from_rotation(rotation: Array) -> Array:
    """Return the unit quaternion (4,) wxyz with w >= 0 of a rotation matrix (3, 3).

    The largest component is taken from the diagonal and the others divided by it, so that no
    difference of nearly equal numbers loses digits (Shepperd 1978).
    """
    r = np.asarray(rotation, dtype=np.float64)
    trace = np.trace(r)
    candidates = np.array([trace, r[0, 0], r[1, 1], r[2, 2]])
    largest = int(np.argmax(candidates))
    if largest == 0:
        q = np.array([1 + trace, r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])
    else:
        i = largest - 1
        j, k = (i + 1) % 3, (i + 2) % 3
        q = np.empty(4)
        q[0] = r[k, j] - r[j, k]
        q[1 + i] = 1 + r[i, i] - r[j, j] - r[k, k]
        q[1 + j] = r[j, i] + r[i, j]
        q[1 + k] = r[k, i] + r[i, k]
    q /= np.linalg.norm(q)
    return q if q[0] >= 0 else -q


def rotation_from_vector(vector: Sequence[float] | Array) -> Array:
    """Return the rotation matrix (3, 3) about ``vector`` (3,) by its length [rad] (Rodrigues' formula)."""
    v = np.asarray(vector, dtype=np.float64)
    half = np.linalg.norm(v) / 2
    # sin(a/2)/a by numpy's sinc stays exact down to a zero vector.
    return rotation_from_quaternion(np.concatenate([[np.cos(half)], np.sinc(half / np.pi) / 2 * v]))


def nearest_rotation(matrix: Sequence[Sequence[float]] | Array) -> tuple[Array, float]:
    """Return the rotation (3, 3) nearest to ``matrix`` and the largest element of their difference."""
    given = np.asarray(matrix, dtype=np.float64)
    u, _, vt = np.linalg.svd(given)
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return rotation, float(np.abs(rotation - given).max())


def aligning_rotation(some: Array, onto: Array) -> Array:
    """Return the rotation (3, 3) that best turns points ``some`` (k, 3) to ``onto`` (k, 3), about their centroids."""
    return nearest_rotation((onto - onto.mean(axis=0)).T @ (some - some.mean(axis=0)))[0]
