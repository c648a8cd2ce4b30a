"""Linear models of driven bodies: closed forms, systems simulated elsewhere, coverage, and other programs."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from identification_takes import FINE_S, Known, driven_path, first_order, noise_inputs
from scipy.integrate import quad
from scipy.signal import lfilter

from mosca.errors import InputError
from mosca.machines.identification.arx import arx_poles, continuous
from mosca.machines.identification.held_inputs import HeldInputs, IntervalGrid, on_grid
from mosca.machines.identification.identify import IdentifySettings, fit_on, fit_percent, identify
from mosca.machines.identification.model_file import transfer_function
from mosca.machines.identification.modes import interval_means, logs_of, poles_of, states
from mosca.machines.identification.output_error import OutputModel, OutputRecord, estimate, fit
from mosca.machines.identification.realization import realization
from mosca.machines.identification.velocities import mean_velocities, smoothed_velocities

TWO_POLES = Known(((40.0,), (-60.0, 200.0)), (1.0, 14.0, 40.0))  # poles -4 and -10


def record_of(known: Known, seed: int, n: int = 1500, period_s: float = 0.02, delay_s: float = 0.0) -> OutputRecord:
    inputs = noise_inputs(seed, n * period_s)
    total = known.distance(inputs, n * period_s, delay_s)[:: round(period_s / FINE_S)]
    return OutputRecord(IntervalGrid(0.0, period_s, n), np.diff(total) / period_s, inputs)


@settings(max_examples=30, deadline=None)
@given(rate=st.floats(0.5, 60), at=st.floats(-0.05, 0.35), delay=st.floats(-0.1, 0.1), step=st.floats(-5, 5))
def test_a_command_at_any_time_gives_the_step_response_and_its_means(
    rate: float, at: float, delay: float, step: float
) -> None:
    grid = IntervalGrid(0.0, 0.05, 6)
    on = on_grid(HeldInputs(("u",), np.array([at]), np.array([[step]])), delay, grid)
    begun = at + delay
    rest = begun if begun > 0 else 0.0  # the mode is at rest at 0 whatever was given before

    def answer(t: float) -> float:
        return step * (1 - np.exp(-rate * (t - rest))) / rate if t > rest else 0.0

    poles = np.array([complex(-rate)])
    found = states(poles, on, grid)[:, 0, 0]
    assert np.allclose(found, [answer(t) for t in grid.instants()], atol=1e-12 + 1e-9 * abs(step))
    means = interval_means(poles, on, grid)[:, 0, 0]
    for k, mean in enumerate(means):
        a, b = 0.05 * k, 0.05 * (k + 1)
        wanted = quad(answer, a, b, points=[rest] if a < rest < b else None)[0] / 0.05
        assert mean.real == pytest.approx(wanted, abs=1e-7 + 1e-6 * abs(step))


@given(st.lists(st.floats(0.1, 100), min_size=1, max_size=4))
def test_poles_are_kept_by_their_logarithms(rates: list[float]) -> None:
    poles = -np.array(rates, dtype=complex)
    again = OutputModel(logs_of(poles), 0.0, np.zeros(1)).poles
    # two that are nearly one may come back as a pair: their polynomial is the same
    assert np.poly(again).real == pytest.approx(np.poly(poles).real, rel=1e-9)
    pair = np.array([complex(-rates[0], 3.0)])
    assert poles_of(logs_of(pair)) == pytest.approx(pair)


def test_an_arx_system_is_recovered_exactly() -> None:
    inputs = noise_inputs(1, 30.0)
    grid = IntervalGrid(0.0, 0.02, 1500)
    u = on_grid(inputs, 0.0, grid).mean
    # (1 - 0.9 q)(1 - 0.5 q) y = 0.1 q u1 + (0.2 - 0.3 q) u2
    a = np.poly([0.9, 0.5])
    y = lfilter([0.0, 0.1], a, u[:, 0]) + lfilter([0.2, -0.3], a, u[:, 1])
    assert np.sort(arx_poles(OutputRecord(grid, y, inputs), 2, 0.0)) == pytest.approx([0.5, 0.9], abs=1e-9)
    assert continuous(np.array([0.9, 0.5]), 0.02) == pytest.approx(np.log([0.9, 0.5]) / 0.02)
    assert continuous(np.array([0.9, -0.5]), 0.02) is None
    # with noise the output error finds the poles that ARX loses
    noisy = OutputRecord(grid, y + np.random.default_rng(3).normal(0, 0.5 * y.std(), len(y)), inputs)
    assert np.max(arx_poles(noisy, 2, 0.0).real) < 0.87


def test_output_errors_recover_a_system_simulated_elsewhere() -> None:
    record = record_of(TWO_POLES, 1, delay_s=0.013)
    model = fit(record, np.log([20.0, 90.0]), 0.0, 0.1)
    assert np.sort(model.poles.real) == pytest.approx([-10, -4], abs=1e-3)
    assert model.gains(2) == pytest.approx(TWO_POLES.gains(), rel=1e-5)
    assert model.delay_s == pytest.approx(0.013, abs=1e-6)
    # a pole that is a complex pair
    swinging = Known(((80.0,), (10.0, 0.0)), (1.0, 6.0, 80.0))
    found = fit(record_of(swinging, 2), np.log([20.0, 90.0]), 0.0, 0.1)
    assert found.poles[0] == pytest.approx(complex(-3, np.sqrt(71)), abs=1e-3)


def test_intervals_hold_for_coloured_noise_where_plain_least_squares_do_not() -> None:
    known = first_order(8.0, (0.05, -0.03))
    truth = np.array([-8.0, 0.05, -0.03, 0.0])
    inside, plain, runs = np.zeros(4), 0, 60
    clean = [record_of(known, seed, n=1200) for seed in range(4)]
    for seed in range(runs):
        record = clean[seed % len(clean)]
        rng = np.random.default_rng(seed)
        # the noise of a slow process that the inputs do not reach
        noise = lfilter([1.0], [1.0, -0.95], rng.normal(0, 0.1, record.grid.n + 200))[200:]
        noisy = OutputRecord(record.grid, record.values + noise, record.inputs)
        found = estimate(noisy, fit(noisy, np.log([5.0]), 0.0, 0.1))
        told = np.delete(np.arange(len(found.quantities)), 1)  # the imaginary part is 0
        low, high = found.intervals[told].T
        inside += (low <= truth) & (truth <= high)
        plain += abs(found.quantities[2] - 0.05) <= 1.96 * _white_sigma(noisy, found.quantities)
    # 95 % of 60, less three binomial standard deviations
    assert (inside >= 52).all(), inside
    assert plain < 48, plain


def _white_sigma(record: OutputRecord, quantities: np.ndarray) -> float:
    """Return the first gain's standard deviation for residuals taken as white, the pole as known."""
    grid, pole = record.grid, np.array([complex(quantities[0])])
    x = interval_means(pole, on_grid(record.inputs, 0.0, grid), grid)[:, 0].real * -quantities[0]
    table = np.column_stack([x, np.ones(len(x))])
    off = record.values - table @ np.linalg.lstsq(table, record.values, rcond=None)[0]
    return float(np.sqrt(np.linalg.inv(table.T @ table)[0, 0] * off.var()))


def test_the_realization_finds_the_poles_of_both_outputs() -> None:
    records = [record_of(first_order(8.0, (0.05, 0.05)), 1), record_of(first_order(20.0, (-0.2, 0.2)), 1)]
    found = realization(records, [0.0, 0.0], 2, 60)
    assert np.sort(found.poles.real) == pytest.approx(np.exp([-20 * 0.02, -8 * 0.02]), abs=1e-3)
    assert found.gains == pytest.approx(np.array([[0.05, 0.05], [-0.2, 0.2]]), rel=0.01)
    assert found.singular_values[2] < 1e-3 * found.singular_values[1]


def test_a_subspace_method_of_another_program_finds_the_same_poles() -> None:
    nfoursid = pytest.importorskip("nfoursid.nfoursid")
    pandas = pytest.importorskip("pandas")
    record = record_of(TWO_POLES, 3)
    u = on_grid(record.inputs, 0.0, record.grid).mean
    table = pandas.DataFrame({"y": record.values, "u0": u[:, 0], "u1": u[:, 1]})
    other = nfoursid.NFourSID(table, output_columns=["y"], input_columns=["u0", "u1"], num_block_rows=12)
    other.subspace_identification()
    theirs = np.linalg.eigvals(other.system_identification(rank=2)[0].a)
    ours = np.exp(fit(record, np.log([20.0, 90.0]), 0.0, 0.1).poles * 0.02)
    assert np.sort(theirs.real) == pytest.approx(np.sort(ours.real), abs=0.02)


def test_velocities_of_a_circle_are_those_of_its_closed_form() -> None:
    t = np.arange(0, 6.0 + FINE_S / 2, FINE_S)
    speed, rate = 0.4, 0.7
    path = driven_path(speed * t, rate * t, 0.02, (1e-4, 3e-4), 5)
    means = mean_velocities(path)
    assert np.isfinite(means).all()
    # noise of a difference of two: sigma sqrt(2) / period
    assert means.mean(axis=0) == pytest.approx([speed, rate], abs=1e-3)
    assert means.std(axis=0) == pytest.approx(np.sqrt(2) * np.array([1e-4, 3e-4]) / 0.02, rel=0.2)
    smooth = smoothed_velocities(path, np.array([0.5, 1.5]))
    error = smooth.values - [speed, rate]
    sigma = np.sqrt(np.diagonal(smooth.covariance, axis1=1, axis2=2))
    assert (error[20:-20].std(axis=0) < 0.2 * means.std(axis=0)).all()
    assert (np.abs(error / sigma) < 5).all()
    # poses that are missing leave their two intervals open, and no others
    kept = np.delete(np.arange(len(path.frame)), [40, 90])
    gaps = type(path)(path.frame[kept], path.time_ns[kept], path.values[kept], path.covariance[kept])
    assert np.flatnonzero(np.isnan(mean_velocities(gaps)[:, 0])).tolist() == [39, 40, 89, 90]


def take(seed: int, v: Known, w: Known, duration_s: float = 24.0) -> tuple:
    inputs = noise_inputs(seed, duration_s)
    distances = v.distance(inputs, duration_s), w.distance(inputs, duration_s)
    return driven_path(*distances, 0.02, (3e-5, 2e-4), seed), inputs


def test_a_model_is_identified_with_the_orders_that_it_has() -> None:
    v, w = first_order(15.0, (0.0024, 0.0024)), Known(((-1.25,), (1.25,)), (1.0, 16.0, 200.0))
    path, inputs = take(1, v, w)
    model = identify(path, inputs, IdentifySettings(most_order=2, most_delay_s=0.04))
    assert [one.order for one in model.outputs] == [1, 2]
    for one, wanted in zip(model.outputs, (v, w), strict=True):
        n, found = one.order, one.estimate
        low, high = found.intervals[2 * n : 2 * n + 2].T
        off = np.abs(found.quantities[2 * n : 2 * n + 2] - wanted.gains())
        assert (off <= 2 * (high - low) / 2).all()
        # the file's transfer function is the model: at rest, and at 5 rad/s beside the known one
        numerators, denominator = transfer_function(one, 2)
        assert numerators[:, -1] / denominator[-1] == pytest.approx(found.model.gains(2))
        at = 5j
        for mine, theirs in zip(numerators, wanted.numerators, strict=True):
            answer = np.polyval(theirs, at) / np.polyval(wanted.denominator, at)
            assert abs(np.polyval(mine, at) / np.polyval(denominator, at) - answer) < 0.05 * abs(answer)
    other, given_inputs = take(2, v, w)
    *_, fits = fit_on(model, other, given_inputs)
    assert min(fits) > 95
    # commands that are believed to be given 0.1 s earlier do not fit
    late = HeldInputs(given_inputs.names, given_inputs.time_s - 0.1, given_inputs.values)
    assert max(fit_on(model, other, late)[2]) < 50


def test_fit_percent_is_that_of_its_definition() -> None:
    y = np.array([[0.0], [2.0], [4.0]])
    assert fit_percent(y, y) == pytest.approx([100.0])
    assert fit_percent(y, np.full((3, 1), 2.0)) == pytest.approx([0.0])
    assert fit_percent(y, np.array([[0.0], [2.0], [3.0]])) == pytest.approx([100 * (1 - 1 / np.sqrt(8))])


def test_inputs_that_tell_nothing_are_refused() -> None:
    t = np.arange(0, 6.0 + FINE_S / 2, FINE_S)
    path = driven_path(0.1 * t, 0.1 * t, 0.02, (1e-4, 3e-4), 5)
    inputs = noise_inputs(1, 6.0)
    with pytest.raises(InputError, match="0 commands fall into the 6 s of the tracks; 16 at least"):
        identify(path, HeldInputs(inputs.names, inputs.time_s + 100, inputs.values))
    same = np.repeat(inputs.values[:, :1], 2, axis=1)
    with pytest.raises(InputError, match="do not vary independently of each other"):
        identify(path, HeldInputs(inputs.names, inputs.time_s, same))
