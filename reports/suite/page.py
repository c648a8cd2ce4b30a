"""The page of a suite: one self-contained HTML file that opens offline, with one row for each scenario."""

from collections.abc import Sequence
from pathlib import Path

from reports.glossary import SUITE_COLUMNS
from reports.page import write_rendered
from reports.suite.history import PastResult
from reports.suite.rows import SuiteResult, row
from reports.units import duration, figure

SCRIPTS = {"sort": "sort.js", "suite": "suite/suite.js"}
STATES = {"bad": "not as it must", "near": "as it must, nearly missed", "good": "as it must"}


def write_suite_page(path: Path, results: Sequence[SuiteResult], past: Sequence[PastResult], out: Path) -> None:
    """Write the page of a suite to ``path``, whole or not at all. ``past``: the history, with these results.

    ``out``: folder of the run folders, whose pages are linked where they exist.
    """
    rows = [row(result, past, out, path) for result in results]
    bad = sum(one["state"] == "bad" for one in rows)
    near = sum(one["state"] == "near" for one in rows)
    commits = sorted({str(r.record.provenance.get("git", "unknown")) for r in results if r.record is not None})
    processors = sorted({str(r.record.provenance.get("processor", "unknown")) for r in results if r.record})
    write_rendered(
        path,
        "suite/suite.html.j2",
        rows=rows,
        badge={"text": "As it must be", "sign": "✓", "tone": "good"}
        if not bad
        else {"text": f"{figure(bad)} not as {'it' if bad == 1 else 'they'} must be", "sign": "✗", "tone": "bad"},
        sentence=f"{figure(len(rows) - bad)} of {figure(len(rows))} scenarios did what they must: claims held, "
        f"controls failed, faults were caught; {figure(near) if near else 'none'} of them nearly missed a limit.",
        facts=[
            ("Commit", ", ".join(commits) or "–"),
            ("Processor", ", ".join(processors) or "–"),
            ("Computing time", duration(sum(r.seconds for r in results))),
        ],
        choices=[
            ("family", "Family", [(f, f) for f in sorted({one["family"] for one in rows})]),
            ("tier", "Tier", [(t, t) for t in sorted({one["tier"] for one in rows})]),
            ("state", "Verdict", [(k, v) for k, v in STATES.items() if any(one["state"] == k for one in rows)]),
        ],
        columns=SUITE_COLUMNS,
        scripts=SCRIPTS,
    )
