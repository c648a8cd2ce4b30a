"""The verb ``mosca clinic``."""

import sys
from typing import Any

import click

from scenarios.cli.options import EXIT_BROKEN, EXIT_PASSED, FILE, POSITIVE


@click.command()
@click.argument("take", type=FILE)
@click.option("--rig", type=FILE, help="rig file with which the take was measured  [default: rig.toml in TAKE]")
@click.option("--tracks", type=FILE, help="labelled tracks of the take  [default: tracks.npz or .csv in TAKE]")
@click.option(
    "--calibration",
    type=FILE,
    help="record of the rig's calibration, as 'mosca calibrate' writes it  [default: RIG.calibration.json]",
)
@click.option("--fps", type=POSITIVE, help="frame rate of a recording that does not state its own [Hz]")
@click.option(
    "--known-length",
    "lengths",
    type=POSITIVE,
    multiple=True,
    metavar="M",
    help="distance of two markers of a rigid body, measured by tape [m]  [repeatable]",
)
@click.option(
    "--tape-sigma-mm", type=POSITIVE, default=1.0, show_default=True, help="standard deviation of --known-length"
)
@click.option("--json", "as_json", is_flag=True, help="print JSON")
def clinic(as_json: bool, lengths: tuple[float, ...], tape_sigma_mm: float, **given: Any) -> None:
    """Name the likeliest cause of a fault in a take, with its evidence and the next step.

    TAKE is a recording or a run folder. Exit codes: 0 no fault was found, 1 a cause is named or a part could not be
    judged, 2 an error in the input.

    \b
    Example:  mosca clinic recordings/take_1 --rig rig.toml --known-length 0.6
    """
    from mosca.clinic.diagnose import KnownLengths
    from scenarios.commands.clinic import ClinicRequest, clinic_json, clinic_lines, clinic_of

    report = clinic_of(ClinicRequest(known=KnownLengths(lengths, 1e-3 * tape_sigma_mm), **given))
    click.echo(clinic_json(report) if as_json else "\n".join(clinic_lines(report)))
    sys.exit(EXIT_BROKEN if report.causes or report.not_judged else EXIT_PASSED)
