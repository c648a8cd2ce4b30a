"""Runs an adapter in a process of its own, with a time limit; returns its time, memory, and reason of failure."""

import json
import os
import signal
import subprocess
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Event
from typing import Any, BinaryIO

from mosca.data.files.bounded import open_file

POLL_S = 0.02
LAST_BYTES = 4096
"""Last bytes of a process's output that are searched for the reason of its failure."""


@dataclass(frozen=True)
class Execution:
    """Outcome of one call of an adapter."""

    error: str
    """Reason why there is no result, in one line; "" where there is one."""
    seconds: float
    """Time from start to end of the process, with imports and compilation [s]."""
    peak_mb: float | None
    """Peak memory of the process [MB]; None where the operating system does not report it."""


def execute(
    command: Sequence[str], environment: Mapping[str, str], folder: Path, limit_s: float, stopped: Event | None = None
) -> Execution:
    """Run ``command`` in ``folder``; end it, with its children, after ``limit_s`` [s] or once ``stopped`` is set.

    Its output is in ``folder/log.txt``.
    """
    if stopped is None:
        stopped = Event()
    folder.mkdir(parents=True, exist_ok=True)
    log = folder / "log.txt"
    begun = time.monotonic()
    with open(log, "wb") as out:
        try:
            code, peak = _waited(_started(command, environment, folder, out), begun + limit_s, stopped)
        except OSError as error:
            return Execution(f"cannot be started: {error.strerror}", time.monotonic() - begun, None)
    seconds = time.monotonic() - begun
    if code is None and stopped.is_set():
        return Execution("stopped", seconds, peak)
    if code is None:
        return Execution(f"cut off at the limit of {limit_s:g} s", seconds, peak)
    return Execution("" if code == 0 else _reason(code, log), seconds, peak)


def adapter_command(
    python: Path, adapter: Path, phase: str, dataset: Path, out: Path, settings: Mapping[str, Any], *more: Path
) -> list[str]:
    """Return the command of one phase; the settings are written beside ``out``."""
    out.parent.mkdir(parents=True, exist_ok=True)
    told = out.with_suffix(".settings.json")
    told.write_text(json.dumps(dict(settings)), encoding="utf-8")
    return [str(python), str(adapter), phase, str(dataset), str(out), str(told), *map(str, more)]


def _started(
    command: Sequence[str], environment: Mapping[str, str], folder: Path, out: BinaryIO
) -> "subprocess.Popen[bytes]":
    return subprocess.Popen(
        command, cwd=folder, env=dict(environment), stdin=subprocess.DEVNULL, stdout=out, stderr=subprocess.STDOUT,
        start_new_session=os.name == "posix",
    )  # fmt: skip


def _waited(process: "subprocess.Popen[bytes]", until: float, stopped: Event) -> tuple[int | None, float | None]:
    """Return the exit code, None where the process was ended before, and its peak memory [MB]."""
    peak: float | None = None
    try:
        while True:
            peak = _peak_mb(process.pid) or peak
            code = process.poll()
            if code is not None or time.monotonic() > until or stopped.wait(POLL_S):
                return code, peak
    finally:
        _ended(process)


def _peak_mb(pid: int) -> float | None:
    """Return the peak memory of a process since it began its program [MB], where Linux reports it.

    ``wait4`` would also count the memory of the process that started it.
    """
    try:
        text = Path(f"/proc/{pid}/status").read_text(encoding="ascii")
    except (OSError, UnicodeError):
        return None
    return next((int(line.split()[1]) / 1024 for line in text.splitlines() if line.startswith("VmHWM:")), None)


def _ended(process: "subprocess.Popen[bytes]") -> None:
    """End a process that still runs, and its children."""
    if process.returncode is not None:
        return
    if os.name == "posix":
        os.killpg(process.pid, signal.SIGKILL)
    else:
        process.kill()
    process.wait()


def _reason(code: int, log: Path) -> str:
    """Return the last line that a process printed: for an exception in Python, its name and message."""
    with open_file(log) as file:
        file.seek(max(0, log.stat().st_size - LAST_BYTES))
        lines = [line for line in file.read().decode("utf-8", "replace").splitlines() if line.strip()]
    what = f"ended by signal {-code}" if code < 0 else f"exit code {code}"
    return f"{what}: {lines[-1].strip()[:200]}" if lines else what
