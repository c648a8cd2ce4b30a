"""Poles of an ARX model by linear least squares: fast, biased by the output's noise; used to start the search.

y(k) + a_1 y(k-1) + ... + a_n y(k-n) = sum over inputs and i = 0..n of b_i u(k-i), plus a constant (Ljung 1999, 4.2).
The output's noise is in the regressors y(k-i), which biases the poles towards 0.
"""

import numpy as np

from mosca.data.arrays import Array
from mosca.machines.identification.held_inputs import on_grid
from mosca.machines.identification.output_error import OutputRecord


def arx_poles(record: OutputRecord, order: int, delay_s: float) -> Array:
    """Return the discrete poles (order,) by least squares over samples whose last ``order`` values are measured."""
    u = on_grid(record.inputs, delay_s, record.grid).mean
    y = record.values
    n = len(y) - order
    past = [y[order - i : order - i + n] for i in range(1, order + 1)]
    given = [u[order - i : order - i + n, j] for i in range(order + 1) for j in range(u.shape[1])]
    table = np.column_stack([*past, *given, np.ones(n)])
    rows = np.isfinite(table).all(axis=1) & np.isfinite(y[order:])
    solution = np.linalg.lstsq(table[rows], y[order:][rows], rcond=None)[0]
    return np.roots(np.concatenate([[1.0], -solution[:order]]))


def continuous(discrete: Array, period_s: float) -> Array | None:
    """Return the continuous poles [rad/s], one of each pair, of ``discrete`` ones; None where one has no counterpart.

    These are unstable poles, and poles on the negative real axis, which no continuous system of the same order has.
    """
    if np.any(np.abs(discrete) >= 1) or np.any((np.abs(discrete.imag) < 1e-9) & (discrete.real <= 0)):
        return None
    half = discrete[discrete.imag >= 0]
    return np.asarray(np.log(half.astype(complex)) / period_s)
