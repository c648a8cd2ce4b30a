"""Output-error models of one output, in continuous time: least squares of the simulated response, with intervals.

The model's response to the commands alone is compared with the measured mean velocities. Noise of the output is in
the residual, not in the regressors, so it causes no bias (Ljung 1999, sections 4.2 and 8.4; an ARX model's least
squares do regress on the noisy output). For a nonlinear system the estimate tends to its best linear approximation
for inputs of that kind (Pintelon and Schoukens 2012, chapter 3). The residual then contains the nonlinear part, which
is coloured and depends on the input. The covariance is therefore the sandwich of White (1982), with the scores summed
over blocks of time much longer than the system's memory. For few blocks, a t distribution holds with one degree of
freedom less than the number of blocks (Bester, Conley and Hansen 2011).

Linear coefficients are solved for at each step (variable projection, Golub and Pereyra 1973): the search is over the
poles and the delay.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import qr
from scipy.optimize import least_squares

from mosca.data.arrays import Array, set_read_only
from mosca.data.distributions import t as student
from mosca.machines.identification.held_inputs import HeldInputs, IntervalGrid, on_grid
from mosca.machines.identification.modes import columns, gains, interval_means, poles_of, states

MOST_BLOCKS, FEWEST_BLOCKS = 30, 8
MEMORIES = 10
"""Least length of a block in units of the system's memory: half of that leaves 5 % of the variance of a sum to
correlations across its ends, double costs blocks."""
STEP = 1e-5
"""Step of the difference quotients, of logarithms and of periods."""


@dataclass(frozen=True, eq=False)
class OutputRecord:
    """Data that a model of one output is fitted to.

    ``values`` (n,): means over the intervals of ``grid``, NaN where not measured; ``inputs`` on the same clock.
    """

    grid: IntervalGrid
    values: Array
    inputs: HeldInputs

    def __post_init__(self) -> None:
        set_read_only(self, values=(self.grid.n,))

    @cached_property
    def rows(self) -> Array:
        """Indices of the measured intervals."""
        return np.flatnonzero(np.isfinite(self.values))

    def until(self, n: int) -> "OutputRecord":
        """Return the record with all intervals after the first ``n`` marked as not measured."""
        return OutputRecord(self.grid, np.where(np.arange(self.grid.n) < n, self.values, np.nan), self.inputs)


@dataclass(frozen=True, eq=False)
class OutputModel:
    """A model of one output: gain from each input by n poles, a delay, an offset.

    ``logs`` (n,) as for ``modes.poles_of``; ``coefficients`` (c,) of ``modes.columns``; ``delay_s``: time from a
    command to its effect.
    """

    logs: Array
    delay_s: float
    coefficients: Array

    def __post_init__(self) -> None:
        set_read_only(self, logs=(None,), coefficients=(None,))

    @property
    def poles(self) -> Array:
        """All poles (n,) [rad/s], each followed by its conjugate."""
        half = poles_of(self.logs)
        return np.array([p for one in half for p in ((one,) if one.imag == 0 else (one, one.conjugate()))])

    def gains(self, inputs: int) -> Array:
        """Return the DC gains (k,)."""
        return gains(poles_of(self.logs), self.coefficients, inputs)

    def response(self, inputs: HeldInputs, grid: IntervalGrid, *, means: bool, from_rest: bool = False) -> Array:
        """Return the output: means (n,) over the grid's intervals, or values (n + 1,) at its instants.

        ``from_rest``: without the initial state of the record to which the model was fitted.
        """
        poles = poles_of(self.logs)
        on = on_grid(inputs, self.delay_s, grid)
        made = (interval_means if means else states)(poles, on, grid)
        coefficients = np.array(self.coefficients)
        if from_rest:
            k = inputs.values.shape[1]
            coefficients[k : len(coefficients) - 1 : k + 1] = 0.0
        return np.asarray(columns(poles, made, grid, means=means) @ coefficients)


@dataclass(frozen=True, eq=False)
class OutputEstimate:
    """A fitted model and its uncertainty.

    ``quantities`` (q,): real and imaginary part of each pole, the slowest first [rad/s]; the k gains; the delay [s].
    ``covariance`` (q, q); ``quantile`` of the t distribution for 95 %; ``residual_rms`` by the degrees of freedom.
    """

    model: OutputModel
    quantities: Array
    covariance: Array
    blocks: int
    residual_rms: float

    @property
    def quantile(self) -> float:
        """Half-width of a 95 % interval in standard deviations."""
        return float(student.ppf(0.975, self.blocks - 1))

    @property
    def intervals(self) -> Array:
        """95 % intervals (q, 2) of the quantities."""
        half = self.quantile * np.sqrt(np.diag(self.covariance))
        return np.stack([self.quantities - half, self.quantities + half], axis=1)


def regressors(record: OutputRecord, logs: Array, delay_s: float) -> Array:
    """Return the regressors (rows, c) of the measured intervals for poles and a delay."""
    poles = poles_of(logs)
    on = on_grid(record.inputs, delay_s, record.grid)
    return columns(poles, interval_means(poles, on, record.grid), record.grid, means=True)[record.rows]


def fit(record: OutputRecord, logs: Array, delay_s: float, most_delay_s: float) -> OutputModel:
    """Return the least-squares model, searched from poles and a delay, which stays within +-``most_delay_s``.

    Poles are kept between the slowest one for which the record has FEWEST_BLOCKS blocks and the Nyquist frequency:
    others cannot be determined.
    """
    period = record.grid.period_s
    slow, fast = np.log(slowest_rate(record)), np.log(np.pi / period)
    low = np.array([slow, 2 * slow] * (len(logs) // 2) + [slow] * (len(logs) % 2) + [-most_delay_s / period])
    high = np.array([fast + np.log(2), 2 * fast] * (len(logs) // 2) + [fast] * (len(logs) % 2) + [-low[-1]])
    y = record.values[record.rows]

    def residual(at: Array) -> Array:
        q, _ = qr(regressors(record, at[:-1], at[-1] * period), mode="economic", check_finite=False)
        return np.asarray(y - q @ (q.T @ y))

    start = np.clip(np.append(logs, delay_s / period), low + 1e-6, high - 1e-6)
    found = least_squares(residual, start, bounds=(low, high), diff_step=STEP, ftol=1e-9, max_nfev=40).x
    a = regressors(record, found[:-1], found[-1] * period)
    return OutputModel(found[:-1], float(found[-1] * period), np.linalg.lstsq(a, y, rcond=None)[0])


def estimate(record: OutputRecord, model: OutputModel) -> OutputEstimate:
    """Return a model that was fitted to ``record``, with its uncertainty."""
    period, k = record.grid.period_s, record.inputs.values.shape[1]
    at = np.append(model.logs, model.delay_s / period)
    n, linear = len(at), model.coefficients

    def both(x: Array, c: Array) -> tuple[Array, Array]:
        """Return response and quantities."""
        poles = sorted(OutputModel(x[:-1], 0.0, c).poles, key=lambda p: (-p.real, p.imag))
        parts = [v for p in poles for v in (p.real, p.imag)]
        told = np.array([*parts, *gains(poles_of(x[:-1]), c, k), x[-1] * period])
        return regressors(record, x[:-1], x[-1] * period) @ c, told

    response, quantities = both(at, linear)
    a = regressors(record, model.logs, model.delay_s)
    jacobian, change = np.empty((len(a), n + len(linear))), np.zeros((len(quantities), n + len(linear)))
    for j in range(n):
        move = np.where(np.arange(n) == j, STEP, 0.0)
        (up, told_up), (down, told_down) = both(at + move, linear), both(at - move, linear)
        jacobian[:, j] = (up - down) / (2 * STEP)
        change[:, j] = (told_up - told_down) / (2 * STEP)
    jacobian[:, n:] = a
    for j in range(len(linear)):
        unit = np.where(np.arange(len(linear)) == j, 1.0, 0.0)
        change[-1 - k : -1, n + j] = gains(poles_of(model.logs), unit, k)
    residual = record.values[record.rows] - response
    block, count = _blocks(record, model)
    scale = np.linalg.norm(jacobian, axis=0)
    scale[scale == 0] = 1.0
    inverse = np.linalg.pinv((jacobian / scale).T @ (jacobian / scale)) / np.outer(scale, scale)
    scores = np.zeros((count, jacobian.shape[1]))
    np.add.at(scores, block, jacobian * residual[:, None])
    covariance = inverse @ (scores.T @ scores) @ inverse * (count / (count - 1))
    rms = float(np.sqrt(residual @ residual / max(len(residual) - jacobian.shape[1], 1)))
    return OutputEstimate(model, quantities, change @ covariance @ change.T, count, rms)


def slowest_rate(record: OutputRecord) -> float:
    """Return the absolute value [rad/s] of the slowest pole for which the record is long enough."""
    return FEWEST_BLOCKS * MEMORIES / (len(record.rows) * record.grid.period_s)


def block_length_s(record: OutputRecord, model: OutputModel) -> float:
    """Return the least length [s] of a block: MEMORIES times the sum of slowest time constant and command's hold."""
    held = float(np.median(np.diff(record.inputs.time_s))) if len(record.inputs.time_s) > 1 else 0.0
    return MEMORIES * (float(np.max(-1.0 / model.poles.real)) + held)


def _blocks(record: OutputRecord, model: OutputModel) -> tuple[Array, int]:
    """Return the block (rows,) of each measured interval, and the number of blocks."""
    count = block_count(len(record.rows) * record.grid.period_s, block_length_s(record, model))
    return np.arange(len(record.rows)) * count // len(record.rows), count


def block_count(span_s: float, length_s: float) -> int:
    """Return the number of blocks of ``length_s`` in a span, limited to FEWEST_BLOCKS to MOST_BLOCKS."""
    return int(np.clip(span_s / length_s, FEWEST_BLOCKS, MOST_BLOCKS))
