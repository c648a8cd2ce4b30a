"""Results of suites over commits: a file to which suites append one JSON line for each scenario and run."""

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from mosca.data.files.bounded import parse_json, read_text
from mosca.errors import InputError
from reports.content import content_digest
from reports.record import RunRecord

MOST_DRAWN = 60
"""Most results of one scenario that a page draws: the latest ones."""


@dataclass(frozen=True)
class PastResult:
    """One scenario's result in one run of a suite."""

    time: str
    """Time when the suite ended, UTC, as ISO 8601."""
    commit: str
    """Commit of the program; with "+" where files differed from it, "unknown" outside a checkout."""
    scenario: str
    content: str
    """Digest of the settings that affect figures: results with other settings belong to another history."""
    as_it_must: bool
    seconds: float
    values: Mapping[str, float]
    """Metric -> value, in the record's unit; finite values only."""


def past_result(record: RunRecord, as_it_must: bool, seconds: float, time: str) -> PastResult:
    """Return the line of a history for a scenario that ran."""
    values = {metric.name: metric.value for metric in record.metrics if math.isfinite(metric.value)}
    commit = str(record.provenance.get("git", "unknown"))
    return PastResult(time, commit, record.scenario, content_digest(record), as_it_must, round(seconds, 2), values)


def read_history(path: Path) -> list[PastResult]:
    """Return the results in a history, in the order in which they were appended; none where there is no such file.

    InputError names a line that is not a result.
    """
    if not path.exists():
        return []
    found = []
    for number, line in enumerate(read_text(path, "a history of suites").splitlines(), start=1):
        if line.strip():
            try:
                found.append(_result(parse_json(line)))
            except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
                raise InputError(
                    f"{path}: line {number}: not a result of a suite ({error}); remove that line"
                ) from None
    return found


def append_history(path: Path, results: Iterable[PastResult]) -> None:
    """Append results to a history, one line each, in one write; a missing file is made."""
    text = "".join(json.dumps(asdict(one), allow_nan=False) + "\n" for one in results)
    if text:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a", encoding="utf-8") as file:
            file.write(text)


def _result(document: Any) -> PastResult:
    names = [field.name for field in fields(PastResult)]
    one = PastResult(**{name: document[name] for name in names})
    texts = all(isinstance(getattr(one, name), str) for name in ("time", "commit", "scenario", "content"))
    if not texts or not isinstance(one.as_it_must, bool) or not _number(one.seconds):
        raise ValueError("a key has a value of another kind")
    if not isinstance(one.values, dict) or not all(_number(value) for value in one.values.values()):
        raise ValueError("'values' are not all numbers")
    return one


def _number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
