"""Responses of single poles to held inputs: exact in continuous time, between samples too.

A mode is x' = lambda x + u. Over an interval of length T with u held, x(T) = e^(lambda T) x(0) +
(e^(lambda T) - 1) / lambda u; a command inside the interval adds the same of its change and of the time that is left.
The mean of x over an interval follows from its ends: ((x(T) - x(0)) / T - mean of u) / lambda.
"""

import numpy as np

from mosca.data.arrays import Array
from mosca.machines.identification.held_inputs import InputsOnGrid, IntervalGrid


def poles_of(logs: Array) -> Array:
    """Return the poles [rad/s], one of each complex pair, of sections with coefficients of logarithms ``logs`` (n,).

    Two values b, c a section s^2 + e^b s + e^c, and a last one a of s + e^a where n is odd: all are stable, and real
    poles become a complex pair without a step.
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
    """Return what ``poles_of`` makes stable ``poles`` of, one of each pair; an odd number's slowest is alone."""
    pairs = [p for p in poles if p.imag != 0]
    real = sorted((p.real for p in poles if p.imag == 0), reverse=True)
    alone = [real.pop(0)] if len(real) % 2 else []
    logs = [v for p in pairs for v in (np.log(-2.0 * p.real), np.log(abs(p) ** 2))]
    for one, two in zip(real[::2], real[1::2], strict=True):
        logs += [np.log(-one - two), np.log(one * two)]
    return np.array(logs + [np.log(-p) for p in alone])


def states(poles: Array, inputs: InputsOnGrid, grid: IntervalGrid) -> Array:
    """Return the states (n + 1, l, k) of the modes of ``poles`` (l,) for each input, from 0 at the first instant."""
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
    """Return the real regressors (n, c) of an output: what its linear coefficients multiply.

    For each pole its response to each input and to its own initial state (real and imaginary part of a complex one),
    then a constant. ``of_inputs`` (n, l, k): ``interval_means``, or ``states``; ``means``: which of them.
    """
    t = grid.period_s * np.arange(len(of_inputs))
    made = []
    for j, pole in enumerate(poles):
        free = np.exp(pole * t) * (np.expm1(pole * grid.period_s) / (pole * grid.period_s) if means else 1.0)
        both = np.column_stack([of_inputs[:, j], free])
        made += [both.real] if pole.imag == 0 else [both.real, both.imag]
    return np.column_stack([*made, np.ones(len(t))])


def gains(poles: Array, coefficients: Array, inputs: int) -> Array:
    """Return the DC gains (k,) of ``coefficients`` (c,) of the columns of ``columns``, k ``inputs``."""
    result, at = np.zeros(inputs), 0
    for pole in poles:
        at_rest = -1.0 / pole
        for part in (at_rest.real,) if pole.imag == 0 else (at_rest.real, at_rest.imag):
            result += coefficients[at : at + inputs] * part
            at += inputs + 1
    return result
