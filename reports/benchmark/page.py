"""Writes the leaderboard of a benchmark: one self-contained HTML file that opens offline."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from reports.glossary import BENCHMARK_COLUMNS, Term, term
from reports.page import write_rendered
from reports.units import figure

SCRIPTS = {"sort": "sort.js"}
BOARDS = {
    "images": (
        "From images to points",
        "Each entrant gets images and cameras, and finds points by itself: detection, correspondence, triangulation.",
    ),
    "matched": (
        "Correspondence given",
        "The truth says which of an entrant's own image points are of one marker: detection and triangulation are "
        "compared. Where discs overlap, an image point of two markers is given to one of them.",
    ),
}
METRICS = ("ospa", "position_rms", "position_p95", "position_max", "completeness", "ghosts_per_frame")
LABELS = {
    "ospa": "OSPA [mm]",
    "position_rms": "rms [mm]",
    "position_p95": "95 % [mm]",
    "position_max": "largest [mm]",
    "completeness": "complete [%]",
    "ghosts_per_frame": "ghosts/frame",
}
SCALES = {"completeness": 100.0, "ghosts_per_frame": 1.0}


def write_leaderboard(path: Path, document: Mapping[str, Any]) -> None:
    """Write the page of a result to ``path``, whole or not at all; the same result gives the same bytes."""
    titles = {one["name"]: one["title"] for one in document["entrants"]}
    failures = [row for row in document["rows"] if row["error"] or row["again"]]
    write_rendered(
        path,
        "benchmark/leaderboard.html.j2",
        sentence=_sentence(document, failures),
        seeds=_seeds(document),
        boards=[_board(document, name, titles) for name in BOARDS if document["overall"][name]],
        failures=[
            (titles[row["entrant"]], row["set"], row["error"] or f"not the same twice: {row['again']}")
            for row in failures
        ],
        sets=document["sets"],
        left_out=document["left_out"],
        entrants=[
            {**one, "installed": ", ".join(one["installed"]) or "this program's own environment"}
            for one in document["entrants"]
        ],
        terms=[
            (LABELS[name], one) for name in METRICS if (one := BENCHMARK_COLUMNS.get(name) or term(name)) is not None
        ],
        limit=figure(document["limit_s"]),
        provenance=json.dumps(document["provenance"], indent=2, ensure_ascii=False),
        scripts=SCRIPTS,
    )


def _term(name: str) -> Term | None:
    return BENCHMARK_COLUMNS.get(name) or term(name)


def _sentence(document: Mapping[str, Any], failures: list[Any]) -> str:
    parts = [f"{len(document['entrants'])} entrants on {len(document['sets'])} data sets."]
    for name, (title, _) in BOARDS.items():
        rows = document["overall"][name]
        if rows:
            parts.append(f"{title}: least OSPA has {rows[0]['title']}, {figure(1e3 * rows[0]['ospa_m'])} mm.")
    if failures:
        parts.append(f"{len(failures)} without a result, or with another one the second time: they are named below.")
    elif document["twice"]:
        parts.append("All were run twice, and every figure was the same.")
    return " ".join(parts)


def _seeds(document: Mapping[str, Any]) -> str:
    return (
        f"Seeds are drawn from the passphrase {document['passphrase']!r} ({document['told']}); its SHA-256 is "
        f"{document['commitment_sha256']}. Settings were tuned on other seeds; mosca's are its defaults."
    )


def _board(document: Mapping[str, Any], name: str, titles: Mapping[str, str]) -> dict[str, Any]:
    title, about = BOARDS[name]
    rows = [row for row in document["rows"] if row["table"] == name]
    least = {
        one: min(r["metrics"]["ospa"]["value"] for r in rows if r["set"] == one) for one in {r["set"] for r in rows}
    }
    return {
        "title": title,
        "about": about,
        "overall": [
            {
                "title": one["title"],
                "ospa": figure(1e3 * one["ospa_m"]),
                "key": one["ospa_m"],
                "interval": " .. ".join(figure(1e3 * end) for end in one["ospa_ci95_m"]),
                "rms": "–" if one["rms_m"] is None else figure(1e3 * one["rms_m"]),
                "rms_key": "" if one["rms_m"] is None else one["rms_m"],
                "complete": f"{100 * one['completeness']:.2f}",
                "ghosts": figure(one["ghosts_per_frame"]),
                "best": one["best"],
                "sets": one["sets"],
                "failed": one["failed"],
            }
            for one in document["overall"][name]
        ],
        "labels": [LABELS[metric] for metric in METRICS],
        "rows": [_row(row, titles, row["metrics"]["ospa"]["value"] == least[row["set"]]) for row in rows],
    }


def _row(row: Mapping[str, Any], titles: Mapping[str, str], best: bool) -> dict[str, Any]:
    cells = []
    for metric in METRICS:
        found = row["metrics"].get(metric)
        if found is None:
            cells.append(("–", "", ""))
            continue
        scale = SCALES.get(metric, 1e3)
        ends = found["ci95"]
        interval = "" if ends is None else " .. ".join(figure(scale * end) for end in ends)
        cells.append((figure(scale * found["value"]), found["value"], interval))
    return {
        "set": row["set"],
        "title": titles[row["entrant"]],
        "cells": cells,
        "best": best and not row["error"],
        "seconds": figure(row["seconds"]),
        "seconds_key": row["seconds"],
        "peak": "–" if row["peak_mb"] is None else f"{row['peak_mb']:.0f}",
        "peak_key": "" if row["peak_mb"] is None else row["peak_mb"],
        "error": row["error"],
        "settings": ", ".join(f"{key} = {value}" for key, value in row["settings"].items()) or "defaults",
    }
