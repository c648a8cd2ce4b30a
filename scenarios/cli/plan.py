"""The verb that plans camera positions: plan."""

import os
import sys
from pathlib import Path

import click

from scenarios.cli.options import FILE, OUT_FOLDER, print_table, table
from scenarios.cli.progress import Progress


@click.command()
@click.argument("volume", type=FILE)
@click.option("--verify", is_flag=True, help="also simulate the plan, calibrated from images")
@click.option(
    "--evaluations", type=click.IntRange(200, 1_000_000), default=8000, show_default=True,
    help="evaluations of the objective for the most cameras; each smaller number of cameras gets a third",
)  # fmt: skip
@click.option("--curve/--no-curve", default=True, show_default=True, help="also plan with fewer cameras")
@click.option("--workers", type=click.IntRange(1, 64), help="rendering threads of --verify  [default: all cores]")
@click.option(
    "--out", type=OUT_FOLDER, help="new folder for rig, scenario, result and page  [default: runs/plans/VOLUME]"
)
def plan(volume: Path, verify: bool, evaluations: int, curve: bool, workers: int | None, out: Path | None) -> None:
    """Plan the positions, the directions and the lenses of cameras.

    VOLUME is a file with the volume, the room, obstacles, cameras on sale and a budget. The plan minimises the
    standard deviation that 90 % of the markers do not exceed, as predicted from image noise, calibration and
    visibility.

    \b
    Example:  mosca plan docs/examples/plan_room.toml --evaluations 1000 --no-curve --out runs/plans/try
    """
    from scenarios.studies.plan.command import PAGE_FILE, PlanOptions

    target = out or Path("runs") / "plans" / volume.stem
    options = PlanOptions(volume, target, evaluations, curve, verify, workers or os.cpu_count() or 1)
    with (progress := Progress("plan")) as shown:
        document = options.run(shown, progress.stage)
    _print(document)
    sys.stdout.flush()
    click.echo(f"{target / PAGE_FILE}")


def _print(document: dict) -> None:  # type: ignore[type-arg]
    """Print the curve, the predictions and the simulated values."""
    from reports.plan.page import curve_cells, plan_sentence, verified_rows

    share = f"{100 * document['quantile']:.0f} %"
    shown = table("cameras", "price", f"{share} [mm]", "rms [mm]", "calibration [mm]", "seen by < 2 [%]")
    for one in document["curve"]:
        shown.add_row(str(one["cameras"]), f"{one['price']:g}", *curve_cells(one))
    print_table(shown)
    rows = verified_rows(document)
    if rows:
        compared = table("", "predicted", "simulated")
        for row in rows:
            compared.add_row(*row)
        print_table(compared)
    click.echo(plan_sentence(document))
