"""Comparability of two runs' figures, and whether comparable figures are better, worse or the same."""

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from reports.compare import SMALLEST_SHARE, numerical_versions, reading, worsening
from reports.content import claim, content, settings
from reports.record import RunRecord

NAMED = 3
"""Most differing settings that a sentence names."""
Verdict = Literal["better", "worse", "same", "not comparable"]


@dataclass(frozen=True)
class MetricChange:
    """A metric against the same one of another run."""

    verdict: Verdict
    why: str = ""
    """Reason why the metric is not comparable."""
    share: float | None = None
    """(value - other value) / size of the other value; None where that size is 0."""


def not_comparable(record: RunRecord, first: RunRecord) -> str:
    """Return in words why figures of ``record`` and ``first`` cannot be compared; "" where they can.

    Runs are comparable if they are of one scenario with the same settings and source of frames, and both are expected
    to pass. Another seed is another sample of the same: it is comparable, with wider intervals.
    """
    if record.scenario != first.scenario:
        return f"another scenario ({first.scenario})"
    if record.expect != first.expect:
        return f"expected to {record.expect}, the other to {first.expect}"
    if record.expect != "pass":
        return "a control: its figures are meant to be bad, and must lie in ranges"
    if record.source != first.source:
        return f"frames of {record.source}, the other's of {first.source}"
    if not settings(record) or not settings(first):
        return "settings are not recorded"
    here, there = content(record), content(first)
    other = [key for key in sorted({*here, *there}) if key != "seed" and here.get(key) != there.get(key)]
    if other:
        more = f" and {len(other) - NAMED} more" if len(other) > NAMED else ""
        return f"other settings: {', '.join(other[:NAMED])}{more}"
    return ""


def change(record: RunRecord, first: RunRecord, name: str) -> MetricChange | None:
    """Return the change of metric ``name`` from ``first`` to ``record`` (comparable runs); None where one lacks it.

    Better and worse are by the rule of ``reports.compare`` in both directions: by more than 2 %, by more than the
    interval of the difference, and by more than twice the spread that either states. Else it is the same.
    """
    new, old = record.metric(name), first.metric(name)
    if new is None or old is None:
        return None
    share = (new.value - old.value) / abs(old.value) if old.value and np.isfinite(new.value) else None
    if new.aligned_by != old.aligned_by:
        return MetricChange("not comparable", f"aligned by {new.aligned_by}, the other by {old.aligned_by}")
    how, here, there = reading(old), record.provenance, first.provenance
    if how.speed and any(here.get(key) != there.get(key) for key in ("platform", "processor")):
        return MetricChange("not comparable", "a speed on another machine", share)
    spread = max(new.spread or 0.0, old.spread or 0.0) or None
    moved = abs(new.value - old.value) > SMALLEST_SHARE * (abs(old.value) if how.wanted is None else how.wanted)
    if moved and spread is None and (new.ci95 is None or old.ci95 is None):
        same_numerics = numerical_versions(record) == numerical_versions(first)
        same_numerics = same_numerics and here.get("processor") == there.get("processor")
        unlike = "it is a speed" if how.speed else "seeds differ" if record.seed != first.seed else ""
        unlike = unlike or ("" if same_numerics else "versions or processors differ")
        if unlike:
            return MetricChange("not comparable", f"{unlike}, and no interval of it is known", share)
    new, old = replace(new, spread=spread), replace(old, spread=spread)
    if worsening(record, new, first, old) is not None:
        return MetricChange("worse", share=share)
    if worsening(first, old, record, new) is not None:
        return MetricChange("better", share=share)
    return MetricChange("same", share=share)


def differences(records: tuple[RunRecord, ...]) -> list[dict[str, Any]]:
    """Return the differences among runs, most important first: rows of group, key and one text for each run."""
    columns = [
        {
            ("Run", "scenario"): one.scenario, ("Run", "expected to"): one.expect, ("Run", "source"): one.source,
            ("Run", "seed"): one.seed, ("Run", "duration [s]"): content(one).get("capture.duration_s"),
            ("Run", "rig"): one.rig, ("Run", "model gap"): one.model_gap,
            **{("Settings", key): value for key, value in content(one).items() if key not in _SHOWN_ABOVE},
            **{("Claim", key): value for key, value in claim(one).items() if key != "expect"},
            **{("Program", key): one.provenance.get(key) for key in ("git", "platform", "processor")},
            **{("Program", key): value for key, value in one.provenance.get("versions", {}).items()},
        }
        for one in records
    ]  # fmt: skip
    rows = []
    for group in ("Run", "Settings", "Claim", "Program"):
        for key in dict.fromkeys(key for column in columns for key in column if key[0] == group):
            values = [column.get(key) for column in columns]
            if any(value != values[0] for value in values):
                rows.append(
                    {"group": group, "key": key[1], "values": ["–" if v in (None, "") else _text(v) for v in values]}
                )
    return rows


_SHOWN_ABOVE = ("seed", "capture.duration_s", "model_gap")


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:g}" if isinstance(value, float) else str(value)
