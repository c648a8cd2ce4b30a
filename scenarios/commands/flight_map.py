"""A map of crashes and position error over latency and dropout: many short flights, in processes."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.stats import binomtest, spearmanr

from mosca.data.files.whole_file import write_text
from mosca.errors import InputError
from mosca.machines.closed_loop.delay_margin import PositionLoop, mean_age_s
from mosca.machines.closed_loop.filtered_loop import FilteredLoop
from reports.flight_map_plot import FlightMap, map_picture
from reports.plot_style import svg_file
from scenarios.flight.pilot import PERIOD_S, motion_noise
from scenarios.flight.predicted import PoseNoise, fly_predicted
from scenarios.run.pose_noise import pose_noise
from scenarios.run.worker_processes import spawned_pool
from scenarios.score.flight import flight_scores
from scenarios.spec.catalog import find
from scenarios.spec.scenario import Scenario, load_scenario

RESAMPLES = 2000
LEAST_SECONDS = 1.0


class FlightOutcome(NamedTuple):
    """Outcome of one flight."""

    crashed: bool
    rms_m: float
    """Rms distance from the path; NaN where the flight crashed before it was scored."""


@dataclass(frozen=True)
class MapCell:
    """The flights at one latency and dropout."""

    latency_s: float
    dropout: float
    age_s: float
    """Mean age of the pose behind the acting command: latency, time since the newest pose, half a control period,
    command."""
    runs: int
    crashes: int
    crash_ci95: tuple[float, float]
    """Wilson interval of the share of flights that crash."""
    rms_m: float
    """Root mean square over the flights that did not crash; NaN where all did."""
    rms_ci95: tuple[float, float]


@dataclass(frozen=True)
class MapOptions:
    """The options of ``mosca flight map``, under their names."""

    scenario: str
    latency: tuple[float, ...]
    """Mean delays from mid-exposure to arrival [s]."""
    dropout: tuple[float, ...]
    runs: int
    """Number of flights in each cell."""
    seconds: float
    """Scored length of each flight [s]."""
    workers: int
    out: Path | None
    plot: Path | None
    overrides: tuple[str, ...]

    def run(self, progress: Callable[[int, int | None], None]) -> list[str]:
        """Fly, write the requested files, and return the lines to print."""
        path = find(self.scenario)
        spec = load_scenario(path, self.overrides)
        if spec.flight is None:
            raise InputError(f"{path}: no [flight]; a map is made of flights in closed loop: add it")
        least = spec.flight.delay_s(spec.capture.exposure_s) - spec.flight.pipeline_s
        if min(self.latency) < least:
            raise InputError(
                f"--latency {1e3 * min(self.latency):g}: exposure, readout, transfer and jitter of {path} alone take "
                f"{1e3 * least:g} ms; give that or more"
            )
        noise = pose_noise(spec, path.parent, self.workers)
        cells = self._flown(spec, path.parent, noise, progress)
        sigma_m = float(np.sqrt(np.trace(noise.at(np.array(spec.working_space.center_m)))))
        if self.out is not None:
            write_text(self.out, csv_of(cells))
        if self.plot is not None:
            write_text(self.plot, svg_file(map_picture(_drawn(cells, margin_of(spec, sigma_m / np.sqrt(3))))))
        return described(spec, cells, sigma_m)

    def _flown(
        self, spec: Scenario, folder: Path, noise: PoseNoise, progress: Callable[[int, int | None], None]
    ) -> list[MapCell]:
        assert spec.flight is not None
        duration_s = spec.flight.handover_s + spec.flight.settle_s + self.seconds
        jobs = [
            _changed(spec, latency, dropout, duration_s, spec.seed + k)
            for latency in self.latency
            for dropout in self.dropout
            for k in range(self.runs)
        ]
        outcomes: list[FlightOutcome] = []
        with spawned_pool(self.workers) as pool:
            chunk = max(1, min(8, len(jobs) // (4 * self.workers)))
            for outcome in pool.map(_fly, jobs, [folder] * len(jobs), [noise] * len(jobs), chunksize=chunk):
                outcomes.append(outcome)
                progress(len(outcomes), len(jobs))
        cells = []
        for k in range(0, len(jobs), self.runs):
            cells.append(cell_of(jobs[k], outcomes[k : k + self.runs]))
        return cells


def cell_of(spec: Scenario, outcomes: Sequence[FlightOutcome]) -> MapCell:
    """Return the cell of the flights with one setting."""
    assert spec.flight is not None
    latency_s = spec.flight.delay_s(spec.capture.exposure_s)
    age_s = latency_s + mean_age_s(1 / spec.capture.frame_rate_hz, spec.flight.dropout)
    age_s += spec.flight.command_s + PERIOD_S / 2
    crashes = sum(one.crashed for one in outcomes)
    squares = np.array([one.rms_m**2 for one in outcomes if not one.crashed])
    rms, interval = np.nan, (np.nan, np.nan)
    if len(squares):
        rms = float(np.sqrt(squares.mean()))
        drawn = np.random.default_rng(0).choice(squares, (RESAMPLES, len(squares))).mean(axis=1)
        low, high = np.sqrt(np.quantile(drawn, [0.025, 0.975]))
        interval = (float(low), float(high))
    share = wilson95(crashes, len(outcomes))
    return MapCell(latency_s, spec.flight.dropout, age_s, len(outcomes), crashes, share, rms, interval)


def wilson95(count: int, n: int) -> tuple[float, float]:
    """Return the 95 % interval of a share that was observed in ``count`` of ``n`` cases (Wilson 1927)."""
    found = binomtest(count, n).proportion_ci(0.95, method="wilson")
    return float(found.low), float(found.high)


def margin_of(spec: Scenario, sigma_m: float) -> float:
    """Return the delay [s] above which the linear loop is unstable if its filter does not account for the delay.

    ``sigma_m``: standard deviation of a pose's position on each axis. With prediction the margin is infinite, since
    the filter accounts for the delay.
    """
    assert spec.flight is not None
    if spec.flight.compensate:
        return np.inf
    loop = PositionLoop(spec.flight.position_gain, spec.flight.velocity_gain)
    period_s = 1 / spec.capture.frame_rate_hz
    measures = spec.flight.inputs == "imu"
    return FilteredLoop(loop, motion_noise(spec.flight), sigma_m, PERIOD_S, period_s, measures).margin_s()


def described(spec: Scenario, cells: Sequence[MapCell], sigma_m: float) -> list[str]:
    """Return the lines to print: a line for each cell, and remarks on the figures."""
    assert spec.flight is not None
    lines = [f"sigma of a pose's position at the centre: {1e3 * sigma_m:.3g} mm (3D, from the rig's geometry)"]
    lines.append("latency  dropout  age      crashed                rms off the path")
    for one in cells:
        low, high = one.crash_ci95
        share = f"{one.crashes} of {one.runs} ({100 * low:.0f} .. {100 * high:.0f} %)"
        rms = "-"
        if np.isfinite(one.rms_m):
            rms = f"{1e3 * one.rms_m:.2f} mm ({1e3 * one.rms_ci95[0]:.2f} .. {1e3 * one.rms_ci95[1]:.2f})"
        setting = f"{1e3 * one.latency_s:5.1f} ms  {100 * one.dropout:4.0f} %  {1e3 * one.age_s:5.1f} ms"
        lines.append(f"{setting}  {share:<21}  {rms}")
    margin = margin_of(spec, sigma_m / np.sqrt(3))
    if np.isfinite(margin):
        lines.append(f"latency from which on the linear loop with its filter is unstable: {1e3 * margin:.1f} ms")
    inside = [one for one in cells if one.latency_s < margin]
    beyond = [one for one in cells if one.latency_s >= margin]
    for name, group in (("below it", inside), ("above it", beyond)) if np.isfinite(margin) else ():
        if group:
            count, n = sum(one.crashes for one in group), sum(one.runs for one in group)
            lines.append(f"  {name}: {count} of {n} flights crashed")
    flown = [one for one in cells if np.isfinite(one.rms_m)]
    if len(flown) > 3:
        for name, values in (
            ("age", [one.age_s for one in flown]),
            ("latency", [one.latency_s for one in flown]),
            ("dropout", [one.dropout for one in flown]),
        ):
            if len(set(values)) > 1:
                rank = spearmanr(values, [one.rms_m for one in flown]).statistic
                lines.append(f"rank correlation of rms with {name}: {rank:.2f}")
    return lines


def csv_of(cells: Sequence[MapCell]) -> str:
    """Return the cells as a table."""
    lines = ["latency_s,dropout,age_s,runs,crashes,crash_low,crash_high,rms_m,rms_low_m,rms_high_m"]
    for one in cells:
        values = (one.latency_s, one.dropout, one.age_s, one.runs, one.crashes, *one.crash_ci95, one.rms_m)
        texts = [f"{value:.6g}" if np.isfinite(value) else "" for value in (*values, *one.rms_ci95)]
        lines.append(",".join(texts))
    return "\n".join(lines) + "\n"


def _changed(spec: Scenario, latency_s: float, dropout: float, duration_s: float, seed: int) -> Scenario:
    assert spec.flight is not None
    rest = spec.flight.delay_s(spec.capture.exposure_s) - spec.flight.pipeline_s
    flight = spec.flight.model_copy(update={"pipeline_s": latency_s - rest, "dropout": dropout})
    capture = spec.capture.model_copy(update={"duration_s": duration_s})
    return spec.model_copy(update={"flight": flight, "capture": capture, "seed": seed})


def _fly(spec: Scenario, folder: Path, noise: PoseNoise) -> FlightOutcome:
    path = fly_predicted(spec, folder, noise, with_delay=False).path
    scores = flight_scores(path, None)
    return FlightOutcome(bool(path.crash), scores["flight_rms"].value if "flight_rms" in scores else np.nan)


def _drawn(cells: Sequence[MapCell], margin_s: float) -> FlightMap:
    latency, dropout = sorted({one.latency_s for one in cells}), sorted({one.dropout for one in cells})
    shape = len(latency), len(dropout)
    return FlightMap(
        np.array(latency),
        np.array(dropout),
        np.array([one.crashes / one.runs for one in cells]).reshape(shape),
        np.array([one.rms_m for one in cells]).reshape(shape),
        np.array([one.age_s for one in cells]).reshape(shape),
        margin_s,
    )
