"""What counts as a regression: numbers by hand, Student's own interval, and simulated runs."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from reports_examples import example_record
from rich.console import Console
from scipy import stats

from mosca.data.arrays import Array
from reports.compare import missing, reading, regressions, summary_table
from reports.record import Metric, MetricBlocks, RunRecord


def run_with(*metrics: Metric, seed: int = 7, platform: str = "Linux x86_64") -> RunRecord:
    return example_record(metrics=metrics, seed=seed, provenance={"platform": platform})


def rms_of(errors: Array, blocks: int = 20, with_blocks: bool = True) -> Metric:
    """Return position_rms of errors (n, 3), its blocks, and an interval of +-10 %, as correlated frames give."""
    squares = np.array_split(np.sum(errors**2, axis=1), blocks)
    made = MetricBlocks(tuple(float(s.sum()) for s in squares), tuple(float(len(s)) for s in squares))
    value = float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))
    return Metric(
        "position_rms", value, "m", len(errors), (0.9 * value, 1.1 * value), blocks=made if with_blocks else None
    )


def session(seed: int) -> Array:
    """Return errors (2000, 3) [m] whose size changes from block to block, as it does in a motion."""
    rng = np.random.default_rng(seed)
    size = np.repeat(np.random.default_rng(99).uniform(0.5, 2.0, 20), 100)
    return 1e-4 * size[:, None] * rng.normal(size=(2000, 3))


BASE = run_with(rms_of(session(1)))


def test_a_planted_five_percent_is_reported_although_one_runs_interval_is_wider() -> None:
    (found,) = regressions(run_with(rms_of(1.05 * session(1))), BASE)
    assert found.paired
    assert found.share == pytest.approx(0.05)
    assert found.half_width < 0.02 * found.baseline
    assert "position_rms" in str(found)
    assert "worse by 5.0 %" in str(found)


@pytest.mark.parametrize(("factor", "found"), [(1.0, 0), (1.019, 0), (1.021, 1), (0.5, 0)])
def test_two_percent_are_a_regression_and_an_improvement_is_none(factor: float, found: int) -> None:
    assert len(regressions(run_with(rms_of(factor * session(1))), BASE)) == found


def test_other_noise_of_the_same_size_is_rarely_a_regression() -> None:
    """Same scenario and seed, but every error drawn anew: about 2.5 % of 300 may be reported, by the interval."""
    reports = sum(bool(regressions(run_with(rms_of(session(seed))), BASE_OF[seed % 10])) for seed in range(300))
    assert reports <= 16  # binomial(300, 0.025): P(> 16) = 0.1 %


BASE_OF = [run_with(rms_of(session(1000 + i))) for i in range(10)]


def test_five_percent_is_found_under_noise_that_is_not_shared() -> None:
    """5 % worse and a tenth of the noise's variance drawn anew: the pairs still show it."""
    noisy = 1.05 * (np.sqrt(0.9) * session(1) + np.sqrt(0.1) * session(2))
    assert len(regressions(run_with(rms_of(noisy)), BASE)) == 1


@pytest.mark.parametrize("name", ["position_p95", "hota"])
def test_the_paired_half_width_of_a_mean_is_students(name: str) -> None:
    rng = np.random.default_rng(5)
    old, new = rng.normal(10, 1, 25), rng.normal(11, 1, 25)
    if name == "hota":
        old, new = new, old
    before = Metric(name, float(old.mean()), "1", 25, blocks=MetricBlocks(tuple(old), (1.0,) * 25))
    after = Metric(name, float(new.mean()), "1", 25, blocks=MetricBlocks(tuple(new), (1.0,) * 25))
    (found,) = regressions(run_with(after), run_with(before))
    wanted = stats.t.ppf(0.975, 24) * stats.sem(new - old)
    assert found.half_width == pytest.approx(wanted, rel=1e-3)


def test_without_blocks_the_facing_halves_of_both_intervals_count() -> None:
    old = Metric("position_rms", 1.00, "m", 9, (0.90, 1.03))
    # Halves 0.03 and 0.04 facing each other: sqrt(0.03^2 + 0.04^2) = 0.05.
    assert regressions(run_with(Metric("position_rms", 1.051, "m", 9, (1.011, 9.0))), run_with(old))
    assert not regressions(run_with(Metric("position_rms", 1.049, "m", 9, (1.009, 9.0))), run_with(old))
    (found,) = regressions(run_with(Metric("position_rms", 1.08, "m", 9, (1.04, 9.0))), run_with(old))
    assert found.half_width == pytest.approx(0.05)
    assert not found.paired


def test_runs_of_other_seeds_and_few_or_different_blocks_are_not_paired() -> None:
    worse = 1.05 * session(1)
    assert regressions(run_with(rms_of(worse), seed=8), BASE) == ()
    assert regressions(run_with(rms_of(worse, blocks=19)), BASE) == ()
    assert regressions(run_with(rms_of(worse, blocks=7)), run_with(rms_of(session(1), blocks=7))) == ()


def test_blocks_without_samples_are_left_out() -> None:
    blocks = MetricBlocks((0.0, *(4.0 + i for i in range(10))), (0.0, *(1.0,) * 10))
    old = Metric("position_p95", 8.5, "m", 10, blocks=blocks)
    new = replace(old, value=8.5 * 1.05, blocks=MetricBlocks(tuple(1.05 * s for s in blocks.sums), blocks.weights))
    assert regressions(run_with(new), run_with(old))[0].paired


def test_ghosts_from_none_are_a_regression() -> None:
    old = Metric("ghosts_per_frame", 0.0, "1", 100)
    (found,) = regressions(run_with(replace(old, value=0.5)), run_with(old))
    assert found.share == float("inf")
    assert "from nothing" in str(found)


@pytest.mark.parametrize(
    ("name", "before", "after", "worse"),
    [
        ("nees", 3.0, 2.8, True),
        ("nees", 2.8, 3.05, False),
        ("nees", 3.0, 3.05, False),  # 0.05 is less than 2 % of 3
        ("nees_detect", 3.0, 3.2, True),
        ("coverage95", 0.95, 0.99, True),
        ("coverage95", 0.90, 0.95, False),
        ("completeness", 0.99, 0.95, True),
        ("completeness", 0.95, 0.99, False),
        ("efficiency", 0.99, 0.90, True),
        ("efficiency.detect", 0.90, 0.99, False),
        ("hota", 0.9, 0.8, True),
        ("position_max", 1.0, 1.1, True),
        ("ray_angle_rms", 1.0, 1.1, True),
    ],
)
def test_which_way_is_worse(name: str, before: float, after: float, worse: bool) -> None:
    old = Metric(name, before, "1", 10)
    assert bool(regressions(run_with(replace(old, value=after)), run_with(old))) == worse


def test_unknown_metrics_follow_their_sense() -> None:
    assert reading(Metric("calibrated_cameras", 4, "1", 4, sense="at_least")).sense == "at_least"
    assert reading(Metric("ray_angle_rms", 4, "rad", 4)).made_by == "root_mean"


def test_noise_of_still_markers_is_compared_as_the_root_mean_square_that_it_is() -> None:
    # squares [m^2] of 10 blocks, all 21 % larger: 10 % in the root, without scatter
    def noise(scale: float) -> Metric:
        squares = [scale * (1 + 0.1 * (k % 3)) * 1e-8 for k in range(10)]
        blocks = MetricBlocks(tuple(squares), (1.0,) * 10)
        return Metric("static_noise", float(np.sqrt(np.mean(squares))), "m", 10, blocks=blocks)

    (worse,) = regressions(run_with(noise(1.21)), run_with(noise(1.0)))
    assert worse.share == pytest.approx(0.1)
    # by hand: leaving a block of 1.2 out instead of one of 1.0 changes the root by 1 % in both, so their difference
    # by about 1 % of itself: its jackknife interval is a part of it, not of the square metres
    assert 1e-3 < worse.half_width / worse.worse_by < 0.1


def test_speed_is_judged_on_one_platform_with_intervals_only() -> None:
    old, new = (Metric("frame_rate", 400, "1/s", 9, (390, 410)), Metric("frame_rate", 300, "1/s", 9, (290, 310)))
    assert regressions(run_with(new), run_with(old))
    assert not regressions(run_with(new, platform="other"), run_with(old))
    assert not regressions(run_with(replace(new, ci95=None)), run_with(old))


def test_an_extreme_is_judged_by_the_scatter_of_the_blocks_extremes() -> None:
    largest = np.random.default_rng(3).gumbel(1.0, 0.1, 30)
    old = Metric("position_max", float(largest.max()), "m", 30, blocks=MetricBlocks(tuple(largest), (1.0,) * 30))
    planted = replace(old, value=1.05 * old.value, blocks=MetricBlocks(tuple(1.05 * largest), (1.0,) * 30))
    assert len(regressions(run_with(planted), run_with(old))) == 1
    rng, reports = np.random.default_rng(4), 0
    for _ in range(300):
        a, b = (rng.gumbel(1.0, 0.1, 30) for _ in range(2))
        pair = [
            Metric("position_max", float(v.max()), "m", 30, blocks=MetricBlocks(tuple(v), (1.0,) * 30))
            for v in (a, b)
        ]
        reports += bool(regressions(run_with(pair[0]), run_with(pair[1])))
    assert reports <= 20


def test_a_figure_that_can_no_longer_be_given_is_a_regression() -> None:
    old = Metric("position_rms", 1.0, "m", 9, (0.9, 1.1))
    assert regressions(run_with(replace(old, value=float("nan"), ci95=None)), run_with(old))
    assert missing(run_with(), run_with(old)) == ("position_rms",)


def test_records_of_two_scenarios_are_not_compared() -> None:
    with pytest.raises(ValueError, match="compared with"):
        regressions(replace(BASE, scenario="other"), BASE)


values = st.floats(1e-4, 1e4)
names = st.sampled_from(["position_rms", "completeness", "nees", "ghosts_per_frame", "position_max"])


@st.composite
def runs(draw: st.DrawFn, name: str) -> RunRecord:
    value, below, above = draw(values), draw(st.floats(0, 0.5)), draw(st.floats(0, 0.5))
    sums = draw(st.none() | st.lists(values, min_size=10, max_size=10))
    blocks = None if sums is None else MetricBlocks(tuple(sums), (1.0,) * 10)
    return run_with(Metric(name, value, "m", 9, (value * (1 - below), value * (1 + above)), blocks=blocks))


@st.composite
def pairs(draw: st.DrawFn) -> tuple[RunRecord, RunRecord]:
    name = draw(names)
    return draw(runs(name)), draw(runs(name))


@given(pairs())
def test_only_one_of_two_can_be_worse_and_none_than_itself(pair: tuple[RunRecord, RunRecord]) -> None:
    a, b = pair
    assert regressions(a, a) == ()
    assert not (regressions(a, b) and regressions(b, a))
    for found in regressions(a, b):
        assert found.worse_by > found.half_width >= 0
        assert found.share > 0.02


@given(pairs(), st.sampled_from([1e-3, 0.5, 4.0, 1024.0]))
def test_the_unit_does_not_matter(pair: tuple[RunRecord, RunRecord], factor: float) -> None:
    a, b = pair
    if a.metrics[0].name == "nees":
        return
    power = 2 if reading(a.metrics[0]).made_by == "root_mean" else 1

    def scaled(record: RunRecord) -> RunRecord:
        (m,) = record.metrics
        assert m.ci95 is not None
        blocks = m.blocks and MetricBlocks(tuple(s * factor**power for s in m.blocks.sums), m.blocks.weights)
        ci95 = (m.ci95[0] * factor, m.ci95[1] * factor)
        return replace(record, metrics=(replace(m, value=m.value * factor, ci95=ci95, blocks=blocks),))

    before, after = regressions(a, b), regressions(scaled(a), scaled(b))
    if before and after:
        assert after[0].share == pytest.approx(before[0].share)
    else:
        near = (*before, *after)
        assert all(r.share < 0.0200001 or r.worse_by < 1.000001 * r.half_width for r in near)


def test_the_summary_shows_each_run_with_figures_and_limits() -> None:
    console = Console(width=140, record=True, file=open("/dev/null", "w"))  # noqa: SIM115
    with console.file:
        control = Metric("position_rms", 2e-3, "m", 960, limit=3e-4, passed=False, within=(1.8e-3, 2.2e-3))
        records = [example_record(), example_record(scenario="[red]odd", passed=False), run_with(control)]
        console.print(summary_table(records))
    text = console.export_text()
    for part in ("accuracy/ring_of_six", "[red]odd", "pass", "FAIL", "0.245 <= 0.3 mm", "99.17 >= 98 %", "14.9"):
        assert part in text
    assert "2 in 1.8 .. 2.2 mm" in text


def elsewhere(record: RunRecord, processor: str = "skylake X86_V3") -> RunRecord:
    return replace(record, provenance={**record.provenance, "processor": processor})


def test_another_processors_noise_is_another_sample_and_an_unchanged_product_passes_there() -> None:
    """A paired rule would report figures that differ by 2.1 % with an interval of +-10 %, as they do elsewhere."""
    new = run_with(rms_of(1.021 * session(1)))
    assert len(regressions(new, BASE)) == 1
    assert regressions(elsewhere(new), BASE) == ()


def with_spread(record: RunRecord, spread: float) -> RunRecord:
    return replace(record, metrics=tuple(replace(m, spread=spread) for m in record.metrics))


def test_with_a_spread_in_the_baseline_five_percent_are_found_on_another_processor() -> None:
    base = with_spread(BASE, 0.001 * BASE.metrics[0].value)
    (found,) = regressions(elsewhere(run_with(rms_of(1.05 * session(1)))), base)
    assert found.paired
    assert found.share == pytest.approx(0.05)


@pytest.mark.parametrize("processor", ["", "skylake X86_V3"])
def test_what_last_digits_change_is_no_regression(processor: str) -> None:
    new = run_with(rms_of(1.03 * session(1)))
    new = elsewhere(new, processor) if processor else new
    assert regressions(new, with_spread(BASE, 0.02 * BASE.metrics[0].value)) == ()
    assert len(regressions(new, with_spread(BASE, 0.01 * BASE.metrics[0].value))) == 1


def test_a_count_without_interval_is_judged_on_another_processor_by_its_spread() -> None:
    switches = Metric("identity_switches", 4.0, "1", 100, spread=1.0)
    assert regressions(elsewhere(run_with(replace(switches, value=6.0))), run_with(switches)) == ()
    assert len(regressions(elsewhere(run_with(replace(switches, value=7.0))), run_with(switches))) == 1


def test_a_gross_fault_is_found_on_another_processor_too() -> None:
    (found,) = regressions(elsewhere(run_with(rms_of(1.4 * session(1)))), BASE)
    assert not found.paired


def test_elsewhere_a_figure_without_interval_is_left_to_its_limit_and_a_lost_one_is_not() -> None:
    largest = Metric("position_max", 1e-3, "m", 100)
    worse, lost = replace(largest, value=2e-3), replace(largest, value=float("nan"))
    assert len(regressions(run_with(worse), run_with(largest))) == 1
    assert regressions(elsewhere(run_with(worse)), run_with(largest)) == ()
    assert len(regressions(elsewhere(run_with(lost)), run_with(largest))) == 1


def test_unchanged_products_on_other_processors_are_hardly_ever_reported() -> None:
    """1,000 unpaired comparisons of one product: all of them pass with a probability of 95 %."""
    reports = 0
    for seed in range(1000):
        rng = np.random.default_rng(seed)
        sigma = 0.05
        new, old = 1.0 + sigma * rng.normal(size=2)
        metric = Metric("position_rms", old, "m", 100, (old - 1.96 * sigma, old + 1.96 * sigma))
        other = replace(metric, value=new, ci95=(new - 1.96 * sigma, new + 1.96 * sigma))
        reports += len(regressions(elsewhere(run_with(other)), run_with(metric)))
    assert reports <= 1
