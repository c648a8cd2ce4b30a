"""Pools of worker processes. Workers leave Ctrl-C to the process that started them, and end with it."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager

from mosca.errors import InputError


def spawned_pool(jobs: int, initializer: Callable[[], object] | None = None) -> ProcessPoolExecutor:
    """Return a pool of ``jobs`` processes that are spawned.

    A forked child would inherit threads of its parent's libraries in unknown states. Raises InputError where this
    system has no locks for processes: on Linux these are files in /dev/shm.
    """
    context = multiprocessing.get_context("spawn")
    try:
        context.Lock()
    except OSError as error:
        raise InputError(
            f"processes beside each other need locks, and this system gives none ({error.strerror}; /dev/shm); mount "
            "/dev/shm, or run scenarios one by one with 'mosca run'"
        ) from None
    return ProcessPoolExecutor(jobs, mp_context=context, initializer=initializer)


@contextmanager
def ctrl_c_held_back() -> Iterator[None]:
    """Block Ctrl-C in this thread, and permanently in processes started here, so that only this process handles it.

    The terminal sends it to all of them; where signals cannot be blocked (Windows), workers end by themselves.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def begin_worker() -> None:
    """Prepare a worker: it ends with the process that started it, and SIGTERM does not end an idle worker."""
    # between two tasks there is nothing to end
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """End this worker when the process that started it was killed: its work would not be used."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
