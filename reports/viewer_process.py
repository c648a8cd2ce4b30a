"""The Rerun viewer as a process of its own, which reads a log from a pipe while it grows."""

import os
import tempfile
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mosca.data.rig import Rig
from mosca.errors import InputError
from reports.viewer import RerunLog
from reports.viewer_program import viewer_program

SHOWN_HZ = 10.0
"""Rate at which live data are shown."""
LOOKED_AT_S = 0.1
"""Interval of the checks whether the viewer still runs."""
VIEWER_STARTS_S = 0.3
"""Time after which a viewer without a display has ended."""


class ViewerClosedError(Exception):
    """The viewer has ended: a person closed it, or it had no window."""


class ViewerLog(RerunLog):
    """A log that the process ``viewer`` reads from the pipe ``path``; ``reading``: the pipe's reading end.

    Once the viewer has ended, the pipe is read here: otherwise rerun would wait for ever to write its data.
    """

    def __init__(self, path: Path, rig: Rig, viewer: int, reading: int) -> None:
        super().__init__(path, rig)
        self.viewer = viewer
        self._ended, self._over = threading.Event(), threading.Event()
        self._watching = threading.Thread(target=self._watch, args=(os.dup(reading),), name="viewer", daemon=True)
        self._watching.start()

    @property
    def ended(self) -> bool:
        """Whether the viewer has ended before the log."""
        return self._ended.is_set()

    def log_step(self, *step: Any, **more: Any) -> None:
        """Log one pulse as ``RerunLog`` does; ViewerClosedError where the viewer has ended."""
        if self.ended:
            raise ViewerClosedError("the viewer was closed, or could not open its window")
        super().log_step(*step, **more)

    def close(self) -> None:
        """Write remaining data; the viewer stays open. May be called twice."""
        super().close()
        self._over.set()
        self._watching.join()

    def _watch(self, reading: int) -> None:
        while not _has_ended(self.viewer):
            if self._over.wait(LOOKED_AT_S):
                break
        else:
            self._ended.set()
            while os.read(reading, 1 << 16):
                pass
        os.close(reading)


def log_in_viewer(rig: Rig, arguments: Sequence[str] = ("--port", "auto", "--bind", "127.0.0.1")) -> ViewerLog:
    """Start the Rerun viewer and return a log that it reads from a pipe; the viewer stays open afterwards.

    ``arguments``: for the viewer; in tests it saves its data. InputError where there is no viewer, or no pipes.
    """
    program = viewer_program("--view")
    if not hasattr(os, "mkfifo"):
        raise InputError("--view: the Rerun viewer cannot be started (no pipes)")
    with tempfile.TemporaryDirectory(prefix="mosca-view-") as folder:
        pipe = Path(folder) / "view.rrd"
        os.mkfifo(pipe)
        # both ends are held open until the log is open: the viewer must not see the end of the pipe, nor the log wait
        both = os.open(pipe, os.O_RDWR)
        reading = os.open(pipe, os.O_RDONLY)
        try:
            viewer = _started((program, "-", *arguments), reading)
            until = time.monotonic() + VIEWER_STARTS_S
            while time.monotonic() < until:
                if _has_ended(viewer):
                    raise InputError("--view: the Rerun viewer ended at once; is there a display?")
                time.sleep(0.02)
            return ViewerLog(pipe, rig, viewer, reading)
        finally:
            os.close(reading)
            os.close(both)


def _has_ended(process: int) -> bool:
    """Return whether a child process has ended; must not be called again after that."""
    return os.waitpid(process, os.WNOHANG)[0] != 0


def _started(command: Sequence[str], reading: int) -> int:
    """Start a program that reads from ``reading`` and outlives this one; return its process id."""
    quiet = [(os.POSIX_SPAWN_OPEN, out, os.devnull, os.O_WRONLY, 0) for out in (1, 2)]
    actions = [(os.POSIX_SPAWN_DUP2, reading, 0), *quiet]
    return os.posix_spawn(command[0], list(command), os.environ, file_actions=actions, setpgroup=0)
