"""Compiled 3 x 3 linear algebra and disjoint sets against numpy and scipy."""

import numba
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from mosca.numba_support.linalg3 import (
    cofactors3,
    determinant3,
    inverse3,
    mahalanobis3,
    plus_identity3,
    quadratic_form3,
    scaled3,
    store3,
    sum3,
    symmetric3,
    times3,
)
from mosca.numba_support.union_find import root_of, unite


@numba.njit(error_model="numpy")
def inverted(a, out):  # type: ignore[no-untyped-def]
    store3(inverse3(symmetric3(a)), out)


@numba.njit(error_model="numpy")
def combined(a, b, out):  # type: ignore[no-untyped-def]
    store3(scaled3(plus_identity3(sum3(symmetric3(a), symmetric3(b)), 2.0), 3.0), out)


@numba.njit(error_model="numpy")
def forms(a, v):  # type: ignore[no-untyped-def]
    s = symmetric3(a)
    return (
        determinant3(s, cofactors3(s)),
        quadratic_form3(s, v[0], v[1], v[2]),
        mahalanobis3(s, v[0], v[1], v[2]),
        times3(s, v[0], v[1], v[2]),
    )


@numba.njit
def sets(n, left, right):  # type: ignore[no-untyped-def]
    parent = np.arange(n)
    for i in range(left.shape[0]):
        unite(parent, left[i], right[i])
    for k in range(n):
        parent[k] = root_of(parent, k)
    return parent


def covariances() -> list[np.ndarray]:
    random = np.random.default_rng(3)
    halves = random.normal(size=(20, 3, 3)) * 10.0 ** random.uniform(-3, 3, size=(20, 1, 1))
    return [half @ half.T for half in halves]


@pytest.mark.parametrize("a", covariances())
def test_symmetric_matrices_as_numpy_has_them(a: np.ndarray) -> None:
    out, v = np.empty((3, 3)), np.array([0.3, -1.2, 0.7])
    inverted(a, out)
    assert_allclose(out, np.linalg.inv(a), rtol=1e-12 * np.linalg.cond(a))
    assert np.array_equal(out, out.T)
    combined(a, np.diag(v), out)
    assert_allclose(out, 3.0 * (a + np.diag(v) + 2.0 * np.eye(3)), rtol=1e-15)
    determinant, form, (distance2, same), product = forms(a, v)
    assert determinant == same
    close = 1e-13 * np.linalg.cond(a)
    assert_allclose(determinant, np.linalg.det(a), rtol=close)
    assert_allclose(form, v @ a @ v, rtol=1e-12)
    assert_allclose(distance2, v @ np.linalg.solve(a, v), rtol=close)
    assert_allclose(product, a @ v, rtol=1e-12, atol=1e-12 * np.abs(a).max())


def test_disjoint_sets_are_the_connected_components_and_their_roots_the_smallest_elements() -> None:
    random, n = np.random.default_rng(5), 200
    left, right = random.integers(0, n, 120), random.integers(0, n, 120)
    found = sets(n, left, right)
    _, labels = connected_components(coo_array((np.ones(120), (left, right)), shape=(n, n)), directed=False)
    smallest = np.array([np.flatnonzero(labels == label)[0] for label in labels])
    assert np.array_equal(found, smallest)
