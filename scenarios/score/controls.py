"""Verdict on a control: its fault must show in the derived ranges, and all other limits must hold."""

from collections.abc import Mapping

import numpy as np

from reports.metrics import METRICS
from scenarios.types import Score


def control_verdict(
    scores: Mapping[str, Score],
    limits: Mapping[str, float | tuple[float, float]],
    met: Mapping[str, bool],
    breaks: Mapping[str, tuple[float, float]],
) -> tuple[bool, str]:
    """Return whether a control fails as it must, and the same in words.

    ``limits``, ``met``: the limit of each limited metric, and whether it is met; ``breaks``: the ranges in which the
    broken metrics must lie, in their units. A metric without a value lies in no range.
    """
    wrong = []
    found = []
    for name, (low, high) in breaks.items():
        value = _value(scores, name)
        wanted = _range(low, high)
        if low <= value <= high:
            found.append(f"{name} {value:.4g} in {wanted}")
        else:
            wrong.append(f"{_shown(name, value)} outside {wanted}")
    for name, holds in met.items():
        if not holds and name not in breaks:
            limit = limits[name]
            side = "below" if METRICS[name].sense == "at_least" else "above"
            where = f"{side} its limit {limit:.4g}" if isinstance(limit, float) else f"outside {_range(*limit)}"
            wrong.append(f"{_shown(name, _value(scores, name))} {where}")
    if wrong:
        return False, f"control broken: {'; '.join(wrong)}"
    return True, f"fails as it must: {', '.join(found)}"


def _range(low: float, high: float) -> str:
    return f"[{low:.4g}, {high:.4g}]"


def _value(scores: Mapping[str, Score], name: str) -> float:
    return scores[name].value if name in scores else float("nan")


def _shown(name: str, value: float) -> str:
    return f"{name} {value:.4g}" if np.isfinite(value) else f"{name} (not measured)"
