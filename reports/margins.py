"""Nearness of metrics to their limits, and the largest contributions to their errors."""

from collections.abc import Sequence

import numpy as np

from mosca.data.arrays import Array
from reports.evidence import Evidence
from reports.metrics import kind_of
from reports.record import Metric, RunRecord
from reports.units import figure

NEAR = 0.85
"""Share of a limit from which a figure is named as near it: a choice for reading, not a criterion."""
BUDGETED = 0.8
"""Share of a limit from which the page leads to an error budget; a broken limit does so too."""
SQUARES = ("position_rms", "relative_accuracy", "reprojection_rms")
"""Metrics that have error budgets: root mean squares, whose squares add up."""
NAMED = 3
"""Most markers, cameras or seconds that are named."""


def share_of_limit(metric: Metric) -> float | None:
    """Return the share of its limit that a metric uses up; None without a limit that can be used up."""
    limit = metric.limit
    if limit is None or metric.within is not None:
        return None
    if metric.sense == "at_most":
        return metric.value / limit if limit > 0 else None
    kind = kind_of(metric.name)
    if kind is not None and kind.quantity == "share":
        return (1 - metric.value) / (1 - limit) if limit < 1 else None
    return limit / metric.value if metric.value > 0 else None


def near_limits(record: RunRecord, evidence: Evidence) -> list[dict[str, str]]:
    """Return the metrics that use up ``NEAR`` of their limit or more, with the largest contributions to each."""
    found = []
    for metric in record.metrics:
        share = share_of_limit(metric)
        if share is None or share < NEAR:
            continue
        state = "over its limit" if metric.passed is False else "within its limit"
        why = _why(metric.name, evidence)
        found.append({"name": metric.name, "share": f"{figure(100 * share)} %", "state": state, "why": why})
    return found


def budget_wanted(record: RunRecord) -> str | None:
    """Return the first metric near or over its limit that has error budgets; None where there is none."""
    if record.source != "twin" or record.expect != "pass" or record.error_budget:
        return None
    for metric in record.metrics:
        share = share_of_limit(metric)
        if metric.name in SQUARES and (metric.passed is False or (share is not None and share >= BUDGETED)):
            return metric.name
    return None


def _why(name: str, evidence: Evidence) -> str:
    """Return in words the markers and the second that contribute most to a metric's error; "" where unknown."""
    errors = evidence.errors
    if errors is None or not len(errors.frame):
        return ""
    if name in ("position_rms", "relative_accuracy", "position_p95", "position_max"):
        squares = errors.distance_m() ** 2
        of_marker = np.bincount(errors.marker, squares, len(evidence.truth_names))
        second = np.floor(errors.time_s - errors.time_s.min()).astype(int)
        of_second = np.bincount(second, squares)
        text = f"Of the squared error {_shares(evidence.truth_names, of_marker)}"
        if len(of_second) > 1:
            worst = int(np.argmax(of_second))
            start = float(errors.time_s.min()) + worst
            share = 100 * of_second[worst] / max(of_second.sum(), 1e-300)
            text += f"; the second from {figure(round(start, 2))} s has {figure(float(share))} %"
        return text + "."
    if name in ("completeness", "hota") and evidence.marker_seen is not None:
        missed = np.maximum(evidence.marker_seen - np.bincount(errors.marker, minlength=len(evidence.truth_names)), 0)
        if missed.any():
            return f"Of the {figure(int(missed.sum()))} missed samples {_shares(evidence.truth_names, missed)}."
    return ""


def _shares(names: Sequence[str], values: Array) -> str:
    """Return the largest of ``values`` by name, as shares of their sum."""
    order = np.argsort(-values, kind="stable")[:NAMED]
    total = max(float(values.sum()), 1e-300)
    return ", ".join(f"{names[i]} has {figure(100 * float(values[i]) / total)} %" for i in order if values[i] > 0)


def share_used(metric: Metric) -> float | None:
    """Return ``share_of_limit``; for a range, the distance of the value from its middle over half the range.

    This is 1 at an end of the range and above 1 outside. None where there is no limit, or one that cannot be used up
    (0, or a share of 1).
    """
    if metric.within is None:
        return share_of_limit(metric)
    low, high = metric.within
    half = (high - low) / 2
    return abs(metric.value - (low + half)) / half if half > 0 else None
