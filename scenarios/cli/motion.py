"""The verb for files of recorded motion: motion convert."""

from pathlib import Path

import click

from mosca.errors import InputError
from scenarios.cli.options import FILE, OUT_FILE, POSITIVE


@click.group()
def motion() -> None:
    """Convert files of recorded human motion."""


@motion.command()
@click.argument("source", type=FILE)
@click.argument("out", type=OUT_FILE)
@click.option("--skeleton", type=FILE, help="ASF file that belongs to an AMC file")
@click.option(
    "--fps", type=POSITIVE, help="frame rate, where the file states none or a wrong one  [default: AMC 120 Hz]"
)
@click.option("--metres-per-unit", type=POSITIVE, help="unit of a BVH file  [default: 0.01 m, for SOURCE and OUT]")
def convert(source: Path, out: Path, skeleton: Path | None, fps: float | None, metres_per_unit: float | None) -> None:
    """Read an AMC file with its skeleton, or a BVH file, and write a BVH file.

    \b
    Example:  mosca motion convert 02_01.amc walk.bvh --skeleton 02.asf
    """
    from mosca.data.motion.asf import read_asf_amc
    from mosca.data.motion.bvh import read_bvh
    from mosca.formats.bodies.bvh_writer import write_bvh

    if out.suffix.lower() != ".bvh":
        raise InputError(f"{out}: suffix '{out.suffix}' given; .bvh is written")
    unit_m = 0.01 if metres_per_unit is None else metres_per_unit
    if source.suffix.lower() == ".amc" and skeleton is not None:
        found = read_asf_amc(skeleton, source, frame_rate_hz=fps or 120.0)
    elif source.suffix.lower() == ".bvh" and skeleton is None:
        found = read_bvh(source, metres_per_unit=unit_m, frame_rate_hz=fps)
    else:
        raise InputError(f"{source}: a .bvh alone, or an .amc with --skeleton FILE.asf, is wanted")
    write_bvh(found, out, metres_per_unit=unit_m)
    click.echo(f"{out} written: {len(found.skeleton.names)} joints, {found.duration_s:.2f} s")
