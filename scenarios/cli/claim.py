"""The verb for a claim over many runs: claim."""

import os
import sys
import threading
from pathlib import Path
from typing import Any

import click

from scenarios.cli.options import EXIT_BROKEN, EXIT_PASSED, FILE, OUT_FOLDER, print_table, table
from scenarios.cli.progress import Progress

EXIT_UNDECIDED = 3
"""Exit code, besides those of every verb, where the permitted number of runs does not decide the claim."""
EXITS = {"conforming": EXIT_PASSED, "not conforming": EXIT_BROKEN, "undecided": EXIT_UNDECIDED}


@click.command()
@click.argument("claim", type=FILE)
@click.option("--jobs", type=click.IntRange(1, 256), help="runs at the same time  [default: all cores]")
@click.option("--scheduler", metavar="ADDRESS", help="make the runs on this Dask cluster, e.g. tcp://10.0.0.5:8786")
@click.option("--out", type=OUT_FOLDER, help="folder for result.json and claim.html  [default: runs/claims/CLAIM]")
def claim(claim: Path, jobs: int | None, scheduler: str | None, out: Path | None) -> None:
    """Judge a claim about a scenario over many runs with newly drawn seeds, rigs or calibrations.

    CLAIM is a file or the name of a built-in claim. Runs are made until the claim is decided. The probability of a
    false verdict is at most what the file states, however often the result is looked at. Finished runs are kept:
    after Ctrl-C the same command continues.

    Exit codes: 0 conforming, 1 not conforming, 3 undecided, 2 an input error.

    \b
    Example:  mosca claim quick_cloud --out runs/claims/try
    """
    from mosca.data.files.whole_file import check_folder, check_own_folder
    from mosca.errors import InputError
    from scenarios.run.one_writer import one_writer
    from scenarios.studies.campaign.campaign import find_claim
    from scenarios.studies.campaign.result import RESULT, write_result

    path = find_claim(str(claim))
    target = out or Path("runs") / "claims" / path.stem
    if jobs is not None and scheduler is not None:
        raise InputError("--jobs and --scheduler exclude each other: a cluster has the workers that it has")
    check_own_folder(target, RESULT)
    check_folder(target)
    with one_writer(target):
        result = _result(path, jobs, scheduler)
        # printed before anything is written, so that a full disk does not lose the figures
        _print(result.document)
        runs, most = result.document["runs"], result.document["looks"][-1]
        click.echo(f"{path.stem}: {result.verdict}, after {runs} of at most {most} runs")
        sys.stdout.flush()
        write_result(result.document, target)
    click.echo(f"{target / 'claim.html'}")
    sys.exit(EXITS[result.verdict])


def _result(path: Path, jobs: int | None, scheduler: str | None) -> Any:
    """Make the runs and return the result, with the progress on the terminal."""
    from scenarios.run.interrupt import first_ctrl_c
    from scenarios.studies.campaign.campaign import run_claim
    from scenarios.studies.campaign.cluster import ClusterEngine
    from scenarios.studies.campaign.engine import LocalEngine

    asked = threading.Event()
    with Progress(path.stem) as shown, first_ctrl_c(asked.set):
        engine = LocalEngine(jobs or os.cpu_count() or 1) if scheduler is None else ClusterEngine(scheduler)
        try:
            return run_claim(path, engine, told=shown, stopped=asked.is_set)
        except KeyboardInterrupt:
            click.echo(f"{path.stem}: runs that are done are kept; the same command goes on", err=True)
            raise
        finally:
            engine.close()


def _print(document: Any) -> None:
    """Print each claim beside its limit."""
    from reports.claim.words import claim_words

    shown = table("claimed", "found", f"{100 * document['confidence']:.4g} %", "guard band", "runs", "")
    shown.columns[-1].justify = "left"
    for one in document["claims"]:
        words = claim_words(one)
        shown.add_row(
            words.claimed, words.found, words.interval, words.guard_band, str(one["runs"]),
            one["verdict"] + (f": {one['note']}" if one["note"] else ""),
        )  # fmt: skip
    print_table(shown)
