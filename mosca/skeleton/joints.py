"""Centres and rotations of a person's joints from a pose, with covariances from markers and fitted parameters."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mosca.camera.projection import cross_matrices
from mosca.data.arrays import Array
from mosca.data.joint_motion import JOINTS
from mosca.skeleton.anatomical_axes import CHAINS, ELBOWS, KNEES, segment_axes
from mosca.skeleton.joint_kernels import WIDE, JointTable, Spread, read_joints
from mosca.skeleton.model import Kinematics
from mosca.skeleton.pose import TINY, PoseSolution
from mosca.skeleton.skin import common_modes

LEAST_SPREAD = 1 - float(np.cos(np.deg2rad(10.0)))
"""A hinge that has turned by less than 10 degrees rms shows no axis. Compared with the difference of the first two
singular values of its mean rotation, which is the mean of 1 - cos(turn)."""
STEP_M = 1e-5
"""Step of central differences for the derivatives of landmarks' axes [m]."""


@dataclass(frozen=True, eq=False)
class SegmentAxes:
    """Anatomical axes of segments. ``axes``: body -> body_from_anatomical (3, 3). ``slopes``: body -> its derivative
    (3, p) by the model's parameters, as a rotation vector in anatomical axes [rad/m]. Bodies whose landmarks or axis
    are unknown are left out.
    """

    axes: Mapping[str, Array]
    slopes: Mapping[str, Array]


def fitted_axes(kinematics: Kinematics, poses: Sequence[Array], pose_by_parameters: Sequence[Array]) -> SegmentAxes:
    """Return the axes of a fitted take: ``poses`` (nq,) each, with their derivatives (nv, p) by the parameters.

    The derivative of a pose is that of its least squares solution, hence the negative of
    ``Reduced.pose_by_parameters``.
    """
    hinges = _flexion_axes(kinematics, poses, pose_by_parameters)
    axes: dict[str, Array] = {}
    slopes: dict[str, Array] = {}
    bodies = {body for chain in CHAINS.values() for body in (chain.proximal, chain.distal)} - {""}
    for body in sorted(bodies):
        if body not in _bodies(kinematics):
            continue
        own = {joint: hinge[body] for joint, hinge in hinges.items() if body in hinge}
        try:
            axes[body], slopes[body] = _axes_and_slopes(kinematics, body, own)
        except KeyError:
            continue
    return SegmentAxes(axes, slopes)


def _bodies(kinematics: Kinematics) -> list[str]:
    return [kinematics.mj.body(k).name for k in range(kinematics.mj.nbody)]


def _flexion_axes(
    kinematics: Kinematics, poses: Sequence[Array], pose_by_parameters: Sequence[Array]
) -> dict[str, dict[str, tuple[Array, Array]]]:
    """Return joint -> body -> flexion axis (3,) in the body's axes and its derivative (3, p).

    Joints that hardly bend are left out.
    """
    names = _bodies(kinematics)
    both = {j: (names.index(a), names.index(b)) for j, (a, b) in {**KNEES, **ELBOWS}.items() if {a, b} <= set(names)}
    relative: dict[str, list[Array]] = {joint: [] for joint in both}
    turned: dict[str, list[Array]] = {joint: [] for joint in both}
    for q, by_parameters in zip(poses, pose_by_parameters, strict=True):
        kinematics.pose(q)
        world_from = kinematics.rotations()
        slopes = kinematics.turned_by_pose(np.arange(kinematics.mj.nbody))
        for joint, (near, far) in both.items():
            relative[joint].append(world_from[near].T @ world_from[far])
            turned[joint].append(world_from[far].T @ ((slopes[far] - slopes[near]) @ by_parameters))
    found = {}
    for joint, (near, far) in both.items():
        rotations, vectors = np.array(relative[joint]), np.array(turned[joint])
        spread = np.linalg.svd(rotations.mean(axis=0), compute_uv=False)
        if spread[0] - spread[1] < LEAST_SPREAD:
            continue
        if joint in KNEES:
            found[joint] = dict(zip((names[near], names[far]), _hinge(rotations, vectors), strict=True))
        elif (wrist := f"{joint[0]}_wrist") in kinematics.model.joints:
            found[joint] = {names[near]: _swept(rotations, vectors, kinematics, wrist)}
    return found


def _hinge(rotations: Array, vectors: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Return a hinge's axis (3,) and derivative (3, p) in proximal, then in distal axes.

    ``rotations`` (n, 3, 3) proximal_from_distal; ``vectors`` (n, 3, p) derivatives of their rotation vectors in
    distal axes. The axes a, b minimise the sum of |R_i b - a|^2 (SARA): first singular vectors of the mean of R_i.
    """
    left, sigma, right = np.linalg.svd(rotations.mean(axis=0))
    a, b = left[:, 0], right[0]
    # The change of R is R [v], whose columns are R (v x e); applied to b it is R (v x b), multiplied by a from the
    # left it is (R^T a) x v.
    forward = np.mean(rotations @ cross_matrices(b[None])[0].T @ vectors, axis=0)
    backward = np.mean(cross_matrices(rotations.transpose(0, 2, 1) @ a) @ vectors, axis=0)
    da, db = np.zeros_like(forward), np.zeros_like(forward)
    for k in (1, 2):
        u, v = left[:, k], right[k]
        gap = sigma[0] ** 2 - sigma[k] ** 2
        da += np.outer(u, sigma[0] * (u @ forward) + sigma[k] * (v @ backward)) / gap
        db += np.outer(v, sigma[0] * (v @ backward) + sigma[k] * (u @ forward)) / gap
    sign = 1.0 if a[2] > 0 else -1.0
    return (sign * a, sign * da), (sign * b, sign * db)


def _swept(rotations: Array, vectors: Array, kinematics: Kinematics, wrist: str) -> tuple[Array, Array]:
    """Return the axis (3,), in proximal axes, about which the distal bone's long axis turns; its derivative (3, p).

    The long axis runs from the distal body's origin to ``wrist``; see ``_hinge`` for the other parameters. The axis
    is the direction in which the direction of the long axis has the least variance.
    """
    rows = kinematics.model.joint_rows(wrist)
    bone = kinematics.parameters[rows]
    length = float(np.linalg.norm(bone))
    unit = bone / length
    of_unit = np.zeros((3, vectors.shape[2]))
    of_unit[:, rows] = (np.eye(3) - np.outer(unit, unit)) / length
    directions = rotations @ unit
    slopes = rotations @ (cross_matrices(unit[None])[0].T @ vectors + of_unit)
    directions, slopes = directions - directions.mean(axis=0), slopes - slopes.mean(axis=0)
    n = len(directions)
    value, vector = np.linalg.eigh(directions.T @ directions / n)
    axis, slope = vector[:, 0], np.zeros_like(of_unit)
    along = directions @ axis
    for k in (1, 2):
        u = vector[:, k]
        change = np.einsum("n,i,nip->p", along, u, slopes) + np.einsum("n,i,nip->p", directions @ u, axis, slopes)
        slope += np.outer(u, change / n) / (value[0] - value[k])
    sign = 1.0 if axis[2] > 0 else -1.0
    return sign * axis, sign * slope


def _axes_and_slopes(
    kinematics: Kinematics, body: str, hinges: Mapping[str, tuple[Array, Array]]
) -> tuple[Array, Array]:
    """Return ``body``'s anatomical axes (3, 3) and their derivative (3, p)."""
    model = kinematics.model
    body_id = _bodies(kinematics).index(body)
    children = [
        model.joints[k - 2] for k in range(2, kinematics.mj.nbody) if kinematics.mj.body_parentid[k] == body_id
    ]
    carried = [label for label, at in zip(model.labels, kinematics.body_of_marker, strict=True) if at == body_id]
    rows = {joint: model.joint_rows(joint) for joint in children}
    rows |= {label: model.marker_rows(label) for label in carried}
    values = {name: kinematics.parameters[where].copy() for name, where in rows.items()}
    turned = {joint: hinge[0] for joint, hinge in hinges.items()}
    axes = segment_axes(body, values.__getitem__, turned)
    slopes = np.zeros((3, len(kinematics.parameters)))

    def change(name: str, component: int, of: dict[str, Array]) -> Array:
        ends = []
        for step in (STEP_M, -STEP_M):
            moved = of | {name: of[name] + step * np.eye(3)[component]}
            given = (moved, turned) if of is values else (values, moved)
            ends.append(axes.T @ segment_axes(body, given[0].__getitem__, given[1]))
        return _vector(ends[0] @ ends[1].T) / (2 * STEP_M)

    for name, where in rows.items():
        for component in range(3):
            slopes[:, where.start + component] = change(name, component, values)
    for joint, (_, slope) in hinges.items():
        slopes += np.stack([change(joint, component, turned) for component in range(3)], axis=1) @ slope
    return axes, slopes


def _vector(rotation: Array) -> Array:
    """Return the rotation vector (3,) of a small rotation (3, 3)."""
    return (
        np.array([rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]])
        / 2
    )


class JointReader:
    """Reads the joints of poses of one subject."""

    def __init__(self, kinematics: Kinematics, axes: SegmentAxes, covariance: Array, landmarks_m: Array) -> None:
        """``covariance`` (p, p) of the parameters [m^2]; ``landmarks_m`` (m,) standard deviation per coordinate of
        each marker's mean place against its landmark: its displacement with the skin for the whole take [m].
        """
        self.kinematics = kinematics
        names = _bodies(kinematics)
        self.joints = tuple(joint for joint in JOINTS if CHAINS[joint].distal in names)
        p = len(covariance)
        first = 3 * len(kinematics.model.joints)
        root = np.linalg.cholesky(covariance + 1e-18 * np.eye(p))
        modes = common_modes(kinematics.local, kinematics.body_of_marker, landmarks_m).reshape(p - first, -1)
        columns = np.zeros((p, -(-(p + modes.shape[1]) // WIDE) * WIDE))
        columns[:, :p], columns[first:, p : p + modes.shape[1]] = root, modes
        nothing = np.zeros((3, 3)), np.zeros((3, p))
        known = {body: (axes.axes[body], axes.slopes[body]) for body in axes.axes}
        known["world"] = np.eye(3), nothing[1]
        ends = [(CHAINS[joint].proximal or "world", CHAINS[joint].distal) for joint in self.joints]
        near_axes, near_slopes = _stacked([known.get(near, nothing) for near, _ in ends])
        far_axes, far_slopes = _stacked([known.get(far, nothing) for _, far in ends])
        self._table = JointTable(
            np.array([self._centre_bodies(joint) for joint in self.joints]),
            np.array([names.index(near) for near, _ in ends]),
            np.array([names.index(far) for _, far in ends]),
            near_axes,
            far_axes,
            np.array([near in known and far in known for near, far in ends]),
        )
        # axes come from the fitted parameters; movement of the skin at one instant does not change them
        turns = np.zeros((2, len(self.joints), 3, columns.shape[1]))
        turns[0, :, :, :p], turns[1, :, :, :p] = near_slopes @ root, far_slopes @ root
        landmarks = np.repeat(landmarks_m, 3)
        near_turns, far_turns = turns
        self._spread = Spread(
            _blocks(columns), _blocks(near_turns), _blocks(far_turns), near_slopes[:, :, first:] * landmarks,
            far_slopes[:, :, first:] * landmarks,
        )  # fmt: skip

    def _centre_bodies(self, joint: str) -> tuple[int, int]:
        """Return the two bodies the midpoint of whose origins is the joint's centre, -1 for none."""
        joints = self.kinematics.model.joints
        if CHAINS[joint].centre:
            return (2 + joints.index(joint),) * 2
        if joint == "pelvis" and {"l_hip", "r_hip"} <= set(self.joints):
            return 2 + joints.index("l_hip"), 2 + joints.index("r_hip")
        return -1, -1

    def read(self, solution: PoseSolution) -> tuple[Array, Array, Array, Array]:
        """Return centres (j, 3) [m], their covariances (j, 3, 3), rotations (j, 3, 3) and their covariances.

        Unknown values are NaN. The covariances cover the markers' noise, the movement of their segments under the
        skin, and the errors of the parameters.
        """
        kinematics, j = self.kinematics, len(self.joints)
        kinematics.pose(solution.q)
        out = np.empty((j, 3)), np.empty((j, 3, 3)), np.empty((2, j, 3, 3))
        given = (kinematics.tree, kinematics.placed, solution.normal, solution.weighted)
        if not read_joints(*given, TINY, self._table, self._spread, out):
            raise np.linalg.LinAlgError("the pose's normal matrix is not positive definite")
        centre, rotation, covariance = out
        return centre, covariance[0], rotation, covariance[1]


def _stacked(pairs: Sequence[tuple[Array, Array]]) -> tuple[Array, Array]:
    return np.stack([axes for axes, _ in pairs]), np.stack([slopes for _, slopes in pairs])


def _blocks(columns: Array) -> Array:
    """Return ``columns`` (..., k) in blocks of WIDE, (k / WIDE, ..., WIDE)."""
    return np.ascontiguousarray(np.moveaxis(columns.reshape(*columns.shape[:-1], -1, WIDE), -2, 0))
