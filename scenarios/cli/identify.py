"""The verb that identifies a driven body: identify."""

from pathlib import Path
from typing import Any

import click

from scenarios.cli.options import FILE, OUT_FILE, Number, echo_lines
from scenarios.cli.progress import Progress


@click.command()
@click.argument("tracks", type=FILE)
@click.argument("commands", type=FILE)
@click.option("--out", type=OUT_FILE, help="the model: .json")
@click.option("--plot", type=OUT_FILE, help="commands, measured and modelled velocities: .svg")
@click.option(
    "--body", type=FILE, help="the driven body's definition (.toml)  [default: learned from the tracks' labels]"
)
@click.option(
    "--axes",
    metavar="CENTRE,BACK-FRONT,RIGHT-LEFT",
    help="targets that define the body's axes  [default: T8,T6-T10,T13-T3; with --body those of its file]",
)
@click.option("--inputs", metavar="A,B", help="columns of COMMANDS that drive the body  [default: left and right]")
@click.option("--validate", type=FILE, nargs=2, metavar="TRACKS COMMANDS", help="another take, to validate the model")
@click.option(
    "--orders", type=click.IntRange(1, 6), default=3, show_default=True, help="highest order that is tried, from 1 on"
)
@click.option(
    "--delay",
    type=Number(0.001, 10),
    default=0.2,
    show_default=True,
    help="largest delay of the motion against the commands that is tried, in either direction [s]",
)
def identify(tracks: Path, commands: Path, validate: tuple[Path, Path] | None, **options: Any) -> None:
    """Identify linear models from the commands of a driven body to its v_x and yaw rate, with intervals.

    TRACKS holds the targets of a body that drives on a floor (.npz, .csv, .parquet, .c3d, .trc); COMMANDS is a .csv
    with a clock (time_s or time_ns of the tracks' session, or frame) and columns left and right, in the unit of the
    motors' driver.

    \b
    Example:  mosca identify runs/drive/tracks.npz runs/drive/commands.csv --out model.json --plot fit.svg
    """
    from scenarios.commands.identify import IdentifyOptions

    with Progress("identify") as shown:
        lines = IdentifyOptions(tracks, commands, validate=validate or None, **options).run(shown)
    echo_lines(lines)
