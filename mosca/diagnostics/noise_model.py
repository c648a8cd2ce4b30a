"""Noise model of image points that matching uses, learned while a rig runs.

A detection's covariance contains the noise of its pixels alone. The camera's body also shakes, its trigger jitters,
and its lens is not quite what the calibration states. These errors are estimated from the residuals. With the weights
W = S^-1, where S is an image's whole covariance, and its Jacobian J by the point, the image's residual after the
point is fitted has a covariance with the trace ``tr (S - J P J')``, P = (sum J' W J)^-1. A regression of squared
residuals on this trace gives the variance that each camera adds. The part that grows with the square of the image's
speed gives the jitter of the triggers (variance components, Foerstner 1979). How much of a camera's variance all of
its images in a frame set have in common follows from the likelihood of their residuals
(``mosca.correspondence.shared_turns``).
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls
from scipy.special import ndtr

from mosca.data.arrays import Array
from mosca.data.rig import Rig
from mosca.diagnostics.residual_sums import ResidualSums

ALIKE_WEIGHT, START_WEIGHT = 3.0, 0.05
"""Weights of two priors, as equivalent numbers of updates: that cameras of a rig shake alike to about a third (their
variances to 0.6), and that of the starting value. A body shakes all images of a set together, so an update has one or
two independent residuals a camera. The starting value is a guess of the order of magnitude. Its weight falls with the
number of updates, so that ten frame sets with an error 20 times smaller show that."""


OWN_SHARES, FIELD_SHARES = 0.5 ** np.arange(13), np.concatenate([[0.0], 0.25 ** np.arange(1, 7)])
"""Shares of a camera's variance that may be each image's own, and that of the smooth field that its lens model leaves
(``mosca.correspondence.lens_field``). The rest is common to its images in a frame set. The shares are the means over
their likelihoods. In the library's scenarios 1/2 to 1/4096 of the variance are single images', and 1/4 to 1/1024 the
field's. With half the steps of the field's shares, five scenarios give the same errors, and nees to 9 %; with twice,
nees is up to 1.4 times as large."""
MOST_WEIGHT = 2.0
"""Largest average weight of earlier images over that of an update's images: the scatter of one update's weights."""


@dataclass(frozen=True, eq=False)
class ImageNoise:
    """Error of image points besides detection noise."""

    sigma_px: Array
    """(c,) an axis, of each camera: the learned error and the misfit of its lens model that the calibration
    states."""
    jitter_s: float
    """Standard deviation of the triggers [s]."""
    shared_px: Array
    """(c,) the part of ``sigma_px`` that a camera's images in a frame set have in common."""
    field_px: Array
    """(c,) the part that neighbouring images have in common: a smooth field over the image that the lens model
    leaves."""


class NoiseModel:
    """Estimates ``ImageNoise`` from sums of residuals, with exponential forgetting."""

    def __init__(self, rig: Rig, start_px: float, memory: float) -> None:
        """``start_px``: error until it is learned; ``memory``: updates that count."""
        c = len(rig.cameras)
        self.noise = ImageNoise(np.full(c, start_px), 0.0, np.zeros(c), np.zeros(c))
        self._start_px = start_px
        self._keep = math.exp(-1.0 / memory)
        # points absorb most of the lens's misfit: little of it shows in residuals
        self.lens_px = np.array([camera.residual_px for camera in rig.cameras])
        self._updates = self._images = self._known = 0.0
        self._normal, self._right = np.zeros((c + 1, c + 1)), np.zeros(c + 1)
        self._likely = np.zeros((len(OWN_SHARES), len(FIELD_SHARES)))

    def start_from(self, other: "NoiseModel") -> None:
        """Use what another model has learned, until this one has as many updates."""
        self.noise, self._known = other.noise, other._updates

    def keep_start(self) -> None:
        """Learn nothing from later updates."""
        self._known = math.inf

    def update(self, sums: ResidualSums, likely: Array | None) -> None:
        """Take the sums over the points of a frame set and solve for the variances.

        ``likely``: log-likelihoods (m, f) of the OWN_SHARES (m,) with each of the FIELD_SHARES (f,), if known.
        """
        # images are weighted by the variances estimated at their time; those of a time when cameras were taken for
        # still would outweigh all later ones
        images, here = float(sums.images.sum()), float(sums.normal.diagonal()[:-1].sum())
        before = float(self._normal.diagonal()[:-1].sum())
        most = MOST_WEIGHT * here / images * self._images
        keep = self._keep * (most / before if before > most > 0.0 else 1.0)
        self._normal, self._right = keep * self._normal + sums.normal, keep * self._right + sums.right
        self._images = self._keep * self._images + images
        self._updates = self._keep * self._updates + 1.0
        if likely is not None:
            self._likely = self._keep * self._likely + likely
        if self._updates >= self._known:
            self._solve()

    def _solve(self) -> None:
        """Solve for the variances that each camera and the triggers add, none below zero."""
        c = len(self.lens_px)
        own = self._normal.diagonal()[:c]
        seen = own > 0
        if not seen.any():
            return
        # information of an update about each camera: the logarithm of its variance is as certain for noisy as for
        # quiet ones
        update = np.where(seen, own, own[seen].mean()) / self._updates
        first, _ = _with_prior(self._normal, self._right, START_WEIGHT / self._updates * update, self._start_px**2)
        found, inverse = _with_prior(self._normal, self._right, ALIKE_WEIGHT * update, float(first[:c].mean()))
        # a body shakes all images of a set together; what detection adds is independent
        points = self._images / (seen.sum() * self._updates)
        shared = np.minimum(found[:c] * np.sqrt(update / points), 1.0) ** 2
        deviation = np.sqrt((1.0 + max(points - 1.0, 0.0) * shared) * inverse.diagonal()[:c])
        variance = _mean_above_zero(found[:c], deviation)
        # the estimate is from few residuals: their predictive distribution is Student's
        freedom = (2 * c - 3) / c * self._updates + ALIKE_WEIGHT
        sigma = np.sqrt((1.0 + 2.0 / freedom) * variance + self.lens_px**2)
        likely = np.exp(self._likely - self._likely.max())
        likely /= likely.sum()
        field = float(likely.sum(axis=0) @ FIELD_SHARES)
        common = max(1.0 - field - float(likely.sum(axis=1) @ OWN_SHARES), 0.0)
        random = np.maximum(sigma**2 - self.lens_px**2, 0.0)
        self.noise = ImageNoise(sigma, math.sqrt(found[c]), np.sqrt(common * random), np.sqrt(field * random))


def _mean_above_zero(value: Array, deviation: Array) -> Array:
    """Return the means (n,) of normal distributions of which the part below zero is cut off.

    What few images give to the jitter of triggers, since points erred more where they happened to be fast, is
    missing in the cameras' variances. They are then uncertain, and zero is their least value, not their likeliest.
    """
    z = value / np.maximum(deviation, 1e-300)
    return np.asarray(value + deviation * np.exp(-0.5 * z * z) / (math.sqrt(2.0 * math.pi) * ndtr(z)))


def _with_prior(normal: Array, right: Array, weight: Array, variance: float) -> tuple[Array, Array]:
    """Return the variances (c + 1,), none below zero, that solve the normal equations with a prior.

    Also return the inverse of the equations' matrix (c + 1, c + 1).
    """
    c = len(weight)
    whole, side = normal.copy(), right.copy()
    diagonal = whole.reshape(-1)[:: c + 2]
    diagonal[:c] += weight
    side[:c] += weight * variance
    # without motion nothing shows jitter: its equation is empty
    n = c + 1 if normal[c, c] > 0.0 else c
    size = np.sqrt(diagonal[:n])
    scaled = whole[:n, :n] / (size * size[:, None])
    inverse, result = np.zeros((c + 1, c + 1)), np.zeros(c + 1)
    inverse[:n, :n] = np.linalg.inv(scaled)
    result[:n] = inverse[:n, :n] @ (side[:n] / size)
    if result.min() < 0.0:
        result[:n] = nnls(scaled, side[:n] / size)[0]
    result[:n] /= size
    inverse[:n, :n] /= size * size[:, None]
    return result, inverse
