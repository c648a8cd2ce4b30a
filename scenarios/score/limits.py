"""Limits that are met so easily that their unit may be wrong."""

from collections.abc import Iterable

from reports.metrics import METRICS
from reports.record import Metric
from reports.units import figure, shown

UNSEEN_COUNT = 3.0
"""Upper 95 % bound of a Poisson count with no event observed (the rule of three, -ln 0.05): a count of 0 is taken as
at most this number."""


def times_looser(metric: Metric) -> float:
    """Return the factor by which a met limit is looser than the measured value; 0 where this is not meaningful."""
    value = metric.value
    if metric.limit is None or not metric.passed:
        return 0.0
    if metric.sense == "at_least":
        return value / metric.limit if metric.limit > 0 else 0.0
    if value == 0 and METRICS[metric.name].quantity == "count":
        value = UNSEEN_COUNT / metric.n if metric.name == "ghosts_per_frame" and metric.n else UNSEEN_COUNT
    return metric.limit / value if value > 0 else 0.0


def loose_limits(metrics: Iterable[Metric], factor: float) -> list[str]:
    """Return a line for each limit that is more than ``factor`` times looser than the measured value."""
    lines = []
    for metric in metrics:
        times = times_looser(metric)
        if metric.limit is not None and times > factor:
            (value, limit), unit = shown((metric.value, metric.limit), metric.unit, metric.name)
            times_text = f"{float(f'{times:.3g}'):,.10g}"
            lines.append(
                f"{metric.name}: limit {f'{figure(limit)} {unit}'.strip()} is {times_text} times looser than the "
                f"measured {f'{figure(value)} {unit}'.strip()} (check its unit)"
            )
    return lines
