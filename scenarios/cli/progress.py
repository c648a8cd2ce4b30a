"""A progress bar on a terminal; nothing in a pipe, and nothing with -q."""

import sys
from collections.abc import Callable
from typing import Any

import click

from scenarios.run.interrupt import was_interrupted


class Progress:
    """A context that gives a function of (done, all) which moves the bar; after Ctrl-C it says how far it was."""

    def __init__(self, title: str) -> None:
        self._title = title
        self._bar: Any = None
        self._task: Any = None
        self._moved: tuple[int, int | None] = (0, None)

    def __enter__(self) -> Callable[[int, int | None], None]:
        context = click.get_current_context(silent=True)
        quiet = context is not None and context.find_root().params.get("quiet", False)
        if sys.stderr.isatty() and not quiet:
            from rich.console import Console
            from rich.progress import Progress as Bar

            self._bar = Bar(console=Console(stderr=True), transient=True)
            self._bar.start()
            self._task = self._bar.add_task(self._title, total=None)
        return self._move

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if self._bar is not None:
            self._bar.stop()
        if was_interrupted(error):
            done, total = self._moved
            click.echo(f"{self._title}: stopped at {done}" + ("" if total is None else f" of {total}"), err=True)

    def _move(self, done: int, total: int | None) -> None:
        self._moved = done, total
        if self._bar is not None:
            self._bar.update(self._task, completed=done, total=total)
