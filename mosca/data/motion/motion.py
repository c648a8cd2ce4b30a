"""Skeletons and their motions, and where every joint is: pure forward kinematics.

A joint is the point at which a bone starts. In the rest pose every joint's axes are parallel to the world's, so that
a skeleton consists of offsets only; a motion adds the root's path and one rotation per joint. World: right-handed, Z
up, metres. Readers convert the Y-up world of motion files: file (x, y, z) -> world (x, -z, y), so that a subject
facing the file's +z faces the world's -y and has its left at +x.
"""

from dataclasses import dataclass, field

import numpy as np

from mosca.data.arrays import Array, read_only, set_read_only
from mosca.data.files.decimals import real, reals
from mosca.errors import InputError

WORLD_FROM_Y_UP = read_only([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]], (3, 3), "world_from_y_up")
"""Rotation that takes file coordinates with Y up to the world's with Z up."""
END_SUFFIX = "_end"
"""Suffix of the parent joint's name for the far end of its bone, where there is no other joint."""
LARGEST_NUMBER = 1e6
"""Numbers in motion files beyond this are damage, not data."""


@dataclass(frozen=True, eq=False)
class Skeleton:
    """Joints of a subject: j ``names``, each after its parent.

    ``parents`` (j,) index of the parent, -1 for the root, which is joint 0. ``offsets`` (j, 3) from the parent's
    joint, in the parent's axes [m]; the root's is zero. ``orders`` (j,) the Euler order in which the file writes the
    joint's angles, in the file's own axes and as a product of matrices from left to right ("ZYX" means Rz Ry Rx); ""
    where the file has no angle (ends of bones, rigid bones).
    """

    names: tuple[str, ...]
    parents: Array
    offsets: Array
    orders: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        j = len(self.names)
        object.__setattr__(self, "names", tuple(self.names))
        set_read_only(self, np.int64, parents=(j,))
        set_read_only(self, offsets=(j, 3))
        object.__setattr__(self, "orders", tuple(self.orders) or ("",) * j)
        if len(set(self.names)) != j or not j:
            raise ValueError("skeleton: joint names must differ and there must be one at least")
        if self.parents[0] != -1 or any(not 0 <= p < k for k, p in enumerate(self.parents[1:], 1)):
            raise ValueError("skeleton: joint 0 is the root and every other joint stands after its parent")
        if len(self.orders) != j:
            raise ValueError(f"skeleton: {len(self.orders)} Euler orders given for {j} joints")

    def index(self, name: str) -> int:
        """Return the index of joint ``name``; InputError lists the joints that exist."""
        if name not in self.names:
            raise InputError(f"no joint '{name}' in the skeleton; it has {', '.join(self.names)}")
        return self.names.index(name)


@dataclass(frozen=True, eq=False)
class Motion:
    """A skeleton's recorded motion: t frames at ``frame_rate_hz``, frame k at time k / frame_rate_hz.

    ``root_xyz`` (t, 3) the root joint in the world [m]; ``rotations`` (t, j, 4) unit quaternions wxyz of
    each joint's axes in its parent's (the root's in the world), with signs such that they do not flip from
    frame to frame.
    """

    skeleton: Skeleton
    frame_rate_hz: float
    root_xyz: Array
    rotations: Array

    def __post_init__(self) -> None:
        t = len(np.asarray(self.root_xyz))
        set_read_only(self, root_xyz=(t, 3), rotations=(t, len(self.skeleton.names), 4))
        if not (np.isfinite(self.frame_rate_hz) and self.frame_rate_hz > 0):
            raise ValueError(f"frame_rate_hz: {self.frame_rate_hz} given, a positive number wanted")

    @property
    def duration_s(self) -> float:
        """Time from the first frame to the last [s]."""
        return max(len(self.root_xyz) - 1, 0) / self.frame_rate_hz


@dataclass(frozen=True, eq=False)
class PointMotion:
    """Paths of named points without a skeleton: ``time_s`` (t,), ``xyz`` (t, n, 3) [m], NaN where missing."""

    names: tuple[str, ...]
    time_s: Array
    xyz: Array = field(repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "names", tuple(self.names))
        set_read_only(self, time_s=(None,))
        set_read_only(self, xyz=(len(self.time_s), len(self.names), 3))


def forward_kinematics(motion: Motion) -> tuple[Array, Array]:
    """Return joint positions (t, j, 3) [m] and rotations world_from_joint (t, j, 3, 3) of every frame."""
    local = matrices_from_quaternions(motion.rotations)
    rotations = np.empty_like(local)
    positions = np.empty(local.shape[:3])
    for k, parent in enumerate(motion.skeleton.parents):
        if parent < 0:
            rotations[:, k], positions[:, k] = local[:, k], motion.root_xyz
        else:
            rotations[:, k] = rotations[:, parent] @ local[:, k]
            positions[:, k] = positions[:, parent] + rotations[:, parent] @ motion.skeleton.offsets[k]
    return positions, rotations


def rest_positions(skeleton: Skeleton) -> Array:
    """Return joint positions (j, 3) [m] in the rest pose, the root at the origin."""
    positions = np.zeros((len(skeleton.names), 3))
    for k, parent in enumerate(skeleton.parents[1:], 1):
        positions[k] = positions[parent] + skeleton.offsets[k]
    return positions


def quaternions_from_euler(angles: Array, order: str) -> Array:
    """Return unit quaternions (..., 4) wxyz of the product of rotations about axes ``order``, left to right.

    ``angles`` (..., n) [rad], one for each letter of ``order``: "ZYX" gives Rz(a0) Ry(a1) Rx(a2).
    """
    given = np.asarray(angles, dtype=np.float64)
    total = np.zeros((*given.shape[:-1], 4))
    total[..., 0] = 1.0
    for k, letter in enumerate(order):
        turn = np.zeros_like(total)
        turn[..., 0] = np.cos(given[..., k] / 2)
        turn[..., 1 + "XYZ".index(letter)] = np.sin(given[..., k] / 2)
        total = multiply_quaternions(total, turn)
    return total


def angles_from_matrices(matrices: Array, order: str) -> Array:
    """Return the angles a, b, c (..., 3) [rad] of rotations M (..., 3, 3) = R_i(a) R_j(b) R_k(c), ``order`` "ijk".

    The last angle is computed after the first rotation was removed from M. So the product of the three equals M to
    rounding even where the middle angle is +-90 deg and the others are undetermined (Paul 1981, section 3.5).
    """
    i, j, k = ("XYZ".index(letter) for letter in order)
    sign = 1.0 if (j - i) % 3 == 1 else -1.0
    m = np.asarray(matrices)
    first = np.arctan2(-sign * m[..., j, k], m[..., k, k])
    sine, cosine = sign * np.sin(first), np.cos(first)
    middle = np.arctan2(sign * m[..., i, k], cosine * m[..., k, k] - sine * m[..., j, k])
    last = np.arctan2(
        sign * (cosine * m[..., j, i] + sine * m[..., k, i]), cosine * m[..., j, j] + sine * m[..., k, j]
    )
    return np.stack([first, middle, last], axis=-1)


def multiply_quaternions(p: Array, q: Array) -> Array:
    """Return the Hamilton products p q (..., 4) wxyz: the rotation q followed by p in fixed axes."""
    p, q = np.asarray(p), np.asarray(q)
    pw, px, py, pz = p[..., 0], p[..., 1], p[..., 2], p[..., 3]
    qw, qx, qy, qz = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    w = pw * qw - px * qx - py * qy - pz * qz
    product = np.empty((*w.shape, 4))
    product[..., 0] = w
    product[..., 1] = pw * qx + px * qw + py * qz - pz * qy
    product[..., 2] = pw * qy - px * qz + py * qw + pz * qx
    product[..., 3] = pw * qz + px * qy - py * qx + pz * qw
    return product


def matrices_from_quaternions(wxyz: Array) -> Array:
    """Return rotation matrices (..., 3, 3) of unit quaternions (..., 4) wxyz (Kuipers 1999, eq. 7.7)."""
    w, x, y, z = np.moveaxis(np.asarray(wxyz, dtype=np.float64), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def without_flips(wxyz: Array) -> Array:
    """Return quaternions (t, ..., 4) with signs such that neighbours in time are less than 90 deg apart.

    q and -q are the same rotation; a path that is to be interpolated must not jump between them.
    """
    cosines = np.sum(wxyz[1:] * wxyz[:-1], axis=-1)
    signs = np.cumprod(np.where(cosines < 0, -1.0, 1.0), axis=0)
    return np.concatenate([wxyz[:1], wxyz[1:] * signs[..., None]])


def in_world(vectors: Array) -> Array:
    """Convert vectors (..., 3) from file coordinates with Y up to world coordinates with Z up."""
    return np.asarray(vectors) @ WORLD_FROM_Y_UP.T


def rotations_in_world(wxyz: Array) -> Array:
    """Convert quaternions (..., 4) of rotations in file axes with Y up to rotations in the world's axes."""
    # R' = A R A^T rotates the rotation's axis by A and leaves its angle.
    return np.concatenate([wxyz[..., :1], in_world(wxyz[..., 1:])], axis=-1)


def number(token: str, where: str) -> float:
    """Return ``token`` as a finite number of sane size; InputError begins with ``where``."""
    try:
        value = real(token)
    except ValueError:
        raise InputError(f"{where}: '{token[:40]}' given, a number wanted") from None
    if not abs(value) <= LARGEST_NUMBER:
        raise InputError(f"{where}: {token[:40]} given, a number within +-{LARGEST_NUMBER:g} wanted")
    return value


def numbers(tokens: list[str], where: str) -> Array:
    """Return many ``tokens`` as an array (n,), quickly where all are valid; else the error names the invalid one."""
    try:
        values = np.array(reals(tokens), dtype=np.float64)
        good = bool(np.all(np.abs(values) <= LARGEST_NUMBER))
    except ValueError:
        good = False
    return values if good else np.array([number(token, where) for token in tokens])
