"""The linear model from commands to v_x and yaw rate: orders, poles, gains and delays, with their uncertainty.

Orders are compared by the error on the last part of the take, which they were not fitted to. The smallest order whose
error is not significantly larger than that of the best order is chosen: an additional pole must show that it is
needed.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array
from mosca.data.distributions import t as student
from mosca.errors import InputError
from mosca.machines.identification.arx import arx_poles, continuous
from mosca.machines.identification.held_inputs import HeldInputs, IntervalGrid
from mosca.machines.identification.modes import logs_of, poles_of
from mosca.machines.identification.output_error import (
    FEWEST_BLOCKS,
    OutputEstimate,
    OutputModel,
    OutputRecord,
    block_count,
    block_length_s,
    estimate,
    fit,
    regressors,
    slowest_rate,
)
from mosca.machines.identification.realization import Realization, realization
from mosca.machines.identification.velocities import (
    OUTPUTS,
    UNITS,
    BodyVelocities,
    PlanarPath,
    mean_velocities,
    smoothed_velocities,
)

FIRST_RATES = (0.03, 0.1, 0.3)
"""Poles tried at each delay, in units of the sampling rate: responses of 3 to 30 samples are seen best."""
RESPONSE = 8
"""Length of the pulse response for the realization, in time constants: e^-8 is 0.03 %."""
Report = Callable[[int, int | None], None]


@dataclass(frozen=True)
class IdentifySettings:
    """How a model is identified."""

    most_order: int = 3
    """Largest order that is tried, from 1 on; one above the best order should show that it does not help."""
    most_delay_s: float = 0.2
    """Largest delay of the motion after the commands, or before them, where clocks differ."""
    held_out: float = 0.3
    """Share of the take, at its end, on which orders are compared."""


@dataclass(frozen=True, eq=False)
class IdentifiedOutput:
    """One output's model.

    ``held_out_rms``: rms error on the part held out, of the orders 1, 2, ... that were tried, in the output's unit;
    ``fit_held_out``: fit of the chosen order on that part, fitted without it [%]; ``arx``: discrete poles of the ARX
    model of that order.
    """

    name: str
    unit: str
    estimate: OutputEstimate
    held_out_rms: tuple[float, ...]
    fit_held_out: float
    arx: Array

    @property
    def order(self) -> int:
        """Number of poles."""
        return len(self.estimate.model.logs)


@dataclass(frozen=True, eq=False)
class IdentifiedModel:
    """Model of all outputs, and the data it was made from; times count from the first pose."""

    inputs: tuple[str, ...]
    outputs: tuple[IdentifiedOutput, ...]
    period_s: float
    realization: Realization
    velocities: BodyVelocities

    def response(self, inputs: HeldInputs, grid: IntervalGrid, *, means: bool, from_rest: bool = False) -> Array:
        """Return v_x [m/s] and yaw rate [rad/s] (n, 2), as ``OutputModel.response``."""
        models = [one.estimate.model for one in self.outputs]
        return np.stack([m.response(inputs, grid, means=means, from_rest=from_rest) for m in models], axis=1)


def fit_percent(measured: Array, modelled: Array) -> Array:
    """Return 100 (1 - |y - m| / |y - mean of y|) of each column [%]: 100 is perfect, 0 no better than the mean."""
    off = np.linalg.norm(measured - modelled, axis=0)
    return np.asarray(100.0 * (1.0 - off / np.linalg.norm(measured - measured.mean(axis=0), axis=0)))


def identify(
    path: PlanarPath,
    inputs: HeldInputs,
    settings: IdentifySettings | None = None,
    progress: Report = lambda done, total: None,
) -> IdentifiedModel:
    """Return the model of a take. ``inputs``: on a clock that is 0 at the first pose.

    Raises InputError where the inputs do not vary, or where the take is too short for the model's uncertainty.
    """
    settings = settings or IdentifySettings()
    grid, means = path.grid, mean_velocities(path)
    _check_inputs(inputs, grid, settings)
    records = [OutputRecord(grid, values, inputs) for values in means.T]
    searches, steps = [], len(records) * settings.most_order + 2
    for k, record in enumerate(records):
        counted = lambda order, k=k: progress(k * settings.most_order + order, steps)  # noqa: E731
        searches.append(_identified(record, settings, counted))
    models = [found.estimate.model for found in searches]
    # each command takes effect after the mean of the outputs' delays: the clocks' offset is common to them
    delay = float(np.mean([model.delay_s for model in models]))
    velocities = smoothed_velocities(path, inputs.time_s + delay)
    progress(steps - 1, steps)
    slowest = max(float(np.max(-1.0 / model.poles.real)) for model in models)
    samples = int(np.clip(RESPONSE * slowest / grid.period_s, 20, grid.n // (10 * len(inputs.names))))
    order = sum(found.order for found in searches)
    second = realization(records, [model.delay_s for model in models], order, samples)
    at = path.frame - path.frame[0]
    last = at >= round((1 - settings.held_out) * grid.n)
    shown = [found.first.response(inputs, grid, means=False)[at[last]] for found in searches]
    fits = fit_percent(velocities.values[last], np.stack(shown, axis=1))
    outputs = tuple(
        IdentifiedOutput(name, unit, one.estimate, one.rms, float(share), arx_poles(record, one.order, model.delay_s))
        for name, unit, one, share, record, model in zip(OUTPUTS, UNITS, searches, fits, records, models, strict=True)
    )
    progress(steps, steps)
    return IdentifiedModel(inputs.names, outputs, grid.period_s, second, velocities)


def fit_on(
    model: IdentifiedModel, path: PlanarPath, inputs: HeldInputs
) -> tuple[BodyVelocities, Array, tuple[float, ...]]:
    """Return velocities of another take, the model's response (n, 2) to its commands from rest, and the fits [%]."""
    delay = float(np.mean([one.estimate.model.delay_s for one in model.outputs]))
    velocities = smoothed_velocities(path, inputs.time_s + delay)
    answer = model.response(inputs, path.grid, means=False, from_rest=True)[path.frame - path.frame[0]]
    return velocities, answer, tuple(float(v) for v in fit_percent(velocities.values, answer))


@dataclass(frozen=True, eq=False)
class _Search:
    """An output's order, the ``estimate`` from the whole take, and the ``first`` model without the held-out part."""

    order: int
    estimate: OutputEstimate
    first: OutputModel
    rms: tuple[float, ...]


def _identified(record: OutputRecord, settings: IdentifySettings, tried: Callable[[int], None]) -> _Search:
    cut = round((1 - settings.held_out) * record.grid.n)
    early = record.until(cut)
    late = record.rows[record.rows >= cut]
    logs, delay = _first(early, settings.most_delay_s)
    models, squares = [], []
    for order in range(1, settings.most_order + 1):
        model = _best(early, order, logs, delay, settings.most_delay_s)
        answer = model.response(record.inputs, record.grid, means=True)
        models.append(model)
        squares.append((record.values[late] - answer[late]) ** 2)
        logs, delay = model.logs, model.delay_s
        tried(order)
    _check_length(early, models[0])
    told = [k for k, model in enumerate(models) if _is_told(early, model)]
    blocks = block_count(len(late) * record.grid.period_s, block_length_s(record, models[0]))
    at = told[_smallest_good([squares[k] for k in told], blocks)]
    first = models[at]
    whole = fit(record, first.logs, first.delay_s, settings.most_delay_s)
    _check_length(record, whole)
    rms = tuple(float(np.sqrt(one.mean())) for one in squares)
    return _Search(at + 1, estimate(record, whole), first, rms)


def _first(record: OutputRecord, most_delay_s: float) -> tuple[Array, float]:
    """Return the pole (as logarithm) and delay of the best of a grid of first-order models."""
    period = record.grid.period_s
    y = record.values[record.rows]
    best = (np.inf, np.zeros(1), 0.0)
    for delay in period * np.arange(-np.floor(most_delay_s / period), np.floor(most_delay_s / period) + 1, 2):
        for rate in FIRST_RATES:
            logs = np.log([rate / period])
            a = regressors(record, logs, float(delay))
            off = y - a @ np.linalg.lstsq(a, y, rcond=None)[0]
            best = min(best, (float(off @ off), logs, float(delay)), key=lambda one: one[0])
    return best[1], best[2]


def _best(record: OutputRecord, order: int, logs: Array, delay_s: float, most_delay_s: float) -> OutputModel:
    """Return the best model of ``order``, started from a smaller model's poles plus a faster one, and from ARX's."""
    starts = [logs]
    if order > 1:
        poles = poles_of(logs)
        starts = [logs_of(np.append(poles, 3.0 * poles.real.min()))]
        found = continuous(arx_poles(record, order, delay_s), record.grid.period_s)
        if found is not None:
            starts.append(logs_of(found))
    models = [fit(record, start, delay_s, most_delay_s) for start in starts]
    y = record.values[record.rows]
    off = [float(np.sum((y - regressors(record, m.logs, m.delay_s) @ m.coefficients) ** 2)) for m in models]
    return models[int(np.argmin(off))]


def _smallest_good(squares: list[Array], blocks: int) -> int:
    """Return the first of the models whose squared errors (n,) are not significantly larger than the best's.

    The limit is a two-sided 95 % interval of the difference from the best, from ``blocks`` of time.
    """
    best = int(np.argmin([one.mean() for one in squares]))
    for k, one in enumerate(squares[:best]):
        worse = np.array([part.mean() for part in np.array_split(one - squares[best], blocks)])
        if worse.mean() <= student.ppf(0.975, blocks - 1) * worse.std(ddof=1) / np.sqrt(blocks):
            return k
    return best


def _check_inputs(inputs: HeldInputs, grid: IntervalGrid, settings: IdentifySettings) -> None:
    end = grid.n * grid.period_s
    near = (inputs.time_s > -settings.most_delay_s) & (inputs.time_s < end + settings.most_delay_s)
    if near.sum() < 2 * FEWEST_BLOCKS:
        raise InputError(
            f"{int(near.sum())} commands fall into the {end:.3g} s of the tracks; {2 * FEWEST_BLOCKS} at least are "
            f"wanted (the file's run from {inputs.time_s[0]:.6g} to {inputs.time_s[-1]:.6g} s after the first pose): "
            "are both on the session's clock?"
        )
    values = inputs.values[near] - inputs.values[near].mean(axis=0)
    singular = np.linalg.svd(values / np.maximum(np.abs(values).max(axis=0), 1e-12), compute_uv=False)
    if singular[-1] < 0.01 * singular[0]:
        raise InputError(
            f"the inputs {', '.join(inputs.names)} do not vary independently of each other; their effects cannot be "
            "told apart: drive with noise on each"
        )


def _is_told(record: OutputRecord, model: OutputModel) -> bool:
    """Return whether the record is long enough for the model's slowest pole."""
    return float(np.min(-model.poles.real)) > 1.01 * slowest_rate(record)


def _check_length(record: OutputRecord, model: OutputModel) -> None:
    if not _is_told(record, model):
        span, slowest = len(record.rows) * record.grid.period_s, float(np.min(-model.poles.real))
        raise InputError(
            f"{span:.3g} s are fitted; what the body remembers for {1 / slowest:.2g} s or longer takes a take of "
            "twice that length or more to tell how far its model can be trusted"
        )
