"""The verbs for files of tracks: tracks info, tracks convert, tracks page, tracks ros2."""

from pathlib import Path

import click

from scenarios.cli.options import FILE, OUT_FILE, OUT_FOLDER, POSITIVE, echo_lines, print_table, table


@click.group()
def tracks() -> None:
    """Inspect files of tracks, show them on a page, and convert them: .npz, .csv, .parquet, .c3d, .trc."""


@tracks.command("info")
@click.argument("path", type=FILE)
def tracks_info(path: Path) -> None:
    """Show what a file of tracks holds: length, rate, extent, names, gaps.

    \b
    Example:  mosca tracks info take1.c3d
    """
    from scenarios.commands.track_files import tracks_info as work

    lines, rows = work(path)
    echo_lines(lines)
    if rows:
        shown = table("track", "frames", "% of all", "gaps", "longest [s]")
        for row in rows:
            shown.add_row(*row)
        print_table(shown)


@tracks.command("convert")
@click.argument("path", type=FILE)
@click.argument("out", type=OUT_FILE)
@click.option("--fps", type=POSITIVE, help="frame rate stated in C3D and TRC [Hz]  [default: that of the samples]")
@click.option(
    "--only", "names", multiple=True, metavar="NAME", help="keep only the marker of this name  [repeatable]"
)
def tracks_convert(path: Path, out: Path, fps: float | None, names: tuple[str, ...]) -> None:
    """Write tracks in another format, that of OUT's suffix: .npz, .csv, .parquet, .c3d, .trc (OpenSim).

    \b
    Example:  mosca tracks convert take1.npz take1.trc
    """
    from scenarios.commands.track_files import convert_tracks

    echo_lines(convert_tracks(path, out, fps, names))


@tracks.command("page")
@click.argument("take", type=FILE)
@click.argument("out", type=OUT_FILE)
@click.option("--rig", type=FILE, help="cameras to show  [default: rig.toml of TAKE, or none]")
def tracks_page(take: Path, out: Path, rig: Path | None) -> None:
    """Write a page that shows tracks: a 3D view to turn and play, gaps, residuals, extent.

    TAKE is a file of tracks, of this program or another one, or a run folder. OUT opens in a browser, offline.

    \b
    Example:  mosca tracks page take1.csv take1.html --rig rig.toml
    """
    from scenarios.commands.track_files import page_of_tracks

    echo_lines(page_of_tracks(take, out, rig))


@tracks.command("ros2")
@click.argument("take", type=FILE)
@click.argument("out", type=OUT_FOLDER)
@click.option(
    "--rig", type=FILE, help="properties and poses of the cameras  [default: rig.toml of TAKE or of the recording]"
)
@click.option("--no-cameras", is_flag=True, help="leave the cameras out: ROS has no model for every lens")
@click.option("--recording", type=FILE, help="also write the images of this recording")
@click.option(
    "--max-residual-px", type=POSITIVE, default=0.1, show_default=True, help="largest misfit of ROS's lens model [px]"
)
def tracks_ros2(
    take: Path, out: Path, rig: Path | None, no_cameras: bool, recording: Path | None, max_residual_px: float
) -> None:
    """Write a take as a ROS 2 bag, the folder OUT: point clouds, poses, transforms, camera infos, images.

    TAKE is a file of tracks, or a run folder. Of a run folder the poses of bodies and the rig are also written.

    \b
    Example:  mosca tracks ros2 runs/subjects/drone drone_bag
    """
    from scenarios.commands.track_files import tracks_as_bag

    echo_lines(tracks_as_bag(take, out, rig, recording, None if no_cameras else max_residual_px))
