"""Limits that are met so easily that they may be in another unit than was meant."""

from collections.abc import Iterable

from reports.metrics import METRICS
from reports.record import Metric
from reports.units import figure, shown

UNSEEN_COUNT = 3.0
"""Upper 95 % bound of a Poisson count of which none was seen (the rule of three, -ln 0.05): a count of 0 is taken as
no more than this many."""


def times_looser(metric: Metric) -> float:
    """Return how many times a met limit could be tightened to the measured value; 0 where that says nothing."""
    value = metric.value
    if metric.limit is None or not metric.passed:
        return 0.0
    if metric.sense == "at_least":
        return value / metric.limit
    if value == 0 and METRICS[metric.name].quantity == "count":
        value = UNSEEN_COUNT / metric.n if metric.name == "ghosts_per_frame" and metric.n else UNSEEN_COUNT
    return metric.limit / value if value > 0 else 0.0


def loose_limits(metrics: Iterable[Metric], factor: float) -> list[str]:
    """Return a line for each limit that is more than ``factor`` times looser than what was measured."""
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
