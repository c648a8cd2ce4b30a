"""The verb for editing takes: edit."""

from pathlib import Path

import click

from mosca.errors import InputError
from scenarios.cli.options import FILE, OUT_FILE, POSITIVE, echo_lines


@click.command()
@click.argument("take", type=FILE)
@click.argument("edits", type=FILE, required=False)
@click.option(
    "--out", required=True, type=OUT_FILE, help="the edited take: .npz, .csv, .parquet, .c3d or .trc; a motion: .bvh"
)
@click.option(
    "--undo",
    metavar="[N]",
    is_flag=False,
    flag_value="all",
    help="undo the last N edits of TAKE  [no N: all of them]",
)
@click.option(
    "--fps", type=POSITIVE, help="frame rate to state in .c3d and .trc, or of a .bvh  [default: TAKE's own]"
)
@click.option("--metres-per-unit", type=POSITIVE, default=0.01, show_default=True, help="unit of .bvh files [m]")
def edit(
    take: Path, edits: Path | None, out: Path, undo: str | None, fps: float | None, metres_per_unit: float
) -> None:
    """Edit tracks, or the motion of a skeleton, with a file of operations.

    EDITS is a TOML file of [[edit]] tables: trim, swap, rename, fill, filter, offset, delete; for a .bvh file trim,
    filter, rotate, foot_lock, retarget. The changes are kept beside OUT, in OUT.edits.toml and OUT.edits.npz, and can
    be undone to the bit.

    \b
    Example:  mosca edit take.c3d edits.toml --out edited.npz
              mosca edit edited.npz --undo 1 --out better.npz
              mosca edit edited.npz --out start.npz --undo
    """
    from scenarios.commands.edit import edit_take, undo_take

    if (undo is None) == (edits is None):
        raise InputError("edit: a file of EDITS or --undo, one of the two, is wanted")
    if edits is not None:
        echo_lines(edit_take(take, edits, out, fps, metres_per_unit))
        return
    if undo != "all" and not str(undo).isdecimal():
        raise InputError(f"--undo {undo}: a number of edits, or nothing for all, is wanted")
    echo_lines(undo_take(take, None if undo == "all" else int(str(undo)), out, fps, metres_per_unit))
