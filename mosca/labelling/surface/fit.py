"""Pose and size of a surface model fitted to its markers' points, and the prediction of each marker by the others.

With x_i = R^T (p_i - t) a marker's point in the model's axes, r = x - s mu is normal with the sum of the model's and
the noise's covariance. Pose (flat prior) and logarithm of the size s (normal) are estimated by Gauss-Newton and then
integrated out: Q below is the inverse covariance of r with both unknown. The prediction of marker i from the others
is then normal with covariance Q_ii^-1 and mean x_i - Q_ii^-1 (Q r)_i (leave-one-out prediction; Rasmussen and
Williams 2006, Gaussian Processes for Machine Learning, eq. 5.10-5.12). A marker that is not seen has a noise of 1 m.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.transform import Rotation

from mosca.data.arrays import Array
from mosca.labelling.surface.model import NOISE_M, SurfaceModel

UNSEEN_M2 = 1.0
"""Variance given to a marker that is not seen [m^2]: so large that it has no influence."""
_STEPS, _STILL = 10, 1e-7
"""Most steps of a fit, and the step [m, rad] below which it has converged."""
_KEPT = 64
"""Number of sets of seen markers whose matrices are cached."""


@dataclass(frozen=True, eq=False)
class SurfacePose:
    """Pose and size of a surface: world = ``translation`` + ``rotation`` (places times ``size``)."""

    rotation: Array
    """(3, 3)"""
    translation: Array
    """(3,) [m]"""
    size: float

    def local(self, points: Array) -> Array:
        """Return world points (..., 3) in the model's axes, in the person's size."""
        return np.asarray((points - self.translation) @ self.rotation)


@dataclass(frozen=True, eq=False)
class SurfaceFit:
    """A fitted pose, and the predictions of the markers."""

    pose: SurfacePose
    seen: Array
    """(m,) whether a marker has a point."""
    information: Array
    """Q (m, 3, m, 3)."""
    pull: Array
    """Q r (m, 3)."""
    evidence: float
    """Log density of the seen points, pose and size integrated out, up to a constant per marker."""
    mean: Array
    """(m, 3) prediction of each marker from the others, in the model's axes and the person's size [m]."""
    spread: Array
    """(m, 3, 3) covariance of the prediction, noise included [m^2]."""


class SurfaceFitter:
    """Fits ``model`` to points, using a ``share`` of the variance of its movement."""

    def __init__(self, model: SurfaceModel, share: float = 1.0) -> None:
        self.model = model
        self._covariance = model.covariance(share)
        self._kept: dict[bytes, tuple[Array, float]] = {}

    def fit(self, points: Array, start: SurfacePose) -> SurfaceFit:
        """Return the fit to ``points`` (m, 3) [m], NaN where a marker has none, starting from a pose near it."""
        seen: Array = np.asarray(np.isfinite(points).all(axis=1))
        inverse, log_det = self._inverse(seen)
        rotation, translation, log_size = start.rotation, start.translation, float(np.log(start.size))
        prior = np.zeros(7)
        prior[6] = self.model.size_sigma**-2
        for _ in range(_STEPS):
            r, jacobian = self._linear(points, seen, SurfacePose(rotation, translation, float(np.exp(log_size))))
            weighted = jacobian.T @ inverse
            normal = weighted @ jacobian + np.diag(prior)
            step = -np.linalg.solve(normal, weighted @ r + prior * log_size)
            rotation = rotation @ Rotation.from_rotvec(step[:3]).as_matrix()
            translation = translation + rotation @ step[3:6]
            log_size = float(np.clip(log_size + step[6], -1.0, 1.0))
            if np.abs(step).max() < _STILL:
                break
        pose = SurfacePose(rotation, translation, float(np.exp(log_size)))
        r, jacobian = self._linear(points, seen, pose)
        weighted = jacobian.T @ inverse
        normal = weighted @ jacobian + np.diag(prior)
        information = inverse - weighted.T @ np.linalg.solve(normal, weighted)
        # residual at the prior's mean size, for the size is integrated out
        about = r - jacobian[:, 6] * log_size
        pull = information @ about
        evidence = -0.5 * (about @ pull + log_det + float(np.linalg.slogdet(normal)[1]) - np.log(prior[6]))
        m = len(seen)
        blocks = information.reshape(m, 3, m, 3)
        own = np.linalg.inv(blocks[np.arange(m), :, np.arange(m)])
        away = np.einsum("iab,ib->ia", own, pull.reshape(m, 3))
        local = np.where(seen[:, None], pose.local(np.nan_to_num(points)), pose.size * self.model.place_m)
        spread = own - np.where(seen, 0.0, UNSEEN_M2 - NOISE_M**2)[:, None, None] * np.eye(3)
        return SurfaceFit(pose, seen, blocks, pull.reshape(m, 3), float(evidence), local - away, spread)

    def _linear(self, points: Array, seen: Array, pose: SurfacePose) -> tuple[Array, Array]:
        """Return r (3 m,) and its derivatives (3 m, 7) by turn, shift and logarithm of the size."""
        m = len(seen)
        local, expected = pose.local(np.nan_to_num(points)), pose.size * self.model.place_m
        local = np.where(seen[:, None], local, expected)
        jacobian = np.zeros((m, 3, 7))
        x, y, z = local.T
        jacobian[:, 0, 1], jacobian[:, 0, 2] = -z, y
        jacobian[:, 1, 0], jacobian[:, 1, 2] = z, -x
        jacobian[:, 2, 0], jacobian[:, 2, 1] = -y, x
        jacobian[:, :, 3:6] = -np.eye(3)
        jacobian[:, :, 6] = -expected
        return (local - expected).reshape(-1), jacobian.reshape(3 * m, 7)

    def _inverse(self, seen: Array) -> tuple[Array, float]:
        """Return the inverse (3 m, 3 m) of the covariance of r in a known pose, and the log of its determinant."""
        key = seen.tobytes()
        if key not in self._kept:
            noise = np.repeat(np.where(seen, NOISE_M**2, UNSEEN_M2), 3)
            factor = cho_factor(self._covariance + np.diag(noise), lower=True)
            log_det = 2.0 * float(np.log(np.diag(factor[0])).sum())
            while len(self._kept) >= _KEPT:
                self._kept.pop(next(iter(self._kept)))
            self._kept[key] = cho_solve(factor, np.eye(len(noise))), log_det
        return self._kept[key]


def aligned(points: Array, places: Array) -> SurfacePose:
    """Return the pose and size that bring ``places`` (k, 3) nearest to ``points`` (k, 3); Umeyama 1991."""
    middle, origin = points.mean(axis=0), places.mean(axis=0)
    p, q = points - middle, places - origin
    u, value, vt = np.linalg.svd(p.T @ q)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * sign) @ vt
    size = float((value * sign).sum() / max(float(np.sum(q * q)), 1e-12))
    return SurfacePose(rotation, middle - size * rotation @ origin, size)
