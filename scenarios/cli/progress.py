"""Progress of the work: a bar on a terminal, a line every few seconds elsewhere; nothing with -q."""

import os
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import click

from scenarios.run.interrupt import was_interrupted

EVERY_S = 5.0
"""Time between lines where there is no terminal; shorter work prints none."""
LATER = 0.05
"""Time between lines as a share of the elapsed time, if that is longer, so that hours of work do not fill a log."""
SOME = 10
"""Number of functions that are compiled in any run: small ones, which are not cached."""
FIRST_RUN = 345
"""Number of functions that ``mosca run actor`` compiles after an installation; other work compiles more or fewer."""
BESIDE = 1.45 if (os.cpu_count() or 1) < 4 else 1.0
"""Time until all is compiled, over that of these functions: with few cores the parallel processes finish later (185 s
and 128 s on two)."""


def is_first_run() -> bool:
    """Return whether no kernels are cached yet, so that all of them will be compiled."""
    from mosca.detection.frame_set_kernel import detect_frame_set
    from mosca.numba_support.cache import is_compiled

    return not is_compiled(detect_frame_set)


class Progress:
    """A context that gives a function of (done, all) to report progress; after Ctrl-C it prints the progress reached.

    Compiled functions are reported as well, since the first run after an installation takes minutes for them.
    """

    def __init__(self, title: str) -> None:
        self._title = title
        self._begun_s = time.monotonic()
        self._moved: tuple[int, int | None] = (0, None)
        self._first: tuple[float, int] | None = None
        self._bar: Any = None
        self._task: Any = None
        self._compiled: Any = None
        self._told = 0
        self._stage = ""
        self._is_first: bool | None = None
        self._over = threading.Event()
        self._teller: threading.Thread | None = None

    def __enter__(self) -> Callable[[int, int | None], None]:
        context = click.get_current_context(silent=True)
        if context is not None and context.find_root().params.get("quiet", False):
            return self._move
        from mosca.numba_support.watch import CompiledCount

        self._compiled = CompiledCount()
        if sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import Progress as Bar

            self._bar = Bar(console=Console(stderr=True), transient=True)
            self._bar.start()
            self._task = self._bar.add_task(self._title, total=None)
        self._teller = threading.Thread(target=self._tell, name="progress", daemon=True)
        self._teller.start()
        return self._move

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        self._over.set()
        if self._teller is not None:
            self._teller.join()
        if self._compiled is not None:
            self._compiled.close()
        if self._bar is not None:
            self._bar.stop()
        if was_interrupted(error):
            done, total = self._moved
            counted = f" at {done}" + ("" if total is None else f" of {total}")
            if self._stage and self._moved == (0, None):  # this stage has no count
                counted = ""
            click.echo(f"{self._title}: stopped{counted}{self._stage}", err=True)

    def stage(self, name: str) -> None:
        """Set the name of the stage that begins now; the count restarts."""
        self._stage = f", {name}"
        self._moved, self._first = (0, None), None
        if self._bar is not None:
            self._bar.reset(self._task)
            self._bar.tasks[0].total = None  # None as an argument would not change it

    def _move(self, done: int, total: int | None) -> None:
        self._moved = done, total
        if self._first is None:
            self._first = time.monotonic(), done
        if self._bar is not None:
            self._bar.update(self._task, completed=done, total=total)

    def _tell(self) -> None:
        said: tuple[int, int | None] | None = None
        while not self._over.wait(max(EVERY_S, LATER * (time.monotonic() - self._begun_s))):
            if self._bar is None:
                done, total = moved = self._moved
                if moved != said or total is None or done < total:  # a completed count is printed once
                    click.echo(self.line(time.monotonic()), err=True)
                said = moved
            else:
                self._bar.update(self._task, description=self._title + self._stage + self._compiling())

    def line(self, now_s: float) -> str:
        """Return the progress at ``now_s`` [s, monotonic clock] in one line."""
        done, total = self._moved
        waited = f"{self._title}: {now_s - self._begun_s:.0f} s{self._stage}"
        if not done:
            return waited + self._compiling()
        share = "" if not total else f" of {total} ({100 * done / total:.0f} %)"
        return f"{waited}, {done}{share}{self._left(done, total, now_s)}{self._compiling()}"

    def _left(self, done: int, total: int | None, now_s: float) -> str:
        if self._first is None or not total or done <= self._first[1]:
            return ""
        began_s, before = self._first
        return f", about {(now_s - began_s) / (done - before) * (total - done):.0f} s left"

    def _compiling(self) -> str:
        """Return a text on compiled functions if their number has grown since the last call; else ""."""
        count = 0 if self._compiled is None else self._compiled.functions
        before, self._told = self._told, count
        if count < SOME or count == before:
            return ""
        left = ""
        if self._is_first is None:
            self._is_first = is_first_run()
        if self._is_first and count < FIRST_RUN:
            seconds = (time.monotonic() - self._begun_s) * (BESIDE * FIRST_RUN / count - 1.0)
            left = f" of about {FIRST_RUN}, some {seconds:.0f} s left"
        return f", compiling (once after an installation): {count} functions{left}"
