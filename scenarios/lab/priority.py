"""A capture goes before what else the machine does, where the system lets it."""

import os
from collections.abc import Iterator
from contextlib import contextmanager

NICE = -10


@contextmanager
def before_others() -> Iterator[bool]:
    """Raise the priority of this thread, and of those that it starts, for the block; say whether that was allowed.

    Linux allows it to root and to those whom limits.conf gives ``nice``; macOS to root; Windows has no such call.
    """
    try:
        usual = os.getpriority(os.PRIO_PROCESS, 0)
        os.setpriority(os.PRIO_PROCESS, 0, min(usual, NICE))
    except (AttributeError, OSError):
        yield False
        return
    try:
        yield True
    finally:
        os.setpriority(os.PRIO_PROCESS, 0, usual)
