"""The verbs for skeletons of people: skeleton fit, skeleton track."""

from pathlib import Path
from typing import Any

import click

from scenarios.cli.options import FILE, OUT_FILE, POSITIVE, Number, echo_lines
from scenarios.cli.progress import Progress

PERSON = click.option(
    "--person", metavar="NAME", help="read only the labels NAME:LABEL, where a take has several people"
)
FRAMES = click.option("--frames", metavar="FIRST:LAST", help="read only these frames")
RIG = click.option(
    "--rig",
    type=FILE,
    help="rig file of the cameras: the stated errors then treat shake, which shifts all markers alike, separately",
)


@click.group()
def skeleton() -> None:
    """Fit a skeleton model of a person to one take of labelled tracks, and find its joints in other takes."""


@skeleton.command("fit")
@click.argument("tracks", type=FILE)
@click.option("--out", required=True, type=OUT_FILE, help="the subject: .npz, for 'skeleton track'")
@click.option("--model", type=FILE, help="MJCF of bodies and markers  [default: a person, mosca/skeleton/human.xml]")
@click.option("--mjcf", type=OUT_FILE, help="also write the fitted model as MJCF (.xml)")
@click.option("--osim-scale", type=OUT_FILE, help="also write factors that scale OpenSim's gait2354 (.xml)")
@FRAMES
@PERSON
@RIG
def skeleton_fit(
    tracks: Path,
    out: Path,
    model: Path | None,
    mjcf: Path | None,
    osim_scale: Path | None,
    frames: str | None,
    person: str | None,
    rig: Path | None,
) -> None:
    """Fit a skeleton to labelled tracks: segment lengths, joint centres and markers of one person.

    TRACKS is a .npz, .csv, .parquet, .c3d or .trc file of a take that moves every joint. Labels are those of the
    model, with or without the name of a person before them (Anna:LKNE). Lengths are printed with their uncertainty;
    joints that the take does not determine are named.

    \b
    Example:  mosca skeleton fit range_of_motion.c3d --out anna.npz
    """
    from scenarios.commands.skeleton import Selection, fit_take

    with Progress("skeleton fit") as shown:
        lines = fit_take(tracks, out, model, mjcf, Selection(person, frames, rig), shown, osim_scale)
    echo_lines(lines)


@skeleton.command("track")
@click.argument("tracks", type=FILE)
@click.option("--subject", required=True, type=FILE, help="file that 'skeleton fit' wrote")
@click.option("--out", type=OUT_FILE, help="joint centres and rotations with covariances: .csv")
@click.option("--angles", type=OUT_FILE, help="joint angles (ISB) with standard deviations: .csv")
@click.option("--bvh", type=OUT_FILE, help="the skeleton in motion, in centimetres: .bvh")
@click.option("--mot", type=OUT_FILE, help="OpenSim's coordinates: .mot")
@click.option("--c3d", type=OUT_FILE, help="markers, joint centres and angles: .c3d")
@click.option("--plot", type=OUT_FILE, help="picture of the joint angles, over gait cycles where there are any: .svg")
@click.option("--rrd", type=OUT_FILE, help="markers and bones for the Rerun viewer ('mosca view'): .rrd")
@FRAMES
@PERSON
@RIG
@click.option(
    "--fps", type=POSITIVE, help="frame rate to state in .bvh and .c3d  [default: that of the tracks' times]"
)
@click.option(
    "--heading",
    "heading_deg",
    type=Number(-360, 360),
    default=0.0,
    show_default=True,
    help="direction of walking, measured about the vertical from the world's x; pelvis angles refer to it [deg]",
)
@click.option(
    "--opensim-model",
    "opensim",
    type=click.Choice(["gait2354", "gait2392", "Rajagopal"]),
    default="Rajagopal",
    show_default=True,
    help="the model that the .mot file is for",
)
def skeleton_track(
    tracks: Path, subject: Path, frames: str | None, person: str | None, rig: Path | None, **options: Any
) -> None:
    """Find the joints of a fitted subject in labelled tracks, and write the files that are asked for.

    \b
    Example:  mosca skeleton track walk.c3d --subject anna.npz --angles angles.csv --bvh walk.bvh --plot angles.svg
    """
    from scenarios.commands.skeleton import Outputs, Selection, track_take

    rest = {name: options.pop(name) for name in ("fps", "heading_deg", "opensim")}
    with Progress("skeleton track") as shown:
        read = Selection(person, frames, rig)
        lines = track_take(tracks, subject, Outputs(**options), read, **rest, progress=shown)
    echo_lines(lines)
