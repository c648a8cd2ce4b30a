"""The Rerun viewer as a process of its own, which reads a log from a pipe while it grows."""

import os
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from mosca.data.rig import Rig
from mosca.errors import InputError
from reports.viewer import RerunLog
from reports.viewer_program import viewer_program

SHOWN_HZ = 10.0
"""So often something live is shown."""
VIEWER_STARTS_S = 0.3
"""A viewer without a display has ended by then."""


def log_in_viewer(rig: Rig, arguments: Sequence[str] = ("--port", "auto", "--bind", "127.0.0.1")) -> RerunLog:
    """Start the Rerun viewer and return a log that it reads from a pipe; the viewer stays open afterwards.

    ``arguments``: for the viewer; tests have it save what it gets. InputError where there is no viewer, or no pipes.
    """
    program = viewer_program("--view")
    if not hasattr(os, "mkfifo"):
        raise InputError("--view: the Rerun viewer cannot be started (no pipes)")
    with tempfile.TemporaryDirectory(prefix="mosca-view-") as folder:
        pipe = Path(folder) / "view.rrd"
        os.mkfifo(pipe)
        # held open at both ends until the log is: the viewer must not see its end, nor the log wait for a reader
        both = os.open(pipe, os.O_RDWR)
        reading = os.open(pipe, os.O_RDONLY)
        try:
            viewer = _started((program, "-", *arguments), reading)
            until = time.monotonic() + VIEWER_STARTS_S
            while time.monotonic() < until:
                if os.waitpid(viewer, os.WNOHANG)[0]:
                    raise InputError("--view: the Rerun viewer ended at once; is there a display?")
                time.sleep(0.02)
            return RerunLog(pipe, rig)
        finally:
            os.close(reading)
            os.close(both)


def _started(command: Sequence[str], reading: int) -> int:
    """Start a program that reads from ``reading``, outlives this one and is not stopped with it; return its id."""
    quiet = [(os.POSIX_SPAWN_OPEN, out, os.devnull, os.O_WRONLY, 0) for out in (1, 2)]
    actions = [(os.POSIX_SPAWN_DUP2, reading, 0), *quiet]
    return os.posix_spawn(command[0], list(command), os.environ, file_actions=actions, setpgroup=0)
