"""The verb for acceptance tests: accept."""

import sys
from pathlib import Path
from typing import Any

import click

from scenarios.cli.claim import EXITS
from scenarios.cli.options import FILE, OUT_FOLDER, POSITIVE, SET, print_table, table
from scenarios.cli.progress import Progress


@click.command()
@click.argument("what")
@click.option("--artefact", type=FILE, help="acceptance file: artefacts, certificates, measuring lines, limits")
@click.option("--rig", type=FILE, help="rig file of a recording  [default: rig.toml in it]")
@click.option("--fps", type=POSITIVE, help="frame rate of a recording that does not state its own [Hz]")
@click.option(
    "--source", help="source of a scenario's frames: twin | recording:DIR | hardware:RIG.toml  [default: twin]"
)
@click.option("--seed", type=int, help="seed in place of the scenario's")
@SET
@click.option(
    "--arrivals", type=FILE, help="times at which results were available: .csv  [default: arrivals.csv in WHAT]"
)
@click.option("--workers", type=click.IntRange(1, 64), help="rendering threads  [default: all cores]")
@click.option("--out", type=OUT_FOLDER, help="folder for acceptance.json and .html  [default: runs/acceptance/WHAT]")
def accept(out: Path | None, **given: Any) -> None:
    """Run acceptance tests with certified artefacts, in the manner of VDI/VDE 2634-1, ASTM E3064 and ASTM E3124.

    WHAT is a scenario with [acceptance], a run folder, a file of tracks (.npz, .csv, .parquet, .c3d, .trc), or a
    recording, which is reconstructed first. Each error is shown with its expanded uncertainty and its limit.

    Exit codes: 0 conforming, 1 not conforming, 3 undecided, 2 an input error.

    \b
    Example:  mosca accept acceptance/ball_bar --out runs/acceptance/try
              mosca accept lab/take.c3d --artefact bar.acceptance
    """
    from mosca.data.files.whole_file import check_folder, check_own_folder
    from scenarios.run.one_writer import one_writer
    from scenarios.studies.acceptance.document import acceptance_document
    from scenarios.studies.acceptance.folder import PAGE, RESULT, write_acceptance
    from scenarios.studies.acceptance.take import AcceptOptions, take_of

    options = AcceptOptions(**{**given, "overrides": tuple(given.pop("overrides"))})
    target = out or Path("runs") / "acceptance" / Path(options.what).stem
    check_own_folder(target, RESULT)
    check_folder(target)
    with one_writer(target):
        with Progress(Path(options.what).name) as shown:
            take = take_of(options, target, shown)
        document = acceptance_document(take, target)
        # printed before anything is written, so that a full disk does not lose the figures
        _print(document)
        click.echo(f"{take.name}: {document['verdict']}")
        sys.stdout.flush()
        write_acceptance(document, target)
    click.echo(f"{target / PAGE}")
    sys.exit(EXITS[document["verdict"]])


def _print(document: Any) -> None:
    """Print the worst length of each line and the figures of the clusters, each beside its limit."""
    from reports.acceptance.words import figure_rows, note_lines

    shown = table("figure", "found", "U (k = 2)", "limit", "")
    shown.columns[-1].justify = "left"
    for row in figure_rows(document, worst_only=True):
        shown.add_row(row.what, row.found, row.expanded, row.limit, row.decision)
    print_table(shown)
    for line in note_lines(document):
        click.echo(line)
