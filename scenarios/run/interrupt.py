"""Ctrl-C that takes effect between two steps of the work."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

EXIT_STOPPED = 130
"""Exit code as in shells: 128 plus the number of the signal."""


@contextmanager
def first_ctrl_c(on_first: Callable[[], None]) -> Iterator[None]:
    """Call ``on_first`` at the first Ctrl-C; a second one interrupts at once.

    Outside the main thread, where Python delivers no signals, this does nothing.
    """
    asked = False

    def ask(number: int, frame: FrameType | None) -> None:
        nonlocal asked
        if asked:
            raise KeyboardInterrupt
        asked = True
        on_first()

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, ask)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def between_steps() -> Iterator[Callable[[], None]]:
    """Hold Ctrl-C back until the yielded check is called; a second Ctrl-C interrupts at once.

    An interruption inside compiled code or a callback of a C library appears as another exception or is lost there.
    Between two frame sets it is clean, and data recorded until then are complete.
    """
    asked = threading.Event()

    def check() -> None:
        if asked.is_set():
            raise KeyboardInterrupt

    with first_ctrl_c(asked.set):
        yield check


def was_interrupted(error: BaseException | None) -> bool:
    """Return whether a Ctrl-C in compiled code caused ``error``: an interruption is in its chain of causes."""
    while error is not None:
        if isinstance(error, KeyboardInterrupt):
            return True
        error = error.__cause__ or error.__context__
    return False
