"""Sums of squared rows into a symmetric banded matrix, kept as LAPACK wants it."""

import numpy as np

from mosca.data.arrays import Array
from mosca.numba_support.decorators import kernel


@kernel
def add_rows(
    band: Array,
    right: Array,
    border: Array,
    width: int,
    first: Array,
    weights: Array,
    columns: Array,
    values: Array,
    shared: Array,
    rest: Array,
) -> None:  # pragma: no cover
    """Add rows ``rest = J x`` (n,): J^T J into ``band``, J^T rest into ``right``, J^T shared into ``border``.

    ``band[i - j, j]`` (i >= j) holds the lower half. Unknown (k, c) stands at k * ``width`` + c. Row r reaches the
    coefficients ``first[r]`` + a with ``weights[r, a]``, and of each the ``columns[r]`` (-1: none) with
    ``values[r]``; ``shared`` (n, b) are its derivatives by unknowns that have no time.
    """
    n, reach = weights.shape
    most = columns.shape[1]
    at = np.empty(reach * most, np.int64)
    of = np.empty(reach * most, np.float64)
    for r in range(n):
        m = 0
        for a in range(reach):
            for v in range(most):
                if columns[r, v] >= 0:
                    at[m] = (first[r] + a) * width + columns[r, v]
                    of[m] = weights[r, a] * values[r, v]
                    m += 1
        for i in range(m):
            right[at[i]] += of[i] * rest[r]
            for b in range(shared.shape[1]):
                border[at[i], b] += of[i] * shared[r, b]
            for j in range(m):
                if at[i] >= at[j]:
                    band[at[i] - at[j], at[j]] += of[i] * of[j]


@kernel
def apply_rows(
    x: Array, width: int, first: Array, weights: Array, columns: Array, values: Array
) -> Array:  # pragma: no cover
    """Return J x (n,) of rows as in ``add_rows``."""
    n, reach = weights.shape
    result = np.zeros(n)
    for r in range(n):
        for a in range(reach):
            for v in range(columns.shape[1]):
                if columns[r, v] >= 0:
                    result[r] += weights[r, a] * values[r, v] * x[(first[r] + a) * width + columns[r, v]]
    return result
