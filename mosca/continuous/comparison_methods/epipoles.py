"""Two views that may see each other: fundamental matrix, essential matrix and relative pose.

A camera that sees the other one observes its epipole. With F e = 0 (second paper, eq. 5) and F' e' = 0 (eq. 6), F =
B' M B^T, where the columns of B (3, 2) and B' span the plane perpendicular to e and e'. So the corresponding points
only have to determine M (2, 2), with 3 unknowns up to scale, instead of 8 in a linear solution (9 numbers up to
scale). If an epipole is not observed, B = I on its side: the same code handles both, one, or none.

All image points are bearings: rays (n, 3) in the camera's frame, unit rays for an essential matrix. So lenses beyond
180 degrees and epipoles outside the image need no special treatment, and the sign of an epipole's ray shows on which
side the other camera is, not only on which line. (Homogeneous pixels (x, y, 1) are also bearings when estimating F.)
"""

import numpy as np

from mosca.data.arrays import Array
from mosca.data.rig import Pose

FEWEST = {0: 8, 1: 5, 2: 3}
"""Least correspondences for a matrix, by the number of observed epipoles."""
QUARTER_ROTATION = np.array([[0.0, -1.0], [1.0, 0.0]])
"""Rotation by 90 degrees in the image."""


class TooFewPointsError(ValueError):
    """There are fewer correspondences than the matrix has unknowns."""


def fundamental(first: Array, second: Array, epipole: Array | None = None, other: Array | None = None) -> Array:
    """Return F (3, 3) of norm 1 with ``second . F first ~ 0`` for corresponding bearings (n, 3).

    ``epipole`` (3,): ray in the first view on which the second camera is seen; ``other``: the first camera's ray in
    the second view. Given epipoles hold exactly (eq. 5, 6), and so does rank 2. The algebraic error of unit rays is
    minimised by least squares. Raises TooFewPointsError below 8, 5 or 3 points with no, one or two epipoles.
    """
    right, left = _basis(epipole), _basis(other)
    seen = (epipole is not None) + (other is not None)
    if len(first) < FEWEST[seen]:
        raise TooFewPointsError(
            f"{len(first)} corresponding points with {seen} observed epipoles given, {FEWEST[seen]} are needed"
        )
    a, b = _unit(first) @ right, _unit(second) @ left
    rows = (b[:, :, None] * a[:, None, :]).reshape(len(a), -1)
    core = np.linalg.svd(rows, full_matrices=True)[2][-1].reshape(left.shape[1], right.shape[1])
    u, sizes, vt = np.linalg.svd(core)
    if len(sizes) == 3:
        core = u @ np.diag([sizes[0], sizes[1], 0.0]) @ vt
    matrix = left @ core @ right.T
    return np.asarray(matrix / np.linalg.norm(matrix))


def essential(first: Array, second: Array, epipole: Array | None = None, other: Array | None = None) -> Array:
    """Return E (3, 3) of singular values 1, 1, 0 with ``second . E first ~ 0`` for corresponding unit rays (n, 3).

    Epipoles as in ``fundamental``; they hold exactly. With both observed, E has a single unknown, the rotation about
    the base: M is a rotation or its mirror image, linear in cosine and sine, so that two points suffice.
    """
    if epipole is not None and other is not None:
        return _about_base(_unit(first), _unit(second), _unit(epipole), _unit(other))
    u, _, vt = np.linalg.svd(fundamental(first, second, epipole, other))
    return np.asarray(u @ np.diag([1.0, 1.0, 0.0]) @ vt)


def relative_pose(first: Array, second: Array, epipole: Array | None = None, other: Array | None = None) -> Pose:
    """Return second_from_first, with a base of length 1, from corresponding unit rays (n, 3) and observed epipoles.

    Of the four poses of an essential matrix, the one with most points at positive distances along both rays is taken.
    This also holds beyond 90 degrees from the axis (Hartley and Zisserman 2003, 9.6.3, by ray instead of by depth).
    Observed epipoles take precedence: the second camera must be on the side where it was seen.
    """
    a, b = _unit(first), _unit(second)
    matrix = essential(a, b, epipole, other)
    best: tuple[float, float, Pose] | None = None
    for pose in poses_of_essential(matrix):
        seen = 0.0
        if epipole is not None:
            seen += np.sign(-(pose.rotation.T @ pose.translation) @ epipole)
        if other is not None:
            seen += np.sign(pose.translation @ other)
        along_a, along_b = distances_along(pose, a, b)
        share = float(np.mean((along_a > 0) & (along_b > 0)))
        if best is None or (seen, share) > best[:2]:
            best = (float(seen), share, pose)
    assert best is not None
    return best[2]


def poses_of_essential(matrix: Array) -> tuple[Pose, ...]:
    """Return the four poses ``second_from_first``, base of length 1, that have this essential matrix (3, 3)."""
    u, _, vt = np.linalg.svd(matrix)
    u, vt = u * np.linalg.det(u), vt * np.linalg.det(vt)
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    return tuple(Pose(u @ turn @ vt, sign * u[:, 2]) for turn in (quarter, quarter.T) for sign in (1.0, -1.0))


def distances_along(pose: Pose, first: Array, second: Array) -> tuple[Array, Array]:
    """Return distances along rays (n, 3) of two cameras (``pose``: second_from_first) to their closest approach."""
    a, b, t = first @ pose.rotation.T, second, pose.translation
    # s a - r b = -t, least squares
    aa, bb, ab = (np.einsum("ni,ni->n", p, q) for p, q in ((a, a), (b, b), (a, b)))
    at, bt = a @ t, b @ t
    scale = aa * bb - ab * ab
    with np.errstate(divide="ignore", invalid="ignore"):
        return (ab * bt - bb * at) / scale, (aa * bt - ab * at) / scale


def _unit(rays: Array) -> Array:
    rays = np.asarray(rays, dtype=float)
    return np.asarray(rays / np.linalg.norm(rays, axis=-1, keepdims=True))


def _basis(epipole: Array | None) -> Array:
    """Return a basis perpendicular to an epipole as columns (3, 2), or I (3, 3) where none is observed."""
    if epipole is None:
        return np.eye(3)
    e = _unit(epipole)
    side = np.eye(3)[int(np.argmin(np.abs(e)))]
    x = np.cross(e, side)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(e, x)])


def _about_base(first: Array, second: Array, epipole: Array, other: Array) -> Array:
    """Return the essential matrix for two observed epipoles: only the rotation about the base is unknown.

    With bases whose third axis is the direction from the first camera to the second, in both frames, R is a rotation
    about that axis, and E = [t]x R = B' J Rot(angle) B^T is linear in cosine and sine of the angle.
    """
    right = _basis(epipole)
    left = _basis(-other)
    if len(first) < 2:
        raise TooFewPointsError(f"{len(first)} corresponding points with both epipoles given, 2 are needed")
    a, b = first @ right, second @ left
    # b . QUARTER_ROTATION (c I + s QUARTER_ROTATION) a = c (b . QUARTER_ROTATION a) - s (b . a)
    rows = np.column_stack([np.einsum("ni,ij,nj->n", b, QUARTER_ROTATION, a), -np.einsum("ni,ni->n", b, a)])
    c, s = np.linalg.svd(rows, full_matrices=False)[2][-1]
    return np.asarray(left @ QUARTER_ROTATION @ (c * np.eye(2) + s * QUARTER_ROTATION) @ right.T)
