"""Uniform B-splines in time: values, derivatives, and the exact integral of a squared derivative.

A curve is ``x(t) = sum_k c_k N((t - start) / step + degree - k)`` with the cardinal B-spline ``N`` of ``degree`` on
[0, degree + 1] (de Boor 1978). All pieces are equal, so one small matrix maps a position within a piece to the
weights of the ``degree + 1`` coefficients that affect it.
"""

from dataclasses import dataclass
from functools import lru_cache
from math import ceil

import numpy as np
from scipy.interpolate import BSpline, PPoly
from scipy.linalg import solveh_banded

from mosca.data.arrays import Array


@dataclass(frozen=True)
class Knots:
    """Equally spaced knots: ``pieces`` polynomials of ``degree``, ``step_s`` long each, from ``start_s`` on."""

    start_s: float
    step_s: float
    pieces: int
    degree: int = 5

    @property
    def count(self) -> int:
        """Number of coefficients of one curve."""
        return self.pieces + self.degree

    @property
    def end_s(self) -> float:
        """End of the last piece [s]."""
        return self.start_s + self.pieces * self.step_s

    @property
    def breaks_s(self) -> Array:
        """Instants (pieces + 1,) at which pieces meet [s]."""
        return self.start_s + self.step_s * np.arange(self.pieces + 1)

    def covers(self, time_s: Array) -> Array:
        """Return at which instants (n,) the curve is defined; a rounding error beyond the ends is allowed."""
        t, slack = np.asarray(time_s), 1e-9 * self.step_s
        return np.asarray((t >= self.start_s - slack) & (t <= self.end_s + slack))

    def weights(self, time_s: Array, derivative: int = 0) -> tuple[Array, Array]:
        """Return for instants (n,) the first coefficient (n,) and the weights (n, degree + 1) from it on.

        ``derivative``: weights of that derivative by time [1/s^derivative]. Instants outside are extrapolated from
        the first or last piece.
        """
        along = (np.asarray(time_s, dtype=float) - self.start_s) / self.step_s
        first = np.clip(np.floor(along), 0, self.pieces - 1).astype(np.int64)
        inside = along - first
        piece = _derived(self.degree, derivative)
        powers = inside[:, None] ** np.arange(piece.shape[1])
        return first, powers @ piece.T / self.step_s**derivative

    def gram(self, derivative: int, weight: Array | None = None) -> Array:
        """Return the matrix G of ``integral of (d^m x / dt^m)^2 dt = c^T G c`` over all pieces, lower banded.

        ``gram[o, k]`` is G between coefficients k + o and k, (degree + 1, count); exact. ``weight`` (pieces,): weight
        of each piece's integral.
        """
        return self.gram_of(np.eye(derivative + 1)[derivative], weight)

    def gram_of(self, operator: Array, weight: Array | None = None) -> Array:
        """Return the matrix, stored as by ``gram``, of the integral of (sum_k ``operator``[k] d^k x / dt^k)^2."""
        piece = np.zeros((self.degree + 1, self.degree + 1))
        for k, times in enumerate(operator):
            one = _derived(self.degree, k)
            piece[:, : one.shape[1]] += times * self.step_s**-k * one
        power = np.arange(piece.shape[1])
        local = piece @ (1.0 / (power[:, None] + power + 1)) @ piece.T * self.step_s
        banded = np.zeros((self.degree + 1, self.count))
        each = np.ones(self.pieces) if weight is None else weight
        for offset in range(self.degree + 1):
            for low in range(self.degree + 1 - offset):
                banded[offset, low : low + self.pieces] += local[low + offset, low] * each
        return banded


def knots_over(start_s: float, end_s: float, step_s: float, degree: int = 5) -> Knots:
    """Return knots from ``start_s`` to ``end_s``, at most ``step_s`` apart; both ends are knots."""
    pieces = max(1, ceil((end_s - start_s) / step_s - 1e-9))
    return Knots(start_s, (end_s - start_s) / pieces, pieces, degree)


def values(knots: Knots, coefficients: Array, time_s: Array, derivative: int = 0) -> Array:
    """Return the values (n, ...) at instants (n,) of the curves with ``coefficients`` (count, ...)."""
    return combined(*knots.weights(time_s, derivative), np.asarray(coefficients))


def combined(first: Array, weight: Array, coefficients: Array) -> Array:
    """Return sums (n, ...) of the ``coefficients`` (count, ...) from ``first`` (n,) on, by ``weight`` (n, k)."""
    reached = first[:, None] + np.arange(weight.shape[1])
    return np.asarray(np.einsum("na,na...->n...", weight, coefficients[reached]))


def fitted(knots: Knots, time_s: Array, places: Array) -> Array:
    """Return the coefficients (count, ...) of the curves that fit ``places`` (n, ...) at instants (n,) best."""
    first, weight = knots.weights(time_s)
    flat = np.asarray(places, dtype=float).reshape(len(first), -1)
    band = np.zeros((knots.degree + 1, knots.count))
    right = np.zeros((knots.count, flat.shape[1]))
    for a in range(knots.degree + 1):
        np.add.at(right, first + a, weight[:, a, None] * flat)
        for b in range(a + 1):
            np.add.at(band[a - b], first + b, weight[:, a] * weight[:, b])
    # coefficients that no instant depends on are 0
    band[0] += 1e-12 * band[0].max()
    return np.asarray(solveh_banded(band, right, lower=True).reshape(knots.count, *np.shape(places)[1:]))


@lru_cache(maxsize=32)
def _derived(degree: int, derivative: int) -> Array:
    """Return the matrix from powers of the position in a piece (0 to 1) to the weights' derivatives."""
    spline = BSpline.basis_element(np.arange(degree + 2.0), extrapolate=False)
    pieces = PPoly.from_spline((spline.t, spline.c, degree)).derivative(derivative)
    # the piece [k, k + 1] of N belongs to the coefficient whose spline started k pieces ago
    inner = pieces.c[::-1, (pieces.x[:-1] >= 0) & (pieces.x[:-1] <= degree) & (np.diff(pieces.x) > 0)]
    return np.ascontiguousarray(inner.T[::-1])
