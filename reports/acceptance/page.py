"""Writes the page of an acceptance test: one self-contained HTML file that opens offline."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from reports.acceptance.plots import acceptance_pictures
from reports.acceptance.words import cluster_row, figure_rows, note_lines
from reports.claim.page import BADGES, SCRIPTS
from reports.page import write_rendered
from reports.units import figure


def write_acceptance_page(path: Path, document: Mapping[str, Any]) -> None:
    """Write the page of a result to ``path``, whole or not at all; the same result gives the same bytes."""
    clusters = document["clusters"]
    write_rendered(
        path,
        "acceptance/acceptance.html.j2",
        title=document["title"],
        description=document["description"],
        name=document["name"],
        source=document["source"],
        badge=BADGES[document["verdict"]],
        sentence=acceptance_sentence(document),
        rows=[(row, BADGES.get(row.decision)) for row in figure_rows(document)],
        stretches=[] if clusters is None else [cluster_row(one) for one in clusters["stretches"]],
        premises=[
            one
            for part in ("lengths", "clusters")
            if document[part] is not None
            for one in document[part]["premises"]
        ],
        pictures=acceptance_pictures(document),
        notes=note_lines(document),
        not_covered=document["not_covered"],
        manner=document["manner"],
        inputs=document["inputs"],
        provenance=json.dumps(document["provenance"], indent=2, ensure_ascii=False),
        scripts=SCRIPTS,
    )


def acceptance_sentence(document: Mapping[str, Any]) -> str:
    """Return a result in a sentence."""
    rows = [row for row in figure_rows(document) if row.limit != "none"]
    counts = {kind: sum(row.decision == kind for row in rows) for kind in BADGES}
    told = ", ".join(f"{figure(count)} {kind}" for kind, count in counts.items() if count)
    text = f"{figure(len(rows))} figures with a limit: {told}. "
    if document["verdict"] == "undecided":
        text += "A limit lies within an expanded uncertainty of what was found, or a premise of the test is not met."
    return text.strip()
