"""The verb that streams earlier measurements: replay."""

from pathlib import Path
from typing import Any

import click

from mosca.errors import InputError
from scenarios.cli.options import FILE, POSITIVE, Number, echo_lines
from scenarios.cli.stream_options import fault_options, stream_options, stream_settings


@click.command()
@click.argument("tracks", type=FILE)
@stream_options("natnet")
@click.option("--bodies", type=FILE, help="rigid bodies: definitions of 'bodies learn' (.toml), or poses (.csv)")
@click.option("--joints", type=FILE, help="a person's joints, streamed as a skeleton: .csv of 'skeleton track --out'")
@click.option("--angles", type=FILE, help="the person's joint angles: .csv of 'skeleton track --angles'")
@click.option("--rate", type=Number(0, 1000, min_open=True), help="speed over that of the measurement  [default: 1]")
@click.option("--fast", is_flag=True, help="play as fast as possible")
@click.option(
    "--loop", is_flag=True, help="start again with the first frame after the last; frame numbers and times continue"
)
@click.option("--seconds", type=POSITIVE, help="end after this time [s]")
@click.option("--wait", type=click.IntRange(0, 64), default=0, help="begin when this many clients have connected")
@fault_options
@click.option("--seed", type=click.IntRange(min=0), help="seed of random faults  [default: the file's, or 0]")
def replay(tracks: Path, **given: Any) -> None:
    """Stream tracks at their own pace to the clients of a motion-capture lab, with faults on demand.

    TRACKS is .npz, .csv, .parquet, .c3d or .trc, or a folder with tracks.npz (or .csv) and bodies.csv, as 'mosca run'
    writes, and joints.csv and angles.csv if they exist.
    Ctrl-C ends the stream. Each client's frames and the faults that were made are then reported (docs/streams.md).

    \b
    Example:  mosca replay runs/subjects/drone --loop --multicast 239.255.42.99
              mosca replay take.csv --bodies bodies.toml --fault latency=0.03@5+2 --fault body-lost@10+1
              mosca replay walk.npz --joints joints.csv --angles angles.csv --stream lsl --stream foxglove
    """
    from scenarios.lab.replay import ReplayRequest, replay_tracks

    settings, up = stream_settings(given)
    if given["rate"] is not None and given["fast"]:
        raise InputError(f"--rate {given['rate']:g}: excludes --fast; leave one of them out")
    rate, fast = given.pop("rate"), given.pop("fast")
    request = ReplayRequest(tracks, settings, up=up, speed=None if fast else rate or 1.0, **given)
    echo_lines(replay_tracks(request, click.echo))
