"""A progress bar on a terminal; nothing in a pipe, and nothing with -q."""

import sys
from collections.abc import Callable
from typing import Any

import click


class Progress:
    """A context that gives a function of (done, all) which moves the bar."""

    def __init__(self, title: str) -> None:
        self._title = title
        self._bar: Any = None
        self._task: Any = None

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

    def __exit__(self, *exc: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def _move(self, done: int, total: int | None) -> None:
        if self._bar is not None:
            self._bar.update(self._task, completed=done, total=total)
