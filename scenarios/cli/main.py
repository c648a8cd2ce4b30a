"""The command line: ``mosca VERB``. Heavy packages are imported by the verbs that need them."""

import gc
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

# Set before numpy is imported: BLAS threads for small matrix products block each other as soon as anything else runs
# (measured: adjustments 10 to 100 times slower); large computations here use threads of their own.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import click

from mosca import __version__
from mosca.errors import InputError, MoscaError
from scenarios.cli import accept as cli_accept
from scenarios.cli import benchmark as cli_benchmark
from scenarios.cli import budget as cli_budget
from scenarios.cli import capture as cli_capture
from scenarios.cli import certificate as cli_certificate
from scenarios.cli import claim as cli_claim
from scenarios.cli import clinic as cli_clinic
from scenarios.cli import demo as cli_demo
from scenarios.cli import edit as cli_edit
from scenarios.cli import flight as cli_flight
from scenarios.cli import identify as cli_identify
from scenarios.cli import lab as cli_lab
from scenarios.cli import lab_twin as cli_lab_twin
from scenarios.cli import live as cli_live
from scenarios.cli import motion as cli_motion
from scenarios.cli import plan as cli_plan
from scenarios.cli import replay as cli_replay
from scenarios.cli import rig as cli_rig
from scenarios.cli import self_orient as cli_self_orient
from scenarios.cli import skeleton as cli_skeleton
from scenarios.cli import station as cli_station
from scenarios.cli import suite as cli_suite
from scenarios.cli import sweep as cli_sweep
from scenarios.cli import track_files as cli_track_files
from scenarios.cli import tracks as cli_tracks
from scenarios.cli import vibration as cli_vibration
from scenarios.cli.grouped import GroupedCommands
from scenarios.cli.options import (
    EXIT_BROKEN,
    EXIT_ERROR,
    EXIT_PASSED,
    FILE,
    IMAGES,
    OUT_FILE,
    OUT_FOLDER,
    SCENARIO,
    log_to_stderr,
    print_table,
    table,
)  # fmt: skip
from scenarios.cli.progress import Progress
from scenarios.run.interrupt import EXIT_STOPPED, was_interrupted


@click.group(cls=GroupedCommands, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(__version__, prog_name="mosca")
@click.option("-v", "--verbose", count=True, help="log each stage of the work; -vv: more")
@click.option("-q", "--quiet", is_flag=True, help="log errors only, and show no progress")
def cli(verbose: int, quiet: bool) -> None:
    """A digital-twin testbench for photogrammetric marker motion capture.

    Exit codes: 0 every limit met, 1 a limit broken or not judged, 2 an input error (message of one line).
    """
    log_to_stderr(verbose, quiet)


@cli.command()
@click.argument("scenario", type=SCENARIO)
@click.option(
    "--source", default="twin", help="source of frames: twin | recording:DIR | hardware:RIG.toml", show_default=True
)
@click.option("--seed", type=int, help="seed in place of the scenario's")
@click.option(
    "--set", "overrides", multiple=True, metavar="KEY=VALUE", help="change a key, e.g. capture.duration_s=2"
)
@click.option("--out", type=OUT_FOLDER, help="run folder  [default: runs/SCENARIO]")
@click.option("--rrd", is_flag=True, help="also write run.rrd for the Rerun viewer")
@click.option(
    "--images",
    type=IMAGES,
    help="with --rrd: store the images of this many frame sets, evenly spread, or of all  [default: 100]",
)
@click.option("--record", type=OUT_FOLDER, help="also record the frames into this folder")
@click.option(
    "--truth",
    type=FILE,
    help="truth.npz, or your own truth.csv (label,time_ns,x,y,z), to score frames that are not the twin's  "
    "[default: the truth beside the frames]",
)
@click.option("--workers", type=click.IntRange(1, 64), help="rendering threads  [default: all cores]")
@click.option("--lab", type=FILE, help="lab file of mosca twin fit, with cameras to use in place of the scenario's")
def run(
    scenario: str,
    *,
    source: str,
    seed: int | None,
    overrides: tuple[str, ...],
    out: Path | None,
    rrd: bool,
    images: int | None,
    record: Path | None,
    truth: Path | None,
    workers: int | None,
    lab: Path | None,
) -> None:
    """Run one scenario from scene to score and write its run folder.

    SCENARIO is a file or the name of a built-in scenario. On a recording or a rig without a truth, limits that need
    a truth are reported as not judged. Lengths, rigidity, static noise and residuals are still judged.

    \b
    Example:  mosca run actor --set capture.duration_s=2 --out runs/try
    """
    from scenarios.lab_twin.apply import load_with_lab
    from scenarios.spec.catalog import find, scenario_name
    from scenarios.spec.scenario import changed_keys

    if images is not None and not rrd:
        raise InputError("--images goes with --rrd: it is the Rerun recording that holds them; add --rrd")
    path = find(scenario)
    if seed is not None:
        overrides = (*overrides, f"seed={seed}")
    spec = load_with_lab(path, lab, overrides)
    name = scenario_name(path)
    target = out or Path("runs") / name
    from reports.compare import summary_table
    from scenarios.run.folder import check_out, write_run
    from scenarios.run.one_writer import one_writer
    from scenarios.run.record import with_changed
    from scenarios.run.scenario import run_scenario
    from scenarios.types import RRD_IMAGES, RunOptions

    check_out(target)
    log = target.parent / f".{target.name}.rrd" if rrd else None
    with one_writer(target), _removed_in_the_end(log):
        with (progress := Progress(name)) as shown:
            options = RunOptions(
                source, workers or os.cpu_count() or 1, log, RRD_IMAGES if images is None else images, record, truth,
                shown, progress.stage,
            )  # fmt: skip
            result = run_scenario(spec, name, path.parent, options)
        if overrides or lab is not None:
            result = replace(result, record=with_changed(result.record, changed_keys(path, spec)))
        # printed before anything is written, so that neither a full disk nor a failing page loses the figures
        _print_metrics(result.record)
        print_table(summary_table([result.record]))
        click.echo(f"{name}: {result.record.verdict}")
        sys.stdout.flush()
        write_run(result, target, log)
    click.echo(f"{target / 'report.html'}")
    sys.exit(EXIT_PASSED if result.record.passed else EXIT_BROKEN)


@cli.command("list")
def list_() -> None:
    """Show the built-in scenarios.

    \b
    Example:  mosca list
    """
    from scenarios.spec.catalog import entries

    shown = table("scenario", "tier", "expect", "what it claims", numbers=False)
    for entry in entries(()):
        shown.add_row(entry.name, entry.spec.tier, entry.spec.expect, entry.spec.title)
    print_table(shown)


@cli.command()
@click.argument("path", type=OUT_FILE)
@click.option(
    "--subject",
    type=click.Choice(["cloud", "actor", "drone", "robot"]),
    default="cloud",
    show_default=True,
    help="what is filmed",
)
@click.option(
    "--cameras", type=click.IntRange(2, 100), default=4, show_default=True, help="number of cameras, on a ring"
)
@click.option(
    "--claim", default="1 mm", show_default=True, help="limit of the rms error: '1 mm', or '0.05 %' of the space"
)
def new(path: Path, subject: str, cameras: int, claim: str) -> None:
    """Write a commented scenario file to start from, and the schema with which editors complete its keys.

    \b
    Example:  mosca new my_lab.toml --subject actor --cameras 6 --claim "0.5 mm"
    """
    from scenarios.spec.catalog import write_new

    write_new(path, subject, cameras, claim)
    click.echo(f"{path} written; edit it, then: mosca run {path}")


@cli.command()
@click.argument("runs", nargs=-1, required=True, type=FILE)
@click.option("--out", type=OUT_FILE, default=Path("comparison.html"), show_default=True, help="page to write")
def report(runs: tuple[Path, ...], out: Path) -> None:
    """Compare run folders, or records, on one page: first the differences, then the figures that are comparable.

    \b
    Example:  mosca report runs/before runs/after --out comparison.html
    """
    from reports.comparison.page import write_comparison_page
    from reports.record import read_record

    records = [read_record(run / "record.json" if run.is_dir() else run) for run in runs]
    pages = [run / "report.html" if run.is_dir() else None for run in runs]
    write_comparison_page(out, records, [str(run) for run in runs], pages)
    click.echo(f"{out}")


@cli.command()
@click.argument("run", type=FILE)
@click.option("--web", is_flag=True, help="open in a browser instead of a window")
def view(run: Path, web: bool) -> None:
    """Open a run in the Rerun viewer: cameras, images, detections, tracks and truth on one timeline.

    RUN is a run folder that was made with --rrd, or an .rrd file.

    \b
    Example:  mosca run actor --rrd && mosca view runs/subjects/actor
    """
    from reports.viewer_program import show

    show(run, web)


cli.add_command(cli_suite.suite)
cli.add_command(cli_sweep.sweep)
cli.add_command(cli_budget.budget)
cli.add_command(cli_claim.claim)
cli.add_command(cli_accept.accept)
cli.add_command(cli_certificate.certificate)
cli.add_command(cli_plan.plan)
cli.add_command(cli_benchmark.benchmark)
cli.add_command(cli_tracks.reconstruct)
cli.add_command(cli_tracks.labels)
cli.add_command(cli_tracks.bodies)
cli.add_command(cli_tracks.zones)
cli.add_command(cli_track_files.tracks)
cli.add_command(cli_skeleton.skeleton)
cli.add_command(cli_vibration.vibration)
cli.add_command(cli_flight.flight)
cli.add_command(cli_edit.edit)
cli.add_command(cli_demo.demo)
cli.add_command(cli_identify.identify)
cli.add_command(cli_self_orient.self_orient)
cli.add_command(cli_live.live)
cli.add_command(cli_replay.replay)
cli.add_command(cli_motion.motion)
cli.add_command(cli_rig.calibrate)
cli.add_command(cli_rig.rig)
cli.add_command(cli_rig.target)
cli.add_command(cli_capture.capture)
cli.add_command(cli_clinic.clinic)
cli.add_command(cli_station.station)


@cli.group()
def twin() -> None:
    """Check the virtual cameras, serve them as GigE Vision cameras, or fit them to your own cameras."""


@twin.command("fidelity")
@click.option("--quick", is_flag=True, help="run fewer cases, in a few seconds, without other renderers")
@click.option("--out", type=OUT_FOLDER, help="folder for fidelity.html (with pictures) and fidelity.json")
def twin_fidelity(quick: bool, out: Path | None) -> None:
    """Compare the virtual cameras with independent references, and print each figure beside its limit.

    \b
    Example:  mosca twin fidelity --quick --out runs/fidelity
    """
    from reports.fidelity import all_met, fidelity_table
    from scenarios.fidelity.command import PAGE, look, prepare, write

    if out is not None:
        prepare(out)
    with Progress("fidelity") as shown:
        found = look(quick, out is not None, shown)
    print_table(fidelity_table(found.checks))
    click.echo(found.sentence)
    if out is not None:
        write(found, out)
        click.echo(f"{out / PAGE}")
    sys.exit(EXIT_PASSED if all_met(found.checks) else EXIT_BROKEN)


twin.add_command(cli_lab.twin_serve)
twin.add_command(cli_lab_twin.fit)
twin.add_command(cli_lab_twin.predict)


SCHEMAS = {
    "scenario": "scenarios.spec.scenario:scenario_schema",
    "claim": "scenarios.spec.claim:claim_schema",
    "plan": "scenarios.spec.plan:plan_schema",
    "acceptance": "mosca.accuracy.acceptance.artefact:acceptance_schema",
    "rig": "mosca.data.files.rig_file:rig_schema",
    "target": "mosca.data.files.target_file:target_schema",
    "marker-model": "mosca.formats.bodies.model_file:model_schema",
}
"""Kind of file -> module and function that describe it."""


@cli.command()
@click.argument("kind", type=click.Choice([*SCHEMAS]), metavar="KIND")
def schema(kind: str) -> None:
    """Print the JSON schema of one KIND of file: scenario, claim, plan, acceptance, rig, target, marker-model.

    \b
    Example:  mosca schema scenario > scenario.schema.json
    """
    import json
    from importlib import import_module

    module, function = SCHEMAS[kind].split(":")
    click.echo(json.dumps(getattr(import_module(module), function)(), indent=2))


def main() -> None:
    """Run the command line; known errors become one line and exit code 2."""
    # a verb imports a million permanent objects: searching them for garbage takes a tenth of the start time
    gc.set_threshold(50_000, 10, 10)
    try:
        cli(prog_name="mosca", standalone_mode=False)
    except click.exceptions.Exit as done:
        sys.exit(done.exit_code)
    except click.exceptions.NoArgsIsHelpError as error:
        click.echo(error.format_message(), err=True)
        sys.exit(EXIT_ERROR)
    except click.ClickException as error:
        where = getattr(error, "ctx", None)
        path = where.command_path if where is not None else "mosca"
        told = " ".join(error.format_message().split()).rstrip(".")
        click.echo(f"mosca: {told}; '{path} --help' shows what there is", err=True)
        sys.exit(EXIT_ERROR)
    except MoscaError as error:
        click.echo(f"mosca: {error}", err=True)
        sys.exit(EXIT_ERROR)
    except (click.Abort, KeyboardInterrupt, SystemError) as error:
        if isinstance(error, SystemError) and not was_interrupted(error):
            raise
        # the end of the process waits for threads and processes; another Ctrl-C ends it at once
        signal.signal(signal.SIGINT, lambda *_: os._exit(EXIT_STOPPED))
        click.echo("mosca: stopped; nothing was left half written", err=True)
        sys.exit(EXIT_STOPPED)
    except OSError as error:
        if error.filename is None and error.errno is None:
            raise
        click.echo(f"mosca: {error.filename or 'disk'}: {error.strerror}", err=True)
        sys.exit(EXIT_ERROR)


@contextmanager
def _removed_in_the_end(path: Path | None) -> Iterator[None]:
    try:
        yield
    finally:
        if path is not None:
            path.unlink(missing_ok=True)


def _outcome(metric: Any, scale: float) -> str:
    """Return in words whether a metric meets its limit or range."""
    if metric.within is not None:
        low, high = (f"{scale * end:.4g}" for end in metric.within)
        inside = "met: in" if metric.passed else "broken as it must be: in"
        return f"{inside if metric.as_it_must else 'OUTSIDE'} [{low}, {high}]"
    return "" if metric.passed is None else ("met" if metric.passed else "BROKEN")


def _print_metrics(record: Any) -> None:
    """Print each metric beside its limit."""
    shown = table("metric", "value", "95 %", "limit", "")
    shown.columns[-1].justify = "left"
    for metric in record.metrics:
        scale, unit = (1e3, "mm") if metric.unit == "m" else (1.0, "" if metric.unit == "1" else metric.unit)
        sign = "<=" if metric.sense == "at_most" else ">="
        shown.add_row(
            metric.name,
            f"{metric.value * scale:.4g} {unit}".strip(),
            "" if metric.ci95 is None else f"{metric.ci95[0] * scale:.4g} .. {metric.ci95[1] * scale:.4g}",
            "" if metric.limit is None else f"{sign} {metric.limit * scale:.4g} {unit}".strip(),
            _outcome(metric, scale),
        )
    print_table(shown)


if __name__ == "__main__":
    main()
