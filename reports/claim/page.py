"""Writes the page of a claim: one self-contained HTML file that opens offline."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from reports.claim.plots import claim_pictures
from reports.claim.words import claim_words, value_text
from reports.glossary import term
from reports.page import write_rendered
from reports.units import figure

WORST = 20
"""Runs in the table: those that failed, then the worst ones."""
BADGES = {
    "conforming": {"text": "Conforming", "sign": "✓", "tone": "good"},
    "not conforming": {"text": "Not conforming", "sign": "✗", "tone": "bad"},
    "undecided": {"text": "Undecided", "sign": "–", "tone": ""},
}
SCRIPTS = {"sort": "sort.js"}


def write_claim_page(path: Path, document: Mapping[str, Any]) -> None:
    """Write the page of a result to ``path``, whole or not at all; the same result gives the same bytes."""
    write_rendered(
        path,
        "claim/claim.html.j2",
        title=document["title"],
        description=document["conditions"]["description"],
        badge=BADGES[document["verdict"]],
        sentence=_sentence(document),
        claims=[
            {
                "words": claim_words(one),
                "badge": BADGES[one["verdict"]],
                "runs": one["runs"],
                "note": one["note"],
                "metric": one["metric"],
                "term": term(one["metric"]),
            }
            for one in document["claims"]
        ],
        confidence=f"{100 * document['confidence']:.4g} %",
        pictures=claim_pictures(document),
        metrics=list(dict.fromkeys(one["metric"] for one in document["claims"])),
        worst=_worst(document),
        conditions=_conditions(document),
        provenance=json.dumps(document["provenance"], indent=2, ensure_ascii=False),
        scripts=SCRIPTS,
    )


def _sentence(document: Mapping[str, Any]) -> str:
    failed = document["failed"]
    text = (
        f"{figure(document['runs'])} of at most {figure(document['looks'][-1])} runs were made"
        + (f", {figure(failed)} of them failed. " if failed else ", none failed. ")
        + f"A false verdict has a probability of at most {100 * document['error_rate']:.4g} %, whatever the looks. "
    )
    if document["verdict"] == "undecided":
        text += "The limit lies inside the interval: these runs decide nothing; allow more, or claim less."
    return text.strip()


def _worst(document: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the rows of runs that failed and of the worst ones by the first claim, each with its command."""
    first = document["claims"][0]
    name, sign = first["metric"], -1 if first["sense"] == "at_most" else 1
    runs = sorted(
        document["each_run"], key=lambda run: (not run["failed"], sign * run["metrics"].get(name, 0.0), run["run"])
    )
    of_metric = {one["metric"]: one for one in document["claims"]}
    return [
        {
            "run": run["run"],
            "cells": [
                (value_text(one, run["metrics"].get(metric)), run["metrics"].get(metric, ""))
                for metric, one in of_metric.items()
            ],
            "failed": run["failed"],
            "command": run["command"],
        }
        for run in runs[:WORST]
    ]


def _conditions(document: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the rows of fixed and varied settings."""
    given = document["conditions"]
    rows = [
        ("scenario", given["scenario"]),
        ("seed", f"{given['seed']} + number of the run: noise, paths and calibration anew"),
        ("looks", ", ".join(map(str, document["looks"]))),
    ]
    rows += [(key, f"{json.dumps(value, ensure_ascii=False)}, in all runs") for key, value in given["set"].items()]
    for draw in given["vary"]:
        rest = ", ".join(f"{key} {_plain(value)}" for key, value in draw.items() if key not in ("key", "kind", "by"))
        by = {"add": ", added to the scenario's", "scale": ", times the scenario's"}.get(draw.get("by", "set"), "")
        rows.append((draw["key"], f"{draw['kind']}: {rest}{by}"))
    return rows


def _plain(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False)
