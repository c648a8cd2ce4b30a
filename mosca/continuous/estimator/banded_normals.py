"""Normal equations of curves: block-banded in time, bordered by unknowns that do not depend on time.

    [T  B] [x]   [g]
    [B' C] [s] = [h]

T is banded (a coefficient is coupled only to its neighbours in time), so that all costs are linear in the duration.
One ``Band`` holds one group of coupled unknowns; groups are coupled only through s.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import cholesky_banded, lapack, solve_triangular

from mosca.data.arrays import Array
from mosca.numba_support.decorators import kernel

ROUNDING = 1e-13
"""Relative rounding error of sums of many squares, as a share of the largest number."""
BLOCK = 48
"""Smallest block of the selected inversion: for smaller ones the calls cost more than the sums."""


class Rows(NamedTuple):
    """n equations ``J x + shared s = rest`` of standard deviation 1."""

    first: Array
    """(n,) first coefficient in time that an equation touches."""
    weights: Array
    """(n, reach) weights of it and the following coefficients."""
    columns: Array
    """(n, v) unknowns of each of these coefficients, -1 for none."""
    values: Array
    """(n, v) derivatives by these unknowns."""
    shared: Array
    """(n, b) derivatives by the unknowns that do not depend on time."""
    rest: Array
    """(n,)."""

    def applied(self, x: Array, width: int) -> Array:
        """Return J x (n,) of unknowns x (count * width,)."""
        result: Array = apply_rows(x, width, self)
        return result


class Band:
    """T, g and B of one group: ``count`` coefficients in time of ``width`` unknowns each."""

    def __init__(self, count: int, reach: int, width: int, shared: int) -> None:
        self.count, self.reach, self.width = count, reach, width
        self.band = np.zeros((reach * width, count * width), order="F")
        self.right = np.zeros(count * width)
        self.border = np.zeros((count * width, shared))

    def add(self, rows: Rows) -> None:
        """Add the normal equations of ``rows``."""
        add_rows(self.band, self.right, self.border, self.width, rows)

    def add_prior(self, gram: Array, precision: Array) -> None:
        """Add ``gram`` (banded over time, lower) times ``precision`` (width, width) between the unknowns."""
        blocks = self.band.T.reshape(self.count, self.width, -1)
        for offset in range(gram.shape[0]):
            scale = gram[offset, : self.count - offset]
            for c in range(self.width):
                # column c of block k holds rows from its own diagonal on
                low = c if offset == 0 else 0
                start = offset * self.width + low - c
                into = blocks[: self.count - offset, c, start : start + self.width - low]
                into += scale[:, None] * precision[low:, c]

    def hold(self, x: Array) -> None:
        """Hold every unknown at ``x`` (count * width,), with a weight of the largest number's rounding error."""
        firm = ROUNDING * self.band[0].max()
        self.band[0] += firm
        self.right += firm * x

    def factor(self) -> "Factor":
        """Return the Cholesky factor; the band's memory goes with it."""
        lower = cholesky_banded(self.band, overwrite_ab=False, lower=True, check_finite=False)
        return Factor(lower, self.count, self.reach, self.width)


@dataclass(frozen=True, eq=False)
class Factor:
    """T = L L^T, L lower banded as LAPACK stores it."""

    lower: Array
    count: int
    reach: int
    width: int

    def solve(self, right: Array) -> Array:
        """Return T^-1 right, (n,) or (n, b)."""
        if right.size == 0:
            return right
        found, info = lapack.dpbtrs(self.lower, right, lower=1)
        if info:
            raise ValueError(f"banded solve: LAPACK dpbtrs returned {info}")
        return np.asarray(found).reshape(right.shape)

    def spread(self, random: Array) -> Array:
        """Return L^-T random: standard normal numbers (n, b) become errors of covariance T^-1."""
        found, info = lapack.dtbtrs(self.lower, random, uplo="L", trans="T")
        if info:
            raise ValueError(f"banded solve: LAPACK dtbtrs returned {info}")
        return np.asarray(found).reshape(random.shape)

    def inverse_blocks(self, unknowns: int) -> Array:
        """Return the blocks of T^-1 between coefficients k + o and k of each triple of unknowns.

        (reach, count, unknowns, 3, 3) for o = 0 .. reach - 1 and the first ``unknowns`` triples; zero beyond the end.
        The inverse within the band is computed from L alone, from the end back (Takahashi 1973), in dense blocks:
        S_kk = L_kk^-T L_kk^-1 + G^T S_(k+1)(k+1) G with G = L_(k+1)k L_kk^-1, and S_(k+1)k = -S_(k+1)(k+1) G.
        """
        blocks = np.zeros((self.reach, self.count, unknowns, 3, 3))
        for start, own, across in self._inverse():
            self._keep(blocks, own, start, start, unknowns)
            if across is not None:
                self._keep(blocks, across, start + self.step, start, unknowns)
        return blocks

    @property
    def step(self) -> int:
        """Number of coefficients that the selected inversion takes at once."""
        return max(self.reach - 1, -(-BLOCK // self.width))

    def _inverse(self) -> Iterator[tuple[int, Array, Array | None]]:
        """Yield blocks from the end back: first coefficient, T^-1 within the block, T^-1 with the next block."""
        step = self.step
        after: Array | None = None
        after_size = 0
        for start in reversed(range(0, self.count, step)):
            size = min(step, self.count - start)
            inner = self._dense(start, start, size, size)
            inverse = solve_triangular(inner, np.eye(len(inner)), lower=True, check_finite=False)
            own = inverse.T @ inverse
            across = None
            if after is not None:
                ahead = self._dense(start + size, start, after_size, size) @ inverse
                across = -after @ ahead
                own -= ahead.T @ across
            yield start, own, across
            after, after_size = own, size

    def _dense(self, row: int, column: int, rows: int, columns: int) -> Array:
        """Return the part of L from coefficients ``row`` and ``column`` on as a dense matrix."""
        w = self.width
        i = row * w + np.arange(rows * w)[:, None]
        j = column * w + np.arange(columns * w)[None, :]
        offset = i - j
        inside = (offset >= 0) & (offset < len(self.lower))
        return np.where(inside, self.lower[np.where(inside, offset, 0), np.broadcast_to(j, offset.shape)], 0.0)

    def _keep(self, blocks: Array, dense: Array, row: int, column: int, unknowns: int) -> None:
        """Copy the part of S from coefficients ``row`` and ``column`` on that lies within reach into ``blocks``."""
        w = self.width
        whole = dense.reshape(len(dense) // w, w, -1, w)[:, : 3 * unknowns, :, : 3 * unknowns]
        triples = whole.reshape(whole.shape[0], unknowns, 3, whole.shape[2], unknowns, 3)
        own = np.einsum("kpilpj->klpij", triples)
        for a in range(own.shape[0]):
            for b in range(own.shape[1]):
                offset = row + a - column - b
                if 0 <= offset < self.reach:
                    blocks[offset, column + b] = own[a, b]


def solve_bordered(
    factors: list[Factor], rights: list[Array], borders: list[Array], corner: Array, corner_right: Array
) -> tuple[list[Array], Array, list[Array], Array]:
    """Solve the bordered system of groups.

    Returns the groups' x, s (b,), the groups' T^-1 B and the covariance of s (b, b).
    """
    reduced, right = corner.copy(), corner_right.copy()
    firsts, carried = [], []
    for factor, g, border in zip(factors, rights, borders, strict=True):
        firsts.append(factor.solve(g))
        carried.append(factor.solve(border))
        reduced -= border.T @ carried[-1]
        right -= border.T @ firsts[-1]
    if not len(corner):
        return firsts, np.empty(0), carried, np.empty((0, 0))
    # offsets [s], drifts and angles differ by orders of magnitude: scaled before inverting
    scale = 1 / np.sqrt(np.diag(corner))
    covariance = scale[:, None] * np.linalg.inv(scale[:, None] * reduced * scale) * scale
    shared = covariance @ right
    return [x - c @ shared for x, c in zip(firsts, carried, strict=True)], shared, carried, covariance


@kernel
def add_rows(band: Array, right: Array, border: Array, width: int, rows: Rows) -> None:  # pragma: no cover
    """Add rows ``rest = J x`` (n,): J^T J into ``band``, J^T rest into ``right``, J^T shared into ``border``.

    ``band[i - j, j]`` (i >= j) holds the lower half. Unknown (k, c) has index k * ``width`` + c. Row r depends on the
    coefficients ``first[r]`` + a with ``weights[r, a]``, and on the unknowns ``columns[r]`` (-1: none) of each with
    ``values[r]``; ``shared`` (n, b) are its derivatives by unknowns that do not depend on time.
    """
    first, weights, columns, values, shared, rest = rows
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
def leverages(lower: Array, first: Array, weights: Array, by: Array) -> Array:  # pragma: no cover
    """Return J T^-1 J^T (n, m, m) of each point's m equations.

    J of a point is ``weights`` (n, reach) of the coefficients from ``first`` (n,) on, times ``by`` (n, m, width).
    T = L L^T; ``lower`` (b, count * width) contains L as LAPACK stores it. The inverse within the band is computed
    from L alone, from the end back (Takahashi, Fagan and Chin 1973). For narrow bands, as calls for the dense blocks
    of ``Factor.inverse_blocks`` cost more than the sums there.
    """
    height, size = lower.shape
    inverse = np.zeros((height, size))
    for j in range(size - 1, -1, -1):
        below = min(height - 1, size - 1 - j)
        own = 1.0 / lower[0, j]
        for i in range(below, -1, -1):
            total = own if i == 0 else 0.0
            for k in range(1, below + 1):
                total -= lower[k, j] * inverse[abs(i - k), j + min(i, k)]
            inverse[i, j] = total * own
    (n, reach), m, width = weights.shape, by.shape[1], by.shape[2]
    result = np.zeros((n, m, m))
    for r in range(n):
        for v in range(m):
            for j in range(reach * width):
                covariance = 0.0
                for i in range(reach * width):
                    at = inverse[abs(i - j), first[r] * width + min(i, j)]
                    covariance += weights[r, i // width] * by[r, v, i % width] * at
                for u in range(m):
                    result[r, v, u] += covariance * weights[r, j // width] * by[r, u, j % width]
    return result


@kernel
def apply_rows(x: Array, width: int, rows: Rows) -> Array:  # pragma: no cover
    """Return J x (n,) of rows as in ``add_rows``."""
    first, weights, columns, values = rows.first, rows.weights, rows.columns, rows.values
    n, reach = weights.shape
    result = np.zeros(n)
    for r in range(n):
        for a in range(reach):
            for v in range(columns.shape[1]):
                if columns[r, v] >= 0:
                    result[r] += weights[r, a] * values[r, v] * x[(first[r] + a) * width + columns[r, v]]
    return result
