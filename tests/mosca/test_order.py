"""Order of numbers in compiled code, against NumPy's."""

import numpy as np
import pytest

from mosca.numba_support.decorators import kernel
from mosca.numba_support.order import median_in_place, stable_order


@kernel
def median(values: np.ndarray) -> float:
    return median_in_place(values)


@kernel
def order(values: np.ndarray) -> np.ndarray:
    return stable_order(values)


@pytest.mark.parametrize("kind", [np.float32, np.float64])
@pytest.mark.parametrize("levels", [2, 5, 1000])
def test_medians_are_those_of_numpy(kind: type, levels: int) -> None:
    rng = np.random.default_rng(levels)
    for n in (*range(1, 12), 80, 81, 1000):
        values = (rng.integers(levels, size=n) / 7).astype(kind)
        left = values.copy()
        assert median(left) == np.median(values)
        assert np.array_equal(np.sort(left), np.sort(values))
    assert np.isnan(median(np.empty(0, kind)))


@pytest.mark.parametrize("levels", [2, 5, 1000])
def test_equal_numbers_stay_in_order(levels: int) -> None:
    rng = np.random.default_rng(levels)
    for n in (*range(12), 80, 81, 1000):
        values = rng.integers(levels, size=n) / 7
        values[rng.random(n) < 0.05] = -np.inf
        assert np.array_equal(order(values), np.argsort(values, kind="stable"))
