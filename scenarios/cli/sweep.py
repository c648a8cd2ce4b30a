"""The verb for one scenario with several values of one key: sweep."""

import os
import sys
from pathlib import Path

import click

from scenarios.cli.options import (
    EXIT_BROKEN,
    EXIT_ERROR,
    EXIT_PASSED,
    OUT_FOLDER,
    SCENARIO,
    echo_lines,
    print_table,
    table,
)  # fmt: skip
from scenarios.cli.progress import Progress
from scenarios.run.interrupt import EXIT_STOPPED


@click.command()
@click.argument("scenario", type=SCENARIO)
@click.argument("key")
@click.argument("values", nargs=-1, required=True, metavar="VALUE...")
@click.option(
    "--set", "overrides", multiple=True, metavar="KEY=VALUE", help="change another key in each run  [repeatable]"
)
@click.option("--jobs", type=click.IntRange(1, 256), help="runs at the same time  [default: all cores]")
@click.option("--out", type=OUT_FOLDER, default=Path("runs/sweep"), show_default=True, help="folder of run folders")
def sweep(
    scenario: str, key: str, values: tuple[str, ...], overrides: tuple[str, ...], jobs: int | None, out: Path
) -> None:
    """Run one scenario with several values of one key; print a table, and plot each figure over the values.

    OUT/sweep.html shows the figures with their intervals and limits, and links the runs' own pages.

    \b
    Example:  mosca sweep spaces/space_1m cameras.count 3 4 6 --out runs/cameras
              mosca sweep actor capture.exposure_s 0.2e-3 1e-3 2e-3 --set capture.duration_s=2
    """
    from scenarios.suite.sweep import swept, write_sweep

    entries = swept(scenario, key, values, overrides)
    from reports.comparison.series import series_metrics
    from reports.units import figure, shown
    from scenarios.run.one_writer import one_writer
    from scenarios.suite.suite import STOPPED, complaints, run_suite

    done = 0
    with Progress("sweep") as progress, one_writer(out):

        def told(_: object) -> None:
            nonlocal done
            done += 1
            progress(done, len(entries))

        outcomes = run_suite(entries, out, jobs or os.cpu_count() or 1, told)
    records = [one.record for one in outcomes if one.record is not None]
    names = series_metrics(records)
    rows = table(key, *names, "verdict")
    for value, outcome in zip(values, outcomes, strict=True):
        cells = []
        for name in names:
            metric = outcome.record.metric(name) if outcome.record is not None else None
            numbers, unit = shown((metric.value, *(metric.ci95 or ())), metric.unit, name) if metric else ((), "")
            interval = f" ({figure(numbers[1])} .. {figure(numbers[2])})" if len(numbers) == 3 else ""
            cells.append(f"{figure(numbers[0])} {unit}".rstrip() + interval if numbers else "")
        rows.add_row(value, *cells, "met" if outcome.passed else "not run" if outcome.record is None else "BROKEN")
    print_table(rows)
    sys.stdout.flush()
    echo_lines([str(write_sweep(key, values, outcomes, out))])
    stopped = any(one.error == STOPPED for one in outcomes)
    for line in (line for one in outcomes for line in complaints(one)):
        click.echo(line, err=True)
    if stopped or any(one.error for one in outcomes):
        sys.exit(EXIT_STOPPED if stopped else EXIT_ERROR)
    sys.exit(EXIT_PASSED if all(one.passed for one in outcomes) else EXIT_BROKEN)
