"""A camera's own poses compared with a rig's, as in the Mosca paper's Table 4: mean and rms differences.

Angles are the components about the frame's axes of the rotation between both poses: omega about X, alpha about Y,
kappa about Z. In a test field's frame (z towards the camera) these are, to first order, differences of the
photogrammetric angles of a camera that looks at the field.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from mosca.data.arrays import Array, set_read_only
from mosca.data.rig import Pose
from mosca.errors import InputError
from mosca.machines.self_orientation.camera_path import CameraPath, at_instants, pose_errors
from mosca.machines.self_orientation.rig_side import LeverArm

NAMES = ("X", "Y", "Z", "omega", "alpha", "kappa")
FEWEST = 2

GAP_PERIODS = 2.5
"""Longest gap between poses for interpolation, in periods of the rig's frames."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """Differences of two paths at common instants."""

    own: CameraPath
    """n poses by the camera itself."""
    by_rig: CameraPath
    """n poses by the rig at the same instants."""
    difference: Array
    """(n, 6) own minus rig: position [m], then omega, alpha, kappa [rad]."""

    def __post_init__(self) -> None:
        set_read_only(self, difference=(len(self.own), 6))

    @property
    def mean(self) -> Array:
        """Return the mean differences (6,)."""
        return np.asarray(self.difference.mean(axis=0))

    @property
    def rms(self) -> Array:
        """Return the root mean square differences (6,)."""
        return np.asarray(np.sqrt(np.mean(self.difference**2, axis=0)))

    @property
    def sigma_of_mean(self) -> Array:
        """Return the standard deviations (6,) of the means, from the stated errors of both sides."""
        total = np.zeros((6, 6))
        for path in (self.own, self.by_rig):
            assert path.by_parameter is not None
            common = path.by_parameter.mean(axis=0)
            total += path.covariance.sum(axis=0) / len(path) ** 2 + common @ path.shared.covariance @ common.T
        return np.asarray(np.sqrt(np.diag(total)))


def compare(own: CameraPath, by_rig: CameraPath, gap_s: float) -> Comparison:
    """Compare at the camera's instants, where the rig has poses at most ``gap_s`` apart; both in one frame and clock.

    InputError where they have fewer than FEWEST instants in common.
    """
    other, inside = at_instants(by_rig, own.time_ns, gap_s)
    if len(other) < FEWEST:
        raise InputError(
            f"{len(other)} of the camera's {len(own)} poses lie between poses of the rig; do both takes show "
            "the same flight, and is the offset of their clocks right?"
        )
    mine = own.select(inside)
    return Comparison(mine, other, pose_errors(other, mine.rotation, mine.position))


def estimated_lever_arm(own: CameraPath, body: CameraPath, gap_s: float) -> LeverArm:
    """Return the pose of the camera on the body, estimated from the takes: the mean of body_from_camera.

    It contains the mean errors of both sides. So mean differences are meaningless afterwards, but their scatter is
    not. The covariance is that of the mean of as many independent poses.
    """
    other, inside = at_instants(body, own.time_ns, gap_s)
    if len(other) < FEWEST:
        raise InputError(f"{len(other)} common poses of camera and body; two at least give where the camera sits")
    mine = own.select(inside)
    relative = np.swapaxes(other.rotation, 1, 2) @ mine.rotation
    place = np.einsum("nji,nj->ni", other.rotation, mine.position - other.position)
    left, _, right = np.linalg.svd(relative.sum(axis=0))
    rotation = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
    mean = place.mean(axis=0)
    rest = np.hstack([place - mean, Rotation.from_matrix(relative @ rotation.T).as_rotvec()])
    return LeverArm(Pose(rotation, mean), rest.T @ rest / max(len(rest) - 1, 1) / len(rest))
