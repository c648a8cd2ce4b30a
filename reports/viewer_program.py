"""The Rerun viewer as a program of its own: its location, and opening a file in it."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

from mosca.errors import InputError


def viewer_program(wanted_by: str) -> str:
    """Return the path of the viewer; an InputError that begins with ``wanted_by`` where it is not installed."""
    beside = Path(sys.executable).parent / "rerun"
    program = str(beside) if beside.is_file() else shutil.which("rerun")
    if program is None:
        raise InputError(f"{wanted_by}: the Rerun viewer is not installed; run: pip install rerun-sdk")
    return program


def check_window(wanted_by: str, otherwise: str) -> None:
    """Raise an InputError that begins with ``wanted_by`` where there is no display; ``otherwise``: the remedy."""
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise InputError(f"{wanted_by}: there is no display for a window; {otherwise}")


def show(run: Path, web: bool = False) -> None:
    """Show a run's Rerun recording until the viewer is closed; ``web``: in a browser, served on this machine only.

    ``run``: a run folder with ``run.rrd``, or such a file. Raises InputError where there is no such file, and where
    the viewer cannot open its window.
    """
    path = run / "run.rrd" if run.is_dir() else run
    if not path.is_file():
        raise InputError(f"{path}: no such file; a run writes it with --rrd: mosca run SCENARIO --rrd")
    program = viewer_program("mosca view")
    if not web:
        check_window(str(path), "add --web for a browser, or copy the file")
    how = ("--web-viewer", "--bind", "127.0.0.1") if web else ("--port", "auto", "--bind", "127.0.0.1")
    ended = subprocess.run([program, str(path), *how], check=False)
    if ended.returncode:
        raise InputError(f"{path}: the Rerun viewer ended with code {ended.returncode}; what it said stands above")
