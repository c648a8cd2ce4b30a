"""How large the errors of image points really are: the noise model that matching uses, learned while a rig runs.

A detection's covariance holds the noise of its pixels alone; the camera's body shakes, its trigger jitters, its lens
is not quite what the calibration states. These are estimated from the residuals themselves: with weights W = S^-1, S
an image's whole covariance, and J its Jacobian by the point, what is left of its error after the point is fitted has
the trace ``tr (S - J P J')``, P = (sum J' W J)^-1. Squared residuals regressed on it give the variance that each
camera adds and, as the part that grows with the square of the image's speed, the jitter of the triggers (variance
components, Foerstner 1979).
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from mosca.data.arrays import Array
from mosca.data.rig import Rig
from mosca.diagnostics.residual_sums import ResidualSums

ALIKE_WEIGHT, START_WEIGHT = 6.0, 0.5
"""Weights of the prior, in equivalent number of updates: that cameras of a rig shake alike to about half, and that of
the starting value. A body shakes all images of a set together: an update has one or two independent residuals a
camera."""


@dataclass(frozen=True, eq=False)
class ImageNoise:
    """Error of image points besides detection noise."""

    sigma_px: Array
    """(c,) an axis, of each camera: what was learned and what the calibration states that its lens model leaves."""
    jitter_s: float
    """Of the triggers."""


class NoiseModel:
    """Estimates ``ImageNoise`` from sums of residuals, with exponential forgetting."""

    def __init__(self, rig: Rig, start_px: float, least_px: float, memory: float) -> None:
        """``start_px``: error until it is learned; ``least_px``: at least; ``memory``: updates that count."""
        c = len(rig.cameras)
        self.noise = ImageNoise(np.full(c, start_px), 0.0)
        self._start_px, self._least_px = start_px, least_px
        self._keep = math.exp(-1.0 / memory)
        # points absorb most of the lens's misfit: little of it shows in residuals
        self._lens_px = np.array([camera.residual_px for camera in rig.cameras])
        self._updates = 0.0
        self._normal, self._right = np.zeros((c + 1, c + 1)), np.zeros(c + 1)
        self._prior = np.zeros((c + 1, c + 1))
        self._prior[:c, :c] = ALIKE_WEIGHT * (np.eye(c) - 1.0 / c) + START_WEIGHT * np.eye(c)

    def update(self, sums: ResidualSums) -> None:
        """Take the sums over the points of a frame set and solve for the variances."""
        self._normal = self._keep * self._normal + sums.normal
        self._right = self._keep * self._right + sums.right
        self._updates = self._keep * self._updates + 1.0
        self._solve()

    def _solve(self) -> None:
        """Solve for the variances that each camera and the triggers add, none below zero."""
        c = len(self._lens_px)
        own = self._normal.diagonal()[:c]
        seen = own > 0
        if not seen.any():
            return
        weight = float(own[seen].mean()) / self._updates
        normal, right = self._normal + weight * self._prior, self._right.copy()
        right[:c] += weight * START_WEIGHT * self._start_px**2
        size = np.sqrt(np.maximum(normal.diagonal(), 1e-300))
        found = nnls(normal / size / size[:, None], right / size)[0] / size
        sigma = np.sqrt(np.maximum(found[:c], self._least_px**2) + self._lens_px**2)
        self.noise = ImageNoise(sigma, math.sqrt(found[c]))
