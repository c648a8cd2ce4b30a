"""The verbs that make something to try: demo lab."""

import os
from pathlib import Path

import click

from scenarios.cli.options import OUT_FOLDER, SCENARIO
from scenarios.cli.progress import Progress


@click.group()
def demo() -> None:
    """Make example data for the other commands."""


@demo.command("lab")
@click.argument("folder", type=OUT_FOLDER)
@click.option(
    "--scenario", type=SCENARIO, default="drone", show_default=True, help="scenario with a [calibration], or its file"
)
@click.option("--seconds", type=float, default=2.0, show_default=True, help="length of the take [s]")
@click.option("--set", "overrides", multiple=True, metavar="KEY=VALUE", help="change a key of the scenario")
@click.option("--workers", type=click.IntRange(1, 64), help="rendering threads  [default: all cores]")
def demo_lab(folder: Path, scenario: str, seconds: float, overrides: tuple[str, ...], workers: int | None) -> None:
    """Write the data of a small lab: images for a calibration, a take, and the truth in a folder of its own.

    Calibrate, reconstruct and judge it like your own lab. The commands are printed at the end, and written to
    FOLDER/README.md.

    \b
    Example:  mosca demo lab lab
              mosca demo lab lab --scenario rigs/wand_lengths --seconds 1
    """
    from scenarios.commands.demo_lab import write_demo_lab
    from scenarios.spec.catalog import find
    from scenarios.spec.scenario import load_scenario

    path = find(scenario)
    spec = load_scenario(path, (f"capture.duration_s={seconds}", *overrides))
    with Progress("demo lab") as shown:
        made = write_demo_lab(spec, path.parent, folder, workers or os.cpu_count() or 1, shown)
    click.echo(f"{folder}: {made.images} calibration images, {made.frames} frames of the take; now:\n")
    for command in made.commands:
        click.echo(f"  {command}")
