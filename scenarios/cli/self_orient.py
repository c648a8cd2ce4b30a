"""The verb for a camera that finds its own pose: self-orient."""

from pathlib import Path
from typing import Any

import click

from scenarios.cli.options import FILE, OUT_FILE, POSITIVE, Number, echo_lines
from scenarios.cli.progress import Progress


@click.command("self-orient")
@click.argument("recording", type=FILE)
@click.argument("camera", type=FILE)
@click.argument("field", type=FILE)
@click.option("--out", type=OUT_FILE, help="the camera's poses with covariance: .csv")
@click.option("--name", help="name of the moving camera in CAMERA  [default: its only camera]")
@click.option("--fps", type=POSITIVE, help="frame rate of recordings without times of their own [Hz]")
@click.option(
    "--row-time", type=Number(0, 0.001), help="rolling shutter: delay from row to row [s]  [default: the recording's]"
)
@click.option(
    "--fewest", type=click.IntRange(4), default=6, show_default=True, help="least number of targets for a pose"
)
@click.option("--tracks", type=FILE, help="the rig's tracks of the body that carries the camera")
@click.option("--body", type=FILE, help="that body's definition (.toml)")
@click.option(
    "--seat", type=FILE, help="rig file in which the camera's pose is body_from_camera  [default: estimated]"
)
@click.option("--rig", type=FILE, help="the rig's calibration, for --registration and --rig-recording")
@click.option(
    "--registration", type=FILE, help="the rig's images of the field  [default: the field's frame is the rig's]"
)
@click.option("--rig-recording", type=FILE, help="the rig's images of the flight, which show the lamp")
@click.option(
    "--light", type=float, nargs=3, metavar="X Y Z", help="position of the blinking lamp in the field's axes [m]"
)
@click.option("--light-diameter", type=POSITIVE, default=0.04, show_default=True, help="diameter of the lamp [m]")
@click.option(
    "--offset", type=float, help="time by which the camera's stamps are ahead of the rig's [s]  [default: 0]"
)
def self_orient(recording: Path, camera: Path, field: Path, **options: Any) -> None:
    """Find a moving camera's poses from a test field in its images, and compare them with a rig's.

    RECORDING holds the camera's images; CAMERA its lens (a rig file of 'mosca calibrate'); FIELD the coded targets
    and where they are (.toml).

    \b
    Example:  mosca self-orient flight/frontal frontal.toml field.toml --out poses.csv
    """
    from scenarios.commands.self_orient import SelfOrientOptions

    with Progress("self-orient") as shown:
        lines = SelfOrientOptions(recording, camera, field, **options).run(shown)
    echo_lines(lines)
