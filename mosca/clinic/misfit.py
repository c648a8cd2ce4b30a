"""Faults that explain why rays do not meet: linear models of image displacements, compared by their likelihood.

The projector P = I - J (J'J)^-1 J' removes from the whitened residuals r of a point's images the part that a move of
the point explains. A fault displaces images by A t with few parameters t = (sum A'PA)^-1 sum A'Pr, which leave the
sum of squares Q = sum (r - At)' P (r - At). Models are compared by n log(max(Q / n, 1)) + p log n (Schwarz 1978, Ann.
Stat. 6, 461), with n independent residuals and p parameters: below the stated noise no model gains. The significance
of t follows from its covariance, in which residuals of neighbouring frames are dependent (``long_run_covariance``).
"""

from dataclasses import dataclass

import numpy as np

from mosca.camera.projection import project_with_jacobians
from mosca.clinic.observations import PointImages
from mosca.data.arrays import Array
from mosca.data.distributions import chi2
from mosca.data.rig import Rig
from mosca.data.settings import MatchSettings, TrackSettings
from mosca.diagnostics.long_run_covariance import long_run_covariance

MOST = 3000
"""Largest number of points used, evenly over the take."""
CORRELATED_S = TrackSettings().memory_s
"""Residuals nearer to each other in time count as one (the tracker's memory of an acceleration)."""
IMAGE_PX = MatchSettings().camera_sigma_px
"""Random error of an image point besides detection noise."""


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals of n points in c cameras, their weights, and the derivatives from which designs are made."""

    observations: PointImages
    rest: Array
    """(n, c, 2) observed minus projected [px], 0 where unseen."""
    weight: Array
    """(n, c) 1 / sigma [1/px], 0 where unseen."""
    by_point: Array
    """(n, c, 2, 3) derivatives of the projections by the point [px/m]."""
    by_pose: Array
    """(n, c, 2, 6) derivatives of the projections by the camera's pose."""
    flow: Array
    """(n, c, 2) velocity of the image [px/s]."""
    xy: Array
    """(n, c, 2) projections [px]."""
    projector: Array
    """(n, 2c, 2c) P of each point."""
    freedom: int
    """Number of residuals minus number of point coordinates."""
    independent: float
    """The same, of the independent residuals."""

    def squares(self) -> float:
        """Return Q without any model."""
        return float(self._squares().sum())

    def _squares(self) -> Array:
        r = (self.rest * self.weight[..., None]).reshape(len(self.rest), -1)
        return np.asarray(np.einsum("ni,nij,nj->n", r, self.projector, r))

    @property
    def unit_weight(self) -> float:
        """Rms of the residuals over the stated noise."""
        return float(np.sqrt(self.squares() / max(self.freedom, 1)))

    @property
    def better_half(self) -> float:
        """Unit weight of the best-fitting tracks that together have half of the points.

        A misfit far larger than this comes from a few markers (hidden, merged, wrongly paired).
        """
        squares = self._squares()
        freedom = 2.0 * (self.weight > 0).sum(axis=1) - 3.0
        _, of, counts = np.unique(self.observations.track, return_inverse=True, return_counts=True)
        squares, freedom = np.bincount(of, squares), np.bincount(of, freedom)
        order = np.argsort(squares / np.maximum(freedom, 1.0))
        best = order[: 1 + np.searchsorted(np.cumsum(counts[order]), 0.5 * counts.sum())]
        return float(np.sqrt(squares[best].sum() / max(freedom[best].sum(), 1.0)))


@dataclass(frozen=True, eq=False)
class Fit:
    """A model's parameters, their covariance, the remaining sum of squares, and how far the model moves images."""

    values: Array
    covariance: Array
    squares: float
    score: float
    p_value: float
    moved_px: float
    """Rms over the images that it moves [px]."""


def residuals_of(observations: PointImages, rig: Rig, rate_hz: float) -> Residuals:
    """Return the residuals of points that have a velocity and are seen by two or more cameras."""
    rows = np.flatnonzero(np.isfinite(observations.velocity).all(axis=1))
    some = observations.select(rows[:: max(1, -(-len(rows) // MOST))])
    n, c = len(some), len(rig.cameras)
    rest, weight = np.zeros((n, c, 2)), np.zeros((n, c))
    by_point, by_pose = np.zeros((n, c, 2, 3)), np.zeros((n, c, 2, 6))
    flow, xy = np.zeros((n, c, 2)), np.zeros((n, c, 2))
    for k, camera in enumerate(rig.cameras):
        seen = np.isfinite(some.xy_px[:, k]).all(axis=1)
        made = project_with_jacobians(camera, some.xyz)
        seen &= np.isfinite(made.xy_px).all(axis=1) & np.isfinite(made.by_pose).all(axis=(1, 2))
        rest[seen, k] = some.xy_px[seen, k] - made.xy_px[seen]
        sigma = np.sqrt(some.sigma_px[seen, k] ** 2 + IMAGE_PX**2 + camera.residual_px**2)
        weight[seen, k] = 1.0 / sigma
        by_point[seen, k], by_pose[seen, k] = made.by_point[seen], made.by_pose[seen]
        flow[seen, k] = np.einsum("nij,nj->ni", made.by_point[seen], some.velocity[seen])
        xy[seen, k] = made.xy_px[seen]
    jacobian = (by_point * weight[..., None, None]).reshape(n, 2 * c, 3)
    normal = jacobian.transpose(0, 2, 1) @ jacobian
    on = np.repeat(weight > 0, 2, axis=1).astype(float)
    projector = np.eye(2 * c) * on[:, None, :]
    projector = projector - jacobian @ np.linalg.pinv(normal, hermitian=True) @ jacobian.transpose(0, 2, 1)
    freedom = int(on.sum()) - 3 * n
    together = max(1.0, CORRELATED_S * rate_hz * n / max(len(rows), 1))
    return Residuals(
        some, rest, weight, by_point, by_pose, flow, xy, projector, freedom, max(freedom / together, 1.0)
    )


def score_of(squares: float, residuals: Residuals, parameters: int) -> float:
    """Return the deviance of a model with its penalty; smaller is likelier."""
    n = residuals.independent
    return float(n * np.log(max(squares / max(residuals.freedom, 1), 1.0)) + parameters * np.log(max(n, 2.0)))


def fit(residuals: Residuals, design: Array, searched: int = 1) -> Fit:
    """Return the fit of ``design`` (n, c, 2, p) [px per unit]; ``searched``: number of designs it is the best of."""
    n, p = len(design), design.shape[-1]
    weight = residuals.weight[..., None]
    a = (design * weight[..., None]).reshape(n, -1, p)
    r = (residuals.rest * weight).reshape(n, -1)
    scale = np.sqrt(np.einsum("nip,nip->p", a, a)) + 1e-300
    a = a / scale
    pa = residuals.projector @ a
    normal = np.einsum("nip,niq->pq", a, pa)
    inverse = np.linalg.pinv(normal, rcond=1e-9, hermitian=True)
    values = inverse @ np.einsum("nip,ni->p", pa, r)
    left = r - np.einsum("nip,p->ni", a, values)
    squares = float(np.einsum("ni,nij,nj->", left, residuals.projector, left))
    frames, at = np.unique(residuals.observations.frame, return_inverse=True)
    terms = np.zeros((len(frames), p))
    np.add.at(terms, at, np.einsum("nip,ni->np", pa, left))
    covariance = inverse @ long_run_covariance(terms) @ inverse
    wald = float(values @ np.linalg.pinv(covariance, rcond=1e-9, hermitian=True) @ values)
    moved = np.einsum("ncip,p->nci", design, values / scale)
    touched = (np.abs(design).sum(axis=(2, 3)) > 0) & (residuals.weight > 0)
    rms = float(np.sqrt(np.mean(np.sum(moved[touched] ** 2, axis=1)) / 2)) if touched.any() else 0.0
    rank = int(np.linalg.matrix_rank(normal, hermitian=True, tol=1e-9 * max(np.trace(normal), 1e-300)))
    chance = min(1.0, searched * float(chi2.sf(wald, max(rank, 1))))
    score = score_of(squares, residuals, rank) + 2 * np.log(searched)
    return Fit(values / scale, covariance / scale[:, None] / scale, squares, float(score), chance, rms)
