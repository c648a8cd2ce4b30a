"""Writes the page that compares runs."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from reports.compare import total_seconds
from reports.comparison.changes import MetricChange, change, differences, not_comparable
from reports.comparison.plots import MOST_PANELS, comparison_pictures
from reports.error_tables import Cell
from reports.glossary import COMPARISON_COLUMNS, term
from reports.page import badge, bound, relative_address, write_rendered
from reports.plot_style import Picture
from reports.record import Metric, RunRecord
from reports.units import duration, figure, shown

MARKS = {"worse": "↑ worse", "better": "↓ better", "same": "= same", "not comparable": "not comparable"}
TONES = {"worse": "bad", "better": "good", "same": "", "not comparable": "muted"}
SCRIPTS = {"sort": "sort.js", "filter": "comparison/comparison.js"}


def write_comparison_page(
    path: Path,
    records: Sequence[RunRecord],
    labels: Sequence[str] = (),
    pages: Sequence[Path | None] = (),
    first: Picture | None = None,
) -> None:
    """Write ``records`` side by side to ``path``: differences, figures by runs, plots with the same axes.

    A run is compared with the first run of its scenario. ``labels``: names of the runs (folder names, for example),
    one each; else their numbers. ``pages``: the runs' own pages, one each, or none. ``first``: a picture above all
    else.
    """
    names = list(labels) or [f"run {i + 1}" for i in range(len(records))]
    firsts = [next(k for k, r in enumerate(records) if r.scenario == record.scenario) for record in records]
    reasons = [not_comparable(record, records[f]) for record, f in zip(records, firsts, strict=True)]
    changes = [
        {} if i == f or reasons[i] else {m.name: change(record, records[f], m.name) for m in record.metrics}
        for i, (record, f) in enumerate(zip(records, firsts, strict=True))
    ]
    runs = [
        {
            "label": names[i],
            "address": _address(pages[i] if pages else None, path),
            "title": record.title,
            "scenario": record.scenario,
            "badge": badge(record),
            "against": names[firsts[i]] if firsts[i] != i else "",
            "reason": reasons[i],
            "unpaired": not reasons[i] and record.seed != records[firsts[i]].seed,
        }
        for i, record in enumerate(records)
    ]
    metrics = list(dict.fromkeys(m.name for record in records for m in record.metrics))
    rows = [
        {
            "name": name,
            "term": term(name),
            "cells": cells,
            "verdicts": "|".join(sorted({c["verdict"] for c in cells})),
        }
        for name in metrics
        for cells in [
            [_cell(r.metric(name), of.get(name), run) for r, of, run in zip(records, changes, runs, strict=True)]
        ]
    ]
    write_rendered(
        path,
        "comparison/comparison.html.j2",
        first=first,
        runs=runs,
        rows=rows,
        differences=differences(tuple(records)),
        seconds=[Cell(duration(total_seconds(r)), total_seconds(r)) if r.timings else Cell("–", "") for r in records],
        sentence=_sentence(records, runs, changes) if first is None else f"{_passed(records)} are as claimed.",
        pictures=comparison_pictures(records, names),
        left_out=max(0, len(records) - MOST_PANELS),
        columns=COMPARISON_COLUMNS,
        scripts=SCRIPTS,
    )


def _sentence(records: Sequence[RunRecord], runs: list[dict[str, Any]], changes: list[dict[str, Any]]) -> str:
    """Return in words how many runs are as claimed and comparable, and how many figures are worse and better."""
    found = [one.verdict for of in changes for one in of.values() if one is not None]
    worse, better = found.count("worse"), found.count("better")
    text = f"{_passed(records)} are as claimed. "
    others = [run for run in runs if run["against"]]
    if not others:
        return text + "No two are of one scenario: nothing is compared."
    apart = [run for run in others if run["reason"]]
    if len(apart) < len(others):
        text += f"{figure(worse) if worse else 'No'} figure{'' if worse == 1 else 's'} worse, "
        text += f"{figure(better) if better else 'none'} better, against the first run of the same scenario. "
    if apart:
        text += f"{figure(len(apart))} of {figure(len(others))} cannot be compared with it: see why below."
    return text.strip()


def _passed(records: Sequence[RunRecord]) -> str:
    return f"{sum(r.passed for r in records)} of {len(records)} runs"


def _address(page: Path | None, path: Path) -> str:
    return "" if page is None or not page.is_file() else relative_address(page, path)


def _cell(metric: Metric | None, found: MetricChange | None, run: dict[str, Any]) -> dict[str, Any]:
    """Return one figure of one run: value, interval, limit, and change."""
    if metric is None:
        return {"value": "", "key": "", "verdict": "", "why": ""}
    ends = metric.ci95 or ()
    numbers, unit = shown((metric.value, *ends), metric.unit, metric.name)
    notes = [f"{figure(numbers[1])} … {figure(numbers[2])}"] if ends else []
    notes += [f"limit {bound(metric)}"] if metric.limit is not None else []
    verdict, why, mark = "", "", ""
    if found is not None:
        verdict, why = found.verdict, found.why
        mark = MARKS[verdict]
        if found.share is not None and abs(found.share) >= 0.0005:
            mark += f" ({100 * found.share:+.1f} %)".replace("-", "−")
    elif run["reason"]:
        verdict, why, mark = "not comparable", run["reason"], MARKS["not comparable"]
    return {
        "value": figure(numbers[0]),
        "unit": unit,
        "key": float(f"{metric.value:.9g}"),
        "broken": metric.as_it_must is False,
        "notes": notes,
        "mark": mark,
        "tone": TONES.get(verdict, ""),
        "verdict": verdict,
        "why": why,
    }
