"""The verb for a run in real time: live."""

from typing import Any

import click

from scenarios.cli.options import FILE, IMAGES, LAG, NOT_NEGATIVE, OUT_FILE, POSITIVE, SET, echo_lines
from scenarios.cli.stream_options import stream_options, stream_settings


@click.command()
@click.argument("source")
@click.option("--rig", type=FILE, help="calibrated rig file; a scenario and hardware:RIG.toml have their own")
@click.option(
    "--out", type=OUT_FILE, help="tracks: .npz, .csv, .parquet, .c3d or .trc; until the end they are in OUT.part.csv"
)
@click.option("--record", type=OUT_FILE, help="write counts and the stages' times here: .json")
@click.option(
    "--skeleton",
    type=FILE,
    help="follow the person of this file of 'skeleton fit': labels and joints, which are also streamed",
)
@click.option("--joints", type=OUT_FILE, help="the person's joint centres and rotations with covariances: .csv")
@click.option("--rrd", type=OUT_FILE, help="points, trails and bones for the Rerun viewer: .rrd")
@click.option("--view", is_flag=True, help="show points, trails and bones live in the Rerun viewer")
@click.option(
    "--images", type=IMAGES, default=0, show_default=True,
    help="with --rrd or --view: images of this many frame sets a second, or of all shown; images add latency",
)  # fmt: skip
@click.option("--virtual", type=FILE, help="second MuJoCo scene (MJCF or URDF); tracked bodies move its mocap bodies")
@click.option("--bodies", type=FILE, help="rigid bodies, from 'bodies learn'; a scenario has its own")
@click.option("--bind", multiple=True, metavar="BODY=OBJECT", help="tracked body, and the mocap body that it moves")
@click.option("--display-hz", type=POSITIVE, help="rate of the display  [default: 60]")
@click.option(
    "--display-lead", type=NOT_NEGATIVE, help="the display's own delay, which is predicted over [s]  [default: 0]"
)
@click.option(
    "--display-delay", type=NOT_NEGATIVE, help="show the poses of this time ago, interpolated [s]  [default: 0]"
)
@click.option("--horizon", type=NOT_NEGATIVE, help="longest time over which a pose is predicted [s]  [default: 0.1]")
@stream_options(None)
@click.option("--seconds", type=POSITIVE, help="end after this time [s]  [default: the source's end]")
@click.option("--fps", type=POSITIVE, help="frame rate of a recording that does not state its own [Hz]")
@click.option("--rate", type=POSITIVE, help="playback rate of a recording or scenario [Hz]  [default: its own]")
@click.option(
    "--queued", type=click.IntRange(1, 1000), default=2, show_default=True, help="most frame sets that wait"
)
@LAG
@click.option("--settings", type=FILE, help="TOML file with [detection], [match], [track] and [volume]")
@SET
@click.option("--workers", type=click.IntRange(1, 64), help="rendering threads of a scenario  [default: all cores]")
def live(**given: Any) -> None:
    """Track a source in real time; an overloaded machine drops whole frame sets and reports them.

    SOURCE is hardware:RIG.toml, recording:DIR (played at its rate) or a scenario (rendered beforehand). The command
    prints one line a second; Ctrl-C ends it with complete tracks. With a scenario --set changes the scenario's keys.

    \b
    Example:  mosca live any_source --seconds 2 --out live.csv --record live.json
              mosca live drone --virtual desk.xml --bind drone=tray --rrd desk.rrd
              mosca live drone --stream natnet --stream lsl
    """
    from scenarios.commands.live import run_live_command
    from scenarios.commands.live_sources import LiveOptions

    stream, up = stream_settings(given)
    echo_lines(run_live_command(LiveOptions(**given, stream=stream, up=up), click.echo))
