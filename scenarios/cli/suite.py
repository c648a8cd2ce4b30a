"""The verb for many scenarios: suite."""

import logging
import os
import sys
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from mosca.errors import InputError
from scenarios.cli.options import (
    EXIT_BROKEN,
    EXIT_ERROR,
    EXIT_PASSED,
    FILE,
    OUT_FOLDER,
    OutFile,
    print_table,
)  # fmt: skip
from scenarios.cli.progress import Progress
from scenarios.run.interrupt import EXIT_STOPPED

LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class SuiteOptions:
    """The options of ``mosca suite``, under their names; its help describes them."""

    paths: tuple[Path, ...]
    tier: str
    overrides: tuple[str, ...]
    jobs: int | None
    scheduler: str | None
    out: Path
    junit: Path | None
    compare: Path | None
    update_baselines: bool
    baselines: Path | None
    replicates: tuple[Path, ...]
    history: Path | None

    def check(self) -> None:
        """Raise InputError for options that exclude each other."""
        if self.jobs is not None and self.scheduler is not None:
            raise InputError("--jobs and --scheduler exclude each other: a cluster has the workers that it has")
        if self.baselines is not None and not self.update_baselines:
            raise InputError("--baselines goes with --update-baselines; to compare with a folder give --compare")
        if self.replicates and not self.update_baselines:
            raise InputError("--spread goes with --update-baselines; to compare with a folder give --compare")
        if self.compare is not None and self.update_baselines:
            raise InputError("--compare and --update-baselines exclude each other; give one of them")
        if self.overrides and self.update_baselines and self.baselines is None:
            raise InputError(
                "--set and --update-baselines: baselines are those of the files as they are; leave one out"
            )


@click.command()
@click.argument("paths", nargs=-1, type=FILE)
@click.option(
    "--tier",
    type=click.Choice(["quick", "full"]),
    default="quick",
    show_default=True,
    help="full: also the slow ones",
)
@click.option(
    "--set",
    "overrides",
    multiple=True,
    metavar="KEY=VALUE",
    help="change a key in each scenario, e.g. seed=2; then nothing is compared with the committed baselines  "
    "[repeatable]",
)
@click.option("--jobs", type=click.IntRange(1, 256), help="scenarios at the same time  [default: all cores]")
@click.option("--scheduler", metavar="ADDRESS", help="run them on this Dask cluster, e.g. tcp://10.0.0.5:8786")
@click.option("--out", type=OUT_FOLDER, default=Path("runs/suite"), show_default=True, help="folder of run folders")
@click.option("--junit", type=OutFile(makes_folders=True), help="write JUnit XML here")
@click.option("--compare", type=FILE, help="folder of baselines to compare with  [default: the committed ones]")
@click.option(
    "--update-baselines", is_flag=True, help="make these results the baselines (state the reason in CHANGELOG)"
)
@click.option(
    "--baselines", type=OUT_FOLDER, help="folder that --update-baselines writes to  [default: the committed ones]"
)
@click.option(
    "--spread",
    "replicates",
    type=FILE,
    multiple=True,
    help="with --update-baselines: folder of a run of the same product with other processor features "
    "(.ci/processors makes them); the differences of metrics are stated in the baselines and tolerated  "
    "[repeatable]",
)
@click.option(
    "--history", type=OutFile(makes_folders=True),
    help="file of JSON lines to which these results are appended; the page plots it  [default: OUT/history.jsonl]",
)  # fmt: skip
def suite(**given: Any) -> None:
    """Run all scenarios of a tier (or those in PATH ...) on all cores, and compare with the baselines.

    PATH is a scenario file, a folder of them, or the name of a built-in scenario or folder, as subjects.

    OUT/suite.html shows the expected and the found outcome, the nearest limit and the history over commits.

    \b
    Example:  mosca suite --tier quick --junit runs/suite.xml
    """
    from scenarios.spec import catalog

    options = SuiteOptions(**given)
    options.check()
    entries = catalog.entries(options.paths, options.tier, options.overrides)
    if not entries:
        where = ", ".join(map(str, options.paths)) or "the project"
        other = len(catalog.entries(options.paths, "full", options.overrides)) if options.tier != "full" else 0
        advice = (
            f"--tier full runs the {other} that are there" if other else "'mosca list' shows those of the project"
        )
        raise InputError(f"no scenario of tier '{options.tier}' in {where}; {advice}")
    from reports.compare import summary_table
    from scenarios.suite import suite as work
    from scenarios.suite.pages import known_history, write_suite

    history, past = known_history(options.out, options.history)
    if options.compare is not None:
        work.check_baselines(options.compare)
    for replicate in options.replicates:
        work.check_replicate(entries, replicate)
    outcomes = _outcomes(entries, options)
    stopped = [o.name for o in outcomes if o.error == work.STOPPED]
    # printed before anything is written, so that a full disk does not lose the figures
    print_table(summary_table([o.record for o in outcomes if o.record is not None]))
    sys.stdout.flush()
    if options.update_baselines and not stopped:
        written = options.baselines or work.BASELINES
        work.update_baselines(outcomes, written, options.replicates)
        click.echo(f"{len(outcomes)} baselines written to {written}; say why in CHANGELOG.md")
    elif options.compare is not None or not options.overrides:
        outcomes = work.compared(outcomes, options.compare or work.BASELINES)
    if options.junit is not None:
        work.write_junit(outcomes, options.junit)
    page = write_suite(outcomes, entries, options.out, history, past)
    bad = [line for o in outcomes if o.name not in stopped for line in work.complaints(o)]
    for line in bad:
        click.echo(line, err=True)
    passed = sum(o.passed for o in outcomes)
    click.echo(f"{passed} of {len(outcomes)} scenarios as they should be; {page}")
    if stopped:
        click.echo(f"stopped by hand: {len(stopped)} scenarios did not end: {', '.join(stopped)}", err=True)
        sys.exit(EXIT_STOPPED)
    if any(o.error for o in outcomes):
        sys.exit(EXIT_ERROR)
    sys.exit(EXIT_PASSED if passed == len(outcomes) else EXIT_BROKEN)


def _outcomes(entries: Sequence[Any], options: SuiteOptions) -> list[Any]:
    """Run the scenarios, with the progress on the terminal."""
    from scenarios.run.one_writer import one_writer
    from scenarios.studies.campaign.cluster import ClusterEngine
    from scenarios.suite import suite as work
    from scenarios.suite.on_cluster import run_suite_on

    with Progress("suite") as shown:
        count = 0

        def report(outcome: Any) -> None:
            nonlocal count
            count += 1
            state = "failed" if not outcome.passed else "passed"
            LOG.info("%s: %s, %.1f s", outcome.name, state, outcome.seconds)
            shown(count, len(entries))

        with one_writer(options.out):
            if options.scheduler is not None:
                with closing(ClusterEngine(options.scheduler, "run folders that are done stay")) as engine:
                    return run_suite_on(engine, entries, options.out, report)
            return work.run_suite(entries, options.out, options.jobs or os.cpu_count() or 1, report)
