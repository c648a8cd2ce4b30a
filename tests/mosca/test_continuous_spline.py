"""Splines against scipy's, and the banded solver against dense linear algebra."""

import numpy as np
import pytest
from scipy.interpolate import BSpline

from mosca.continuous.estimator.banded_normals import Band, Rows, leverages, solve_bordered
from mosca.continuous.estimator.motion_prior import Smoothness, expected_accelerations, shrunk
from mosca.continuous.model.bspline import Knots, fitted, knots_over, values


def dense(banded):
    n = banded.shape[1]
    lower = sum(np.diag(banded[o, : n - o], -o) for o in range(len(banded)))
    return lower + np.tril(lower, -1).T


@pytest.mark.parametrize("degree", [3, 5])
@pytest.mark.parametrize("derivative", [0, 1, 2, 3])
def test_values_are_those_of_scipys_splines(degree, derivative):
    knots = knots_over(1.0, 2.0, 0.1, degree)
    c = np.random.default_rng(0).normal(size=(knots.count, 2))
    places = knots.start_s + knots.step_s * (np.arange(knots.count + degree + 1) - degree)
    spline, t = BSpline(places, c, degree), np.linspace(1, 2, 57)
    expected = spline(t, derivative)
    np.testing.assert_allclose(values(knots, c, t, derivative), expected, atol=1e-12 * np.abs(expected).max())


@pytest.mark.parametrize("derivative", [0, 2, 3])
def test_gram_is_the_integral_of_the_squared_derivative(derivative):
    knots = knots_over(0.0, 1.3, 0.1, 3)
    c = np.random.default_rng(1).normal(size=knots.count)
    # Gauss's points: exact for the products of polynomials of these degrees
    x, w = np.polynomial.legendre.leggauss(6)
    t = (knots.breaks_s[:-1, None] + knots.step_s * (x + 1) / 2).ravel()
    expected = (np.tile(w, knots.pieces) * knots.step_s / 2 * values(knots, c, t, derivative) ** 2).sum()
    assert c @ dense(knots.gram(derivative)) @ c == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize("bounded", [True, False])
def test_the_prior_has_the_spectrum_that_it_states_up_to_a_takes_ends(bounded, monkeypatch):
    """Speed's variance is the integral of 1 / (w^4 + c^4) over w / 2 pi, in closed form.

    The control: nothing is known of what came before the take.
    """
    if not bounded:
        monkeypatch.setattr(Smoothness, "begin", lambda _self, knots, _weight=None: np.zeros((0, knots.degree + 1)))
    knots, smooth = knots_over(0.0, 1.0, 0.01, 5), Smoothness(3, 2 * np.pi * 4)
    assert smooth.rank(knots) == knots.count - 1
    # where the point is on the whole is not told
    matrix = dense(smooth.gram(knots)) + 1e-6 * dense(knots.gram(0))
    first, by = knots.weights(np.array([0.0, 0.03, 0.5, 0.97, 1.0]), 1)
    rows = np.zeros((5, knots.count))
    np.put_along_axis(rows, first[:, None] + np.arange(6), by, axis=1)
    speed = np.diag(rows @ np.linalg.solve(matrix, rows.T))
    expected = 1.0 / (2.0 * np.sqrt(2.0) * smooth.corner**3)
    assert bool(np.abs(speed / expected - 1.0).max() < 0.01) is bounded


def test_fitted_curves_reproduce_a_cubic():
    knots, t = knots_over(0.0, 1.0, 0.2, 3), np.linspace(0, 1, 40)
    c = fitted(knots, t, np.column_stack([t**3 - t, 2 * t**2]))
    np.testing.assert_allclose(values(knots, c, [0.33]), [[0.33**3 - 0.33, 2 * 0.33**2]], atol=1e-10)


@pytest.mark.parametrize("width", [3, 6, 30])
def test_banded_solver_equals_dense_algebra(width):
    rng = np.random.default_rng(width)
    knots = knots_over(0.0, 1.0, 0.05, 3)
    n, size = 400, knots.count * width
    first, weight = knots.weights(rng.random(n))
    columns = np.sort(np.stack([rng.permutation(width)[:3] for _ in range(n)]), axis=1)
    rows = Rows(first, weight, columns, rng.normal(size=(n, 3)), rng.normal(size=(n, 2)), rng.normal(size=n))
    band = Band(knots.count, 4, width, 2)
    band.add(rows)
    between = rng.normal(size=(width, width))
    between = between @ between.T + np.eye(width)
    band.add_prior(knots.gram(2) * 1e-3, between)
    band.add_prior(knots.gram(0), np.eye(width))
    jacobian = np.zeros((n, size))
    for r in range(n):
        for a in range(4):
            jacobian[r, (first[r] + a) * width + columns[r]] += weight[r, a] * rows.values[r]
    matrix = jacobian.T @ jacobian + np.kron(dense(knots.gram(2)) * 1e-3, between)
    matrix += np.kron(dense(knots.gram(0)), np.eye(width))
    x = rng.normal(size=size)
    np.testing.assert_allclose(rows.applied(x, width), jacobian @ x, atol=1e-12)
    right, border = band.right.copy(), band.border.copy()
    factor = band.factor()
    corner = rows.shared.T @ rows.shared + np.eye(2)
    found, shared, _, covariance = solve_bordered([factor], [right], [border], corner, rows.shared.T @ rows.rest)
    whole = np.block([[matrix, jacobian.T @ rows.shared], [rows.shared.T @ jacobian, corner]])
    expected = np.linalg.solve(whole, np.concatenate([jacobian.T @ rows.rest, rows.shared.T @ rows.rest]))
    np.testing.assert_allclose(np.concatenate([found[0], shared]), expected, atol=1e-8)
    np.testing.assert_allclose(covariance, np.linalg.inv(whole)[-2:, -2:], rtol=1e-6)
    inverse = np.linalg.inv(matrix).reshape(knots.count, width, knots.count, width)
    blocks = factor.inverse_blocks(width // 3)
    for o in range(4):
        for k in range(knots.count - o):
            for p in range(width // 3):
                part = inverse[k + o, 3 * p : 3 * p + 3, k, 3 * p : 3 * p + 3]
                np.testing.assert_allclose(blocks[o, k, p], part, atol=1e-9)
    if width == 3:
        by = rng.normal(size=(n, 2, 3))
        whole_rows = np.zeros((n, 2, size))
        for r in range(n):
            for a in range(4):
                whole_rows[r, :, 3 * (first[r] + a) : 3 * (first[r] + a) + 3] = weight[r, a] * by[r]
        expected = whole_rows @ np.linalg.inv(matrix) @ np.swapaxes(whole_rows, 1, 2)
        np.testing.assert_allclose(leverages(factor.lower, first, weight, by), expected, atol=1e-9)
    # drawn errors have the covariance: their mean square on one unknown
    drawn = factor.spread(np.asfortranarray(rng.normal(size=(size, 4000))))
    assert np.mean(drawn[size // 2] ** 2) == pytest.approx(np.diag(np.linalg.inv(matrix))[size // 2], rel=0.1)


def test_expected_accelerations_count_the_integral():
    knots = knots_over(0.0, 1.0, 0.1, 3)
    c = np.random.default_rng(4).normal(size=(1, knots.count, 2))
    for smooth in (Smoothness(2), Smoothness(3), Smoothness(3, 4.0)):
        expected = c[0].T @ dense(smooth.gram(knots)) @ c[0] / smooth.rank(knots)
        np.testing.assert_allclose(expected_accelerations(knots, c, smooth), expected, rtol=1e-9)


def test_chance_correlations_are_shrunk_away_and_true_ones_stay():
    rng = np.random.default_rng(5)
    loose = np.cov(rng.normal(size=(20, 40)).T)
    assert (
        np.abs(shrunk(loose, 20) - np.diag(np.diag(loose))).max()
        < 0.5 * np.abs(loose - np.diag(np.diag(loose))).max()
    )
    common = rng.normal(size=(400, 1)) + 0.3 * rng.normal(size=(400, 6))
    tight = np.cov(common.T)
    np.testing.assert_allclose(shrunk(tight, 400), tight, rtol=0.08)


def random_band(seed):
    rng, knots = np.random.default_rng(seed), Knots(0.0, 1.0, 9, 3)
    first, weights = knots.weights(np.repeat(np.sort(rng.uniform(0, 9, 20)), 4))
    n = len(first)
    rows = Rows(
        first, weights, np.tile([[0, 1, 2, -1], [3, 4, 5, -1]], (n // 4, 1)).repeat(2, axis=0),
        rng.normal(size=(n, 4)), np.zeros((n, 0)), rng.normal(size=n)
    )  # fmt: skip
    dense = np.zeros((n, knots.count * 6))
    for r in range(n):
        for a in range(4):
            for c in range(3):
                dense[r, (first[r] + a) * 6 + rows.columns[r, c]] += weights[r, a] * rows.values[r, c]
    return rows, dense, knots


def test_what_nothing_determines_is_held_where_it_is():
    rows, _, knots = random_band(5)
    band = Band(knots.count, 4, 9, 0)
    band.add(rows)
    with pytest.raises(np.linalg.LinAlgError):
        band.factor()
    where = np.arange(9.0 * knots.count)
    band.hold(where)
    held = band.factor().solve(band.right).reshape(-1, 9)
    assert held[:, 6:] == pytest.approx(where.reshape(-1, 9)[:, 6:])


def test_a_livelier_piece_counts_less_in_the_prior():
    knots = Knots(0.0, 0.5, 6, 3)
    weight = np.array([1.0, 0.5, 0, 0, 2, 1])
    c = np.random.default_rng(1).normal(size=knots.count)
    curve = BSpline(0.5 * np.arange(-3, knots.count + 1), c, 3).derivative(2)
    t = np.linspace(0, 3, 6001)
    middle = 0.5 * (t[1:] + t[:-1])
    wanted = (curve(middle) ** 2 * weight[(middle / 0.5).astype(int)]).sum() * (t[1] - t[0])
    gram = knots.gram(2, weight)
    found = sum((2 if o else 1) * (gram[o, : len(c) - o] * c[: len(c) - o] * c[o:]).sum() for o in range(4))
    assert found == pytest.approx(wanted, rel=1e-5)
