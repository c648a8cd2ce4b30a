"""What is live goes before what else the machine does, where the system lets it, and does not wait for itself."""

import gc
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

NICE = -10
SWITCH_S = 5e-4
"""A thread that has something to do waits so long, at most, for one that computes in Python; usually 5 ms."""
SESSION = Path("/proc/self/autogroup")
"""Linux divides its time among sessions (terminals) first: how nice a program is counts within its own alone."""


@contextmanager
def before_others() -> Iterator[bool]:
    """Raise the priority of this thread, and of those that it starts, for the block; yield whether that was allowed.

    Linux allows it to root and to those whom limits.conf gives ``nice``; macOS to root; Windows has no such call. On
    Linux the session of this program goes before other sessions too.
    """
    try:
        usual = os.getpriority(os.PRIO_PROCESS, 0)
        os.setpriority(os.PRIO_PROCESS, 0, min(usual, NICE))
    except (AttributeError, OSError):
        yield False
        return
    session = _session_nice()
    raises = session is not None and session > NICE  # else another program of the session did, and takes it back
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
    """Set it where that is allowed: it takes the same rights, and is refused where it was set just before."""
    try:
        SESSION.write_text(str(nice))
    except OSError:
        return


@contextmanager
def prompt() -> Iterator[None]:
    """For the block, shorten the thread switch interval and freeze existing objects for the garbage collector.

    Modules and compiled code are some hundred thousand objects that stay; scanning them for garbage takes
    tens of milliseconds.
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
