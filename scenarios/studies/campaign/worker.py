"""One run of a claim, made in a process of this computer or by a worker of a cluster."""

import hashlib
import os
import platform
import tempfile
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

from mosca.data.files.bounded import read_bytes
from mosca.errors import InputError, MoscaError
from scenarios.run.provenance import numerics
from scenarios.studies.campaign.files import laid_out
from scenarios.studies.campaign.tasks import RunTask

ROOT = Path(__file__).resolve().parents[3]
ROOMS = ("mosca", "twin", "scenarios", "reports")
NOT_CODE = {"baselines", "library", "claims"}
"""Folders of files that count by their own content, or that no run reads."""
SOURCES = (".py", ".toml", ".xml", ".csv", ".json")


@dataclass(frozen=True)
class RunOutcome:
    """Outcome of a run."""

    number: int
    metrics: Mapping[str, float] = field(default_factory=dict)
    """All metrics of its record; empty where it failed."""
    failed: str = ""
    """Reason why there are none, in one line."""
    processor: str = ""
    seconds: float = field(default=0.0, compare=False)
    """Duration of the run; it is in no result."""
    made: object = field(default=None, compare=False, repr=False)
    """Further output of the run, for work that keeps it."""


Work = Callable[[RunTask, Mapping[str, bytes]], RunOutcome]


def run_task(task: RunTask, contents: Mapping[str, bytes]) -> RunOutcome:
    """Make a run and return its metrics; ``contents``: contents of its files, by their digests.

    Any error that prevents metrics is the outcome: an error of the input or of the calibration, or a bug.
    """
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    from mosca.data.files.toml import check
    from scenarios.run.scenario import run_scenario
    from scenarios.spec.scenario import Scenario
    from scenarios.types import RunOptions

    try:
        with tempfile.TemporaryDirectory(prefix="mosca-claim-") as root:
            folder = laid_out(task.files, contents, Path(root))
            spec = check(Scenario, dict(task.document), task.name)
            record = run_scenario(spec, task.name, folder, RunOptions(page=False)).record
    except MoscaError as error:
        return RunOutcome(task.number, failed=str(error))
    except Exception as error:  # a bug is the result of this run only: the others must not be lost
        return RunOutcome(task.number, failed=bug_line(error))
    return RunOutcome(task.number, {metric.name: metric.value for metric in record.metrics})


def bug_line(error: Exception) -> str:
    """Return an unexpected error and its location as a line."""
    where = traceback.extract_tb(error.__traceback__)[-1]
    text = " ".join(f"{type(error).__name__}: {error}".split())
    return f"{text} ({Path(where.filename).name}:{where.lineno})"


def run_chunk(work: Work, tasks: Sequence[RunTask], contents: Mapping[str, bytes], stamp: str) -> list[RunOutcome]:
    """Return the outcomes of some runs, with the duration of each and the processor that made it.

    InputError where this worker's ``code_stamp`` is not ``stamp``.
    """
    if code_stamp() != stamp:
        raise InputError(
            f"a worker on {platform.node()} has other code or package versions than this computer; install the same"
        )
    found = []
    for task in tasks:
        start = time.perf_counter()
        outcome = work(task, contents)
        seconds = time.perf_counter() - start
        found.append(replace(outcome, processor=str(numerics()["processor"]), seconds=seconds))
    return found


@cache
def code_stamp() -> str:
    """Return a digest of all sources that can affect a run, and of the versions of the packages that they use."""
    digest = hashlib.sha256(repr(numerics()["versions"]).encode())
    for room in ROOMS:
        for path in sorted((ROOT / room).rglob("*")):
            if path.suffix in SOURCES and not NOT_CODE & set(path.parts):
                digest.update(path.relative_to(ROOT).as_posix().encode())
                digest.update(hashlib.sha256(read_bytes(path)).digest())
    return digest.hexdigest()[:32]
