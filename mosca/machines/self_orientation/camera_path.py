"""Poses of a camera over time, with individual errors and errors that all of them share.

Errors are (position x, y, z [m], rotation vector r about the frame's axes [rad], R_true = exp([r]) R), as in
``mosca.data.bodies``. Image noise is independent in each frame. Errors of lens, targets, lever arm and clock are the
same in the whole take, so they do not average out: ``by_parameter`` propagates their common covariance to each pose.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation, Slerp

from mosca.data.arrays import Array, set_read_only
from mosca.data.rig import Pose

DRAWS = 2000
DRAW_SEED = 1004
"""Seed of the draws that give the band of a mean NEES; with another seed the band moves by 1 % of its width."""


@dataclass(frozen=True, eq=False)
class SharedErrors:
    """Names of k parameters whose errors are the same for all poses, and their common covariance."""

    names: tuple[str, ...]
    covariance: Array
    """(k, k)"""

    def __post_init__(self) -> None:
        object.__setattr__(self, "names", tuple(self.names))
        set_read_only(self, covariance=(len(self.names), len(self.names)))


NO_SHARED = SharedErrors((), np.zeros((0, 0)))


@dataclass(frozen=True, eq=False)
class CameraPath:
    """Poses frame_from_camera at n instants; the camera's axes point right, down, ahead."""

    time_ns: Array
    """(n,) rising."""
    rotation: Array
    """(n, 3, 3)"""
    position: Array
    """(n, 3) [m]"""
    covariance: Array
    """(n, 6, 6) of the individual errors of each pose."""
    shared: SharedErrors = NO_SHARED
    by_parameter: Array | None = None
    """(n, 6, k): derivative of a pose's error by each of the shared parameters."""

    def __post_init__(self) -> None:
        n = len(np.asarray(self.time_ns))
        if self.by_parameter is None:
            object.__setattr__(self, "by_parameter", np.zeros((n, 6, len(self.shared.names))))
        set_read_only(self, np.int64, time_ns=(n,))
        set_read_only(self, rotation=(n, 3, 3), position=(n, 3), covariance=(n, 6, 6))
        set_read_only(self, by_parameter=(n, 6, len(self.shared.names)))
        if n > 1 and not (np.diff(self.time_ns) > 0).all():
            raise ValueError("time_ns: poses must be in the order of time, each instant once")

    def __len__(self) -> int:
        return len(self.time_ns)

    def pose(self, k: int) -> Pose:
        """Return pose number ``k``."""
        return Pose(self.rotation[k], self.position[k])

    def select(self, rows: Array) -> "CameraPath":
        """Return the poses selected by a boolean mask or an index array."""
        assert self.by_parameter is not None
        time_ns, rotation, position, covariance, by_parameter = (
            values[rows]
            for values in (self.time_ns, self.rotation, self.position, self.covariance, self.by_parameter)
        )
        return CameraPath(time_ns, rotation, position, covariance, self.shared, by_parameter)

    def total_covariance(self) -> Array:
        """Return the covariance (n, 6, 6) of each pose, of individual and shared errors together."""
        assert self.by_parameter is not None
        common = self.by_parameter @ self.shared.covariance @ np.swapaxes(self.by_parameter, 1, 2)
        return np.asarray(self.covariance + common)

    def with_shared(self, names: Sequence[str], covariance: Array, by_parameter: Array) -> "CameraPath":
        """Return the path with more shared errors, independent of the present ones: k more ``names``, their
        ``covariance`` (k, k) and ``by_parameter`` (n, 6, k).
        """
        assert self.by_parameter is not None
        both = SharedErrors((*self.shared.names, *names), block_diag(self.shared.covariance, covariance))
        return replace(self, shared=both, by_parameter=np.concatenate([self.by_parameter, by_parameter], axis=2))

    def rates(self) -> Array:
        """Return the rate of change (n, 6) of position [m/s] and rotation [rad/s], frame axes, for straight motion of
        constant velocity between neighbouring poses (mean of both sides).
        """
        if len(self) < 2:
            return np.zeros((len(self), 6))
        t = (self.time_ns - self.time_ns[0]) * 1e-9
        turn = Rotation.from_matrix(self.rotation[1:] @ np.swapaxes(self.rotation[:-1], 1, 2)).as_rotvec()
        between = np.hstack([np.diff(self.position, axis=0), turn]) / np.diff(t)[:, None]
        padded = np.concatenate([between[:1], between, between[-1:]])
        return np.asarray((padded[:-1] + padded[1:]) / 2)


def pose_errors(measured: CameraPath, rotation: Array, position: Array) -> Array:
    """Return true minus measured poses (n, 6) [m, rad]; ``rotation`` (n, 3, 3) and ``position`` (n, 3) are true."""
    turn = Rotation.from_matrix(rotation @ np.swapaxes(measured.rotation, 1, 2)).as_rotvec()
    return np.hstack([position - measured.position, turn])


def moved(path: CameraPath, after: Pose) -> CameraPath:
    """Return the path of another point b of the same rigid body: poses frame_from_b, with ``after`` = camera_from_b.

    Errors are propagated along the lever arm.
    """
    assert path.by_parameter is not None
    arm = np.einsum("nij,j->ni", path.rotation, after.translation)
    carry = _carried(arm)
    return CameraPath(
        path.time_ns,
        path.rotation @ after.rotation,
        path.position + arm,
        carry @ path.covariance @ np.swapaxes(carry, 1, 2),
        path.shared,
        carry @ path.by_parameter,
    )


def in_frame(path: CameraPath, frame_from_old: Pose) -> CameraPath:
    """Return the path in another frame, which is known without error."""
    assert path.by_parameter is not None
    turn = np.kron(np.eye(2), frame_from_old.rotation)
    return CameraPath(
        path.time_ns,
        frame_from_old.rotation @ path.rotation,
        frame_from_old.transform(path.position),
        turn @ path.covariance @ turn.T,
        path.shared,
        turn @ path.by_parameter,
    )


def at_instants(path: CameraPath, time_ns: Array, gap_s: float) -> tuple[CameraPath, Array]:
    """Return the path at those of ``time_ns`` (m,) between poses at most ``gap_s`` apart, and which (m,) these are.

    Interpolation is linear; its error is an eighth of acceleration times the gap squared, 0.05 mm for 4 m/s^2 and
    10 ms.
    """
    assert path.by_parameter is not None
    wanted = np.asarray(time_ns, dtype=np.int64)
    if len(path) < 2:
        return path.select(np.zeros(0, dtype=np.int64)), np.zeros(len(wanted), dtype=bool)
    after = np.clip(np.searchsorted(path.time_ns, wanted), 1, len(path) - 1)
    before = after - 1
    span = (path.time_ns[after] - path.time_ns[before]) * 1e-9
    inside = (wanted >= path.time_ns[before]) & (wanted <= path.time_ns[after]) & (span <= gap_s)
    before, after, span = before[inside], after[inside], span[inside]
    share = (wanted[inside] - path.time_ns[before]) * 1e-9 / span
    origin = path.time_ns[0]
    turns = Slerp((path.time_ns - origin) * 1e-9, Rotation.from_matrix(path.rotation))
    a, b = (1 - share)[:, None], share[:, None]
    found = CameraPath(
        wanted[inside],
        turns((wanted[inside] - origin) * 1e-9).as_matrix(),
        a * path.position[before] + b * path.position[after],
        a[:, None] ** 2 * path.covariance[before] + b[:, None] ** 2 * path.covariance[after],
        path.shared,
        a[:, None] * path.by_parameter[before] + b[:, None] * path.by_parameter[after],
    )
    return found, inside


def mean_nees(path: CameraPath, errors: Array) -> tuple[float, tuple[float, float]]:
    """Return the mean of e^T S^-1 e over the poses of ``errors`` (n, 6), and its 95 % band under the stated errors.

    Shared errors correlate the poses, so the band is not that of a chi-square with 6 n degrees of freedom: it is
    estimated from draws of the stated covariances.
    """
    assert path.by_parameter is not None
    n, k = len(path), len(path.shared.names)
    inverse = np.linalg.inv(path.total_covariance())
    mean = float(np.einsum("ni,nij,nj->n", errors, inverse, errors).mean())
    rng = np.random.default_rng(DRAW_SEED)
    own = np.linalg.cholesky(path.covariance)
    left, sizes, _ = np.linalg.svd(path.shared.covariance)
    common = path.by_parameter @ (left * np.sqrt(sizes))
    drawn = np.empty(DRAWS)
    for draw in range(DRAWS):
        e = np.einsum("nij,nj->ni", own, rng.standard_normal((n, 6))) + common @ rng.standard_normal(k)
        drawn[draw] = np.einsum("ni,nij,nj->n", e, inverse, e).mean()
    low, high = np.quantile(drawn, (0.025, 0.975))
    return mean, (float(low), float(high))


def _carried(arm: Array) -> Array:
    """Return matrices (n, 6, 6) that propagate a pose's errors to a point at ``arm`` (n, 3) from it, frame axes."""
    carry = np.tile(np.eye(6), (len(arm), 1, 1))
    # position error grows by r x arm = -[arm]x r
    x, y, z = arm.T
    carry[:, 0, 4], carry[:, 0, 5] = z, -y
    carry[:, 1, 3], carry[:, 1, 5] = -z, x
    carry[:, 2, 3], carry[:, 2, 4] = y, -x
    return carry
