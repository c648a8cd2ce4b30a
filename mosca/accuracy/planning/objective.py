"""The predicted standard deviation over a volume, as numbers to report and as an objective with its gradient.

The covariance of a point is C = (sum_c w J'J / sigma^2)^-1, its standard deviation sqrt(tr C). Reported figures count
a marker that fewer than two cameras see as infinitely bad. The objective must lead an optimiser to good layouts:
camera weights w are smooth, C = (I / worst^2 + sum)^-1 stays finite, and missing cameras have a cost of their own:

    f = sum_k W_k log sigma_(k) + cost mean(max(0, wanted - seen)^2),

with W the weights of Harrell and Davis's quantile (A new distribution-free quantile estimator, Biometrika 69, 1982),
a quantile that depends smoothly on all values about it. The gradient follows from d tr C = -tr(C^2 dN).
"""

from dataclasses import dataclass, field

import numpy as np
from scipy.stats import beta

from mosca.accuracy.planning.views import MarkerRoom, Softness, gather, pull_back
from mosca.data.arrays import Array

TRIANGLE = (np.array([0, 0, 0, 1, 1, 2]), np.array([0, 1, 2, 1, 2, 2]))
TWICE = np.array([1.0, 2.0, 2.0, 1.0, 2.0, 1.0])
"""Number of times that an element of the upper triangle occurs in the matrix."""


@dataclass(frozen=True, eq=False)
class PredictedMarkers:
    """Prediction for each marker, a point of the room with one of the normals."""

    sigma_m: Array
    """(n, k) standard deviation, sqrt of the covariance's trace [m]; infinite where too few cameras see it."""
    covariance: Array
    """(n, k, 3, 3) [m^2]; NaN where too few cameras see the marker."""
    cameras: Array
    """(n, k) number of cameras that see the marker."""

    def quantile_m(self, share: float) -> float:
        """Return the standard deviation [m] that ``share`` of the markers do not exceed; infinite where fewer markers
        are seen.
        """
        return float(np.quantile(self.sigma_m, share, method="higher"))

    def unseen(self, least: int) -> float:
        """Return the share of markers that fewer than ``least`` cameras see."""
        return float(np.mean(self.cameras < least))


def predict(cameras: Array, room: MarkerRoom, least: int = 2) -> PredictedMarkers:
    """Return the prediction for cameras (c, COLUMNS), rows of ``mosca.accuracy.planning.views``, with hard borders.

    ``least``: markers that fewer cameras see count as not measured; at least two.
    """
    total, count = _gathered(cameras, room, Softness())
    good = count > max(2, least) - 0.5
    covariance = np.full((*count.shape, 3, 3), np.nan)
    covariance[good] = np.linalg.inv(_full(total[good]))
    sigma = np.full(count.shape, np.inf)
    sigma[good] = np.sqrt(np.trace(covariance[good], axis1=1, axis2=2))
    return PredictedMarkers(sigma, covariance, count.round().astype(int))


@dataclass(frozen=True, eq=False)
class Objective:
    """Function of camera rows that is minimised."""

    room: MarkerRoom
    share: float
    """Quantile of the standard deviations that is minimised, as a share of the markers."""
    wanted: int
    """Number of cameras that should see each marker."""
    worst_m: float
    """Standard deviation assumed for markers that no camera sees [m]: the size of the volume."""
    softness: Softness
    cost: float = 0.3
    """Cost of the squared number of missing cameras, averaged over the markers, as a change of log sigma."""
    _weights: dict[int, Array] = field(default_factory=dict, repr=False)

    def value(self, cameras: Array) -> float:
        """Return the objective."""
        return self._value(*_gathered(cameras, self.room, self.softness))[0]

    def value_and_slope(self, cameras: Array) -> tuple[float, Array]:
        """Return the objective and its gradient (c, DEGREES) by place [1/m], pan and tilt [1/rad]."""
        room = self.room
        value, by_information, by_count = self._value(*_gathered(cameras, room, self.softness))
        slope = pull_back(
            cameras, room.points, room.normals, room.obstacles, room.center, room.diameter_m, room.tables,
            self.softness.row, by_information, by_count,
        )  # fmt: skip
        return value, slope

    def _value(self, total: Array, count: Array) -> tuple[float, Array, Array]:
        matrix = _full(total)
        matrix[..., np.arange(3), np.arange(3)] += self.worst_m**-2
        inverse = np.linalg.inv(matrix)
        variance = np.trace(inverse, axis1=-2, axis2=-1)
        order = np.argsort(variance, axis=None)
        weights = np.empty(variance.size)
        weights[order] = self._quantile_weights(variance.size)
        weights = weights.reshape(variance.shape)
        missing = np.maximum(0.0, self.wanted - count)
        value = 0.5 * float(np.sum(weights * np.log(variance))) + self.cost * float(np.mean(missing**2))
        squared = (inverse @ inverse)[..., TRIANGLE[0], TRIANGLE[1]] * TWICE
        by_information = -(weights / (2.0 * variance))[..., None] * squared
        return value, by_information, -2.0 * self.cost * missing / missing.size

    def _quantile_weights(self, n: int) -> Array:
        if n not in self._weights:
            steps = beta.cdf(np.arange(n + 1) / n, (n + 1) * self.share, (n + 1) * (1.0 - self.share))
            self._weights[n] = np.diff(steps)
        return self._weights[n]


def _gathered(cameras: Array, room: MarkerRoom, softness: Softness) -> tuple[Array, Array]:
    total, count = gather(
        cameras, room.points, room.normals, room.obstacles, room.center, room.diameter_m, room.tables, softness.row
    )
    return total, count


def _full(triangle: Array) -> Array:
    full = np.empty((*triangle.shape[:-1], 3, 3))
    full[..., TRIANGLE[0], TRIANGLE[1]] = triangle
    full[..., TRIANGLE[1], TRIANGLE[0]] = triangle
    return full
