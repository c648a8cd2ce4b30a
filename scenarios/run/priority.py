"""Priority of live work over other work of the machine, where the system permits it, and short waits for threads."""

import gc
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

NICE = -10
SWITCH_S = 5e-4
"""Longest time that a ready thread waits for one that computes in Python; usually 5 ms."""
SESSION = Path("/proc/self/autogroup")
"""Nice value of the session. Linux divides time among sessions (terminals) first; a program's own nice value counts
only within its session."""


@contextmanager
def before_others() -> Iterator[bool]:
    """Raise the priority of this thread, and of those that it starts, for the block; yield whether that was allowed.

    Linux allows it to root and to users with ``nice`` in limits.conf, macOS to root; Windows has no such call. On
    Linux the priority of this program's session is raised too.
    """
    try:
        usual = os.getpriority(os.PRIO_PROCESS, 0)
        os.setpriority(os.PRIO_PROCESS, 0, min(usual, NICE))
    except (AttributeError, OSError):
        yield False
        return
    session = _session_nice()
    raises = session is not None and session > NICE  # else another program of the session did, and will reset it
    if raises:
        _set_session_nice(NICE)
    try:
        yield True
    finally:
        os.setpriority(os.PRIO_PROCESS, 0, usual)
        if raises and session is not None:
            _set_session_nice(session)


def _session_nice() -> int | None:
    """Return the nice value of this program's session, None where sessions are not distinguished."""
    try:
        return int(SESSION.read_text().split()[-1])
    except (OSError, ValueError, IndexError):
        return None


def _set_session_nice(nice: int) -> None:
    """Set the session's nice value if allowed: it takes the same rights, and is refused just after another change."""
    try:
        SESSION.write_text(str(nice))
    except OSError:
        return


@contextmanager
def prompt() -> Iterator[None]:
    """For the block, shorten the thread switch interval and freeze existing objects for the garbage collector.

    Modules and compiled code are some hundred thousand permanent objects; scanning them for garbage takes tens of
    milliseconds.
    """
    usual = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_S)
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()
        sys.setswitchinterval(usual)
