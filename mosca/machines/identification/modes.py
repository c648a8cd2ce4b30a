"""Responses of single poles to held inputs: exact in continuous time, also between samples.

A mode is x' = lambda x + u. Over an interval of length T with u held, x(T) = e^(lambda T) x(0) +
(e^(lambda T) - 1) / lambda u. A command inside the interval adds the second term, with the input's change for u and
the remaining time for T. The mean of x over an interval follows from its ends: ((x(T) - x(0)) / T - mean of u) /
lambda.
"""

import numpy as np

from mosca.data.arrays import Array
from mosca.machines.identification.held_inputs import InputsOnGrid, IntervalGrid


def poles_of(logs: Array) -> Array:
    """Return the poles [rad/s], one of each complex pair, of sections with ``logs`` (n,) of their coefficients.

    Two values b, c give a section s^2 + e^b s + e^c; where n is odd, the last value a gives s + e^a. All poles are
    stable, and two real poles become a complex pair continuously.
    """
    poles: list[complex] = []
    for k in range(0, len(logs) - 1, 2):
        b, c = np.exp(logs[k : k + 2])
        if b * b >= 4.0 * c:
            fast = -(b + np.sqrt(b * b - 4.0 * c)) / 2.0
            poles += [c / fast, fast]
        else:
            poles.append(complex(-b / 2.0, np.sqrt(4.0 * c - b * b) / 2.0))
    if len(logs) % 2:
        poles.append(-np.exp(logs[-1]))
    return np.array(poles, dtype=complex)


def logs_of(poles: Array) -> Array:
    """Return the ``logs`` from which ``poles_of`` makes stable ``poles``, given one of each complex pair.

    Of an odd number of real poles the slowest has a section of its own.
    """
    pairs = [p for p in poles if p.imag != 0]
    real = sorted((p.real for p in poles if p.imag == 0), reverse=True)
    alone = [real.pop(0)] if len(real) % 2 else []
    logs = [v for p in pairs for v in (np.log(-2.0 * p.real), np.log(abs(p) ** 2))]
    for one, two in zip(real[::2], real[1::2], strict=True):
        logs += [np.log(-one - two), np.log(one * two)]
    return np.array(logs + [np.log(-p) for p in alone])


def states(poles: Array, inputs: InputsOnGrid, grid: IntervalGrid) -> Array:
    """Return the states (n + 1, l, k) of the modes of ``poles`` (l,) for each input, starting from 0."""
    from scipy.signal import lfilter  # takes a second to import

    result = np.zeros((grid.n + 1, len(poles), inputs.at_start.shape[1]), dtype=complex)
    for j, pole in enumerate(poles):
        driven = inputs.at_start * (np.expm1(pole * grid.period_s) / pole)
        np.add.at(driven, inputs.row, inputs.step * (np.expm1(pole * inputs.rest_s) / pole)[:, None])
        result[1:, j] = lfilter([1.0], [1.0, -np.exp(pole * grid.period_s)], driven, axis=0)
    return result


def interval_means(poles: Array, inputs: InputsOnGrid, grid: IntervalGrid) -> Array:
    """Return the means (n, l, k) of the same states over the grid's intervals."""
    x = states(poles, inputs, grid)
    return np.asarray((np.diff(x, axis=0) / grid.period_s - inputs.mean[:, None, :]) / poles[:, None])


def columns(poles: Array, of_inputs: Array, grid: IntervalGrid, *, means: bool) -> Array:
    """Return the real regressors (n, c) of an output, which its linear coefficients multiply.

    They are, for each pole, its response to each input and to its initial state (real and imaginary part of a complex
    one), then a constant. ``of_inputs`` (n, l, k): ``interval_means`` if ``means``, else ``states``.
    """
    t = grid.period_s * np.arange(len(of_inputs))
    made = []
    for j, pole in enumerate(poles):
        free = np.exp(pole * t) * (np.expm1(pole * grid.period_s) / (pole * grid.period_s) if means else 1.0)
        both = np.column_stack([of_inputs[:, j], free])
        made += [both.real] if pole.imag == 0 else [both.real, both.imag]
    return np.column_stack([*made, np.ones(len(t))])


def gains(poles: Array, coefficients: Array, inputs: int) -> Array:
    """Return the DC gains (k,) for ``coefficients`` (c,) of the regressors of ``columns``; k is ``inputs``."""
    result, at = np.zeros(inputs), 0
    for pole in poles:
        at_rest = -1.0 / pole
        for part in (at_rest.real,) if pole.imag == 0 else (at_rest.real, at_rest.imag):
            result += coefficients[at : at + inputs] * part
            at += inputs + 1
    return result
