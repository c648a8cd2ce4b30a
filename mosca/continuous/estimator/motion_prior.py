"""Smoothness prior of the motion, with its strength estimated from the data.

The prior is white noise on the m-th derivative: ``p(x) ~ exp(-1/2 integral x''^T Q^-1 x'' dt)`` for m = 2. The order
m and the knot spacing are those that predict left-out image points best. Recorded people jerk (second order); the
spectrum of swinging motion ends (high orders, and knots no closer than it needs). High orders leave polynomials of
high degree free, which is loose at a take's ends and where only two cameras see a point. So below a corner frequency,
learned like the order, the speed is white instead. At first each point is estimated separately: one strength per
point maximises the marginal likelihood of its image points (REML: the polynomials on which the prior is flat are
integrated out). Then Q between all coordinates of all points that are estimated together follows by
expectation-maximisation: Q is the mean of x'' x''^T over posterior samples. Points of a body move together, and each
exposure constrains only the directions across its lines of sight: the full Q provides depth between exposures.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.linalg import LinAlgError, blas, cho_solve_banded, cholesky_banded, solve_continuous_lyapunov
from scipy.optimize import minimize_scalar

from mosca.continuous.estimator.banded_normals import Band, Rows, leverages
from mosca.continuous.model.bspline import Knots, combined
from mosca.data.arrays import Array

ORDERS = (2, 3, 5, 7)
"""Orders of the derivative that the prior may model as noise; the motion's spectrum falls with twice this power."""
DEGREE = 3
"""Least degree of the splines; at least the prior's order."""
COARSER = 1.5
"""Factor on the knot spacing, or divisor of the corner frequency, from one trial to the next."""
CORNERED = 5
"""Lowest order that is also tried with corners: lower ones leave only lines and parabolas free."""
RANGE = (-26.0, 21.0)
"""Range of log strengths tried, relative to the image points': beyond, one is lost in the other's rounding."""
REFUSED = 1e30
"""Cost of a strength with which the equations are singular in double precision."""
LEAST_FREE = 1e-6
"""Least share of an image point's own error that its curve does not take up: less is rounding."""
PACE_S = 0.1
"""Smoothing width (Gaussian sigma) of the motion's intensity [s]."""
FARTHEST_M = 100.0
"""Prior standard deviation of a point's distance from the origin [m]: negligible, keeps the equations regular."""


@dataclass(frozen=True)
class Smoothness:
    """Prior spectrum of the motion up to a factor: 1 / (w^2m + corner^(2m - 2) w^2), w in rad/s.

    ``order`` m: the derivative that is white noise at high frequencies; below ``corner`` [rad/s] the speed is white.
    The speed is white noise through a Butterworth filter of order m - 1, also before the take. Without a corner,
    polynomials of degree m - 1 cost nothing; with one, only constants do.
    """

    order: int = 2
    corner: float = 0.0

    @property
    def operator(self) -> Array:
        """Factors (m + 1,) of the derivatives whose sum is white noise."""
        if self.corner <= 0.0:
            return np.asarray(np.eye(self.order + 1)[self.order])
        n = self.order - 1
        return np.append(0.0, butterworth(n)[0] * self.corner ** np.arange(n, -1, -1.0))

    def gram(self, knots: Knots, weight: Array | None = None) -> Array:
        """Return the prior's matrix of one coordinate, stored as by ``Knots.gram``."""
        banded = knots.gram_of(self.operator, weight)
        begin = self.begin(knots, weight)
        for offset in range(knots.degree + 1):
            low = np.arange(knots.degree + 1 - offset)
            banded[offset, low] += (begin[:, low + offset] * begin[:, low]).sum(axis=0)
        return banded

    def begin(self, knots: Knots, weight: Array | None = None) -> Array:
        """Return factors (k, degree + 1) of the first coefficients whose sums have a prior variance of 1."""
        if self.corner <= 0.0:
            return np.zeros((0, knots.degree + 1))
        n = self.order - 1
        at = [knots.weights(np.array([knots.start_s]), k + 1)[1][0] * self.corner**-k for k in range(n)]
        size = self.corner ** (n - 0.5) * (1.0 if weight is None else weight[0] ** 0.5)
        return np.asarray(size * butterworth(n)[1] @ np.array(at))

    def weights(self, knots: Knots, time_s: Array) -> tuple[Array, Array]:
        """Return first coefficients and weights, as ``Knots.weights``, of the quantity that is white noise."""
        parts = [times * knots.weights(time_s, k)[1] for k, times in enumerate(self.operator) if times]
        return knots.weights(time_s)[0], np.asarray(sum(parts))

    def rank(self, knots: Knots) -> int:
        """Return the number of coefficients of a coordinate that the prior determines."""
        return knots.count - (self.order if self.corner <= 0.0 else 1)


@lru_cache(maxsize=16)
def butterworth(order: int) -> tuple[Array, Array]:
    """Return the factors (order + 1,) of the derivatives in a Butterworth filter with a corner of 1 rad/s, and R
    (order, order).

    The factor of the highest derivative is 1. R^T R is the stationary precision of the output and its derivatives for
    an input of white noise of intensity 1.
    """
    poles = np.exp(1j * np.pi * (2 * np.arange(1, order + 1) + order - 1) / (2 * order))
    factors = np.poly(poles).real[::-1]
    change = np.diag(np.ones(order - 1), 1)
    change[-1] = -factors[:-1]
    driven = np.zeros((order, order))
    driven[-1, -1] = 1.0
    precision = np.linalg.inv(solve_continuous_lyapunov(change, -driven))
    return factors, np.linalg.cholesky(precision).T


def one_point(
    rows: Rows, knots: Knots, smooth: Smoothness, noise_free: bool = False
) -> tuple[Array, float, float, float]:
    """Return the maximum-likelihood coefficients (count, 3) of one point from its equations, the prior's log
    strength, the factor by which image errors are larger than stated, and the point's ``left_out``.

    ``noise_free``: image errors may be larger than stated, since clocks or poses are not known yet; their size is
    then estimated by maximum likelihood.
    """
    band = Band(knots.count, knots.degree + 1, 3, 0)
    band.add(rows)
    plain = Band(knots.count, knots.degree + 1, 3, 0)
    plain.add_prior(smooth.gram(knots), np.eye(3))
    keep = Band(knots.count, knots.degree + 1, 3, 0)
    keep.add_prior(knots.gram(0), np.eye(3) / FARTHEST_M**2)
    data, prior, right = band.band + keep.band, plain.band, band.right
    total = float(rows.rest @ rows.rest)
    even = float(np.log(data[0].mean() / prior[0].mean()))
    rank = 3 * smooth.rank(knots)
    freedom = max(len(rows.rest) - 3 * (knots.count - smooth.rank(knots)), 1)

    def solved(log_strength: float) -> tuple[float, float, Array, Array]:
        whole = data + np.exp(log_strength) * prior
        lower = cholesky_banded(whole, lower=True, check_finite=False)
        x = cho_solve_banded((lower, True), right, check_finite=False)
        # not total - x right, which is of first order in the rounding errors of x
        of_x = blas.dsbmv(len(whole) - 1, 1.0, whole, x, lower=1)
        misfit = max(total - 2.0 * float(x @ right) + float(x @ of_x), 1e-9 * total)
        likelihood = freedom * np.log(misfit) if noise_free else misfit
        return likelihood + 2 * np.log(lower[0]).sum() - rank * log_strength, misfit, x, lower

    def cost(log_strength: float) -> float:
        try:
            return solved(log_strength)[0]
        except LinAlgError:
            return REFUSED

    # the likelihood may have several maxima, one with all motion treated as noise: take the one that predicts best
    ladder = even + np.arange(RANGE[0] + 2, RANGE[1], 4.0)
    costs = np.array([cost(s) for s in ladder])
    tops = (costs <= np.append(np.inf, costs[:-1])) & (costs < np.append(costs[1:], np.inf))
    results = []
    for near in ladder[tops & (costs < REFUSED)]:
        bounds = (near - 4, near + 4)
        found: Any = minimize_scalar(cost, bounds=bounds, method="bounded", options={"xatol": 0.1})
        best = float(found.x) if found.fun < REFUSED else float(near)
        _, misfit, x, lower = solved(best)
        noise = float(np.sqrt(max(misfit, LEAST_FREE) / freedom)) if noise_free else 1.0
        predicted = left_out(rows, lower, x, noise)
        # the strength was in units of the actual errors
        results.append((predicted, best - 2 * float(np.log(noise)), noise, x.reshape(-1, 3)))
    if not results:
        return np.zeros((knots.count, 3)), 0.0, 1.0, np.inf
    predicted, strength, noise, x = min(results, key=lambda one: one[0])
    return x, strength, noise, predicted


def left_out(rows: Rows, lower: Array, x: Array, noise: float) -> float:
    """Return the sum of -2 log density of each image point predicted from all others.

    ``rows``: two per image point; ``x`` (count * 3,): coefficients fitted to all, with the banded Cholesky factor
    ``lower`` of their equations; ``noise``: factor on the stated errors. Unlike the marginal likelihood, the sum does
    not depend on the uncertainty of the polynomials on which a prior is flat, of which priors of high orders have
    more (Gelfand, Dey and Chang 1992; Rasmussen and Williams 2006, eq. 5.10-5.12).
    """
    rest = (rows.rest - rows.applied(x, 3)).reshape(-1, 2)
    by = rows.values[:, :3].reshape(-1, 2, 3)
    leverage = leverages(lower, rows.first[::2], rows.weights[::2], by)
    sizes, axes = np.linalg.eigh(np.eye(2) - leverage)
    sizes = np.maximum(sizes, LEAST_FREE)
    along = np.einsum("nji,nj->ni", axes, rest)
    return float((along**2 / (noise**2 * sizes) - np.log(sizes / noise**2)).sum())


def expected_accelerations(knots: Knots, curves: Array, smooth: Smoothness, pace: Array | None = None) -> Array:
    """Return the mean of x'' x''^T (w, w) over drawn curves (draws, count, w), in the prior's sense.

    ``smooth``: the derivatives used, with their factors. The integral is exact, by Gauss points of each piece, and is
    divided by the number of coefficients that the prior determines.
    """
    nodes, share = np.polynomial.legendre.leggauss(knots.degree)
    time = (knots.breaks_s[:-1, None] + 0.5 * knots.step_s * (1.0 + nodes)).ravel()
    weight = np.ones(knots.pieces) if pace is None else 1.0 / pace
    root = np.sqrt(0.5 * knots.step_s * weight[:, None] * share).ravel()
    first, by = smooth.weights(knots, time)
    begin = smooth.begin(knots, weight)
    total = np.zeros((curves.shape[2], curves.shape[2]))
    for one in curves:
        for part in (combined(first, root[:, None] * by, one), begin @ one[: knots.degree + 1]):
            total += part.T @ part
    return total / (len(curves) * smooth.rank(knots))


def liveliness(knots: Knots, curves: list[Array], covariances: list[Array], smooth: Smoothness) -> Array:
    """Return the intensity of the motion in each piece (pieces,) relative to ``covariances``, from the drawn curves
    (draws, count, w) of all groups together, smoothed over ``PACE_S``.
    """
    middle = 0.5 * (knots.breaks_s[:-1] + knots.breaks_s[1:])
    first, by = smooth.weights(knots, middle)
    total, width = np.zeros(knots.pieces), 0
    for drawn, covariance in zip(curves, covariances, strict=True):
        inverse = np.linalg.inv(covariance)
        width += len(covariance)
        for one in drawn:
            second = combined(first, by, one)
            total += np.einsum("ti,ij,tj->t", second, inverse, second) / len(drawn)
    kernel = np.exp(-0.5 * ((middle[:, None] - middle) / PACE_S) ** 2)
    return np.asarray(kernel @ (total * knots.step_s / width) / kernel.sum(axis=1))


def shrunk(covariance: Array, number: int) -> Array:
    """Return a covariance (w, w) of ``number`` samples with correlations shrunk towards 0 by their own scatter.

    Schaefer and Strimmer (2005): shrunk by the correlations' summed variance over their summed square, at least by
    0.05 so that it can be inverted.
    """
    deviation = np.sqrt(np.maximum(np.diag(covariance), 1e-30))
    correlation = covariance / deviation[:, None] / deviation
    away = correlation[~np.eye(len(correlation), dtype=bool)]
    if not len(away):
        return covariance
    noise = float(((1 - away**2) ** 2).sum()) / max(number, 1)
    share = float(np.clip(noise / max(float((away**2).sum()), 1e-12), 0.05, 1.0))
    kept = (1 - share) * correlation
    np.fill_diagonal(kept, 1.0)
    return np.asarray(kept * deviation[:, None] * deviation)
