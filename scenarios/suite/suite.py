"""Many scenarios: run on all cores, summarised, compared with their baselines, reported as JUnit XML."""

import multiprocessing
import os
import shutil
import signal
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from pathlib import Path
from types import FrameType

import numpy as np
from junitparser import Error, Failure, JUnitXml, TestCase, TestSuite

from mosca.data.files.whole_file import whole_file
from mosca.errors import InputError, MoscaError
from reports.compare import Regression, missing, regressions
from reports.record import RunRecord, read_record, write_record
from scenarios.run.interrupt import first_ctrl_c, was_interrupted
from scenarios.run.worker_processes import begin_worker, ctrl_c_held_back, spawned_pool
from scenarios.spec.catalog import Entry
from scenarios.spec.scenario import Scenario, load_scenario

BASELINES = Path(__file__).resolve().parents[2] / "reports" / "baselines"
STOPPED = "stopped by hand"
POLL_S = 0.1


@dataclass(frozen=True)
class Outcome:
    """Outcome of one scenario: its record, the known error that prevented the run or the writing of its folder, and
    its seconds.
    """

    name: str
    record: RunRecord | None
    error: str
    seconds: float
    worse: tuple[Regression, ...] = ()
    gone: tuple[str, ...] = ()
    picture: str = ""
    """Drawing of its scene, as small inline SVG."""

    @property
    def passed(self) -> bool:
        """Whether the scenario ran, met its limits and has no regression."""
        whole = self.record is not None and self.record.passed and not self.error
        return whole and not self.worse and not self.gone


def run_suite(entries: Sequence[Entry], out: Path, jobs: int, told: Callable[[Outcome], None]) -> list[Outcome]:
    """Run ``entries`` in ``jobs`` processes, each scenario into ``out``/name; ``told`` is called as each ends.

    Outcomes are in the order of the entries. The longest start first, so that all cores end at about the same time.
    Ctrl-C ends running scenarios; these, and those that did not start, have the error ``STOPPED``.
    """
    order = longest_first(entries)
    done: dict[str, Outcome] = {}
    asked = threading.Event()
    jobs = min(jobs, max(1, len(order)))
    with first_ctrl_c(asked.set), spawned_pool(jobs, begin_worker) as pool:
        with ctrl_c_held_back():
            pending = {pool.submit(_run_one, str(e.path), e.name, str(out / e.name), e.overrides) for e in order}
        try:
            while pending:
                if asked.is_set():
                    pending = {future for future in pending if not future.cancel()}
                    for worker in multiprocessing.active_children():
                        worker.terminate()
                ended, pending = wait(pending, POLL_S, FIRST_COMPLETED)
                for outcome in filter(None, (_outcome_of(future, asked.is_set()) for future in ended)):
                    done[outcome.name] = outcome
                    told(outcome)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for worker in multiprocessing.active_children():
                worker.kill()
                worker.join()
            _remove_unfinished(out / entry.name for entry in order)
            raise
    return [done.get(e.name) or Outcome(e.name, None, STOPPED, 0.0) for e in entries]


def _outcome_of(future: "Future[Outcome]", stopping: bool) -> Outcome | None:
    """Return a scenario's outcome; None for one that was stopped before it had one."""
    try:
        return future.result()
    except (KeyboardInterrupt, BrokenProcessPool):
        if not stopping:
            raise
        return None


def _end_scenario(number: int, frame: FrameType | None) -> None:
    # once only: a second signal must not end the clean-up
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    raise KeyboardInterrupt


def _remove_unfinished(folders: Iterable[Path]) -> None:
    """Remove files that killed processes left beside their run folders."""
    for folder in folders:
        for left in folder.parent.glob(f".{folder.name}.*"):
            shutil.rmtree(left) if left.is_dir() else left.unlink()


def check_baselines(folder: Path) -> None:
    """Raise InputError where the folder of baselines does not exist."""
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder of baselines; 'mosca suite --update-baselines' makes one")


def check_replicate(entries: Sequence[Entry], folder: Path) -> None:
    """Raise InputError where ``folder`` of a suite run lacks the record of one of ``entries``."""
    for entry in entries:
        read_record(folder / entry.name / "record.json")


def compared(outcomes: Sequence[Outcome], baselines: Path) -> list[Outcome]:
    """Return the outcomes with their regressions against the baselines; none for a scenario without a baseline."""
    return [_compared(outcome, baselines) for outcome in outcomes]


def update_baselines(outcomes: Sequence[Outcome], baselines: Path, replicates: Sequence[Path] = ()) -> None:
    """Write the records as the new baselines; refuse where any scenario failed.

    ``replicates``: folders of suite runs of the same product with other processor features; each metric's spread
    among them is written to its baseline. Without them, the spreads of the replaced baselines are kept.
    """
    failed = [o.name for o in outcomes if not o.passed]
    if failed:
        raise InputError(f"baselines are not updated while {', '.join(failed)} failed; mend that first")
    records = [o.record for o in outcomes if o.record is not None]
    paths = [baseline_path(record.scenario, baselines) for record in records]
    if replicates:
        stated = [_with_spread(r, [read_record(f / r.scenario / "record.json") for f in replicates]) for r in records]
    else:
        stated = [_with_spread_of(r, path) for r, path in zip(records, paths, strict=True)]
    for record, path in zip(stated, paths, strict=True):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_record(replace(record, timings={}, cameras={}), path)


def _with_spread(record: RunRecord, others: Sequence[RunRecord]) -> RunRecord:
    """Return the record with each metric's largest change among other runs of the same product, where all have it."""
    metrics = []
    for metric in record.metrics:
        values = [found.value for other in others if (found := other.metric(metric.name)) is not None]
        changes = np.abs(np.subtract(values, metric.value))
        known = 0 < len(values) == len(others) and bool(np.isfinite(changes).all())
        metrics.append(replace(metric, spread=float(changes.max()) if known else None))
    return replace(record, metrics=tuple(metrics))


def _with_spread_of(record: RunRecord, path: Path) -> RunRecord:
    """Return the record with the spreads of the baseline at ``path``, if there is one."""
    if not path.is_file():
        return record
    old = read_record(path)
    known = {metric.name: metric.spread for metric in old.metrics}
    return replace(record, metrics=tuple(replace(m, spread=known.get(m.name)) for m in record.metrics))


def baseline_path(name: str, baselines: Path) -> Path:
    """Return the path of a scenario's baseline."""
    return baselines / f"{name}.json"


def write_junit(outcomes: Sequence[Outcome], path: Path) -> None:
    """Write the outcomes as JUnit XML, one test case for each scenario."""
    suite = TestSuite("mosca suite")
    for outcome in outcomes:
        case = TestCase(outcome.name, classname="mosca.scenarios", time=outcome.seconds)
        if outcome.error:
            case.result = [Error(outcome.error)]
        elif not outcome.passed:
            case.result = [Failure("; ".join(complaints(outcome)))]
        suite.add_testcase(case)
    suite.update_statistics()
    document = JUnitXml()
    document.add_testsuite(suite)
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as temporary:
        document.write(str(temporary), pretty=True)


def complaints(outcome: Outcome) -> list[str]:
    """Return lines on the faults of an outcome."""
    lines = [f"{outcome.name}: {outcome.error}"] if outcome.error else []
    if outcome.record is None:
        return lines
    lines += [] if outcome.record.passed else [f"{outcome.name}: {outcome.record.verdict}"]
    lines += [f"regression: {r}" for r in outcome.worse]
    lines += [f"{outcome.name}: metric '{name}' of the baseline is gone" for name in outcome.gone]
    return lines


def longest_first(entries: Sequence[Entry]) -> list[Entry]:
    """Return the scenarios that render most first, so that all workers end at about the same time."""
    return sorted(entries, key=_weight, reverse=True)


def made(load: Callable[[], Scenario], name: str, folder: Path, out: Path) -> Outcome:
    """Run one scenario into the run folder ``out``; ``folder``: that of the files that it names."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    from reports.suite.thumbnail import thumbnail
    from scenarios.run.folder import check_out, write_run
    from scenarios.run.one_writer import one_writer
    from scenarios.run.scenario import run_scenario

    start = time.perf_counter()
    record, picture = None, ""
    try:
        check_out(out)
        with one_writer(out):
            result = run_scenario(load(), name, folder)
            record, picture = result.record, thumbnail(result.evidence)
            write_run(result, out)
    except MoscaError as error:
        return Outcome(name, record, str(error), time.perf_counter() - start, picture=picture)
    return Outcome(name, record, "", time.perf_counter() - start, picture=picture)


def _run_one(path: str, name: str, out: str, overrides: tuple[str, ...] = ()) -> Outcome:
    """Run one scenario in a worker process."""
    before = signal.signal(signal.SIGTERM, _end_scenario)
    start = time.perf_counter()
    try:
        return made(lambda: load_scenario(Path(path), overrides), name, Path(path).parent, Path(out))
    except (KeyboardInterrupt, SystemError) as error:
        if not was_interrupted(error):
            raise
        return Outcome(name, None, STOPPED, time.perf_counter() - start)
    finally:
        signal.signal(signal.SIGTERM, before)


def _compared(outcome: Outcome, baselines: Path) -> Outcome:
    path = baseline_path(outcome.name, baselines)
    if outcome.record is None or not path.exists() or outcome.record.expect != "pass":
        return outcome  # a control's figures are bad on purpose
    baseline = read_record(path)
    return replace(
        outcome, worse=tuple(regressions(outcome.record, baseline)), gone=tuple(missing(outcome.record, baseline))
    )


def _weight(entry: Entry) -> float:
    capture = entry.spec.capture
    return capture.duration_s * capture.frame_rate_hz * entry.spec.cameras.count
