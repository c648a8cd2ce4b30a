"""Constants of the product: their page, and what becomes of headline figures when they change.

    python -m tests.studies.constants page                       write docs/constants.md
    python -m tests.studies.constants screen                     groups, times 0.7 and 1.3, bisected where one matters
    python -m tests.studies.constants single mosca/detection     each alone, times 0.5 and 2

Both trials go on where they were broken off (``--out``), as long as no source changes; ``--keep`` writes what they
found beside the code. ``screen`` ends with 1 where a constant matters that was not known to.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from datetime import UTC, datetime
from pathlib import Path

from tests.studies.constants.inventory import REACHED, ROOT, Constant, constants
from tests.studies.constants.outcomes import Outcomes, read_outcomes, surprises, write_outcomes
from tests.studies.constants.page import PAGE, page
from tests.studies.constants.screen import Kept, all_answers, code_stamp, screen


def main() -> int:
    """Do what the command line asks for; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tests.studies.constants", description=__doc__.split("\n")[0])
    parser.add_argument("what", choices=["page", "screen", "single"])
    parser.add_argument("packages", nargs="*", default=REACHED, help="beginnings of paths (default: all reached)")
    parser.add_argument("--factors", type=float, nargs="+", help="default: 0.7 1.3, of single 0.5 2")
    parser.add_argument("--minutes", type=float, default=55.0, help="after them no further one is begun (default 55)")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--takes", nargs="+", default=(), help="default: all")
    parser.add_argument("--data", type=Path, default=ROOT / "runs" / "constants" / "data", help="where the takes lie")
    parser.add_argument("--out", type=Path, default=ROOT / "runs" / "constants" / "answers.jsonl")
    parser.add_argument("--afresh", action="store_true", help="screen also what is known to matter")
    parser.add_argument("--keep", action="store_true", help="write what was found to outcomes.json and the page")
    given = parser.parse_args()
    listed = constants()
    if given.what == "page":
        PAGE.write_text(page(listed, read_outcomes()), encoding="utf-8")
        return 0
    factors = given.factors or ([0.5, 2.0] if given.what == "single" else [0.7, 1.3])
    with tempfile.TemporaryDirectory(prefix="constants-") as kernels:
        return _tried(given, listed, factors, Path(kernels))


def _tried(given: argparse.Namespace, listed: list[Constant], factors: list[float], kernels: Path) -> int:
    ends = time.monotonic() + 60 * given.minutes
    os.environ["NUMBA_CACHE_DIR"] = str(kernels)
    os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")
    # before anything of mosca is imported
    from tests.studies.constants import run_time

    run_time.install(one.key for one in listed if one.package in REACHED)
    from tests.studies.constants.evaluate import Forked
    from tests.studies.constants.headlines import headlines

    answers = Forked(headlines(given.data, tuple(given.takes)), given.jobs, ends)
    cells = run_time.known_keys()
    groups = [[one.key for one in listed if one.key.startswith(p) and one.key in cells] for p in given.packages]
    stamp = code_stamp(ROOT) + "/" + ",".join(take.name for take in answers.takes)
    kept, outcomes, code = Kept(given.out, stamp), read_outcomes(), 0
    for take, figures in answers.base.items():
        print(f"{take}: " + ", ".join(f"{name} {value:.4g}" for name, value in figures.items()), flush=True)
    if given.what == "single":
        questions = [((key,), factor) for group in groups for key in group for factor in factors]
        there = all_answers(questions, answers, kept)
        for question, figures in there.items():
            outcomes.add_single(question, answers.base, figures)
        print(f"{len(there)} of {len(questions)} asked")
    else:
        first = [one for factor in factors for one in outcomes.questions(groups, factor, given.afresh)]
        found = screen(first, answers.base, answers, kept)
        for (keys, factor), moved in found.matters.items():
            print(f"{' + '.join(keys)} x {factor:g}: {'; '.join(map(str, moved[:3]))}")
        for (keys, factor), moved in surprises(found, outcomes):
            print(f"NOT KNOWN: {' + '.join(keys)} x {factor:g}: {moved[0]}")
            code = 1
        if found.unasked:
            print(f"no time for {len(found.unasked)} groups: run again, it goes on where it stopped")
            code = 1
        if given.keep:
            outcomes.add_screen(found, factors)
    if given.keep:
        _keep(outcomes, [take.name + " (outside)" * take.outside for take in answers.takes], listed)
        code = 0
    return code


def _keep(outcomes: Outcomes, takes: list[str], listed: list[Constant]) -> None:
    commit = subprocess.run(
        ["git", "rev-parse", "--short=8", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.strip()
    outcomes.date, outcomes.commit, outcomes.takes = f"{datetime.now(UTC):%Y-%m-%d}", commit, takes
    write_outcomes(outcomes)
    PAGE.write_text(page(listed, outcomes), encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
