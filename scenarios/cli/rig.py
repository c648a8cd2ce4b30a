"""The verbs for rigs and targets: calibrate, rig check, rig compare, rig convert, target sheet."""

from pathlib import Path
from typing import Any, Literal

import click

from mosca.errors import InputError
from scenarios.cli.options import FILE, OUT_FILE, POSITIVE, SET, Number, echo_lines
from scenarios.cli.progress import Progress


@click.command()
@click.argument("recording", type=FILE)
@click.option(
    "--target", required=True, type=FILE, help="target file (TOML): the target that was shown to the cameras"
)
@click.option(
    "--out",
    required=True,
    type=OUT_FILE,
    help="rig file to write (.toml); its page (.html) and record (.calibration.json) go beside it",
)
@click.option(
    "--lens",
    type=click.Choice(["mosca", "opencv", "fisheye"]),
    help="lens model  [default: the one that predicts held-out views best; for measured points that of their file]",
)
@click.option(
    "--free",
    metavar="NAME,NAME...",
    help="lens parameters to estimate  [default: all; for a wand or measured points those that these determine]",
)
@click.option(
    "--pixel-pitch-mm",
    type=POSITIVE,
    default=0.01,
    show_default=True,
    help="mx of a Mosca lens (data sheet of the sensor); it is held fixed and only sets the unit of c",
)
@click.option("--known", type=FILE, help="earlier rig of these cameras, with which the new one is compared")
@click.option("--exterior-only", is_flag=True, help="keep the lenses of --known, and estimate the poses anew")
@click.option(
    "--axes",
    type=FILE,
    nargs=2,
    metavar="RECORDING L_FRAME",
    help="recording of an L-frame and its target file: sets the world's axes",
)
@click.option(
    "--lengths",
    type=FILE,
    nargs=2,
    metavar="RECORDING BAR",
    help="recording of a certified scale bar and its target file: checks the scale",
)
@click.option("--fps", type=POSITIVE, help="frame rate of a recording that does not state its own [Hz]")
@click.option(
    "--every", type=click.IntRange(min=1), default=1, show_default=True, metavar="N", help="use every N-th frame set"
)
@click.option(
    "--reference",
    type=click.IntRange(min=0),
    help="frame set in which the pose of field or board defines the world frame  [default: the first]",
)
@click.option(
    "--leave-out-unseen",
    is_flag=True,
    help="leave out cameras that saw too little of the target, and calibrate the others",
)
@SET
def calibrate(**given: Any) -> None:
    """Calibrate cameras from images of a target: interior and exterior orientation, with precision and verdict.

    The target file's kind selects the method: a test field or a board (its first pose is the world frame), a wand
    (focal lengths estimated, scale from its length; give --axes), or points measured in the images beforehand. A
    wand's image points may come from a table of EasyWand, DLTdv or Argus (RECORDING ends in .csv). The image points
    of a single light may come from a session of MultiCamSelfCal (points.dat; see docs/calibration.md).

    \b
    Example:  mosca calibrate lab/field --target field.toml --out rig.toml
              mosca calibrate lab/moved --target field.toml --known rig.toml --exterior-only --out rig2.toml
              mosca calibrate lab --target points.toml --lens opencv --free fx_px,fy_px,cx_px,cy_px,k1 --out rig.toml
    """
    from scenarios.commands.calibrate import CalibrateOptions
    from scenarios.commands.calibrate import calibrate as work

    options = CalibrateOptions(**given)
    with Progress(options.recording.name) as shown:
        lines = work(options, shown)
    echo_lines(lines)


@click.group()
def rig() -> None:
    """Check and compare rig files, and convert them to and from files of other programs."""


@rig.command("check")
@click.argument("path", type=FILE, required=False)
@click.option("--devices", is_flag=True, help="list the cameras that the drivers see; opens none of them")
@click.option("--live", is_flag=True, help="take frames for 2 s: rates, light, focus, stamps, disk")
@click.option(
    "--flash",
    type=FILE,
    metavar="RECORDING",
    help="report the synchronisation of cameras that all filmed a flashing light (docs/capture.md)",
)
@click.option("--fps", type=POSITIVE, help="with --flash: frame rate of a recording that does not state its own [Hz]")
def rig_check(path: Path | None, devices: bool, live: bool, flash: Path | None, fps: float | None) -> None:
    """Read a rig file and report the overlap of its cameras' views, or the state of its devices.

    With --live the exit code is 1 if a pulse lacks a whole frame of any camera.

    \b
    Example:  mosca rig check rig.toml
              mosca rig check --devices
              mosca rig check --live rig.toml
              mosca rig check --flash lab/flashes
    """
    if fps is not None and flash is None:
        raise InputError("--fps goes with --flash; leave it out")
    absent: list[str] = []
    whole = True
    if live and (path is None or devices):
        raise InputError("--live takes frames of a rig file's cameras; give the rig file, and leave --devices out")
    if flash is not None:
        if path is not None or devices or live:
            raise InputError("--flash looks at a recording alone; leave rig file, --devices and --live out")
        from mosca.diagnostics.light_marker.offsets import synchronise
        from mosca.recording import open_recording

        with open_recording(flash, None, fps) as recording:
            lines = synchronise(recording).lines()
    elif live and path is not None:
        from scenarios.lab.rig_check import check_rig_live

        lines, whole = check_rig_live(path)
    elif devices:
        from scenarios.lab.devices import describe_devices

        lines, absent = describe_devices(path)
    elif path is None:
        raise InputError(
            "rig check: give a rig file, --devices for the cameras that are there, or --flash for how they are "
            "synchronised"
        )
    else:
        from scenarios.commands.describe_rig import describe_rig

        lines = list(describe_rig(path))
    echo_lines(lines)
    if absent:
        raise InputError(
            f"{path}: {len(absent)} of its cameras not found: {', '.join(absent)}; check cable, power and network, "
            "and serial or address in [camera.hardware]"
        )
    if not whole:
        raise SystemExit(1)


@rig.command("compare")
@click.argument("a", type=FILE)
@click.argument("b", type=FILE)
@click.option(
    "--align",
    type=click.Choice(["similarity", "rigid", "none"]),
    default="rigid",
    show_default=True,
    help="common motion that is removed before the comparison",
)
def rig_compare(a: Path, b: Path, align: Literal["similarity", "rigid", "none"]) -> None:
    """Compare two calibrations on their rays (px) and in the volume (mm); parameters may differ where rays agree.

    \b
    Example:  mosca rig compare monday.toml friday.toml
    """
    from mosca.calibration.quality.compare_rigs import compare_rigs
    from mosca.formats.rigs.rig_formats import read_any_rig

    echo_lines(compare_rigs(read_any_rig(a)[0], read_any_rig(b)[0], align=align).lines())


@rig.command("convert")
@click.argument("source", type=FILE)
@click.argument("out", type=FILE)
@click.option("--format", "format_", help="format to write (see below)  [default: mosca]")
@click.option(
    "--unit", type=click.Choice(["m", "mm"]), help="unit of the source's lengths, where the source does not state it"
)
@click.option("--size-px", type=(int, int), help="image width and height, where the source does not state them")
@click.option("--pixel-mm", type=(float, float), help="pixel pitch x and y, where a format needs it [mm]")
@click.option(
    "--max-residual-px",
    type=Number(min=0),
    default=0.1,
    show_default=True,
    help="largest misfit over the image that a conversion between lens models may leave [px]",
)
def rig_convert(
    source: Path,
    out: Path,
    format_: str | None,
    unit: Literal["m", "mm"] | None,
    size_px: tuple[int, int] | None,
    pixel_mm: tuple[float, float] | None,
    max_residual_px: float,
) -> None:
    """Read a calibration of another program, or write one for it, and report what is lost.

    Formats: mosca, aniposelib (Pose2Sim), caliscope, opencv, qtm, openptv; multicamselfcal is only read.

    \b
    Example:  mosca rig convert Calib.qca.txt rig.toml
    """
    from mosca.formats.rigs.rig_formats import RigFileOptions, read_any_rig, write_any_rig

    options = RigFileOptions(size_px=size_px, unit=unit, pixel_mm=pixel_mm, max_residual_px=max_residual_px)
    found, notes = read_any_rig(source, None, options)
    echo_lines((*notes, *write_any_rig(found, out, format_ or "mosca", options)))
    click.echo(f"{out} written: {len(found.cameras)} cameras")


@click.group()
def target() -> None:
    """Print calibration targets, and find the scale of a print."""


@target.command("sheet")
@click.argument("path", type=FILE)
@click.option("--out", required=True, type=OUT_FILE, help="sheet to write: .pdf or .svg; further sheets get numbers")
@click.option("--page", type=click.Choice(["A4", "A3", "A2", "letter"]), help="paper  [default: as large as needed]")
@click.option(
    "--colour", type=click.Choice(["white", "black"]), default="white", show_default=True, help="colour of the dots"
)
def target_sheet(path: Path, out: Path, page: str | None, colour: Literal["white", "black"]) -> None:
    """Print a target file's coded targets or board, with a ruler that shows whether the printer kept the size.

    \b
    Example:  mosca target sheet field.toml --out field.pdf
    """
    from mosca.data.files.target_file import PointsTarget, read_target_file
    from mosca.formats.sheets.target_sheet import write_sheets

    made = read_target_file(path)
    if isinstance(made, PointsTarget):
        raise InputError(f"{path}: kind = 'points' has nothing to print; a field, a board or a scale bar has")
    for sheet in write_sheets(made, out, page, colour):
        click.echo(f"{sheet} written; measure its ruler after printing")


@target.command("scale")
@click.argument("path", type=FILE)
@click.option(
    "--ruler",
    type=(POSITIVE, POSITIVE),
    metavar="MEASURED PRINTED",
    help="length of the sheet's ruler as measured, and as printed beside it [mm]",
)
@click.option(
    "--scan",
    type=(FILE, POSITIVE),
    metavar="IMAGE DPI",
    help="scan of a sheet with coded targets, and its resolution [pixels an inch]",
)
@click.option(
    "--page", type=click.Choice(["A4", "A3", "A2", "letter"]), help="paper of the sheet  [default: as printed]"
)
@click.option(
    "--colour", type=click.Choice(["white", "black"]), default="white", show_default=True, help="colour of the dots"
)
def target_scale(
    path: Path,
    ruler: tuple[float, float] | None,
    scan: tuple[Path, float] | None,
    page: str | None,
    colour: Literal["white", "black"],
) -> None:
    """Find the scale at which a sheet was printed, and the lengths that its target file must hold.

    \b
    Example:  mosca target scale field.toml --ruler 148.9 150
              mosca target scale field.toml --scan sheet.png 600
    """
    from scenarios.commands.targets import scale_from_ruler, scale_from_scan

    if ruler is not None and scan is None:
        lines = scale_from_ruler(path, *ruler)
    elif scan is not None and ruler is None:
        lines = scale_from_scan(path, *scan, page, colour)
    else:
        raise InputError("target scale: give --ruler MEASURED PRINTED or --scan IMAGE DPI, one of the two")
    echo_lines(lines)
