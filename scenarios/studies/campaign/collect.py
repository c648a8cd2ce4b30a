"""Makes the runs of a claim in any order and on any number of workers, and judges them in their own order."""

import logging
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Protocol

from mosca.errors import InputError
from scenarios.run.kept_calibrations import cache_folder, digest_of, read_kept, write_kept
from scenarios.studies.campaign.engine import Chunk, Engine
from scenarios.studies.campaign.tasks import RunTask
from scenarios.studies.campaign.worker import RunOutcome, Work, code_stamp, run_task

LOG = logging.getLogger(__name__)
POLL_S = 0.2
MOST_DEATHS = 3
"""Number of processes that may die during one run before it counts as failed; after the first death it runs alone."""
LOST = (BrokenProcessPool, CancelledError, ConnectionError)
"""Errors of a chunk whose worker died, or whose engine was lost."""
DIED = "its process died three times: out of memory, or killed"


class Outcomes(Protocol):
    """A store of outcomes besides their collection."""

    def find(self, task: RunTask) -> RunOutcome | None:
        """Return the outcome of a run if it is known already."""
        ...

    def keep(self, task: RunTask, outcome: RunOutcome) -> None:
        """Store an outcome when its run ends, in any order."""
        ...


class KeptRuns(Outcomes):
    """Outcomes cached by the content of all their inputs, so that claims can share runs."""

    def __init__(self, work: Work, folder: Path | None = None) -> None:
        """Set the ``folder`` of the cache; default: among the caches of the user."""
        self._folder = folder or cache_folder("runs")
        self._code = (code_stamp(), f"{work.__module__}.{work.__qualname__}")

    def find(self, task: RunTask) -> RunOutcome | None:
        """Return the outcome of this run if it is cached."""
        found = read_kept(self._path(task))
        return None if found is None else replace(found, number=task.number)

    def keep(self, task: RunTask, outcome: RunOutcome) -> None:
        """Cache an outcome; where the folder cannot be written, nothing is cached."""
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            write_kept(self._path(task), outcome)
        except (OSError, InputError) as error:
            LOG.warning("%s: the run is not kept: %s", self._folder, error)

    def _path(self, task: RunTask) -> Path:
        inputs = (self._code, task.document, task.files.folder, task.files.digests)
        return self._folder / f"{digest_of(inputs)}.run"


@dataclass
class _Collection:
    """Outcomes so far, and chunks in progress."""

    tasks: Sequence[RunTask]
    engine: Engine
    work: Work
    kept: Outcomes
    done: dict[int, RunOutcome]
    pending: dict[Chunk, list[int]]
    deaths: dict[int, int]
    next: int = 0

    def prefix(self) -> int:
        """Return the number of runs, from the first, that are done without a gap."""
        count = 0
        while count in self.done:
            count += 1
        return count


def collect(
    tasks: Sequence[RunTask],
    engine: Engine,
    enough: Callable[[Sequence[RunOutcome]], int],
    *,
    work: Work = run_task,
    kept: Outcomes | None = None,
    told: Callable[[int], None] = lambda done: None,
    stopped: Callable[[], bool] = lambda: False,
) -> list[RunOutcome]:
    """Return the outcomes of the first runs, as many as ``enough`` returns for all outcomes so far, in order.

    ``enough`` returns the number of runs that settle the claim, or a larger number than there are. Its value, and so
    the result, is the same for any engine. ``told`` is called with the number of runs done; ``stopped`` returns
    whether to stop (KeyboardInterrupt), and completed runs are kept.
    """
    state = _Collection(tasks, engine, work, kept or KeptRuns(work), {}, {}, {})
    judged = -1
    while True:
        if stopped():
            raise KeyboardInterrupt
        _fill(state)
        count = state.prefix()
        if count != judged:
            judged = count
            told(count)
            settled = enough([state.done[k] for k in range(count)])
            if settled <= count or count == len(tasks):
                return [state.done[k] for k in range(min(settled, count))]
        if state.pending:
            _take(state)


def _fill(state: _Collection) -> None:
    """Start runs, or find them cached; a run during which a worker may have died runs alone."""
    suspects = [k for k in state.deaths if k not in state.done]
    if suspects:
        if not state.pending:
            _submit(state, suspects[:1])
        return
    while len(state.pending) < state.engine.slots:
        size = _chunk_size(state)
        chunk = list(islice(_not_kept(state), size))
        if not chunk:
            return
        _submit(state, chunk)


def _not_kept(state: _Collection) -> Iterator[int]:
    """Yield the next runs that must be made, in order."""
    while state.next < len(state.tasks):
        number = state.next
        state.next += 1
        if number not in state.done:
            found = state.kept.find(state.tasks[number])
            if found is None:
                yield number
            else:
                state.done[number] = found


def _chunk_size(state: _Collection) -> int:
    """Return the number of runs for a chunk of sufficient length; one before any duration is known."""
    times = sorted(one.seconds for one in state.done.values() if one.seconds > 0)
    if not times or state.engine.chunk_s <= 0:
        return 1
    return min(64, max(1, math.ceil(state.engine.chunk_s / times[len(times) // 2])))


def _submit(state: _Collection, numbers: list[int]) -> None:
    tasks = [state.tasks[k] for k in numbers]
    contents: Mapping[str, bytes] = tasks[0].files.contents
    if any(one.files.contents is not contents for one in tasks):
        contents = {key: data for one in tasks for key, data in one.files.contents.items()}
    try:
        state.pending[state.engine.submit(state.work, tasks, contents)] = numbers
    except LOST as error:  # broken between two chunks
        _recover(state, numbers, error)


def _take(state: _Collection) -> None:
    """Wait for the next chunk that ends, and collect its outcomes."""
    ended, _ = wait(state.pending, POLL_S, FIRST_COMPLETED)
    if not ended and state.engine.lost:
        _recover(state, [], ConnectionError("lost"))
        return
    for chunk in ended:
        try:
            outcomes = chunk.result()
        except LOST as error:
            _recover(state, [], error)
            return
        del state.pending[chunk]
        for outcome in outcomes:
            state.done[outcome.number] = outcome
            state.deaths.pop(outcome.number, None)
            state.kept.keep(state.tasks[outcome.number], outcome)


def _recover(state: _Collection, numbers: list[int], error: BaseException) -> None:
    """Start again after a worker died or the engine was lost; a run during which several workers died has failed."""
    LOG.warning("a worker or the scheduler was lost (%s); what was under way begins again", type(error).__name__)
    for chunk in [one for one in state.pending if _has_result(one)]:
        for outcome in chunk.result():
            state.done[outcome.number] = outcome
            state.kept.keep(state.tasks[outcome.number], outcome)
        del state.pending[chunk]
    again = [*numbers, *(k for chunk in state.pending.values() for k in chunk)]
    if not isinstance(error, ConnectionError):
        for k in again:
            state.deaths[k] = state.deaths.get(k, 0) + 1
            if state.deaths[k] >= MOST_DEATHS:
                state.done[k] = RunOutcome(k, failed=DIED)
    state.pending.clear()
    state.next = min([state.next, *again])
    state.engine.revive()


def _has_result(chunk: Chunk) -> bool:
    return chunk.done() and not chunk.cancelled() and chunk.exception() is None
