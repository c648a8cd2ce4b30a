"""The whole benchmark: data sets are made, entrants are installed and run, and all are scored in the same way."""

import logging
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np

from mosca.errors import InputError
from scenarios.studies.benchmark.entrant import (
    ADAPTERS,
    Entrant,
    EnvironmentFailed,
    own_environment,
    python_of,
    settings_for,
)
from scenarios.studies.benchmark.execute import Execution, adapter_command, execute
from scenarios.studies.benchmark.folder import AboutSet, read_about, read_set_truth
from scenarios.studies.benchmark.kept import keep_rows, kept_rows, row_key
from scenarios.studies.benchmark.make import SetFile, make_set, missing
from scenarios.studies.benchmark.scoring import match_detections, nothing_found, read_found, score_found
from scenarios.studies.benchmark.seeds import Passphrase
from scenarios.types import Score

LOG = logging.getLogger(__name__)
LIMIT_S = 300.0
"""Longest duration of one phase of an entrant on one data set [s]."""
Shown = Callable[[int, int], object]


@dataclass(frozen=True)
class BenchmarkRow:
    """Result of an entrant on a data set, in one of the two tables."""

    table: str
    set: str
    entrant: str
    scores: dict[str, Score]
    error: str
    """Reason why it is scored as nothing found; "" where it is not."""
    seconds: float
    peak_mb: float | None
    settings: dict[str, Any] = field(default_factory=dict)
    again: str = ""
    """Differences of the second run with ``--twice``; "" where there are none."""


@dataclass(frozen=True)
class BenchmarkJob:
    """Folders of a benchmark, and the time limit of an entrant."""

    data: Path
    """Data sets and their truth."""
    work: Path
    """Files that entrants write."""
    cache: Path
    """Cached environments."""
    limit_s: float = LIMIT_S
    workers: int = 1
    """Threads that render, and entrants that run side by side."""
    twice: bool = False


@dataclass(frozen=True)
class Benchmarked:
    """All rows, the sets that were made, and the reasons why others were not."""

    rows: tuple[BenchmarkRow, ...]
    sets: dict[str, AboutSet]
    left_out: dict[str, str]
    pythons: dict[str, Path]
    """Pythons of the entrants that could be installed."""

    @property
    def failures(self) -> list[str]:
        """One line for each row without a result, and for each that differs in a second run."""
        lines = [f"{row.entrant} on {row.set} ({row.table}): {row.error}" for row in self.rows if row.error]
        return lines + [
            f"{row.entrant} on {row.set} ({row.table}): not the same twice: {row.again}"
            for row in self.rows
            if row.again
        ]


def run_benchmark(
    sets: Sequence[SetFile], entrants: Sequence[Entrant], passphrase: Passphrase, job: BenchmarkJob, shown: Shown
) -> Benchmarked:
    """Make the sets, and run and score the entrants on each of them."""
    steps = len(entrants) + len(sets) * (1 + len(entrants))
    done = 0

    def step(what: str) -> None:
        nonlocal done
        done += 1
        LOG.info("%s", what)
        shown(done, steps)

    pythons: dict[str, Path] = {}
    reasons: dict[str, str] = {}
    for entrant in entrants:
        try:
            pythons[entrant.name] = python_of(entrant, job.cache)
        except EnvironmentFailed as error:
            reasons[entrant.name] = str(error)
        step(f"environment of {entrant.name}: {reasons.get(entrant.name) or 'ready'}")
    rows: list[BenchmarkRow] = []
    about: dict[str, AboutSet] = {}
    left_out: dict[str, str] = {}
    for one in sets:
        why = missing(one)
        kept = [] if why else _kept(one, entrants, passphrase, job, reasons)
        if not why and kept is None:
            try:
                make_set(one, passphrase, job.data, job.workers)
            except InputError as error:
                why = str(error)
        step(f"data set {one.name}: {why or ('made' if kept is None else 'kept rows are used')}")
        if why:
            left_out[one.name] = why
            continue
        about[one.name] = read_about(job.data / one.name / "dataset.json")
        if kept is None:
            kept = _on_set(one, entrants, passphrase, job, (pythons, reasons), step)
        else:
            done += len(entrants)
        rows += kept or []
    return Benchmarked(tuple(rows), about, left_out, pythons)


def _kept(
    one: SetFile, entrants: Sequence[Entrant], passphrase: Passphrase, job: BenchmarkJob, reasons: dict[str, str]
) -> list[BenchmarkRow] | None:
    """Return the cached rows of all entrants on a set; None where one is missing."""
    if not (job.data / one.name / "dataset.json").is_file():
        return None
    rows = []
    for entrant in entrants:
        found = None if entrant.name in reasons else kept_rows(*_where_kept(one, entrant, passphrase, job))
        if found is None:
            return None
        rows += [BenchmarkRow(**row) for row in found]
    return rows


def _where_kept(one: SetFile, entrant: Entrant, passphrase: Passphrase, job: BenchmarkJob) -> tuple[Path, str]:
    """Return the file and the key of an entrant's rows on a set."""
    key = row_key(entrant, one.path, passphrase.seed(one.name), job.limit_s, job.twice)
    return job.data.parent / "rows" / f"{one.name}-{entrant.name}.json", key


def _on_set(
    one: SetFile,
    entrants: Sequence[Entrant],
    passphrase: Passphrase,
    job: BenchmarkJob,
    installed: tuple[dict[str, Path], dict[str, str]],
    step: Callable[[str], None],
) -> list[BenchmarkRow]:
    """Run all entrants on a set, ``job.workers`` of them in parallel; rows with results are cached."""
    on_set = OnSet(one.name, job, *installed)
    rows: dict[str, list[BenchmarkRow]] = {}
    finding = [entrant for entrant in entrants if entrant.detections_of is None]
    borrowing = [entrant for entrant in entrants if entrant.detections_of is not None]
    with ThreadPoolExecutor(job.workers) as pool:
        try:
            for some in (finding, borrowing):
                for entrant, own in zip(some, pool.map(on_set.rows_of, some), strict=True):
                    if not any(row.error or row.again for row in own):
                        keep_rows(*_where_kept(one, entrant, passphrase, job), own)
                    rows[entrant.name] = own
                    step(f"{entrant.name} on {one.name}")
        finally:
            # after Ctrl-C nothing keeps running
            on_set.stopped.set()
    return [row for entrant in entrants for row in rows[entrant.name]]


class OnSet:
    """The entrants on one data set."""

    def __init__(self, name: str, job: BenchmarkJob, pythons: dict[str, Path], reasons: dict[str, str]) -> None:
        self.name, self.job, self.pythons, self.reasons = name, job, pythons, reasons
        self.truth = read_set_truth(job.data / "truth" / name)
        low, high = np.array(read_about(job.data / name / "dataset.json").volume_m)
        self.working_space_m = float((high - low).max())
        self.stopped = Event()
        """When it is set, running entrants are ended and no more are started."""
        self._matched: dict[tuple[str, str], Path | str] = {}

    def rows_of(self, entrant: Entrant) -> list[BenchmarkRow]:
        """Return the entrant's rows, one for each of its tables."""
        settings = settings_for(entrant, self.name)
        rows = []
        for table in entrant.tables:
            scores, error, spent = self.scored(entrant, table, settings, "first")
            again = ""
            if self.job.twice and not error:
                again = _difference(scores, self.scored(entrant, table, settings, "second"))
            rows.append(
                BenchmarkRow(
                    table, self.name, entrant.name, scores, error, spent.seconds, spent.peak_mb, settings, again
                )
            )
        return rows

    def scored(
        self, entrant: Entrant, table: str, settings: dict[str, Any], turn: str
    ) -> tuple[dict[str, Score], str, Execution]:
        """Run an entrant and score it; without a result it is scored as nothing found, with the reason."""
        out = self.job.work.absolute() / turn / self.name / entrant.name / f"{table}.csv"
        out.unlink(missing_ok=True)
        spent = Execution(self.reasons.get(entrant.name, ""), 0.0, None)
        try:
            if not spent.error:
                spent = self._run(entrant, table, settings, turn, out)
            if not spent.error:
                return score_found(read_found(out, self.truth), self.truth, self.working_space_m), "", spent
            error = spent.error
        except InputError as nonsense:
            error = f"no usable output: {nonsense}"
        return nothing_found(self.truth, self.working_space_m), error, spent

    def _run(self, entrant: Entrant, table: str, settings: dict[str, Any], turn: str, out: Path) -> Execution:
        if table == "images":
            return self._phase(entrant, "points", settings, out)
        source = entrant if entrant.detections_of is None else None
        first = Execution("", 0.0, None)
        if source is None:
            found = self._matched.get((entrant.detections_of or "", turn), "it did not run")
            if isinstance(found, str):
                return Execution(f"no image points of {entrant.detections_of}: {found}", 0.0, None)
            matched = found
        else:
            self._matched[entrant.name, turn] = "no result"
            detections = out.with_name("detections.csv")
            detections.unlink(missing_ok=True)
            first = self._phase(entrant, "detect", settings, detections)
            if first.error:
                self._matched[entrant.name, turn] = first.error
                return first
            matched = out.with_name("matched_points.csv")
            match_detections(detections, self.truth, matched)
            self._matched[entrant.name, turn] = matched
        second = self._phase(entrant, "triangulate", settings, out, matched)
        peaks = [peak for peak in (first.peak_mb, second.peak_mb) if peak is not None]
        return Execution(second.error, first.seconds + second.seconds, max(peaks, default=None))

    def _phase(self, entrant: Entrant, phase: str, settings: dict[str, Any], out: Path, *more: Path) -> Execution:
        dataset = (self.job.data / self.name).absolute()
        python, adapter = self.pythons[entrant.name], ADAPTERS / entrant.adapter
        command = adapter_command(python, adapter, phase, dataset, out, settings, *more)
        return execute(command, own_environment(entrant), out.parent / phase, self.job.limit_s, self.stopped)


def _difference(scores: dict[str, Score], again: tuple[dict[str, Score], str, Execution]) -> str:
    """Return the differences of a second run's metrics from the first; "" where all are the same to the last bit."""
    others, error, _ = again
    if error:
        return error
    told = [
        f"{name} {scores[name].value!r} and {others[name].value!r}"
        for name in scores
        if name in others and scores[name].value != others[name].value
    ]
    if set(scores) != set(others):
        told.append("other metrics")
    return "; ".join(told)


def default_cache() -> Path:
    """Return the folder of cached environments unless the user names one."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "mosca-benchmark"
