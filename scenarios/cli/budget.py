"""The verb for error budgets: budget."""

from pathlib import Path

import click

from scenarios.cli.options import OUT_FOLDER, SCENARIO, Number, echo_lines, print_table, table
from scenarios.cli.progress import Progress


@click.command()
@click.argument("scenario", type=SCENARIO)
@click.option("--metric", default="position_rms", show_default=True, help="metric to split up, a root mean square")
@click.option(
    "--by", type=click.Choice(["source", "camera"]), default="source", show_default=True,
    help="'camera': the sources of error of each single camera are taken together",
)  # fmt: skip
@click.option("--sources", help="NAME,NAME,...: switch only these off  [default: all that the scenario has]")
@click.option(
    "--seeds",
    type=click.IntRange(1, 1000),
    default=3,
    show_default=True,
    help="number of takes, each with its own noise",
)
@click.option("--seconds", type=Number(0.2, 600), default=2.0, show_default=True, help="length of each take [s]")
@click.option(
    "--orders", type=click.IntRange(2, 10000), default=32, show_default=True,
    help="random orders that are drawn for more than 8 sources or cameras; for up to 8 all subsets are run",
)  # fmt: skip
@click.option("--workers", type=click.IntRange(1, 64), default=2, show_default=True, help="processes")
@click.option("--set", "overrides", multiple=True, metavar="KEY=VALUE", help="change a key of the scenario")
@click.option(
    "--out", type=OUT_FOLDER, help="folder for budget.json and budget.svg  [default: runs/budgets/SCENARIO]"
)
def budget(
    scenario: str,
    metric: str,
    by: str,
    sources: str | None,
    seeds: int,
    seconds: float,
    orders: int,
    workers: int,
    overrides: tuple[str, ...],
    out: Path | None,
) -> None:
    """Split an error among its sources: Shapley values of the mean square, with 95 % intervals.

    Sources are switched off in all subsets, each time with the same random numbers. The contributions and the
    remainder add up to the whole.

    \b
    Example:  mosca budget actor --sources occlusion,noise,calibration --seeds 2 --seconds 1
    """
    from reports.budget import HEADINGS, budget_rows, budget_words
    from scenarios.studies.budget.budget import BudgetSettings
    from scenarios.studies.budget.command import PICTURE_FILE, BudgetOptions

    chosen = tuple(dict.fromkeys(filter(None, sources.split(",")))) if sources is not None else ()
    settings = BudgetSettings(metric, by, chosen, seeds, seconds, orders, workers)
    with Progress("budget") as shown:
        made, folder = BudgetOptions(scenario, overrides, out, settings).run(shown)
    rows = table(*HEADINGS)
    for row in budget_rows(made):
        rows.add_row(*row)
    print_table(rows)
    echo_lines(budget_words(made))
    click.echo(f"{folder / PICTURE_FILE}")
