"""Smoothness prior of the motion, with its strength estimated from the data.

The prior is white noise on the second or third derivative: ``p(x) ~ exp(-1/2 integral x''^T Q^-1 x'' dt)``, whichever
has the larger likelihood of all image points (recorded people: the second; smooth machines: the third). First each
point separately: one strength per point, maximising the marginal likelihood of its image points (REML: the
polynomials on which the prior is flat integrated out). Then Q between all coordinates of all points that are
estimated together, by expectation-maximisation: Q is the mean of x'' x''^T over posterior samples. Points of a body
move together, and each exposure constrains only the directions across its lines of sight: the full Q provides depth
between exposures.
"""

from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.linalg import LinAlgError, cho_solve_banded, cholesky_banded
from scipy.optimize import minimize_scalar

from mosca.continuous.estimator.banded_normals import Band, Rows
from mosca.continuous.model.bspline import Knots, values
from mosca.data.arrays import Array

ORDERS = (2, 3)
"""Derivatives that the prior may take for noise."""
RANGE = (-32.0, 12.0)
"""Logarithms of strengths that are tried, in units in which coordinates are m and time s."""
PACE_S = 0.1
"""Smoothing width (Gaussian sigma) of the motion's intensity."""
FARTHEST_M = 100.0
"""Standard deviation of a point's distance from the origin: negligible, keeps the equations regular."""


def one_point(rows: Rows, knots: Knots, order: int, noise_free: bool = False) -> tuple[Array, float, float, float]:
    """Return the maximum-likelihood coefficients (count, 3) of one point from its equations, the prior's log
    strength, how many times larger than stated the image errors are, and -2 log of the marginal likelihood, alike for
    all orders.

    ``noise_free``: image errors may be
    larger than stated, since clocks or poses are not known yet; they are then as large as is likeliest.
    """
    band = Band(knots.count, knots.degree + 1, 3, 0)
    band.add(rows)
    plain = Band(knots.count, knots.degree + 1, 3, 0)
    plain.add_prior(knots.gram(order), np.eye(3))
    keep = Band(knots.count, knots.degree + 1, 3, 0)
    keep.add_prior(knots.gram(0), np.eye(3) / FARTHEST_M**2)
    data, prior, right = band.band + keep.band, plain.band, band.right
    total = float(rows.rest @ rows.rest)
    rank = 3 * (knots.count - order)
    of_order = 3 * (2 * order * np.log(FARTHEST_M) - log_determinant(knots, order))
    freedom = max(len(rows.rest) - 3 * order, 1)

    def solved(log_strength: float) -> tuple[float, Array]:
        lower = cholesky_banded(data + np.exp(log_strength) * prior, lower=True, check_finite=False)
        x = cho_solve_banded((lower, True), right, check_finite=False)
        misfit = max(total - x @ right, 1e-9 * total)
        if noise_free:
            misfit = freedom * np.log(misfit)
        return misfit + 2 * np.log(lower[0]).sum() - rank * log_strength + of_order, x

    def cost(log_strength: float) -> float:
        try:
            return solved(log_strength)[0]
        except LinAlgError:
            return np.inf

    # the likelihood may have two tops: the ladder finds the higher one
    ladder = np.arange(RANGE[0] + 2, RANGE[1], 4.0)
    near = float(ladder[int(np.argmin([cost(s) for s in ladder]))])
    bounds = (near - 4, near + 4)
    found: Any = minimize_scalar(cost, bounds=bounds, method="bounded", options={"xatol": 0.1})
    best = float(found.x)
    least, x = solved(best)
    if not noise_free:
        return x.reshape(-1, 3), best, 1.0, least
    # the strength was in units of the errors that there are
    noise = max(1.0, float(np.sqrt(max(total - float(x @ right), 0.0) / freedom)))
    return x.reshape(-1, 3), best - 2 * float(np.log(noise)), noise, least


@lru_cache(maxsize=32)
def log_determinant(knots: Knots, order: int) -> float:
    """Return the log of the product of the prior's eigenvalues that are not zero, for one coordinate and strength 1.

    The prior is ``step^(-2 m) D^T M D``: D takes the m-th differences of coefficients, M is ``gram(0)`` of splines of
    m degrees less, n coefficients. The product is ``step^(-2 m n) det M det(D D^T)``, and ``det(D D^T)`` the product
    of ``(n + i + j - 1) / (i + j - 1)`` over i, j = 1 .. m (plane partitions in a box: MacMahon); exact for any n.
    """
    lower_degree = replace(knots, degree=knots.degree - order)
    n = lower_degree.count
    lower = cholesky_banded(lower_degree.gram(0), lower=True, check_finite=False)
    index = np.arange(1, order + 1)
    sums = index[:, None] + index - 1.0
    differences = float(np.log((n + sums) / sums).sum())
    return float(2 * np.log(lower[0]).sum()) + differences - 2 * order * n * float(np.log(knots.step_s))


def expected_accelerations(knots: Knots, curves: Array, order: int, pace: Array | None = None) -> Array:
    """Return the mean of x'' x''^T (w, w) over drawn curves (draws, count, w), as the prior counts it.

    ``order``: of the derivative, the second or the third.

    By each piece's two Gauss points, exact for cubics, and over the number of second derivatives that are free.
    """
    middle = 0.5 * (knots.breaks_s[:-1] + knots.breaks_s[1:])
    away = knots.step_s / (2 * np.sqrt(3))
    time = np.sort(np.concatenate([middle - away, middle + away]))
    total = np.zeros((curves.shape[2], curves.shape[2]))
    calm = np.ones(len(time)) if pace is None else np.repeat(pace, 2) ** -0.5
    for one in curves:
        second = values(knots, one, time, order) * calm[:, None]
        total += second.T @ second
    return total * (knots.step_s / 2) / (len(curves) * (knots.count - order))


def liveliness(knots: Knots, curves: list[Array], covariances: list[Array], order: int) -> Array:
    """Return how many times more than ``covariances`` state each piece (pieces,) moves, all groups' drawn curves
    (draws, count, w) together, smoothed over ``PACE_S``.
    """
    middle = 0.5 * (knots.breaks_s[:-1] + knots.breaks_s[1:])
    total, width = np.zeros(knots.pieces), 0
    for drawn, covariance in zip(curves, covariances, strict=True):
        inverse = np.linalg.inv(covariance)
        width += len(covariance)
        for one in drawn:
            second = values(knots, one, middle, order)
            total += np.einsum("ti,ij,tj->t", second, inverse, second) / len(drawn)
    kernel = np.exp(-0.5 * ((middle[:, None] - middle) / PACE_S) ** 2)
    return np.asarray(kernel @ (total * knots.step_s / width) / kernel.sum(axis=1))


def shrunk(covariance: Array, number: int) -> Array:
    """Return a covariance (w, w) of ``number`` samples with correlations as far towards 0 as their own scatter asks.

    Schaefer and Strimmer (2005): the correlations' summed variance over their summed square; at least 0.05 so that
    it can be inverted.
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
