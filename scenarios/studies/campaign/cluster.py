"""Runs on a Dask cluster: its scheduler gives chunks to workers, and gives them to others where a worker dies."""

import logging
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from mosca.errors import InputError, MoscaError
from scenarios.studies.campaign.engine import Chunk
from scenarios.studies.campaign.tasks import RunTask
from scenarios.studies.campaign.worker import Work, code_stamp, run_chunk

LOG = logging.getLogger(__name__)
PATIENCE_S = 60.0
"""Time to wait for a scheduler that was lost."""
CONNECT_S = 10.0
"""Time to wait for the first connection to a scheduler."""
POLL_S = 0.2


class ClusterEngine:
    """A Dask scheduler and its workers."""

    chunk_s = 1.0
    """Shortest chunk, by Dask's own advice: its overhead per task is some milliseconds."""

    def __init__(self, address: str, lost: str = "runs that are done are kept: the same command goes on") -> None:
        """Connect to the scheduler at ``address``; InputError where there is none, or where workers have threads.

        ``lost``: words on what happens to runs if the scheduler does not come back.
        """
        self._address, self._lost = address, lost
        self._client = self._connected(CONNECT_S)
        self._contents: tuple[Mapping[str, bytes], Any] | None = None
        self._futures: set[Any] = set()
        self._check_workers()

    @property
    def slots(self) -> int:
        """Two chunks for each worker: one in progress and one waiting there."""
        return max(2, 2 * len(self._workers()))

    @property
    def lost(self) -> bool:
        """Whether the client is closed for good."""
        return self._client.status in ("closed", "closing")

    def submit(self, work: Work, tasks: Sequence[RunTask], contents: Mapping[str, bytes]) -> Chunk:
        """Begin a chunk."""
        small = [RunTask(**{**vars(one), "files": one.files.without_contents()}) for one in tasks]
        # pure=False: a chunk that is given up and started again is a different one
        future = self._client.submit(run_chunk, work, small, self._scattered(contents), code_stamp(), pure=False)
        self._futures.add(future)
        chunk: Chunk = Future()
        future.add_done_callback(lambda done: self._ended(done, chunk))
        return chunk

    def revive(self) -> None:
        """Wait for the scheduler for at most a minute; InputError where it does not come back."""
        LOG.warning("%s: scheduler or worker lost; runs that were under way begin again", self._address)
        for future in self._futures:
            future.cancel()
        self._futures, self._contents = set(), None
        until = time.monotonic() + PATIENCE_S
        while not self.lost and self._client.status != "running" and time.monotonic() < until:
            time.sleep(POLL_S)
        if self._client.status != "running":
            self._client.close(timeout=1)
            self._client = self._connected(max(1.0, until - time.monotonic()))
            self._check_workers()

    def close(self) -> None:
        """Give up chunks in progress, and leave the cluster."""
        for future in self._futures:
            future.cancel()
        self._client.close(timeout=5)

    def _connected(self, timeout_s: float) -> Any:
        try:
            from distributed import Client
        except ImportError:
            raise InputError(
                f"--scheduler {self._address}: Dask is not installed; pip install 'mosca-testbench[cluster]', or "
                "leave --scheduler out"
            ) from None
        try:
            return Client(self._address, timeout=timeout_s, set_as_default=False, name="mosca")
        except (OSError, ValueError) as error:
            raise InputError(
                f"--scheduler {self._address}: no Dask scheduler answers within {timeout_s:.0f} s "
                f"({type(error).__name__}); 'dask scheduler' starts one and 'dask worker ADDRESS --nthreads 1' "
                f"workers; {self._lost}"
            ) from None

    def _workers(self) -> Mapping[str, Any]:
        found: Mapping[str, Any] = self._client.scheduler_info(n_workers=-1)["workers"]
        return found

    def _check_workers(self) -> None:
        """Raise InputError where a worker runs several threads, or other code."""
        for name, one in self._workers().items():
            if one["nthreads"] != 1:
                raise InputError(
                    f"--scheduler {self._address}: worker {name} has {one['nthreads']} threads; runs take a process "
                    "each: dask worker ADDRESS --nworkers N --nthreads 1"
                )
        try:
            self._client.run(code_stamp)
        except Exception as error:
            raise InputError(
                f"--scheduler {self._address}: a worker cannot import mosca ({error}); install the same version there"
            ) from None

    def _scattered(self, contents: Mapping[str, bytes]) -> Any:
        """Return the files' contents on every worker; they are sent once and named by their content."""
        if not contents:
            return {}
        if self._contents is None or self._contents[0] is not contents:
            self._contents = contents, self._client.scatter([dict(contents)], hash=True, broadcast=True)[0]
        return self._contents[1]

    def _ended(self, future: Any, chunk: Chunk) -> None:
        self._futures.discard(future)
        error = future.exception() if future.status == "error" else None
        if future.status == "finished":
            chunk.set_result(future.result())
        elif type(error).__name__ == "KilledWorker":
            chunk.set_exception(BrokenProcessPool(str(error)))
        elif isinstance(error, MoscaError):
            chunk.set_exception(error)
        else:  # cancelled, or lost with the scheduler or with the worker that had the files
            chunk.set_exception(ConnectionError(str(error)))
