"""Run mutants and say which of them survive.

    python -m tests.mutations                       all, about a minute each
    python -m tests.mutations half_a_pixel jitter_off
    python -m tests.mutations --table docs/mutations.md

Each is written into a copy of the working tree, in which the tests that it names run until one fails. Exit code 1
where one survives, 2 where tests fail without any mutant.
"""

import argparse
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

from tests.mutations.mutant import ROOT, Mutant, read_mutants

COMPILING_S, SLOWER = 900, 3
"""A mutant whose tests take so much longer than so many times their time without any mutant hangs, and is noticed:
compiling what it changes takes some minutes on a slow machine."""
REPORT = "mutants.xml"
"""Of the run without a mutant, in the tree."""


@dataclass(frozen=True)
class Outcome:
    """``by``: what noticed the mutant, empty where nothing did."""

    mutant: Mutant
    by: str
    seconds: float


def copied_tree(target: Path) -> None:
    """Copy all files of the working tree that git does not ignore."""
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT, capture_output=True, text=True, check=True,
    ).stdout  # fmt: skip
    for name in filter(None, listed.split("\0")):
        if (ROOT / name).is_file():
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, target / name)


def seconds_of(tests: Sequence[str], report: Path) -> float:
    """Return how long ``tests`` took by a report of pytest in JUnit's form [s]."""
    files = tuple({test.split("::")[0].removesuffix(".py").replace("/", ".") for test in tests})
    cases = ElementTree.parse(report).iter("testcase")
    return sum(float(case.get("time", 0)) for case in cases if case.get("classname", "").startswith(files))


def noticed_by(tree: Path, tests: Sequence[str], longest_s: float | None) -> str:
    """Return what fails of ``tests`` in a tree: the first one, or where ``longest_s`` is None all; empty: nothing.

    ``longest_s``: time after which they are ended [s]. All leave a report in JUnit's form, REPORT, in the tree.
    """
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--tier", "full", *tests]
    run = subprocess.Popen(
        [*command, "--junitxml", REPORT] if longest_s is None else [*command, "-x"],
        cwd=tree, env={**os.environ, "PYTHONPATH": str(tree), "COLUMNS": "200"}, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True,
    )  # fmt: skip
    try:
        said, _ = run.communicate(timeout=longest_s)
    except subprocess.TimeoutExpired:
        os.killpg(run.pid, signal.SIGKILL)
        run.communicate()
        return f"no end within {longest_s:.0f} s"
    if run.returncode == 0:
        return ""
    lines = [line for line in said.splitlines() if line.startswith(("FAILED ", "ERROR "))]
    if not lines:
        raise RuntimeError(f"pytest ended with {run.returncode}: {said[-2000:]}")
    return ", ".join(line.split(" - ")[0].split(" ", 1)[1] for line in lines)


def table(outcomes: Sequence[Outcome]) -> str:
    """Return the outcomes as a Markdown document."""
    caught = sum(bool(one.by) for one in outcomes)
    lines = [
        "# Bugs that are noticed",
        "",
        "This page shows which tests notice bugs that are planted in the code, one at a time. "
        f"{caught} of {len(outcomes)} planted bugs are noticed.",
        "`tests/mutations` holds the lists of bugs. "
        "`python -m tests.mutations --table docs/mutations.md` writes this page.",
        "",
        "| bug | file | noticed by |",
        "|---|---|---|",
    ]
    for one in outcomes:
        by = f"`{one.by}`" if one.by else "**nothing**"
        lines.append(f"| {one.mutant.name} | `{one.mutant.file}` | {by} |")
    return "\n".join(lines) + "\n"


def main() -> int:
    """Run what the command line asks for; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutations", description=__doc__.split("\n")[0])
    parser.add_argument("names", nargs="*", help="mutants to run (default: all)")
    parser.add_argument("--table", type=Path, help="write the outcomes there, as Markdown")
    given = parser.parse_args()
    mutants = read_mutants()
    unknown = sorted(set(given.names) - {one.name for one in mutants})
    if unknown:
        parser.error(f"no mutant '{unknown[0]}'; there are {', '.join(one.name for one in mutants)}")
    wanted = [one for one in mutants if not given.names or one.name in given.names]
    outcomes = []
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        tree = Path(folder)
        copied_tree(tree)
        wrong = noticed_by(tree, sorted({test for one in wanted for test in one.tests}), None)
        if wrong:
            print(f"without any mutant these fail: {wrong}", file=sys.stderr)
            return 2
        for mutant in wanted:
            begin, path = time.perf_counter(), tree / mutant.file
            longest_s = COMPILING_S + SLOWER * seconds_of(mutant.tests, tree / REPORT)
            sound = path.read_text()
            path.write_text(mutant.applied(sound))
            outcomes.append(Outcome(mutant, noticed_by(tree, mutant.tests, longest_s), time.perf_counter() - begin))
            path.write_text(sound)
            last = outcomes[-1]
            print(f"{mutant.name}: {last.by or 'NOT NOTICED'} ({last.seconds:.0f} s)", flush=True)
            if given.table is not None:
                given.table.write_text(table(outcomes))
    left = [one.mutant.name for one in outcomes if not one.by]
    print(f"{len(outcomes) - len(left)} of {len(outcomes)} noticed" + (f"; not: {', '.join(left)}" if left else ""))
    return 1 if left else 0


if __name__ == "__main__":
    sys.exit(main())
