"""A suite on a Dask cluster: each scenario is run by a worker, and its run folder is sent back."""

import io
import shutil
import tarfile
import tempfile
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from mosca.data.files.toml import check, read_toml
from mosca.data.files.whole_file import whole_folder
from mosca.errors import InputError
from scenarios.run.folder import check_out
from scenarios.run.interrupt import first_ctrl_c
from scenarios.run.one_writer import one_writer
from scenarios.spec.catalog import Entry
from scenarios.spec.scenario import Scenario, apply_overrides
from scenarios.studies.campaign.collect import Outcomes, collect
from scenarios.studies.campaign.engine import Engine
from scenarios.studies.campaign.files import gathered, laid_out
from scenarios.studies.campaign.tasks import RunTask
from scenarios.studies.campaign.worker import RunOutcome, bug_line
from scenarios.suite.suite import STOPPED, Outcome, longest_first, made


@dataclass(frozen=True)
class _Made:
    """A scenario's outcome, and its run folder as a tar archive; empty where there is none."""

    outcome: Outcome
    archive: bytes


def run_suite_on(
    engine: Engine, entries: Sequence[Entry], out: Path, told: Callable[[Outcome], None]
) -> list[Outcome]:
    """Run ``entries`` on ``engine``, each scenario into ``out``/name, like ``scenarios.suite.suite.run_suite``.

    Files that a scenario names are sent with it; a scenario whose worker dies starts again elsewhere.
    """
    for entry in entries:
        check_out(out / entry.name)
    tasks = [_task(k, entry) for k, entry in enumerate(longest_first(entries))]
    taken = _TakenIn(out, told)
    asked = threading.Event()
    try:
        with first_ctrl_c(asked.set):
            every = collect(tasks, engine, lambda done: len(tasks), work=_work, kept=taken, stopped=asked.is_set)
        for task, outcome in zip(tasks, every, strict=True):
            if task.name not in taken.done:  # nothing came back for a scenario whose workers died
                taken.keep(task, outcome)
    except KeyboardInterrupt:
        pass
    return [taken.done.get(entry.name) or Outcome(entry.name, None, STOPPED, 0.0) for entry in entries]


class _TakenIn(Outcomes):
    """Unpacks each run folder when its run has ended; returns no earlier outcomes, since a suite must be run."""

    def __init__(self, out: Path, told: Callable[[Outcome], None]) -> None:
        self._out, self._told = out, told
        self.done: dict[str, Outcome] = {}

    def find(self, task: RunTask) -> None:
        """Return None: no outcome is known yet."""

    def keep(self, task: RunTask, outcome: RunOutcome) -> None:
        """Store the outcome of a scenario."""
        if isinstance(outcome.made, _Made):
            found, archive = outcome.made.outcome, outcome.made.archive
        else:
            found, archive = Outcome(task.name, None, outcome.failed, outcome.seconds), b""
        folder = self._out / task.name
        if archive:
            try:
                _unpack(archive, folder)
            except InputError as error:
                found = Outcome(task.name, found.record, str(error), found.seconds, picture=found.picture)
        self.done[task.name] = found
        self._told(found)


def _task(number: int, entry: Entry) -> RunTask:
    document = read_toml(entry.path)
    apply_overrides(document, entry.overrides)
    files = gathered(document, entry.path.parent)
    return RunTask(number, entry.name, entry.spec.seed, {}, document, files)


def _work(task: RunTask, contents: Mapping[str, bytes]) -> RunOutcome:
    """Run a scenario on a worker."""
    with tempfile.TemporaryDirectory(prefix="mosca-suite-") as root:
        folder, out = laid_out(task.files, contents, Path(root) / "files"), Path(root) / "run"
        try:
            outcome = made(lambda: check(Scenario, dict(task.document), task.name), task.name, folder, out)
        except Exception as error:  # a bug is the result of this run only: the others must not be lost
            return RunOutcome(task.number, failed=bug_line(error))
        return RunOutcome(task.number, failed=outcome.error, made=_Made(outcome, _packed(out)))


def _packed(folder: Path) -> bytes:
    if not folder.is_dir():
        return b""
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w") as archive:
        archive.add(folder, arcname=".")
    return packed.getvalue()


def _unpack(packed: bytes, folder: Path) -> None:
    """Make the run folder; that of an earlier run is replaced."""
    with one_writer(folder):
        if folder.exists():
            shutil.rmtree(folder)
        with whole_folder(folder) as part, tarfile.open(fileobj=io.BytesIO(packed)) as archive:
            archive.extractall(part, filter="data")
