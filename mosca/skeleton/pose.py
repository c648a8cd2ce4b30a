"""The pose of one instant from its markers: damped Gauss-Newton on MuJoCo's kinematics (inverse kinematics)."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from mosca.data.arrays import Array
from mosca.skeleton.kernels import PoseEquations, fill_equations
from mosca.skeleton.model import Kinematics

LARGEST_TURN = 0.6
"""Largest rotation of a joint in one iteration [rad]: linearised, a step beyond it is not to be trusted."""
SETTLED = 1e-4
"""Largest step of a pose that has converged [m, rad]: the next would be of its square's order."""
TINY = 1e-9
"""Added to the diagonal of a normal matrix: degrees of freedom that neither markers nor prior hold do not move."""
ROBUST = 3.0
"""Markers farther from the model than this many standard deviations weigh less (Huber 1964)."""


@dataclass(frozen=True, eq=False)
class PoseSolution:
    """A pose ``q`` (nq,), its normal matrix (nv, nv); of the markers weights (m,), residuals (m, 3) [m], derivatives
    (m, 3, nv) and ``weighted`` information (m, 3, 3).
    """

    q: Array
    normal: Array
    weight: Array
    residual: Array
    slopes: Array
    weighted: Array
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
) -> PoseSolution:
    """Return the pose that fits markers ``xyz`` (m, 3) best, starting from ``q`` (nq,).

    ``information`` (m, 3, 3): inverse covariance of each marker against the model [1/m^2]; 0 for one not measured.
    The joints' prior about ``posture`` (nv,) holds what the markers leave open.
    """
    damping, settled = 0.0, False
    best = linearised(kinematics, q, xyz, information, robust, posture)
    for _ in range(iterations):
        step = _step(best, damping)
        trial = linearised(kinematics, kinematics.moved(best.q, step), xyz, information, robust, posture)
        settled = bool(np.abs(step).max() < SETTLED)
        if trial.cost <= best.cost * (1 + 1e-9):
            best = trial
            damping = damping / 10 if damping > 1e-3 else 0.0
        else:
            damping = max(10 * damping, 1e-3)
        if settled:
            break
    weighted = best.weight[:, None, None] * information
    return PoseSolution(best.q, best.normal, best.weight, best.residual, best.slopes, weighted, settled)


@dataclass(frozen=True, eq=False)
class Linearised:
    """Equations of a pose: ``normal`` (nv, nv) ``step`` = ``gradient`` (nv,), with the joints' prior.

    ``weight`` (m,) and ``residual`` (m, 3) of the markers, ``slopes`` (m, 3, nv) their derivatives.
    """

    q: Array
    normal: Array
    gradient: Array
    weight: Array
    residual: Array
    slopes: Array
    cost: float


def linearised(
    kinematics: Kinematics,
    q: Array,
    xyz: Array,
    information: Array,
    robust: float = ROBUST,
    posture: Array | float = 0.0,
    share: float = 1.0,
) -> Linearised:
    """Return the equations at the pose ``q`` (nq,), which ``kinematics`` takes; see ``solve_pose``.

    ``posture`` (nv,): mean of the joints' rotation vectors, about which the prior holds them with ``share`` of its
    weight: a take's frames share one, for its postures are not drawn anew in each.
    """
    kinematics.pose(q)
    m, nv = len(xyz), kinematics.mj.nv
    filled = PoseEquations(
        np.empty((m, 3, nv)), np.empty(m), np.empty((m, 3)), np.empty((nv, nv)), np.empty(nv)
    )  # fmt: skip
    cost = fill_equations(kinematics.markers(), xyz, information, robust, kinematics.moving(), filled)
    slopes, weight, residual, normal, gradient = filled
    prior = share * kinematics.model.rotation_sigma[6:].reshape(-1, 3) ** -2.0
    vectors, turned = kinematics.rotation_vectors(q)
    off = vectors - np.reshape(posture, -1)[6:].reshape(-1, 3) if np.ndim(posture) else vectors
    normal[kinematics.ball_rows[:, :, None], kinematics.ball_rows[:, None, :]] += turned.transpose(0, 2, 1) @ (
        prior[:, :, None] * turned
    )
    gradient[6:] -= np.einsum("kij,ki->kj", turned, prior * off).ravel()
    cost += float(np.sum(prior * off**2))
    return Linearised(np.array(q), normal, gradient, weight, residual, slopes, cost)


def pose_by_parameters(kinematics: Kinematics, slopes: Array, weighted: Array) -> Array:
    """Return the block (nv, p) of the normal matrix between a pose, which ``kinematics`` takes, and the parameters.

    ``slopes`` (m, 3, nv) of the markers by the pose, ``weighted`` (m, 3, 3) information.
    """
    m, _, nv = slopes.shape
    by_joints = kinematics.by_parameters(kinematics.body_of_marker)
    of_body = kinematics.rotations()[kinematics.body_of_marker]
    shaped = weighted @ slopes
    of_markers = (shaped.transpose(0, 2, 1) @ of_body).transpose(1, 0, 2).reshape(nv, 3 * m)
    return np.concatenate([shaped.reshape(3 * m, nv).T @ by_joints.reshape(3 * m, -1), of_markers], axis=1)


def _step(at: Linearised, damping: float) -> Array:
    normal = at.normal + damping * np.diag(np.diag(at.normal)) + TINY * np.eye(len(at.normal))
    return limited(np.asarray(cho_solve(cho_factor(normal), at.gradient)))


def limited(step: Array) -> Array:
    """Return a pose's step (nv,) shortened to LARGEST_TURN."""
    turn = np.abs(step[3:]).max()
    return step * min(1.0, LARGEST_TURN / turn) if turn > 0 else step
