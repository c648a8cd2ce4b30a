"""The verb for the public benchmark: benchmark."""

import logging
import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from mosca.errors import InputError
from scenarios.cli.options import EXIT_BROKEN, EXIT_PASSED, OUT_FOLDER, print_table, table
from scenarios.cli.progress import Progress

LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class BenchmarkOptions:
    """The options of ``mosca benchmark``, under their names; its help describes them."""

    out: Path
    quick: bool
    sets: tuple[str, ...]
    entrants: tuple[str, ...]
    passphrase: str | None
    fresh: bool
    twice: bool
    limit_s: float | None
    export: Path | None
    tune: bool
    cache: Path | None
    workers: int | None

    def check(self) -> None:
        """Raise InputError for options that exclude each other."""
        if self.fresh and self.passphrase is not None:
            raise InputError("--fresh and --passphrase exclude each other; give one of them")
        if self.tune and (self.fresh or self.passphrase is not None):
            raise InputError("--tune and --fresh or --passphrase: settings are tuned on the tuning seeds alone")
        if self.tune and (self.export is not None or self.twice):
            raise InputError("--tune goes with --set, --entrant, --quick, --cache, --limit and --out alone")
        if self.export is not None and (self.twice or self.entrants):
            raise InputError("--export writes data sets and runs no entrant; leave --twice and --entrant out")


@click.command()
@click.option(
    "--out", type=OUT_FOLDER, default=Path("runs/benchmark"), show_default=True, help="folder of the result"
)
@click.option("--quick", is_flag=True, help="run two data sets only")
@click.option("--set", "sets", multiple=True, metavar="NAME", help="run only this data set  [repeatable]")
@click.option("--entrant", "entrants", multiple=True, metavar="NAME", help="run only this entrant  [repeatable]")
@click.option(
    "--passphrase",
    metavar="TEXT",
    help="text from which the seeds are drawn  [default: the published round's, else a new one]",
)
@click.option("--fresh", is_flag=True, help="draw a new passphrase that nobody has known")
@click.option(
    "--twice", is_flag=True, help="run all entrants twice; figures that differ are reported, with exit code 1"
)
@click.option(
    "--limit", "limit_s", type=click.FloatRange(1, 86400), metavar="SECONDS",
    help="longest time for a phase of an entrant on a set  [default: 300]",
)  # fmt: skip
@click.option("--export", type=OUT_FOLDER, help="only write the data sets and their truth into this folder")
@click.option("--tune", is_flag=True, help="tune settings on the tuning seeds (changes settings.toml)")
@click.option(
    "--cache", type=OUT_FOLDER, help="folder of the entrants' environments  [default: ~/.cache/mosca-benchmark]"
)
@click.option(
    "--workers",
    type=click.IntRange(1, 64),
    help="rendering threads, and entrants at the same time  [default: all cores]",
)
def benchmark(**given: Any) -> None:
    """Compare mosca with other programs on the same images, and write a leaderboard.

    Each entrant runs in an environment of its own, built at the first run. OUT/leaderboard.html is the page.
    Exit code 1: an entrant gave no result on a set, or other figures the second time. The table states which entrant
    and why.

    \b
    Example:  mosca benchmark --quick --out runs/benchmark
    """
    options = BenchmarkOptions(**given)
    options.check()
    from scenarios.studies.benchmark import seeds
    from scenarios.studies.benchmark.benchmark import LIMIT_S, BenchmarkJob, default_cache
    from scenarios.studies.benchmark.entrant import read_entrants
    from scenarios.studies.benchmark.make import set_files

    sets = set_files(options.sets, options.quick)
    entrants = read_entrants(options.entrants)
    job = BenchmarkJob(
        data=options.out / "data",
        work=options.out / "work",
        cache=options.cache or default_cache(),
        limit_s=options.limit_s or LIMIT_S,
        workers=options.workers or os.cpu_count() or 1,
        twice=options.twice,
    )
    if options.tune:
        _tune(sets, entrants, job)
        return
    if options.passphrase is not None:
        passphrase = seeds.given(options.passphrase)
    else:
        # until the first round is published there is none to repeat
        passphrase = (None if options.fresh else seeds.published()) or seeds.fresh()
    if not (options.sets or options.quick):
        sets = set_files(passphrase.sets)
    if options.export is not None:
        _export(sets, passphrase, options.export, job.workers)
        return
    _run(sets, entrants, passphrase, job, options.out)


def _tune(sets: Any, entrants: Any, job: Any) -> None:
    from dataclasses import replace

    from scenarios.studies.benchmark.tuning import tune

    tune(sets, entrants, replace(job, data=job.data / "tuning", work=job.work / "tuning"), click.echo)


def _export(sets: Any, passphrase: Any, folder: Path, workers: int) -> None:
    """Write the data sets; those that cannot be made here are printed."""
    from mosca.data.files.whole_file import check_folder
    from scenarios.studies.benchmark.make import make_set, missing, write_readme

    check_folder(folder)
    if folder.exists() and any(folder.iterdir()):
        raise InputError(f"--export {folder}: holds files already; name a new or an empty folder")
    folder.mkdir(parents=True, exist_ok=True)
    with Progress("benchmark") as shown:
        for k, one in enumerate(sets):
            if why := missing(one):
                click.echo(f"{one.name}: not made: {why}", err=True)
            else:
                make_set(one, passphrase, folder, workers)
            shown(k + 1, len(sets))
    write_readme(folder, passphrase)
    click.echo(f"{folder}: seeds of passphrase '{passphrase.text}' ({passphrase.told})")


def _run(sets: Any, entrants: Any, passphrase: Any, job: Any, out: Path) -> None:
    from mosca.data.files.whole_file import check_folder
    from reports.benchmark.page import write_leaderboard
    from scenarios.run.one_writer import one_writer
    from scenarios.studies.benchmark.benchmark import run_benchmark
    from scenarios.studies.benchmark.result import document_of, overall, write_result

    check_folder(out)
    with one_writer(out):
        job.data.mkdir(parents=True, exist_ok=True)
        with Progress("benchmark") as shown:
            found = run_benchmark(sets, entrants, passphrase, job, shown)
        document = document_of(found, entrants, passphrase, job)
        for title, board in (("from images", "images"), ("correspondence given", "matched")):
            shown_table = table(title, "OSPA mm", "rms mm", "complete", "ghosts/frame", "best", "no result")
            rows = overall(document, board)
            for row in rows:
                shown_table.add_row(*row.words())
            if rows:
                print_table(shown_table)
        sys.stdout.flush()
        write_result(document, out / "result.json")
        write_leaderboard(out / "leaderboard.html", document)
    for name, why in found.left_out.items():
        click.echo(f"data set {name} left out: {why}", err=True)
    for line in found.failures:
        click.echo(line, err=True)
    click.echo(
        f"passphrase '{passphrase.text}' ({passphrase.told}); the same again: --passphrase '{passphrase.text}'"
    )
    click.echo(f"{out / 'leaderboard.html'}")
    sys.exit(EXIT_BROKEN if found.failures else EXIT_PASSED)
