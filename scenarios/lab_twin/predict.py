"""Prediction of a lab's measurement in a planned experiment: its fitted twin runs the scenario several times.

In each run the parameters are drawn about their estimates with their standard deviations, and the seed is drawn. So
the runs scatter like a measurement in the lab about the truth: by unknown properties of the lab, and by chance. The
interval is that of one more run (Student's t), in the logarithm where all values are above zero.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mosca.data.distributions import t as student
from mosca.errors import InputError
from reports.record import RunRecord
from scenarios.lab_twin.apply import drawn, put_cameras
from scenarios.lab_twin.lab_file import LabTwin
from scenarios.run.scenario import RunResult, run_scenario
from scenarios.spec.scenario import Scenario
from scenarios.types import RunOptions

CONFIDENCE = 0.95
FEWEST_DRAWS = 3
OF_TIME = ("latency_p99", "frame_rate", "timing_seconds")
"""Metrics that depend on the computer, not on the lab."""


@dataclass(frozen=True)
class Prediction:
    """The predicted value of a metric in the lab."""

    metric: str
    unit: str
    value: float
    low: float
    high: float
    """``low`` to ``high``: 95 % interval of one measurement; no metric is below 0."""
    runs: int


def predict(
    spec: Scenario,
    lab: LabTwin,
    name: str,
    folder: Path,
    draws: int,
    workers: int = 1,
    progress: Callable[[int, int | None], None] | None = None,
) -> tuple[RunResult, tuple[Prediction, ...]]:
    """Run ``spec``, which has the lab's cameras, ``draws`` times; return the run of the estimates, and predictions.

    InputError for fewer than FEWEST_DRAWS draws.
    """
    if draws < FEWEST_DRAWS:
        raise InputError(f"--draws {draws}: {FEWEST_DRAWS} or more are wanted, or no interval can be told")
    options = RunOptions(workers=workers)
    central = run_scenario(spec, name, folder, options)
    found: dict[str, list[float]] = {}
    for k in range(draws):
        one = run_scenario(drawn_spec(spec, lab, k), name, folder, replace(options, page=False)).record
        for metric in one.metrics:
            found.setdefault(metric.name, []).append(metric.value)
        if progress is not None:
            progress(k + 1, draws)
    units = {metric.name: metric.unit for metric in central.record.metrics}
    told = tuple(
        predicted(metric, units[metric], values)
        for metric, values in found.items()
        if metric in units and metric not in OF_TIME and len(values) == draws
    )
    return replace(central, record=with_predictions(central.record, told)), told


def drawn_spec(spec: Scenario, lab: LabTwin, draw: int) -> Scenario:
    """Return the scenario with the lab's parameters and the seed drawn anew."""
    document = spec.model_dump(mode="python", exclude_unset=True)
    document["camera"] = list(document.get("camera", ()))
    put_cameras(document, drawn(lab, np.random.default_rng([spec.seed, draw])))
    return Scenario.model_validate({**document, "seed": spec.seed + 1 + draw})


def predicted(metric: str, unit: str, values: Sequence[float]) -> Prediction:
    """Return the prediction of a further run's value from the runs' values."""
    array = np.array(values)
    n = len(array)
    reach = float(student.ppf(0.5 + 0.5 * CONFIDENCE, n - 1)) * math.sqrt(1.0 + 1.0 / n)
    if np.all(array > 0.0) and unit != "1":
        log = np.log(array)
        middle, own = float(log.mean()), reach * float(log.std(ddof=1))
        value = float(np.sqrt(np.mean(array**2))) if metric.endswith("rms") else math.exp(middle)
        return Prediction(metric, unit, value, math.exp(middle - own), math.exp(middle + own), n)
    middle, own = float(array.mean()), reach * float(array.std(ddof=1))
    return Prediction(metric, unit, middle, max(middle - own, 0.0), middle + own, n)


def with_predictions(record: RunRecord, told: Sequence[Prediction]) -> RunRecord:
    """Return a record whose notes state the predictions."""
    notes: Mapping[str, str] = dict(record.counts.get("notes", {}))
    lines = {f"predicted {one.metric}": line(one) for one in told}
    return replace(record, counts={**record.counts, "notes": {**notes, **lines}})


def line(one: Prediction) -> str:
    """Return a prediction in words."""
    scale, unit = (1e3, "mm") if one.unit == "m" else (1.0, "" if one.unit == "1" else one.unit)
    low, high = scale * one.low, scale * one.high
    return f"{scale * one.value:.4g} {unit}, 95 % {low:.4g} .. {high:.4g}, {one.runs} draws of the lab's parameters"
