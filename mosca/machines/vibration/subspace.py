"""Poles and shapes from correlations: covariance-driven stochastic subspace identification (SSI-cov).

Peeters and De Roeck, Reference-based stochastic subspace identification, 1999. Correlations are means over pairs of
measured samples, so that gaps need no filling.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import svd

from mosca.data.arrays import Array, set_read_only
from mosca.machines.vibration.modal import mac, phase_collinearity

_Pole = tuple[int, float, float, Array, bool]


@dataclass(frozen=True, eq=False)
class Poles:
    """Poles of models of several orders, one row per pole and order."""

    order: Array
    """(p,)"""
    frequency_hz: Array
    """(p,)"""
    damping: Array
    """(p,)"""
    shape: Array
    """(p, c) complex."""
    stable: Array
    """(p,) whether the order before has nearly the same pole."""

    def __post_init__(self) -> None:
        p = len(np.asarray(self.order))
        set_read_only(self, np.int64, order=(p,))
        set_read_only(self, frequency_hz=(p,), damping=(p,))
        set_read_only(self, np.complex128, shape=(p, None))
        set_read_only(self, np.bool_, stable=(p,))

    def __len__(self) -> int:
        return len(self.order)


@dataclass(frozen=True)
class SubspaceSettings:
    """Settings for fitting models and selecting poles as modes."""

    components: int = 16
    """Principal directions of the channels that are kept."""
    block_rows: int = 50
    """Lags in either direction: at least a quarter period of the lowest mode, more for close modes."""
    orders: tuple[int, ...] = tuple(range(4, 61, 2))
    frequency_step: float = 0.01
    """Largest relative change of a stable pole's frequency from one order to the next."""
    damping_step: float = 0.2
    """The same for its damping, which is known an order of magnitude less well than its frequency."""
    shape_mac: float = 0.95
    """Least MAC of a stable pole's shapes from one order to the next."""
    most_damping: float = 0.2
    least_mpc: float = 0.7
    least_share: float = 0.6
    """Least share of the orders, from the first that has it, in which a mode is stable."""


def correlations(values: Array, lags: int) -> Array:
    """Return R (lags + 1, c, c) = mean of y(t + l) y(t)^T for values y (t, c), NaN where not measured."""
    there = np.isfinite(values)
    y, m = np.where(there, values, 0.0), there.astype(np.float64)
    t = len(y)
    complete = bool(there.all())
    result = np.empty((lags + 1, y.shape[1], y.shape[1]))
    for lag in range(lags + 1):
        pairs = float(t - lag) if complete else np.maximum(m[lag:].T @ m[: t - lag], 1.0)
        result[lag] = (y[lag:].T @ y[: t - lag]) / pairs
    return result


def poles_of(correlation: Array, rate_hz: float, basis: Array, settings: SubspaceSettings) -> Poles:
    """Return the poles of all orders from correlations (2 i, c, c) at ``rate_hz``, shapes by ``basis`` (channels, c).

    Poles that grow, do not oscillate or are damped more than ``most_damping`` are left out.
    """
    i, c = len(correlation) // 2, correlation.shape[1]
    hankel = np.block([[correlation[j + k + 1] for k in range(i)] for j in range(i)])
    u, s, _ = svd(hankel, full_matrices=False, lapack_driver="gesdd")
    rows: list[_Pole] = []
    before: list[_Pole] = []
    for order in settings.orders:
        if order > min(len(s), c * (i - 1)):
            break
        observed = u[:, :order] * np.sqrt(s[:order])
        transition = np.linalg.lstsq(observed[:-c], observed[c:], rcond=None)[0]
        value, vector = np.linalg.eig(transition)
        pole = np.log(value.astype(np.complex128)) * rate_hz
        frequency, damping = np.abs(pole) / (2 * np.pi), -pole.real / np.maximum(np.abs(pole), 1e-300)
        kept = (pole.imag > 0) & (damping > 0) & (damping < settings.most_damping)
        shapes = (basis @ (observed[:c] @ vector[:, kept])).T
        own = [
            (order, f, d, shape, _has(before, f, d, shape, settings))
            for f, d, shape in zip(frequency[kept], damping[kept], shapes, strict=True)
        ]
        rows, before = rows + own, own
    orders, frequencies, dampings, stable = (np.array([row[k] for row in rows]) for k in (0, 1, 2, 4))
    shape = np.array([row[3] for row in rows]) if rows else np.empty((0, len(basis)))
    return Poles(orders, frequencies, dampings, shape, stable)


def _has(poles: list[_Pole], f: float, d: float, shape: Array, s: SubspaceSettings) -> bool:
    """Return whether one of ``poles`` is nearly (f, d, shape)."""
    return any(
        abs(other / f - 1) < s.frequency_step
        and abs(damped / d - 1) < s.damping_step
        and mac(shape, its)[0, 0] > s.shape_mac
        for _, other, damped, its, _ in poles
    )


@dataclass(frozen=True, eq=False)
class Candidate:
    """A pole that is stable from order to order: medians, a complex shape (c,), share of orders that have it."""

    frequency_hz: float
    damping: float
    shape: Array
    orders: float


def candidates(poles: Poles, settings: SubspaceSettings) -> tuple[Candidate, ...]:
    """Return groups of stable poles with nearly one frequency and shape over the orders, lowest frequency first."""
    left = np.flatnonzero(poles.stable)
    orders = np.unique(poles.order)
    found = []
    while len(left):
        f = poles.frequency_hz[left]
        near = np.abs(f[:, None] / f[None, :] - 1) < settings.frequency_step
        alike = near & (mac(poles.shape[left].T, poles.shape[left].T) > settings.shape_mac)
        members = left[alike[np.argmax(alike.sum(axis=1))]]
        left = np.setdiff1d(left, members)
        own = np.unique(poles.order[members])
        share = len(own) / max(int(np.sum(orders > own[0])), 1)
        middle = members[np.argsort(poles.frequency_hz[members])[len(members) // 2]]
        shape = poles.shape[middle]
        if len(own) < 3 or share < settings.least_share or phase_collinearity(shape) < settings.least_mpc:
            continue
        frequency, damping = (float(np.median(v[members])) for v in (poles.frequency_hz, poles.damping))
        found.append(Candidate(frequency, damping, shape, min(share, 1.0)))
    return tuple(sorted(found, key=lambda one: one.frequency_hz))
