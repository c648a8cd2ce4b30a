"""Output of a suite besides its run folders: a page with one row for each scenario, and the continued history."""

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

from reports.suite.history import PastResult, append_history, past_result, read_history
from reports.suite.page import write_suite_page
from reports.suite.rows import SuiteResult
from scenarios.spec.catalog import Entry
from scenarios.suite.suite import Outcome

PAGE, HISTORY = "suite.html", "history.jsonl"


def write_suite(
    outcomes: Sequence[Outcome], entries: Sequence[Entry], out: Path, history: Path, past: Sequence[PastResult]
) -> Path:
    """Append the results to ``history``, which held ``past``; write the page into ``out`` and return its path."""
    now = datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
    results = [_result(outcome, entry) for outcome, entry in zip(outcomes, entries, strict=True)]
    new = [past_result(r.record, r.as_it_must, r.seconds, now) for r in results if r.record is not None]
    append_history(history, new)
    write_suite_page(out / PAGE, results, [*past, *new], out)
    return out / PAGE


def known_history(out: Path, history: Path | None) -> tuple[Path, list[PastResult]]:
    """Return path (``history`` or a file in ``out``) and contents of the history; to be called before a long run."""
    path = history or out / HISTORY
    return path, read_history(path)


def _result(outcome: Outcome, entry: Entry) -> SuiteResult:
    spec = entry.spec
    worse = tuple(str(one).removeprefix(f"{outcome.name}: ") for one in outcome.worse)
    gone = tuple(f"metric '{name}' of the baseline is gone" for name in outcome.gone)
    return SuiteResult(
        outcome.name, spec.title, spec.tier, spec.expect, outcome.record, outcome.error, (*worse, *gone),
        outcome.seconds, outcome.picture,
    )  # fmt: skip
