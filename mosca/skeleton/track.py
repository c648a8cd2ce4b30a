"""Poses of a fitted subject in every frame of a take, and its joints with their covariances."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array
from mosca.data.joint_motion import JointMotion
from mosca.data.motion.motion import WORLD_FROM_Y_UP, Motion, Skeleton, multiply_quaternions, without_flips
from mosca.data.rotations import quaternion_from_rotation
from mosca.skeleton.fit import LEAST_SIGMA_M, FittedSubject
from mosca.skeleton.joints import JointReader
from mosca.skeleton.marker_frames import MarkerFrames
from mosca.skeleton.model import Kinematics
from mosca.skeleton.pose import PoseSolution, solve_pose
from mosca.skeleton.pose_kernels import information_of
from mosca.skeleton.skin import common_m
from mosca.skeleton.start import starting_pose

FEWEST_MARKERS = 6
"""With fewer markers than this a pose is determined by its prior: no result."""
NO_SHIFT = np.zeros((3, 3))
LOST = 0.3
"""A pose is searched for without its predecessor where the mean weight of its markers falls below this."""


@dataclass(frozen=True, eq=False)
class SkeletonTake:
    """A subject's poses: ``q`` (n, nq), NaN where not found; ``joints``; ``residual_m`` (n, m) distance of each
    marker from the model's, NaN where not measured.
    """

    joints: JointMotion
    q: Array
    residual_m: Array


class SkeletonTracker:
    """Finds the pose of one subject frame after frame."""

    def __init__(self, subject: FittedSubject) -> None:
        self.subject = subject
        self.kinematics = Kinematics(subject.model, subject.parameters)
        common = common_m(subject.skin_m, self.kinematics.body_of_marker)
        self.reader = JointReader(self.kinematics, subject.axes, subject.covariance, common)
        self._skin_m = np.maximum(subject.skin_m, LEAST_SIGMA_M)
        self._q: Array | None = None

    def step(self, xyz: Array, covariance: Array) -> PoseSolution | None:
        """Return the pose for markers ``xyz`` (m, 3) of the subject's labels, NaN where not measured, [m].

        ``covariance`` (m, 3, 3) of the measurement [m^2]. None where fewer than FEWEST_MARKERS are there.
        """
        seen = np.isfinite(xyz[:, 0])
        if seen.sum() < FEWEST_MARKERS:
            self._q = None
            return None
        information = np.empty((len(xyz), 3, 3))
        information_of(np.array(xyz), np.array(covariance, order="C"), self._skin_m, information)
        start = self._q if self._q is not None else starting_pose(self.kinematics, xyz).q
        solution = solve_pose(self.kinematics, start, xyz, information, posture=self.subject.posture)
        if self._q is not None and solution.weight[seen].mean() < LOST:
            fresh = starting_pose(self.kinematics, xyz).q
            again = solve_pose(self.kinematics, fresh, xyz, information, posture=self.subject.posture)
            solution = again if again.weight[seen].mean() > solution.weight[seen].mean() else solution
        self._q = solution.q
        return solution

    def joints(self, solution: PoseSolution, shared: Array = NO_SHIFT) -> tuple[Array, Array, Array, Array]:
        """Return the result of ``JointReader.read`` for a pose that ``step`` has returned.

        ``shared`` (3, 3) [m^2]: covariance of a shift of all markers, which shifts all joints and turns none.
        """
        centre, own, matrices, rotation_covariance = self.reader.read(solution)
        return centre, own + shared, matrices, rotation_covariance

    def joints_at(self, solution: PoseSolution, frame: int, time_ns: int, shared: Array = NO_SHIFT) -> JointMotion:
        """Return the joints of a pose that ``step`` has returned, as the motion of one instant; see ``joints``."""
        centre, centre_covariance, matrices, rotation_covariance = self.joints(solution, shared)
        return JointMotion(
            np.array([frame]), np.array([time_ns]), self.reader.joints, centre[None], centre_covariance[None],
            _quaternions(matrices)[None], rotation_covariance[None],
        )  # fmt: skip


def track_subject(
    subject: FittedSubject,
    frames: MarkerFrames,
    progress: Callable[[int, int | None], None] = lambda done, total: None,
) -> SkeletonTake:
    """Return the subject's poses and joints in ``frames``, whose labels are the subject's."""
    tracker = SkeletonTracker(subject)
    n, j = len(frames), len(tracker.reader.joints)
    q = np.full((n, tracker.kinematics.mj.nq), np.nan)
    residual = np.full(frames.seen.shape, np.nan)
    centre, centre_covariance = np.full((n, j, 3), np.nan), np.full((n, j, 3, 3), np.nan)
    rotation, rotation_covariance = np.full((n, j, 4), np.nan), np.full((n, j, 3, 3), np.nan)
    for k in range(n):
        progress(k, n)
        solution = tracker.step(frames.xyz[k], frames.covariance[k])
        if solution is None:
            continue
        q[k] = solution.q
        residual[k] = np.where(frames.seen[k], np.linalg.norm(solution.residual, axis=1), np.nan)
        centre[k], centre_covariance[k], matrices, rotation_covariance[k] = tracker.joints(solution, frames.shared[k])
        rotation[k] = _quaternions(matrices)
    progress(n, n)
    joints = JointMotion(
        frames.frame, frames.time_ns, tracker.reader.joints, centre, centre_covariance, rotation, rotation_covariance
    )
    return SkeletonTake(joints, q, residual)


def _quaternions(matrices: Array) -> Array:
    """Return rotations (j, 3, 3) as quaternions (j, 4) wxyz; NaN stays NaN."""
    found = np.full((len(matrices), 4), np.nan)
    known = np.isfinite(matrices[:, 0, 0])
    found[known] = [quaternion_from_rotation(matrix) for matrix in matrices[known]]
    return found


def motion_of(subject: FittedSubject, q: Array, frame_rate_hz: float) -> Motion:
    """Return poses ``q`` (n, nq) as a skeleton in motion, upright in its rest pose; poses are held over gaps."""
    kinematics = Kinematics(subject.model, subject.parameters)
    mj = kinematics.mj
    good = np.flatnonzero(np.isfinite(q[:, 0]))
    held = q[good[np.clip(np.searchsorted(good, np.arange(len(q)), side="right") - 1, 0, None)]]
    offsets = np.concatenate([np.zeros((1, 3)), mj.body_pos[2:] @ WORLD_FROM_Y_UP.T])
    names = [mj.joint(k).name for k in range(mj.njnt)]
    skeleton = Skeleton(tuple(names), mj.body_parentid[1:] - 1, offsets)
    rotations = held[:, 3:].reshape(len(q), -1, 4).copy()
    # Axes of the bodies have y up; axes of a skeleton at rest are the world's, with z up.
    rotations[..., 1:] = rotations[..., 1:] @ WORLD_FROM_Y_UP.T
    rotations[:, 0] = multiply_quaternions(held[:, 3:7], quaternion_from_rotation(WORLD_FROM_Y_UP.T))
    return Motion(skeleton, frame_rate_hz, held[:, :3], without_flips(rotations))
