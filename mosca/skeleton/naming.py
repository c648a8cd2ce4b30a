"""Names of a subject's markers among unlabelled points, by its pose or by the distances between its markers."""

from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import linear_sum_assignment

from mosca.data.arrays import Array
from mosca.data.distributions import chi2
from mosca.data.tracks import Samples, Tracks, table
from mosca.labelling.assign import marker_of_tracks
from mosca.labelling.marker_model import BEYOND, MarkerModel, learn_model
from mosca.skeleton.fit import FittedSubject
from mosca.skeleton.model import Kinematics
from mosca.skeleton.pose import TINY, PoseSolution

NAMED = float(chi2.ppf(1 - 1e-3, 3))
"""Largest squared Mahalanobis distance of a point that is given a marker's name: one true point in 1000 gets none."""
RELEASED = float(chi2.ppf(1 - 1e-6, 3))
"""Largest squared Mahalanobis distance of a point that keeps its name."""
MARGIN = 2 * float(np.log(20.0))
"""Twice the log likelihood by which another name must be less likely, odds of 20 to 1; a point keeps its name against
an equally likely one."""
ROOM_M3 = 1.0
"""Volume about a person in which points that belong to no marker are assumed [m^3]."""
MEDIAN = float(chi2.ppf(0.5, 3))
"""Median of chi-square with 3 degrees of freedom."""
SLIDE_M = 0.005
"""Movement of a marker on the skin that the fitted take did not show, per coordinate [m]: skin slides as joints turn,
and other movements turn the joints farther. Single markers in walking: 4 to 16 mm (docs/people.md)."""
POSTURES = 200
"""Postures from which distances between markers are learned: their standard deviations are known to 5 %."""


class NamedPoints(NamedTuple):
    """Points of one instant: ``xyz`` (n, 3) [m], ``covariance`` (n, 3, 3), ``marker`` (n,) index, -1 for none."""

    xyz: Array
    covariance: Array
    marker: Array

    def of_markers(self, m: int) -> tuple[Array, Array]:
        """Return places (m, 3), NaN where there is none, and covariances (m, 3, 3) of m markers."""
        named = self.marker >= 0
        xyz, covariance = np.full((m, 3), np.nan), np.zeros((m, 3, 3))
        xyz[self.marker[named]], covariance[self.marker[named]] = self.xyz[named], self.covariance[named]
        return xyz, covariance


def squared_distances(away: Array, covariance: Array) -> Array:
    """Return d^T C^-1 d (...) of ``away`` (..., 3) and ``covariance`` (..., 3, 3)."""
    return np.asarray(np.sum(away * np.linalg.solve(covariance, away[..., None])[..., 0], axis=-1))


def spread_about(solution: PoseSolution, skin2: Array, markers: Array) -> Array:
    """Return the covariance (k, 3, 3) of ``markers`` (k,) about a pose's: of the pose and the skin ``skin2`` (m,)."""
    slopes = solution.slopes[markers]
    nv = slopes.shape[2]
    shaped = cho_solve(cho_factor(solution.normal + TINY * np.eye(nv)), slopes.reshape(-1, nv).T)
    moved = slopes @ shaped.T.reshape(len(markers), 3, nv).transpose(0, 2, 1)
    return np.asarray(moved + skin2[markers, None, None] * np.eye(3))


def scale_of(squared: Array) -> float:
    """Return the factor, 1 or more, by which squared distances (k,) of named points are larger than stated.

    It is taken from the median: wrong names do not change it, but skin that moves more than in the fitted take does.
    """
    return max(1.0, float(np.median(squared)) / MEDIAN) if len(squared) else 1.0


def renamed(
    points: NamedPoints,
    open_: Array,
    places: Array,
    spread: Array,
    doubtful: Array | bool = False,
    scale: float = 1.0,
) -> NamedPoints:
    """Return the points after a new assignment of those without a name and of ``doubtful`` (n,) ones.

    ``open_`` (k,): markers that may be assigned, including those of doubtful points; ``places`` (k, 3) and ``spread``
    (k, 3, 3) of these. The assignment is one to one, with the least sum of squared distances (and log determinants).
    A point whose second name is about as likely gets none.
    """
    rows = np.flatnonzero((points.marker < 0) | doubtful)
    if not len(rows) or not len(open_):
        return points
    away = points.xyz[rows, None] - places
    far = np.einsum("nki,nki->nk", away, away) > RELEASED * scale * (
        np.trace(spread, axis1=1, axis2=2) + np.trace(points.covariance[rows], axis1=1, axis2=2)[:, None]
    )
    near = ~far
    squared, size = np.full(near.shape, np.inf), np.zeros(near.shape)
    at, of = np.nonzero(near)
    covariance = scale * (spread[of] + points.covariance[rows[at]])
    squared[at, of] = squared_distances(away[at, of], covariance)
    size[at, of] = np.linalg.slogdet(covariance)[1] if len(at) else 0.0
    now = points.marker[rows, None] == open_
    # twice the log odds that a point at this place belongs to no marker, against the marker
    stray = squared + size + 3 * np.log(2 * np.pi) + 2 * np.log(len(rows) / ROOM_M3)
    fits = ((squared < NAMED) & (stray < -MARGIN)) | (now & (squared < RELEASED))
    cost = np.where(fits, squared + size, np.inf)
    marker = np.array(points.marker)
    marker[rows] = -1
    if not fits.any():
        return points._replace(marker=marker)
    least, none = float(cost[fits].min()), float(cost[fits].max() - cost[fits].min()) + RELEASED
    gain = np.where(fits, cost - least - none - np.where(now, MARGIN, 0.0), 0.0)
    first, second = linear_sum_assignment(gain)
    for i, k in zip(first.tolist(), second.tolist(), strict=True):
        if not fits[i, k]:
            continue
        others = np.delete(cost[i], k)
        if now[i, k] or not len(others) or others.min() > cost[i, k] + MARGIN:
            marker[rows[i]] = open_[k]
    return points._replace(marker=marker)


def skin_variance(subject: FittedSubject) -> Array:
    """Return the variance (m,) of a coordinate of each marker about its place on the body, in any movement [m^2]."""
    return np.asarray(subject.skin_m**2 + SLIDE_M**2)


def marker_model_of(subject: FittedSubject) -> MarkerModel:
    """Return the distances between a subject's markers: means and spreads over postures drawn about its own.

    ``learn_model`` assumes that other movements reach BEYOND times as far as those that it saw. The prior of the
    joints already reaches that far, so postures are drawn with its standard deviations divided by BEYOND.
    """
    kinematics = Kinematics(subject.model, subject.parameters)
    rng, mj, m = np.random.default_rng(0), kinematics.mj, len(subject.model.labels)
    sigma = np.where(np.isfinite(subject.model.rotation_sigma), subject.model.rotation_sigma, 0.0) / BEYOND
    mean = np.where(np.arange(mj.nv) < 6, 0.0, subject.posture)
    xyz = np.empty((POSTURES, m, 3))
    for k in range(POSTURES):
        kinematics.pose(kinematics.moved(mj.qpos0, mean + rng.normal(0.0, sigma)))
        xyz[k] = kinematics.markers()
    xyz += rng.normal(size=xyz.shape) * np.sqrt(skin_variance(subject))[:, None]
    n = POSTURES * m
    frame = np.repeat(np.arange(POSTURES), m)
    return learn_model(
        Tracks(
            frame, frame, np.tile(np.arange(m), POSTURES), np.tile(subject.model.labels, POSTURES), xyz.reshape(n, 3),
            np.zeros((n, 3, 3)), np.zeros(n, np.int64), np.zeros(n), np.full(n, "measured"),
        )
    )  # fmt: skip


def searched(model: MarkerModel, labels: tuple[str, ...], samples: list[Samples]) -> dict[int, int]:
    """Return track -> index in ``labels`` of the tracks that ``model`` names in ``samples``, frame set by set."""
    found = marker_of_tracks(table(samples), model)
    return {track: labels.index(model.names[marker]) for track, marker in found.items()}
