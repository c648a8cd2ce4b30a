"""The verbs that open devices: capture, and rig check with the devices that the drivers find."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from mosca.errors import InputError
from scenarios.cli.options import FILE, POSITIVE, echo_lines, print_table, table
from scenarios.cli.progress import Progress
from scenarios.run.interrupt import EXIT_STOPPED

if TYPE_CHECKING:
    from scenarios.lab.capture import CaptureOutcome

EXIT_LOST = 1


@click.command()
@click.option("--rig", required=True, type=FILE, help="rig file with [camera.hardware] and [hardware]")
@click.option("--out", required=True, type=FILE, help="folder of the recording; must not exist yet")
@click.option("--frames", type=click.IntRange(min=1), help="end after this many pulses  [default: Ctrl-C]")
@click.option("--seconds", type=POSITIVE, help="end after this time [s]")
@click.option("--detections", is_flag=True, help="keep the detections only, no images")
@click.option("--view", is_flag=True, help="show images, detections and points live in the Rerun viewer")
@click.option(
    "--settings", type=FILE, help="TOML file of settings as in mosca reconstruct, for --detections and --view"
)
@click.option("--program", type=FILE, help="TOML file of commands to send and events to record")
def capture(
    rig: Path,
    out: Path,
    frames: int | None,
    seconds: float | None,
    detections: bool,
    view: bool,
    settings: Path | None,
    program: Path | None,
) -> None:
    """Record the cameras of a rig; Ctrl-C ends the take properly.

    Exit codes: 0 each pulse has a whole frame of each camera, 1 something was lost (see the table), 130 Ctrl-C came
    before the end that --frames or --seconds set.

    \b
    Example:  mosca capture --rig rig.toml --out lab/take1 --seconds 30
    """
    from scenarios.lab.capture import CaptureRequest
    from scenarios.lab.capture import capture as work

    if frames is not None and seconds is not None:
        raise InputError("--frames and --seconds exclude each other; give one of them")
    request = CaptureRequest(rig, out, frames, seconds, detections, view, None, settings, program)
    with Progress(out.name) as shown:
        outcome = work(request, shown)
    tell(outcome, out)
    if outcome.stopped and request.ends:
        sys.exit(EXIT_STOPPED)
    sys.exit(0 if outcome.whole else EXIT_LOST)


def tell(outcome: "CaptureOutcome", out: Path) -> None:
    """Print the counts of each camera, and notes."""
    columns = ("frames", "failed", "dropped", "unproven", "untimed", "overrun", "relocked", "reopened")
    shown = table("camera", *columns)
    for name, row in outcome.cameras.items():
        shown.add_row(name, *(str(getattr(row, column)) for column in columns))
    print_table(shown)
    echo_lines(outcome.notes)
    ended = ", ended by hand" if outcome.stopped else ""
    skipped = f" ({outcome.skipped} skipped)" if outcome.skipped else ""
    click.echo(f"{outcome.pulses} pulses{skipped}, {outcome.lost} frame sets lost{ended}; {out}")
