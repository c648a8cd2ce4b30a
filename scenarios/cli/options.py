"""Parts that several verbs share: options and their values, -v and -q, lines and tables on the terminal."""

import logging
import math
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import click
from click.shell_completion import CompletionItem

from mosca.data.files.whole_file import check_folder, check_writable


class Number(click.FloatRange):
    """A finite number in a range: ``nan`` and ``inf`` are numbers in Python, but no durations or rates."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the number, or fail as click does."""
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{number:g} is no finite number.", param, ctx)
        return number


class ScenarioName(click.Path):
    """A scenario's file, or the name of a built-in one; shells complete both."""

    name = "scenario"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the text unchanged: the verb resolves it."""
        return value

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        """Return files, and names that begin with ``incomplete`` as a whole or in their last part."""
        from scenarios.spec.catalog import built_in, scenario_name

        found = [
            name
            for name in map(scenario_name, built_in())
            if name.startswith(incomplete) or name.split("/")[-1].startswith(incomplete)
        ]
        return [*map(CompletionItem, found), *super().shell_complete(ctx, param, incomplete)]


class ImageCount(click.ParamType):  # type: ignore[type-arg,unused-ignore]
    """A number of frame sets whose images are shown, or ``all`` of them."""

    name = "all|N"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the number, ``ALL_IMAGES`` for all, or fail as click does."""
        if value == "all":
            return ALL_IMAGES
        try:
            count = int(value)
        except (TypeError, ValueError):
            count = -1
        if count < 0:
            self.fail(f"'{value}' given; allowed are 'all' and whole numbers from 0 on.", param, ctx)
        return count


class OutFile(click.Path):
    """A file to write: whether it can be written is tested while the command line is read, before any work."""

    def __init__(self, makes_folders: bool = False) -> None:
        """Set ``makes_folders``: whether the verb makes the folders above the file."""
        super().__init__(path_type=Path)
        self._makes_folders = makes_folders

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the path; InputError where no file can be written there."""
        path: Path = super().convert(value, param, ctx)  # type: ignore[assignment]
        if self._makes_folders and not path.parent.is_dir():
            check_folder(path.parent)
        else:
            check_writable(path)
        return path


class OutFolder(click.Path):
    """A folder to write into, tested in the same way."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the path; InputError where no files can be written there."""
        path: Path = super().convert(value, param, ctx)  # type: ignore[assignment]
        check_folder(path)
        return path


SCENARIO = ScenarioName()
FILE = click.Path(path_type=Path)
OUT_FILE, OUT_FOLDER = OutFile(), OutFolder(path_type=Path)
LAG = click.option("--lag", type=int, metavar="FRAMES", help="smooth each position with this many later frames")
SET = click.option(
    "--set", "overrides", multiple=True, metavar="KEY=VALUE", help="change a setting, e.g. detection.false_alarms=0.1"
)
POSITIVE = Number(min=0, min_open=True)
NOT_NEGATIVE = Number(min=0)
ALL_IMAGES = 1 << 31
IMAGES = ImageCount()
EXIT_PASSED, EXIT_BROKEN, EXIT_ERROR = 0, 1, 2
"""Exit codes of every verb: limits met; broken or not judged; an error in the input."""
LOGGERS = ("mosca", "twin", "hardware", "scenarios")
LEVELS = (logging.WARNING, logging.INFO, logging.DEBUG)
"""Log levels without -v, with -v and with -vv."""


def log_to_stderr(verbose: int, quiet: bool) -> None:
    """Send the packages' log to stderr: warnings, with -v stages, with -vv details, with -q errors only."""
    if quiet and verbose:
        raise click.UsageError("-q and -v exclude each other; give one of them")
    handler = logging.StreamHandler()
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    for name in LOGGERS:
        logger = logging.getLogger(name)
        logger.setLevel(logging.ERROR if quiet else LEVELS[min(verbose, len(LEVELS) - 1)])
        logger.handlers = [handler]


def echo_lines(lines: Iterable[str]) -> None:
    """Print lines."""
    for line in lines:
        click.echo(line)


def table(*headings: str, numbers: bool = True) -> Any:
    """Return a plain table; with ``numbers`` all columns but the first are flush right."""
    from rich.table import Table

    shown = Table(box=None, pad_edge=False)
    for k, heading in enumerate(headings):
        shown.add_column(heading, justify="right" if numbers and k else "left")
    return shown


def print_table(shown: Any) -> None:
    """Print a renderable of ``rich``; a pipe gets whole lines instead of an assumed terminal width."""
    from rich.console import Console

    Console(width=None if sys.stdout.isatty() else 140).print(shown)
