"""Figures over the values of one key: one panel for each metric, with 95 % intervals and limits."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from reports.comparison.plots import COLUMNS, side_by_side
from reports.plot_style import BLUE, DOTTED, VERMILION, Picture, house_style, svg_text
from reports.record import Metric, RunRecord
from reports.units import figure, shown

ALWAYS = ("position_rms", "calibration_volume_rms", "completeness")
"""Metrics that are drawn wherever they are known, with or without a limit."""
MOST_METRICS, MOST_TICKS = 9, 8


def series_metrics(records: Sequence[RunRecord]) -> list[str]:
    """Return the names of the metrics to draw: ``ALWAYS`` and those with limits, if two runs have them."""
    limited = [m.name for record in records for m in record.metrics if m.limit is not None or m.within is not None]
    names = dict.fromkeys([*ALWAYS, *limited])
    return [name for name in names if len(_known(name, records)) >= 2][:MOST_METRICS]


def figures_over(key: str, values: Sequence[str], records: Sequence[RunRecord]) -> Picture | None:
    """Draw the metrics of ``records`` over ``values`` of ``key``, one each; None where no two runs share a metric.

    Numbers are drawn at their positions on the axis, other values side by side.
    """
    names = series_metrics(records)
    if not names:
        return None
    at, numbers = _places(values)
    with house_style():
        drawing, panels = side_by_side(len(names), 1.9)
        told = [_draw(axes, name, at, _known(name, records)) for axes, name in zip(panels, names, strict=True)]
        for axes in panels:
            if not numbers:
                axes.set_xticks(at, values)
            elif len(at) <= MOST_TICKS:
                axes.set_xticks(at, [f"{x:g}" for x in at])
        for axes in panels[-COLUMNS:]:
            axes.set_xlabel(key)
        alt = f"Figures over {key}, {values[0]} to {values[-1]}: {'; '.join(told)}."
        text = f"Each figure over {key}; bars: its 95 % interval within the run; dotted: its limit. Where intervals "
        text += (
            "overlap, the values are not told apart. Each run has one calibration; their scatter is not in the bars."
        )
        return Picture("over", f"Figures over {key}", text, alt, svg_text(drawing, "over", alt))


def _known(name: str, records: Sequence[RunRecord]) -> list[tuple[int, Metric]]:
    """Return (number, metric) of the runs that have a metric."""
    found = ((k, record.metric(name)) for k, record in enumerate(records))
    return [(k, metric) for k, metric in found if metric is not None and np.isfinite(metric.value)]


def _draw(axes: Axes, name: str, at: Sequence[float], known: Sequence[tuple[int, Metric]]) -> str:
    """Draw one metric, and return its first and last value in words."""
    largest = max((metric for _, metric in known), key=lambda metric: abs(metric.value))
    (scaled,), unit = shown((largest.value or 1.0,), largest.unit, name)
    factor = scaled / (largest.value or 1.0)
    axes.plot([at[k] for k, _ in known], [factor * m.value for _, m in known], "o-", color=BLUE, markersize=4.5)
    for k, metric in known:
        axes.plot(
            [at[k]] * 2, [factor * end for end in metric.ci95 or (metric.value,) * 2], color=BLUE, linewidth=2.2
        )
    for bound in {b for _, m in known for b in m.within or (() if m.limit is None else (m.limit,))}:
        axes.axhline(factor * bound, color=VERMILION, linestyle=DOTTED)
    axes.set_title(f"{name} [{unit}]" if unit else name)
    axes.margins(x=0.12, y=0.15)
    ends = [figure(factor * known[k][1].value) for k in (0, -1)]
    return f"{name} from {ends[0]} to {ends[1]} {unit}".rstrip()


def _places(values: Sequence[str]) -> tuple[list[float], bool]:
    """Return the positions of the values on the axis, and whether these are the values' own numbers."""
    try:
        return [float(value) for value in values], True
    except ValueError:
        return [float(k) for k in range(len(values))], False
