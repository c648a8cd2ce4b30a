"""The verbs of the lab's own twin: twin fit, twin predict."""

import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from scenarios.cli.options import EXIT_PASSED, FILE, OUT_FILE, OUT_FOLDER, POSITIVE, SCENARIO, print_table, table
from scenarios.cli.progress import Progress

if TYPE_CHECKING:
    from mosca.accuracy.lab_twin.estimates import Told


@click.command("fit")
@click.argument("recordings", nargs=-1, required=True, metavar="KIND:FOLDER ...")
@click.option("--out", type=OUT_FILE, required=True, help="lab file to write")
@click.option("--rig", type=FILE, help="rig file of the calibrated cameras; needed for moving:FOLDER")
@click.option("--fps", type=POSITIVE, help="frame rate of recordings that do not state their own [Hz]")
@click.option("--bits", type=click.IntRange(8, 16), help="significant bits of a pixel  [default: as recorded]")
def fit(recordings: tuple[str, ...], out: Path, rig: Path | None, fps: float | None, bits: int | None) -> None:
    """Fit virtual cameras to your own cameras: each parameter with its uncertainty, from ordinary recordings.

    KIND is dark (caps on the lenses), lit (an even bright surface, no targets), static (targets at rest) or moving (a
    wand or a person with markers). Parameters that these recordings do not determine are named, with the recording
    that would. mosca run --lab and mosca twin predict read the file.

    \b
    Example:  mosca twin fit dark:lab/dark lit:lab/lit static:lab/still moving:lab/walk --rig rig.toml --out lab.toml
    """
    from scenarios.lab_twin.fit import FitRequest, fit_lab

    with Progress("fit") as shown:
        told = fit_lab(FitRequest(recordings, out, rig, fps, bits), shown)
    print_table(told_table(told))
    for line in lacking_lines(told):
        click.echo(line)
    click.echo(f"{out}")
    sys.exit(EXIT_PASSED)


@click.command("predict")
@click.argument("scenario", type=SCENARIO)
@click.option("--lab", type=FILE, required=True, help="lab file of mosca twin fit")
@click.option(
    "--draws", type=click.IntRange(3, 1000), default=8, show_default=True, help="draws of the lab's parameters"
)
@click.option("--set", "overrides", multiple=True, metavar="KEY=VALUE", help="change a key of the scenario")
@click.option("--out", type=OUT_FOLDER, help="run folder of the run with the estimates  [default: none]")
@click.option("--workers", type=click.IntRange(1, 64), help="rendering threads  [default: all cores]")
def predict(
    scenario: str, lab: Path, draws: int, overrides: tuple[str, ...], out: Path | None, workers: int | None
) -> None:
    """Predict the metrics of a planned experiment in your lab, each with a 95 % interval.

    SCENARIO runs with the lab's cameras in place of its own, once with the estimates and --draws times with
    parameters drawn about the estimates and other seeds. Calibration errors are included where the scenario has a
    [calibration].

    \b
    Example:  mosca twin predict rigs/wand_lengths --lab lab.toml --draws 8 --out runs/predicted
    """
    from scenarios.lab_twin.apply import load_with_lab
    from scenarios.lab_twin.lab_file import read_lab
    from scenarios.lab_twin.predict import line
    from scenarios.lab_twin.predict import predict as predicted
    from scenarios.run.folder import check_out, write_run
    from scenarios.run.one_writer import one_writer
    from scenarios.spec.catalog import find, scenario_name

    path = find(scenario)
    spec = load_with_lab(path, lab, overrides)
    if out is not None:
        check_out(out)
    with Progress("predict") as shown:
        result, told = predicted(
            spec, read_lab(lab), scenario_name(path), path.parent, draws, workers or os.cpu_count() or 1, shown
        )
    for one in told:
        click.echo(f"{one.metric}: {line(one)}")
    if out is not None:
        with one_writer(out):
            write_run(result, out)
        click.echo(f"{out / 'report.html'}")
    sys.exit(EXIT_PASSED)


def told_table(told: Sequence["Told"]) -> Any:
    """Return a table of the estimates: parameter, camera, value, 95 % interval, evidence."""
    from mosca.accuracy.lab_twin.estimates import ParameterEstimate
    from scenarios.lab_twin.lab_file import interval

    shown = table("parameter", "camera", "estimate", "95 %", "evidence", numbers=False)
    found = [one for one in told if isinstance(one, ParameterEstimate)]
    for one in sorted(found, key=lambda e: [o.key for o in found].index(e.key)):
        low, high = interval(one)
        ends = "" if one.sigma == 0.0 else f"{low:.4g} .. {high:.4g}"
        shown.add_row(one.key, one.camera, f"{one.value:.4g}", ends, one.evidence)
    return shown


def lacking_lines(told: Sequence["Told"]) -> list[str]:
    """Return a line for each reason why parameters are not estimated, with the cameras and keys concerned."""
    from mosca.accuracy.lab_twin.estimates import NotTold

    lacking: dict[str, tuple[dict[str, None], dict[str, None]]] = {}
    for one in told:
        if isinstance(one, NotTold):
            keys, cameras = lacking.setdefault(one.reason, ({}, {}))
            keys[one.key] = cameras[one.camera] = None
    return [
        f"not told by these recordings: {reason} ({', '.join(keys)} of {', '.join(cameras)})"
        for reason, (keys, cameras) in lacking.items()
    ]
