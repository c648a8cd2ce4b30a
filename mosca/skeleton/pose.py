"""The pose of one instant from its markers: damped Gauss-Newton (inverse kinematics)."""

from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array
from mosca.skeleton.kernels import unpack
from mosca.skeleton.model import Kinematics
from mosca.skeleton.pose_kernels import fit_pose

LARGEST_TURN = 0.6
"""Largest rotation of a joint in one iteration [rad]: the linearisation does not hold beyond it."""
SETTLED = 1e-4
"""Largest step of a pose that has converged [m, rad]: the next step would be of the order of its square."""
TINY = 1e-9
"""Added to the diagonal of a normal matrix, so that degrees of freedom not determined by markers or prior stay."""
ROBUST = 3.0
"""Markers farther from the model than this many standard deviations get less weight (Huber 1964)."""


@dataclass(frozen=True, eq=False)
class PoseSolution:
    """A pose ``q`` (nq,) and the equations there: ``normal`` (nv, nv) ``step`` = ``gradient`` (nv,), with the joints'
    prior; ``cost``. The markers have ``weight`` (m,), ``residual`` (m, 3) [m], derivatives ``slopes`` (m, 3, nv) and
    ``weighted`` information (m, 3, 3). ``converged``: whether the last step was below SETTLED.
    """

    q: Array
    normal: Array
    gradient: Array
    weight: Array
    residual: Array
    slopes: Array
    weighted: Array
    cost: float
    converged: bool


def solve_pose(
    kinematics: Kinematics,
    q: Array,
    xyz: Array,
    information: Array,
    *,
    posture: Array | float = 0.0,
    robust: float = ROBUST,
    iterations: int = 30,
    share: float = 1.0,
) -> PoseSolution:
    """Return the pose that fits markers ``xyz`` (m, 3) best, starting from ``q`` (nq,); ``kinematics`` is set to it.

    ``information`` (m, 3, 3): inverse covariance of each marker against the model [1/m^2]; 0 for one not measured.
    The joints' prior about ``posture`` (nv,), the mean of their rotation vectors, determines what the markers do not,
    with ``share`` of its weight. LinAlgError where neither determines it.
    """
    tree, prior = kinematics.tree, kinematics.prior(posture, share)
    start, limits = np.array(q, dtype=np.float64), (SETTLED, LARGEST_TURN, TINY)
    # copies: kernels are compiled once more for arrays that are read-only
    given = np.array(xyz, dtype=np.float64), np.array(information, dtype=np.float64, order="C")
    best, cost, settled = fit_pose(tree, kinematics.placed, prior, start, *given, float(robust), iterations, limits)
    if not np.isfinite(cost):
        raise np.linalg.LinAlgError("the pose's normal matrix is not positive definite")
    normal = np.zeros((kinematics.mj.nv, kinematics.mj.nv))
    unpack(tree, best.rows, normal)
    slopes = kinematics.by_pose(kinematics.placed.marker, kinematics.body_of_marker)
    weighted = best.weight[:, None, None] * information
    return PoseSolution(
        best.q, normal, best.gradient, best.weight, best.residual, slopes, weighted, float(cost), settled
    )


def linearised(
    kinematics: Kinematics,
    q: Array,
    xyz: Array,
    information: Array,
    robust: float = ROBUST,
    posture: Array | float = 0.0,
    share: float = 1.0,
) -> PoseSolution:
    """Return the equations at the pose ``q`` (nq,), to which ``kinematics`` is set; see ``solve_pose``.

    ``share``: all frames of a take share one prior, since their postures are not independent.
    """
    return solve_pose(kinematics, q, xyz, information, posture=posture, robust=robust, iterations=0, share=share)


def pose_by_parameters(kinematics: Kinematics, slopes: Array, weighted: Array) -> Array:
    """Return the block (nv, p) of the normal matrix between the pose of ``kinematics`` and the parameters.

    ``slopes`` (m, 3, nv) of the markers by the pose, ``weighted`` (m, 3, 3) information.
    """
    m, _, nv = slopes.shape
    by_joints = kinematics.by_parameters(kinematics.body_of_marker)
    of_body = kinematics.rotations()[kinematics.body_of_marker]
    shaped = weighted @ slopes
    of_markers = (shaped.transpose(0, 2, 1) @ of_body).transpose(1, 0, 2).reshape(nv, 3 * m)
    return np.concatenate([shaped.reshape(3 * m, nv).T @ by_joints.reshape(3 * m, -1), of_markers], axis=1)


def limited(step: Array) -> Array:
    """Return a pose's step (nv,) shortened to LARGEST_TURN."""
    turn = np.abs(step[3:]).max()
    return step * min(1.0, LARGEST_TURN / turn) if turn > 0 else step
