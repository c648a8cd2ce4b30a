"""Engines that make runs: processes of this computer, or anything else that takes chunks of runs."""

from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from typing import Protocol

from scenarios.run.worker_processes import begin_worker, ctrl_c_held_back, spawned_pool
from scenarios.studies.campaign.tasks import RunTask
from scenarios.studies.campaign.worker import RunOutcome, Work, code_stamp, run_chunk

Chunk = Future[list[RunOutcome]]


class Engine(Protocol):
    """Takes chunks of runs. A chunk whose worker died, or whose engine was lost, ends with an error."""

    @property
    def slots(self) -> int:
        """Useful number of chunks in progress."""
        ...

    @property
    def chunk_s(self) -> float:
        """Shortest chunk that is worth its overhead [s]."""
        ...

    @property
    def lost(self) -> bool:
        """Whether no chunk in progress will ever end."""
        ...

    def submit(self, work: Work, tasks: Sequence[RunTask], contents: Mapping[str, bytes]) -> Chunk:
        """Begin a chunk."""
        ...

    def revive(self) -> None:
        """Restore the engine after an error; all chunks in progress are given up. MoscaError where that fails."""
        ...

    def close(self) -> None:
        """End the engine and the chunks in progress."""
        ...


class LocalEngine:
    """Processes of this computer."""

    chunk_s = 0.0
    lost = False

    def __init__(self, jobs: int) -> None:
        """Prepare ``jobs`` processes, which start with the first chunks."""
        self._jobs = jobs
        self._pool = spawned_pool(self._jobs, begin_worker)

    @property
    def slots(self) -> int:
        """One more than there are processes, so that none waits for the next chunk."""
        return self._jobs + 1

    def submit(self, work: Work, tasks: Sequence[RunTask], contents: Mapping[str, bytes]) -> Chunk:
        """Begin a chunk."""
        with ctrl_c_held_back():
            return self._pool.submit(run_chunk, work, tasks, contents, code_stamp())

    def revive(self) -> None:
        """Begin new processes after one of them died."""
        self.close()
        self._pool = spawned_pool(self._jobs, begin_worker)

    def close(self) -> None:
        """End the processes."""
        workers = list((self._pool._processes or {}).values())
        self._pool.shutdown(wait=False, cancel_futures=True)
        for worker in workers:
            worker.kill()
        for worker in workers:
            worker.join()
