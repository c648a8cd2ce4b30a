"""The words of a certificate, for its page and its PDF."""

from collections.abc import Mapping
from typing import Any

HEADINGS = ("Figure", "Found", "Interval", "Limit", "Decision")
KINDS = {"acceptance": "Acceptance test", "claim": "Claim over many runs", "budget": "Error budget", "run": "Run"}
RULE = (
    "Conforming: what was found keeps its limit by more than its expanded uncertainty (acceptance test) or at the "
    "stated error rate (claim); undecided: it does not, nor does it break it. Intervals are as "
    "each result states them."
)


def conclusion(document: Mapping[str, Any]) -> str:
    """Return a certificate in a sentence."""
    counted = [one for one in document["results"] if one["counts"]]
    judged = [one for one in counted if one["verdict"] is not None]
    parts = [f"{KINDS[one['kind']].lower()} of {one['name']}: {one['verdict']}" for one in judged]
    text = "; ".join(parts) + "." if parts else "No result decides whether a limit is kept."
    if document["changed"]:
        text += (
            f" Changed since their hash was taken: {', '.join(document['changed'])}; what rests on them is not shown."
        )
    return text[0].upper() + text[1:]


def hash_rows(document: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Return role, name and SHA-256 of all input files."""
    rows = []
    for one in document["results"]:
        rows.append((KINDS[one["kind"]], one["file"], one["sha256"]))
        rows += [(f"{given['what']} of it", given["file"], given["sha256"]) for given in one["inputs"]]
    return rows


def rows_of(one: Mapping[str, Any]) -> list[tuple[str, str, str, str, str]]:
    """Return a result's figures as cells under HEADINGS."""
    return [
        (row["what"], row["found"], row["interval"] or "–", row["limit"] or "–", row["decision"] or "–")
        for row in one["rows"]
    ]


def version_lines(document: Mapping[str, Any]) -> list[str]:
    """Return the commit and the versions of each result, one line each."""
    lines = []
    for one in document["results"]:
        versions = ", ".join(f"{name} {number}" for name, number in one["versions"].get("versions", {}).items())
        lines.append(f"{one['name']}: commit {one['commit']}" + (f"; {versions}" if versions else ""))
    return lines
