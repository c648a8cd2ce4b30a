"""The verbs for files of tracks: tracks info, tracks convert."""

from pathlib import Path

import click

from scenarios.cli.options import FILE, OUT_FILE, POSITIVE, echo_lines, print_table, table


@click.group()
def tracks() -> None:
    """Look into files of tracks, and convert them: .npz, .csv, .c3d, .trc."""


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
@click.option("--only", "names", multiple=True, metavar="NAME", help="keep the marker of this name  [repeatable]")
def tracks_convert(path: Path, out: Path, fps: float | None, names: tuple[str, ...]) -> None:
    """Write tracks in another format, that of OUT's suffix: .npz, .csv, .c3d, .trc (OpenSim).

    \b
    Example:  mosca tracks convert take1.npz take1.trc
    """
    from scenarios.commands.track_files import convert_tracks

    echo_lines(convert_tracks(path, out, fps, names))
