"""Rows of a suite's page: expectation and verdict separately, the figure nearest to its limit, the history."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from markupsafe import Markup

from reports.content import content_digest
from reports.error_tables import Cell, number_cell
from reports.glossary import term
from reports.margins import NEAR, share_used
from reports.page import OF_EVERY_RUN, relative_address
from reports.record import Metric, RunRecord
from reports.suite.history import MOST_DRAWN, PastResult
from reports.suite.sparkline import sparkline
from reports.units import duration, figure, shown

MUST = {"pass": "must pass", "fail": "must fail", "caught": "must be caught", "diagnosed": "must be diagnosed"}
AS_IT_MUST = {"pass": "passed", "fail": "failed", "caught": "caught", "diagnosed": "diagnosed"}
HEADLINES = ("position_rms", "relative_accuracy")
"""Metrics whose history is drawn: the first of these that has a limit, else the scenario's own first limit."""


@dataclass(frozen=True)
class SuiteResult:
    """Data of one scenario for a suite's page."""

    name: str
    title: str
    tier: str
    expect: str
    record: RunRecord | None
    """None where the scenario did not run to its end."""
    error: str = ""
    """Reason why it did not."""
    complaints: tuple[str, ...] = ()
    """Regressions against the baselines, and missing metrics."""
    seconds: float = 0.0
    picture: str = ""
    """Inline SVG."""

    @property
    def as_it_must(self) -> bool:
        """Whether the scenario ran, its verdict is the expected one, and there is no regression."""
        return self.record is not None and self.record.passed and not self.error and not self.complaints


def verdict(result: SuiteResult) -> tuple[str, str]:
    """Return the outcome of the scenario, in capitals where it is not the required one, and the reason."""
    record = result.record
    if record is None or result.error:
        return "DID NOT RUN" if record is None else "NOT WRITTEN", result.error
    if record.not_judged and not any(metric.passed is False for metric in record.metrics):
        return "NOT JUDGED", record.verdict
    if not record.passed:
        wrong = [broken_words(metric) for metric in record.metrics if metric.as_it_must is False]
        if record.expect == "pass":
            did = "FAILED"
        elif record.expect in ("caught", "diagnosed"):
            did = f"NOT {record.expect.upper()}"
        else:
            did = "FAILED OTHERWISE" if any(m.passed is False for m in record.metrics) else "PASSED"
        return did, "; ".join(wrong) or record.verdict
    if result.complaints:
        return "WORSE", "; ".join(result.complaints)
    return AS_IT_MUST[record.expect], ""


def broken_words(metric: Metric) -> str:
    """Return a metric beside the limit that it breaks: position_rms 0.117 > 0.1 mm."""
    if metric.within is not None:
        (value, low, high), unit = shown((metric.value, *metric.within), metric.unit, metric.name)
        return f"{metric.name} {figure(value)} outside {figure(low)} to {figure(high)} {unit}".rstrip()
    assert metric.limit is not None
    (value, limit), unit = shown((metric.value, metric.limit), metric.unit, metric.name)
    sign = ">" if metric.sense == "at_most" else "<"
    return f"{metric.name} {figure(value)} {sign} {figure(limit)} {unit}".rstrip()


def nearest(record: RunRecord) -> tuple[Metric, float] | None:
    """Return the metric that uses the largest share of its limit or range, and that share; None without any."""
    used = [(metric, share) for metric in record.metrics if (share := share_used(metric)) is not None]
    return max(used, key=lambda pair: pair[1]) if used else None


def headline(record: RunRecord) -> Metric | None:
    """Return the metric whose history is drawn; for a control, the one whose limit its fault must break."""
    faulty = [m for m in record.metrics if m.within is not None] if record.expect == "fail" else []
    limited = [metric for metric in record.metrics if metric.limit is not None]
    main = [metric for name in HEADLINES for metric in limited if metric.name == name]
    own = [metric for metric in limited if metric.name not in OF_EVERY_RUN]
    return next(iter((*faulty, *main, *own, *limited, *record.metrics)), None)


def row(result: SuiteResult, past: Sequence[PastResult], out: Path, page: Path) -> dict[str, Any]:
    """Return the template's row. ``past``: the whole history; ``out``: run folders; ``page``: file to be written."""
    record, folder = result.record, out / result.name
    did, why = verdict(result)
    state = "good" if result.as_it_must else "bad"
    pages = [
        (text, relative_address(folder / name, page))
        for text, name in (("run's page", "report.html"), ("calibration", "calibration.html"))
        if record is not None and (folder / name).is_file()
    ]
    close = None if record is None else nearest(record)
    if state == "good" and close is not None and close[1] >= NEAR:
        state = "near"
    return {
        "name": result.name,
        "title": result.title or result.name,
        "family": result.name.split("/")[0] if "/" in result.name else "(none)",
        "tier": result.tier,
        "must": MUST[result.expect],
        "did": did,
        "why": why,
        "state": state,
        "pages": pages,
        "budget": bool(record is not None and record.error_budget and pages),
        "near": _near(close),
        "bars": [] if record is None else [_bar(metric) for metric in record.metrics if metric.limit is not None],
        "sentence": "" if record is None else record.verdict,
        "history": {} if record is None else _history(record, past),
        "time": Cell(duration(result.seconds) if result.seconds else "–", result.seconds or ""),
        "picture": Markup(result.picture),
    }


def _near(close: tuple[Metric, float] | None) -> dict[str, Any]:
    if close is None:
        return {"cell": Cell("–", ""), "metric": "", "width": 0}
    metric, share = close
    cell = number_cell(float(f"{100 * share:.3g}"), "%")
    return {"cell": cell, "metric": metric.name, "width": round(min(100 * share, 100), 1)}


def _bar(metric: Metric) -> dict[str, Any]:
    """Return one limit of a scenario: value, limit or range, and the used share of it."""
    bounds = metric.within or (metric.limit or 0.0,)
    numbers, unit = shown((metric.value, *bounds), metric.unit, metric.name)
    sign = "≤" if metric.sense == "at_most" else "≥"
    ends = [figure(number) for number in numbers[1:]]
    share = share_used(metric)
    return {
        "name": metric.name,
        "term": term(metric.name),
        "value": f"{figure(numbers[0])} {unit}".rstrip(),
        "limit": f"{ends[0]} to {ends[1]} {unit}".rstrip() if metric.within else f"{sign} {ends[0]} {unit}".rstrip(),
        "share": "–" if share is None else f"{figure(float(f'{100 * share:.3g}'))} %",
        "width": None if share is None else round(min(100 * share, 100), 1),
        "good": metric.as_it_must,
    }


def _history(record: RunRecord, past: Sequence[PastResult]) -> dict[str, Any]:
    """Return drawings of the headline's history, small and large, and a description in words."""
    metric = headline(record)
    if metric is None:
        return {}
    own = [one for one in past if one.scenario == record.scenario]
    alike = [one for one in own if one.content == content_digest(record)]
    drawn = [one for one in alike if metric.name in one.values][-MOST_DRAWN:]
    if not drawn:
        return {}
    commits = len({one.commit for one in drawn})
    words = f"{figure(len(drawn))} result{'' if len(drawn) == 1 else 's'} of {figure(commits)} commit"
    words += "" if commits == 1 else "s"
    if others := len(own) - len(alike):
        words += f"; {figure(others)} of other settings or seeds are not drawn"
    key = float(f"{drawn[-1].values[metric.name]:.9g}")
    small, large = (Markup(sparkline(metric, drawn, size)) for size in (False, True))
    return {"metric": metric.name, "small": small, "large": large, "words": words, "key": key}
