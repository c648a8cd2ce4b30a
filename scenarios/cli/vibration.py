"""The verb for modes of vibration: vibration."""

from pathlib import Path
from typing import Any

import click

from scenarios.cli.options import FILE, OUT_FILE, POSITIVE, Number, echo_lines
from scenarios.cli.progress import Progress


@click.command()
@click.argument("tracks", type=FILE)
@click.option("--out", type=OUT_FILE, help="modes with their shapes: .json or .csv")
@click.option("--plot", type=OUT_FILE, help="picture of the spectra, the modes and the noise floor: .svg")
@click.option(
    "--axes",
    type=click.Choice(["normal", "xyz"]),
    default="normal",
    show_default=True,
    help="displacements along the normal of the targets' plane, or in space",
)
@click.option(
    "--direction",
    type=(float, float, float),
    metavar="X Y Z",
    help="displacements along this direction instead of the normal",
)
@click.option(
    "--rigid",
    metavar="all | A,B,C",
    help="remove the rigid motion of all targets, or of these targets on the carrier",
)
@click.option("--fps", type=POSITIVE, help="frame rate [Hz]  [default: that of the tracks' times]")
@click.option("--frames", metavar="FIRST:LAST", help="read only these frames")
@click.option(
    "--lowest", "lowest_hz", type=POSITIVE, default=1.0, show_default=True, help="lowest frequency of a mode [Hz]"
)
@click.option(
    "--exposure",
    "exposure_s",
    type=Number(min=0),
    default=0.0,
    help="exposure of the cameras [s], by which amplitudes are corrected",
)
@click.option(
    "--segment", "segment_s", type=POSITIVE, default=8.0, show_default=True, help="segment of the spectra [s]"
)
@click.option(
    "--order",
    "highest_order",
    type=click.IntRange(10, 200),
    default=60,
    show_default=True,
    help="highest order of the models: two per mode and some for the noise",
)
def vibration(tracks: Path, out: Path | None, plot: Path | None, **options: Any) -> None:
    """Find modes of vibration in tracks: frequencies, damping, shapes, noise floor, and warnings.

    TRACKS is a .npz, .csv, .parquet, .c3d or .trc file of targets on a vibrating object. The forces need not be
    measured.

    \b
    Example:  mosca vibration panel.csv --out modes.json --plot spectra.svg --exposure 0.001
    """
    from scenarios.commands.vibration import VibrationOptions, vibration_take

    with Progress("vibration"):
        lines = vibration_take(tracks, out, plot, VibrationOptions(**options))
    echo_lines(lines)
