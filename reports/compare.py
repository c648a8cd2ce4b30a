"""Compares runs: regressions against baselines, and runs side by side.

The rule is a pure function, without randomness or IO. A metric is a *regression* when it is worse than its baseline

- by more than 2 % (``SMALLEST_SHARE``), and
- by more than the half-width of the 95 % interval *of that worsening*.

Two runs of one scenario with one seed have the same frames and the same noise, so their errors are paired. The
interval of one run alone is for another *session*; it is often +-10 % and would hide a 5 % change. So the interval of
the paired difference is used. Each record keeps its metrics' sums by block (``MetricBlocks``). The delete-one-block
jackknife of the difference gives its standard error (Kuensch 1989, "The jackknife and the bootstrap for general
stationary observations", Ann. Statist. 17(3), here with non-overlapping blocks), which is multiplied by Student's t.
A uniform 5 % is then far above its interval, and a repeated run has no difference. Noise that is not shared (a noise
source was added) widens the interval.

Without blocks in both, with other seeds or other cuts, the runs are two independent samples: the half-width is
sqrt(h_new^2 + h_baseline^2) of the facing halves of both ``ci95``. A metric with neither blocks nor ``ci95`` is
deterministic (a count, for example), and only the 2 % apply.

Another processor changes last digits. The images from a seed stay the same except for single pixels at a rounding
boundary (``tests/scenarios/test_processors.py``), so that the pairs remain valid; decisions of the pipeline near a
threshold may change. A baseline therefore states each metric's ``spread``, the largest change among runs of the same
product with other processor features (``.ci/processors``). A metric that is worse by at most ``SPREADS`` times its
spread is no regression.

Other versions of numerical libraries, or another processor where the baseline states no spread, make independent
samples. A suite compares some hundreds of metrics, several of which exceed a 95 % interval by chance. So there the
half-width is widened to a joint 95 % interval of ``FAMILY`` metrics (Bonferroni), and a metric without interval is
only compared with its limit. Speed (``latency_p99``, ``frame_rate``) also depends on the machine: it is judged only
between records of one platform, and only with intervals.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from rich.markup import escape
from rich.table import Table

from mosca.data.arrays import Array
from reports.metrics import Combination, MetricKind, kind_of
from reports.record import Metric, RunRecord
from reports.units import figure, shown

SMALLEST_SHARE = 0.02
"""Share of the baseline up to which a metric that is worse is no regression (the contract's 2 %)."""
FEWEST_BLOCKS = 8
"""Least number of pairs of blocks: with fewer, the jackknife's standard error is unreliable."""

FAMILY = 1000
"""Comparisons of one suite, in round figures (the quick tier has 670 metrics)."""
FAMILY_FACTOR = NormalDist().inv_cdf(1 - 0.025 / FAMILY) / NormalDist().inv_cdf(0.975)
"""Half-width of a joint 95 % interval of a family over that of a single 95 % interval: 2.07."""
SPREADS = 2.0
"""Changes up to this multiple of the spread count as last digits. The spread is the largest of a few changes: another
change of the same kind exceeds it once in a few times, and exceeds twice the spread rarely."""
NUMERICAL = ("python", "numpy", "scipy", "numba", "mujoco", "opencv-python-headless")
"""Packages whose versions affect last digits."""


@dataclass(frozen=True)
class Regression:
    """A metric that got worse."""

    scenario: str
    name: str
    unit: str
    value: float
    baseline: float
    worse_by: float
    """Worsening in the metric's unit, as ``half_width``."""
    half_width: float
    share: float
    """``worse_by`` over the baseline's size (infinite where that is 0)."""
    paired: bool
    """Whether the interval comes from pairs of blocks."""

    def __str__(self) -> str:
        (new, old, width), unit = shown((self.value, self.baseline, self.half_width), self.unit, self.name)
        share = f"{100 * self.share:.1f} %" if np.isfinite(self.share) else "from nothing"
        return (
            f"{self.scenario}: {self.name} {figure(new)} {unit}".rstrip()
            + f", baseline {figure(old)}: worse by {share} (interval +-{figure(width)}, "
            + ("paired)" if self.paired else "unpaired)")
        )


def reading(metric: Metric) -> MetricKind:
    """Return the kind of ``metric``: that of ``kind_of``, else one by its own sense and its name."""
    kind = kind_of(metric.name)
    if kind is not None:
        return kind
    made_by: Combination = "root_mean" if "rms" in metric.name.split("_") else "mean"
    return MetricKind(metric.unit, metric.sense, "ratio", made_by)


def regressions(record: RunRecord, baseline: RunRecord) -> tuple[Regression, ...]:
    """Return the metrics of ``record`` that are worse than ``baseline``, by the rule in this module's docstring.

    Metrics that only one of the records has are not compared: see ``missing``. Raises ValueError for records of two
    scenarios.
    """
    if record.scenario != baseline.scenario:
        raise ValueError(f"regressions: {record.scenario} compared with {baseline.scenario}")
    found = (
        worsening(record, metric, baseline, before)
        for metric in record.metrics
        if (before := baseline.metric(metric.name)) is not None
    )
    return tuple(r for r in found if r is not None)


def numerical_versions(record: RunRecord) -> tuple[object, ...]:
    """Return the platform and the versions that affect last digits."""
    versions = record.provenance.get("versions", {})
    return record.provenance.get("platform"), *(versions.get(name) for name in NUMERICAL)


def missing(record: RunRecord, baseline: RunRecord) -> tuple[str, ...]:
    """Return the names of the baseline's metrics that ``record`` lacks: a loss that no figure shows."""
    return tuple(m.name for m in baseline.metrics if record.metric(m.name) is None)


def worsening(record: RunRecord, new: Metric, baseline: RunRecord, old: Metric) -> Regression | None:
    """Return the regression of the metric ``new`` of ``record`` against ``old``; None where it is none."""
    how = reading(old)
    if how.speed and not _speed_comparable(record, new, baseline, old):
        return None
    worse_by = _badness(how, new.value) - _badness(how, old.value)
    size = abs(old.value) if how.wanted is None else how.wanted
    if not worse_by > SMALLEST_SHARE * size:
        return None
    same_seed, same_versions = (
        record.seed == baseline.seed,
        numerical_versions(record) == numerical_versions(baseline),
    )
    same_processor = record.provenance.get("processor") == baseline.provenance.get("processor")
    same_noise = same_versions and (same_processor or old.spread is not None)
    paired = same_seed and same_noise and _pairable(new, old)
    half_width = _paired_half_width(how, new, old) if paired else _unpaired_half_width(how, new, old)
    if same_seed and not same_noise and np.isfinite(worse_by):
        if new.ci95 is None or old.ci95 is None:
            return None
        half_width *= FAMILY_FACTOR
    half_width = max(half_width, SPREADS * (old.spread or 0.0))
    if not worse_by > half_width:
        return None
    share = worse_by / size if size > 0 else float("inf")
    return Regression(record.scenario, new.name, new.unit, new.value, old.value, worse_by, half_width, share, paired)


def _badness(how: MetricKind, value: float) -> float:
    """Return ``value`` with its sign such that more is worse; a missing value is the worst."""
    return float("inf") if np.isnan(value) else float(_turned(how, np.asarray(value)))


def _speed_comparable(record: RunRecord, new: Metric, baseline: RunRecord, old: Metric) -> bool:
    platform = record.provenance.get("platform")
    known = new.ci95 is not None and old.ci95 is not None
    return known and platform is not None and platform == baseline.provenance.get("platform")


def _pairable(new: Metric, old: Metric) -> bool:
    if new.blocks is None or old.blocks is None or len(new.blocks.sums) != len(old.blocks.sums):
        return False
    both = (np.asarray(new.blocks.weights) > 0) & (np.asarray(old.blocks.weights) > 0)
    return int(both.sum()) >= FEWEST_BLOCKS


def _paired_half_width(how: MetricKind, new: Metric, old: Metric) -> float:
    """Return the half-width of the worsening's 95 % interval from paired blocks, in the metric's unit.

    Jackknife: theta_i is the worsening without block i; variance = (b - 1) / b sum (theta_i - mean)^2. For an extreme
    the jackknife is not consistent (Miller 1974). A largest value scatters about as much as the largest values of
    single blocks (the maximum of Gumbel variables has their scale), so the standard deviation of the blocks'
    differences is used.
    """
    assert new.blocks is not None
    assert old.blocks is not None
    sums = np.array([new.blocks.sums, old.blocks.sums])
    weights = np.array([new.blocks.weights, old.blocks.weights])
    used = np.all(weights > 0, axis=0)
    sums, weights = sums[:, used], weights[:, used]
    b = sums.shape[1]
    if how.made_by == "extreme":
        turned = _turned(how, sums / weights)
        return _students_t(b - 1) * float(np.std(turned[0] - turned[1], ddof=1))
    means = (sums.sum(axis=1, keepdims=True) - sums) / (weights.sum(axis=1, keepdims=True) - weights)
    turned = _turned(how, np.sqrt(np.maximum(means, 0.0)) if how.made_by == "root_mean" else means)
    without = turned[0] - turned[1]
    variance = (b - 1) / b * float(np.sum((without - without.mean()) ** 2))
    return _students_t(b - 1) * float(np.sqrt(variance))


def _turned(how: MetricKind, values: Array) -> Array:
    if how.wanted is not None:
        return np.abs(values - how.wanted)
    return values if how.sense == "at_most" else -values


def _unpaired_half_width(how: MetricKind, new: Metric, old: Metric) -> float:
    """Return sqrt(h_new^2 + h_old^2) of the halves of both intervals that face each other."""
    upwards = new.value > old.value
    total = 0.0
    for metric, above in ((new, not upwards), (old, upwards)):
        if metric.ci95 is not None:
            low, high = metric.ci95
            total += max(0.0, high - metric.value if above else metric.value - low) ** 2
    return float(np.sqrt(total))


def _students_t(freedom: int) -> float:
    """Return Student's t at 97.5 %: Cornish-Fisher expansion, Abramowitz & Stegun 26.7.5 (1e-3 from 7 on)."""
    x = 1.959964
    g1 = (x**3 + x) / 4
    g2 = (5 * x**5 + 16 * x**3 + 3 * x) / 96
    g3 = (3 * x**7 + 19 * x**5 + 17 * x**3 - 15 * x) / 384
    return x + g1 / freedom + g2 / freedom**2 + g3 / freedom**3


MAIN_METRICS = ("position_rms", "relative_accuracy", "completeness", "ghosts_per_frame", "frame_rate")


def summary_table(records: Sequence[RunRecord]) -> Table:
    """Return a terminal table: a row for each run with its verdict, the main metrics beside limits, and seconds.

    A figure that breaks its limit is red. Only metrics that some record has get a column.
    """
    columns = [n for n in MAIN_METRICS if any(r.metric(n) for r in records)]
    table = Table(title=None, header_style="bold")
    table.add_column("scenario", overflow="fold")
    table.add_column("verdict")
    for name in columns:
        table.add_column(name.replace("_", " "), justify="right")
    table.add_column("s", justify="right")
    for record in records:
        broken = not record.not_judged or any(metric.as_it_must is False for metric in record.metrics)
        verdict = "[green]pass[/]" if record.passed else "[red]FAIL[/]" if broken else "not judged"
        cells = [_cell(record.metric(name)) for name in columns]
        table.add_row(escape(record.scenario), verdict, *cells, f"{total_seconds(record):.1f}")
    return table


def _cell(metric: Metric | None) -> str:
    if metric is None:
        return ""
    bounds = metric.within or (() if metric.limit is None else (metric.limit,))
    numbers, unit = shown((metric.value, *bounds), metric.unit, metric.name)
    text = figure(numbers[0])
    if metric.within is not None:
        text += f" [dim]in {figure(numbers[1])} .. {figure(numbers[2])}[/]"
    elif metric.limit is not None:
        sign = "<=" if metric.sense == "at_most" else ">="
        text += f" [dim]{sign} {figure(numbers[1])}[/]"
    text += f" {unit}" if unit else ""
    return f"[red]{text}[/]" if metric.as_it_must is False else text


def total_seconds(record: RunRecord) -> float:
    """Return the run's seconds: timings["total"] where there is one, else the sum of all."""
    return float(record.timings.get("total", sum(record.timings.values())))
